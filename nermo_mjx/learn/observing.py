"""What a policy observes: groups of readings of the real robot's sensors, with delay and noise, and its commands.

A critic receives additional values (`privileged`), because only the training needs it.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.path import PathPoint
from nermo_mjx.control.pilot import heading
from nermo_mjx.control.protocol import OBJECT_FORM, Ground
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.learn.acting import ACTION_SERVOS
from nermo_mjx.robot import LIMBS, ParameterError, Sensors
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.parameters import SCAN_POINTS, reading_names
from nermo_mjx.robot.quantity import parameter_tree, quantity
from nermo_mjx.rollout.metrics import LOADED
from nermo_mjx.shapes import Array, Scalar

Vector = Float[Array, " k"]

#: Longest delay of readings [s].
LONGEST_DELAY: Final = 0.1
_AXIS_NAMES: Final = ("x", "y", "z")


@parameter_tree
class Sensing:
    """Delay and noise of the policy's sensor readings; the noise is normal, and independent in each control tick."""

    delay: Any = quantity(0.0, "s", 0.0, LONGEST_DELAY, "age of the readings that a policy gets")
    servo_angle_noise: Any = quantity(0.0, "rad", 0.0, 1.0, "of the servos' angles")
    servo_torque_noise: Any = quantity(0.0, "N m", 0.0, 1.0, "of the servos' torques")
    motor_current_noise: Any = quantity(0.0, "A", 0.0, 1.0, "of the servos' currents")
    knee_angle_noise: Any = quantity(0.0, "rad", 0.0, 1.0, "of the knees' angles")
    gyro_noise: Any = quantity(0.0, "rad/s", 0.0, 10.0, "of the IMU's angular velocity")
    accelerometer_noise: Any = quantity(0.0, "m/s^2", 0.0, 50.0, "of the IMU's acceleration")
    projected_gravity_noise: Any = quantity(0.0, "1", 0.0, 1.0, "of the direction of gravity")
    height_scan_noise: Any = quantity(0.0, "m", 0.0, 0.05, "of the ground's heights")


@dataclasses.dataclass(frozen=True)
class Sensed:
    """A group of sensor readings that a policy observes.

    Attributes:
        read: Function from the sensors of one world and, with `ground`, the ground's height to the readings, in SI units.
        scale: Divisor of the readings, so that the observed values are about 1. The noise of the readings of the package
            is a field of `Sensing`.
        labels: Labels of the numbers of custom readings; "" for one number without a label.
        ground: Whether `read` has a second argument, a function from (x, y) in the world to the ground's height [m].
    """

    read: Callable[..., Vector]
    scale: float = 1.0
    labels: tuple[str, ...] = ()
    ground: bool = False


def projected_gravity(sensors: Sensors) -> Float[Array, " 3"]:
    """Direction of the world's -z in the IMU's frame."""
    w, x, y, z = sensors.orientation
    return -jnp.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])


def contact(sensors: Sensors) -> Float[Array, " 4"]:
    """1 for each foot with load, 0 for the others."""
    none, full = LOADED
    return jnp.clip((sensors.foot_force - none) / (full - none), 0.0, 1.0)


def current(sensors: Sensors) -> Float[Array, " k"]:
    """Current of each servo's motor [A], which increases with the magnitude of the torque (`rollout.electrical`).

    The sensor is calibrated with the constants of the published servo, for any sampled body, and ignores back-EMF.
    """
    servo = ModelParameters().servo
    per_torque = (servo.stall_current - servo.idle_current) / servo.torque_limit
    return servo.idle_current + per_torque * jnp.abs(sensors.servo_torque[: len(ACTION_SERVOS)])


