"""What a policy observes: groups of readings of the real robot's sensors, with delay and noise, and its commands.

A critic may know more (`privileged`), since it is not used after training.
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

#: The longest delay that readings may have [s].
LONGEST_DELAY: Final = 0.1
_AXIS_NAMES: Final = ("x", "y", "z")


@parameter_tree
class Sensing:
    """Delay and noise of the sensor readings that reach the policy; noise is normal, and new in each control tick."""

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
    """What a policy observes of a reading.

    Attributes:
        read: the readings of one world, in SI units, from its sensors and, with `ground`, the ground's height.
        scale: what is observed is the reading over this, so that it is about 1. Its noise is a field of `Sensing`.
        labels: of the numbers of one's own; "" for one without a label.
        ground: whether `read` gets, beside the sensors, a function from (x, y) in the world to the ground's height [m].
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
    """0 for a foot without load, 1 for a loaded one."""
    none, full = LOADED
    return jnp.clip((sensors.foot_force - none) / (full - none), 0.0, 1.0)


def current(sensors: Sensors) -> Float[Array, " k"]:
    """Current in each servo's motor [A], which rises with its torque's magnitude (`rollout.electrical`).

    The sensor is calibrated with the constants of the published servo, whatever body is drawn; without back-EMF.
    """
    servo = ModelParameters().servo
    per_torque = (servo.stall_current - servo.idle_current) / servo.torque_limit
    return servo.idle_current + per_torque * jnp.abs(sensors.servo_torque[: len(ACTION_SERVOS)])


def height_scan(sensors: Sensors, ground: Ground, yaw: Scalar | None = None) -> Float[Array, " 12"]:
    """Heights of the ground at `SCANNED` over that beneath the torso, at most 0.05 up or down [m].

    The grid turns with the torso's `yaw` [rad], by default that of its attitude, and stays level, as the term of this
    name does in Isaac Lab and mjlab, which count down from the robot instead. Obstacles are no ground.
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
    """The torso's left and ahead on the ground, (2,) each."""
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]), jnp.stack([jnp.sin(yaw), -jnp.cos(yaw)])


#: What the robot senses, and the ground's heights, by names of `READINGS`. Currents are what a motor's supply shows of
#: its torque: no sign.
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
#: What files of former versions call readings and their noise.
FORMER_NAMES: Final = _FORMER_READINGS | {
    f"sensing.{old}_noise": f"sensing.{new}_noise" for old, new in _FORMER_READINGS.items()
}


def today(name: str) -> str:
    """The name of an observation's number, of which a former version wrote `servo_load.spine` and `gyro.x`.

    >>> today("servo_load.spine"), today("gyro.x"), today("phase.cos")
    ('spine_servo_torque', 'gyro_x', 'phase.cos')
    """
    group, _, label = name.partition(".")
    group = FORMER_NAMES.get(group, group)
    if not label or group not in SENSED_READINGS:
        return name
    return f"{group}_{label}" if label in _AXIS_NAMES else f"{label}_{group}"


#: Other inputs of a policy: the gait's phase as cosine and sine, the command, where it is beside the path, the path's
#: curvature there, and its own last action.
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