def height_scan(sensors: Sensors, ground: Ground, yaw: Scalar | None = None) -> Float[Array, " 12"]:
    """Heights of the ground at `SCANNED`, relative to the height beneath the torso, clipped to +-0.05 [m].

    The grid turns with the torso's `yaw` [rad], by default the yaw of its attitude, and stays level, like the term of
    this name in Isaac Lab and mjlab, whose values are depths below the robot instead. Obstacles do not count as ground.
    """
    x, y, _ = sensors.position
    left_direction, ahead = directions(attitude(sensors.orientation)[2] if yaw is None else yaw)
    points = jnp.asarray(SCAN_POINTS)
    heights = ground(
        x + points[:, 0] * left_direction[0] + points[:, 1] * ahead[0],
        y + points[:, 0] * left_direction[1] + points[:, 1] * ahead[1],
    )
    return jnp.clip(heights - ground(x, y), -0.05, 0.05)


def directions(yaw: Scalar) -> tuple[Array, Array]:
    """Unit vectors to the left of the torso and ahead on the ground, (2,) each, for a `yaw` [rad]."""
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]), jnp.stack([jnp.sin(yaw), -jnp.cos(yaw)])


#: Readings of the robot's sensors, and heights of the ground, by names of `READINGS`. Currents have no sign, because a
#: motor's supply shows only the magnitude of the torque.
SENSED_READINGS: Final[dict[str, Sensed]] = {
    "servo_angle": Sensed(lambda s: s.servo_angle[: len(ACTION_SERVOS)]),
    "servo_torque": Sensed(lambda s: s.servo_torque[: len(ACTION_SERVOS)], 0.1),
    "motor_current": Sensed(current, 0.5),
    "knee_angle": Sensed(lambda s: s.knee_angle),
    "foot_contact": Sensed(contact),
    "gyro": Sensed(lambda s: s.gyro, 3.0),
    "accelerometer": Sensed(lambda s: s.accelerometer, 9.81),
    "projected_gravity": Sensed(projected_gravity),
    "height_scan": Sensed(height_scan, 0.01, ground=True),
}
_FORMER_READINGS: Final = {
    "servo_load": "servo_torque",
    "servo_current": "motor_current",
    "tilt": "projected_gravity",
}
#: Names of readings and their noise in files of former versions, with the present names.
FORMER_NAMES: Final = _FORMER_READINGS | {
    f"sensing.{old}_noise": f"sensing.{new}_noise" for old, new in _FORMER_READINGS.items()
}


def current_name(name: str) -> str:
    """The present name of a number of an observation; a former version wrote `servo_load.spine` and `gyro.x`.

    >>> current_name("servo_load.spine"), current_name("gyro.x"), current_name("phase.cos")
    ('spine_servo_torque', 'gyro_x', 'phase.cos')
    """
    group, _, label = name.partition(".")
    group = FORMER_NAMES.get(group, group)
    if not label or group not in SENSED_READINGS:
        return name
    return f"{group}_{label}" if label in _AXIS_NAMES else f"{label}_{group}"


#: Other inputs of a policy: the gait's phase as cosine and sine, the command, the robot's distance from the path, the
#: curvature of the path there, and the policy's last action.
POLICY_INPUTS: Final = ("phase", "command", "path", "curvature", "action")
#: Default observation of a policy.
DEFAULT_OBSERVATION: Final = (
    "servo_angle",
    "servo_torque",
    "knee_angle",
    "foot_contact",
    "gyro",
    "accelerometer",
    "phase",
    "command",
    "path",
    "action",
)


class InternalInputs(NamedTuple):
    """Inputs of a policy in one world that do not come from sensors.

    Attributes:
        phase: Phase of the gait [cycles]; None if the controller does not have a phase.
        command: Commanded values (c,).
        path: Point of the path beside the torso; None if the controller does not follow a path.
        action: Last action (a,).
        geometry: Geometry of the robot in the parameters of its controller.
    """

    phase: Scalar | None
    command: Vector
    path: PathPoint | None
    action: Vector
    geometry: Geometry


@dataclasses.dataclass(frozen=True)
class Observer:
    """Makes observations of one world.

    Attributes:
        groups: Names from `SENSED_READINGS` and `POLICY_INPUTS`, in the order of the observation.
        commands: Names of the commanded values.
        actions: Names of the numbers of an action.
        phase, path: Whether the controller has a phase and a path.
        delayed: Longest delay of the readings, in control ticks.
        noisy: Whether the readings have noise.
        dt: Length of a control tick [s].
        custom_groups: Name and readings of each custom group, which follow the groups of `SENSED_READINGS`.
    """

    groups: tuple[str, ...]
    commands: tuple[str, ...]
    actions: tuple[str, ...]
    phase: bool
    path: bool
    delayed: int
    noisy: bool
    dt: float
    custom_groups: tuple[tuple[str, Sensed], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "groups", tuple(FORMER_NAMES.get(name, name) for name in self.groups)
        )
        allowed = (*SENSED_READINGS, *POLICY_INPUTS)
        for name in self.groups:
            if name not in allowed:
                raise ParameterError(
                    f"observe has {name!r}: allowed is {', '.join(allowed)}, or {OBJECT_FORM}."
                )

    @property
    def sensor_groups(self) -> dict[str, Sensed]:
        """The groups of sensor readings, by name."""
        return {
            name: SENSED_READINGS[name] for name in self.groups if name in SENSED_READINGS
        } | dict(self.custom_groups)

    @property
    def sees_path(self) -> bool:
        """Whether an observation contains the position of the path."""
        return self.path and not {"path", "curvature"}.isdisjoint(self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers of an observation (o,), such as `gyro_x`."""
        input_labels = {
            "phase": ("cos", "sin") if self.phase else (),
            "command": self.commands,
            "path": ("error", "heading") if self.path else (),
            "curvature": ("path",) if self.path else (),
            "action": self.actions,
        }
        labels = {name: _names(name, group) for name, group in self.sensor_groups.items()}
        labels |= {
            name: tuple(f"{name}.{label}" for label in input_labels[name])
            for name in POLICY_INPUTS
            if name in self.groups
        }
        return tuple(itertools.chain.from_iterable(labels.values()))

    def readings(self, sensors: Sensors, ground: Ground | None = None) -> Vector:
        """Present sensor readings, scaled (k,); `ground` is a function from (x, y) to the ground's height [m].

        Raises:
            ParameterError: `ground` is None, and a group needs it.
        """
        parts = []
        for name, group in self.sensor_groups.items():
            if group.ground and ground is None:
                raise ParameterError(
                    f"controller observes {name}, and nothing tells it the ground's height: give it a robot's scene, "
                    "by controller.over(robot.terrain.height)."
                )
            parts.append(
                (group.read(sensors, ground) if group.ground else group.read(sensors)) / group.scale
            )
        return jnp.concatenate(parts) if parts else jnp.zeros(0)

    def memory(self, readings: Vector) -> Float[Array, "ticks k"]:
        """The initial memory: the same readings for all of the last ticks."""
        return jnp.tile(readings, (self.delayed, 1))

    def update_memory(
        self, memory: Float[Array, "ticks k"], readings: Vector
    ) -> Float[Array, "ticks k"]:
        """The memory one tick later, newest readings first."""
        return jnp.concatenate([readings[None], memory[:-1]]) if self.delayed else memory

    def observe(
        self,
        sensing: Sensing,
        memory: Float[Array, "ticks k"],
        sensors: Sensors,
        inputs: InternalInputs,
        key: Any,
        ground: Ground | None = None,
    ) -> Vector:
        """The observation (o,): readings with the delay and noise of `sensing`, and the policy's other inputs.

        `memory` contains earlier readings, newest first, which are interpolated between two ticks. `key` is the random
        key of the noise, and `ground` is as in `readings`.
        """
        readings = self.readings(sensors, ground)
        if self.delayed:
            newest_first = jnp.concatenate([readings[None], memory])
            ticks = jnp.clip(jnp.asarray(sensing.delay) / self.dt, 0.0, self.delayed)
            index = jnp.clip(jnp.floor(ticks).astype(jnp.int32), 0, self.delayed - 1)
            share = ticks - index
            readings = newest_first[index] + share * (newest_first[index + 1] - newest_first[index])
        if self.noisy:
            spread = []
            for name, group in self.sensor_groups.items():
                noise = getattr(sensing, f"{name}_noise", 0.0)
                spread.append(
                    jnp.broadcast_to(jnp.asarray(noise) / group.scale, (len(_names(name, group)),))
                )
            noise = jax.random.normal(key, readings.shape, readings.dtype)
            readings = readings + jnp.concatenate(spread) * noise
        return jnp.concatenate([readings, self.input_values(inputs, sensors)])

    def collect_inputs(
        self, command: Any, control: Any, path: PathPoint | None, action: Vector, geometry: Geometry
    ) -> InternalInputs:
        """Collect the inputs that do not come from sensors, from a `Command` and the state `control` of the controller."""
        orders = [jnp.asarray(getattr(command, name), float) for name in self.commands]
        phase = control.phase if self.phase else None
        return InternalInputs(
            phase, jnp.stack(orders) if orders else jnp.zeros(0), path, action, geometry
        )

    def input_values(self, inputs: InternalInputs, sensors: Sensors) -> Vector:
        """Values of the policy's inputs other than readings."""
        parts: dict[str, Vector] = {"command": inputs.command, "action": inputs.action}
        if inputs.phase is not None:
            turn = 2.0 * jnp.pi * inputs.phase
            parts["phase"] = jnp.stack([jnp.cos(turn), jnp.sin(turn)])
        if inputs.path is not None:
            parts["path"] = jnp.stack(
                [inputs.path.error / 0.1, heading(inputs.path, sensors, inputs.geometry)]
            )
            parts["curvature"] = jnp.reshape(inputs.path.curvature * 0.5, 1)
        selected = [parts[name] for name in POLICY_INPUTS if name in self.groups and name in parts]
        return jnp.concatenate(selected) if selected else jnp.zeros(0)


def _names(name: str, group: Sensed) -> tuple[str, ...]:
    """Names of the numbers of a group of readings."""
    labels = tuple(f"{name}_{label}" if label else name for label in group.labels)
    return labels or tuple(reading_names(name, ACTION_SERVOS))


def privileged_names(
    observed: Sequence[str], sampled_names: Sequence[str], path: bool
) -> tuple[str, ...]:
    """Names of the numbers of `privileged`."""
    return (
        *(f"exact.{name}" for name in observed),
        *(f"velocity.{axis}" for axis in _AXIS_NAMES),
        *reading_names("projected_gravity"),
        "height",
        *reading_names("foot_force"),
        "tail_force",
        *(f"{limb}_foot_height" for limb in LIMBS),
        *reading_names("height_scan"),
        *(() if path else ("yaw",)),
        "time_left",
        *(f"drawn.{name}" for name in sampled_names),
    )


def privileged(
    exact: Vector,
    sensors: Sensors,
    ground: Ground,
    yaw: Scalar,
    time_left: Scalar,
    sampled: Vector,
    path: bool,
) -> Vector:
    """Additional input of the critic (p,): the observation without delay and noise (`exact`), motion, ground, and body.

    `ground` is a function from (x, y) to the ground's height [m], `yaw` the yaw of the torso [rad], `time_left` the
    remaining share of the episode, and `sampled` contains the sampled parameters of the episode, scaled to [-1, 1].
    Without a `path`, the yaw is a part of the input.
    """
    x, y, z = sensors.position
    left_direction, ahead = directions(yaw)
    velocity = sensors.linear_velocity
    ours = jnp.stack([velocity[:2] @ left_direction, velocity[:2] @ ahead, velocity[2]])
    beneath = ground(x, y)
    feet = sensors.foot_position[:, 2] - ground(
        sensors.foot_position[:, 0], sensors.foot_position[:, 1]
    )
    force = jnp.append(sensors.foot_force, sensors.tail_force)
    height = jnp.reshape(z - beneath, 1)
    course = () if path else (jnp.reshape(yaw, 1),)
    return jnp.concatenate(
        [
            exact,
            ours / 0.1,
            projected_gravity(sensors),
            height / 0.05,
            jnp.tanh(force / 2.0),
            feet / 0.01,
            height_scan(sensors, ground, yaw) / SENSED_READINGS["height_scan"].scale,
            *course,
            jnp.reshape(time_left, 1),
            sampled,
        ]
    )