class Told(NamedTuple):
    """What is known in one world apart from its sensors.

    Attributes:
        phase: of the gait cycle, where the controller has one.
        command: commanded values, (c,).
        path: point of the path beside the torso, where there is a path.
        action: the last one.
        geometry: of the robot, as its controller knows it.
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
        groups: names of `SENSED_READINGS` and `POLICY_INPUTS`, in the order in which they are observed.
        commands: names of what is commanded.
        actions: names of the actions.
        phase, path: whether the controller has a phase and a path.
        delayed: largest delay of readings, in control ticks.
        noisy: whether there is noise.
        dt: length of a control tick [s].
        own: name and readings of each group of one's own, observed after those of `SENSED_READINGS`.
    """

    groups: tuple[str, ...]
    commands: tuple[str, ...]
    actions: tuple[str, ...]
    phase: bool
    path: bool
    delayed: int
    noisy: bool
    dt: float
    own: tuple[tuple[str, Sensed], ...] = ()

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
    def sensed(self) -> dict[str, Sensed]:
        """The groups that come from sensors, by name."""
        return {
            name: SENSED_READINGS[name] for name in self.groups if name in SENSED_READINGS
        } | dict(self.own)

    @property
    def sees_path(self) -> bool:
        """Whether an observation says where the path is."""
        return self.path and not {"path", "curvature"}.isdisjoint(self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """Of every number of an observation, such as `gyro_x`."""
        told_labels = {
            "phase": ("cos", "sin") if self.phase else (),
            "command": self.commands,
            "path": ("error", "heading") if self.path else (),
            "curvature": ("path",) if self.path else (),
            "action": self.actions,
        }
        labels = {name: _names(name, group) for name, group in self.sensed.items()}
        labels |= {
            name: tuple(f"{name}.{label}" for label in told_labels[name])
            for name in POLICY_INPUTS
            if name in self.groups
        }
        return tuple(itertools.chain.from_iterable(labels.values()))

    def readings(self, sensors: Sensors, ground: Ground | None = None) -> Vector:
        """Current sensor readings, scaled; `ground` gives its height at (x, y), where it is known.

        Raises:
            ParameterError: it is not known, and a group needs it.
        """
        parts = []
        for name, group in self.sensed.items():
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
        """Readings of the last ticks, at the start: newest first."""
        return jnp.tile(readings, (self.delayed, 1))

    def remembered(
        self, memory: Float[Array, "ticks k"], readings: Vector
    ) -> Float[Array, "ticks k"]:
        """The memory one tick later."""
        return jnp.concatenate([readings[None], memory[:-1]]) if self.delayed else memory

    def observe(
        self,
        sensing: Sensing,
        memory: Float[Array, "ticks k"],
        sensors: Sensors,
        told: Told,
        key: Any,
        ground: Ground | None = None,
    ) -> Vector:
        """The observation: readings, as late and as noisy as `sensing` says, and the policy's other inputs.

        `memory` has earlier readings, newest first; between two ticks they are interpolated. `key` is of the noise,
        `ground` as in `readings`.
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
            for name, group in self.sensed.items():
                noise = getattr(sensing, f"{name}_noise", 0.0)
                spread.append(
                    jnp.broadcast_to(jnp.asarray(noise) / group.scale, (len(_names(name, group)),))
                )
            noise = jax.random.normal(key, readings.shape, readings.dtype)
            readings = readings + jnp.concatenate(spread) * noise
        return jnp.concatenate([readings, self.told(told, sensors)])

    def informed(
        self, command: Any, control: Any, path: PathPoint | None, action: Vector, geometry: Geometry
    ) -> Told:
        """What is known apart from the sensors: from a `Command`, the controller's state, and the rest of `Told`."""
        orders = [jnp.asarray(getattr(command, name), float) for name in self.commands]
        phase = control.phase if self.phase else None
        return Told(phase, jnp.stack(orders) if orders else jnp.zeros(0), path, action, geometry)

    def told(self, told: Told, sensors: Sensors) -> Vector:
        """The policy's inputs other than readings."""
        parts: dict[str, Vector] = {"command": told.command, "action": told.action}
        if told.phase is not None:
            turn = 2.0 * jnp.pi * told.phase
            parts["phase"] = jnp.stack([jnp.cos(turn), jnp.sin(turn)])
        if told.path is not None:
            parts["path"] = jnp.stack(
                [told.path.error / 0.1, heading(told.path, sensors, told.geometry)]
            )
            parts["curvature"] = jnp.reshape(told.path.curvature * 0.5, 1)
        selected = [parts[name] for name in POLICY_INPUTS if name in self.groups and name in parts]
        return jnp.concatenate(selected) if selected else jnp.zeros(0)


def _names(name: str, group: Sensed) -> tuple[str, ...]:
    """Of every number of a group of readings."""
    labels = tuple(f"{name}_{label}" if label else name for label in group.labels)
    return labels or tuple(reading_names(name, ACTION_SERVOS))


def privileged_names(
    observed: Sequence[str], sampled_names: Sequence[str], path: bool
) -> tuple[str, ...]:
    """Of every number that `privileged` gives."""
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
    """What the critic knows: the observation without delay and noise (`exact`), motion, ground, and body.

    `ground` is its height at (x, y) [m], `yaw` that of the torso [rad], `time_left` the share of the episode, `drawn`
    what was drawn for it, in [-1, 1], and `path` is whether the observation says where the robot heads.
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
