"""What a policy observes: groups of readings of the real robot's sensors, with delay and noise, and its commands.

A critic may know more (`privileged`), since it is not used after training.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.path import PathPoint
from nermo_mjx.control.pilot import heading
from nermo_mjx.control.protocol import NAMED
from nermo_mjx.learn.acting import ACTED
from nermo_mjx.robot import LIMBS, ParameterError, Sensors
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import parameter_tree, quantity
from nermo_mjx.rollout.metrics import LOADED
from nermo_mjx.shapes import Array, Scalar

Vector = Float[Array, " k"]

#: The longest delay that readings may have [s].
LONGEST_DELAY: Final = 0.1
_AXES: Final = ("x", "y", "z")


@parameter_tree
class Sensing:
    """Delay and noise of the sensor readings that reach the policy; noise is normal, and new in each control tick."""

    delay: Any = quantity(0.0, "s", 0.0, LONGEST_DELAY, "age of the readings that a policy gets")
    servo_angle_noise: Any = quantity(0.0, "rad", 0.0, 1.0, "of the servos' angles")
    servo_load_noise: Any = quantity(0.0, "N m", 0.0, 1.0, "of the servos' torques")
    servo_current_noise: Any = quantity(0.0, "A", 0.0, 1.0, "of the servos' currents")
    knee_angle_noise: Any = quantity(0.0, "rad", 0.0, 1.0, "of the knees' angles")
    gyro_noise: Any = quantity(0.0, "rad/s", 0.0, 10.0, "of the IMU's angular velocity")
    accelerometer_noise: Any = quantity(0.0, "m/s^2", 0.0, 50.0, "of the IMU's acceleration")
    tilt_noise: Any = quantity(0.0, "1", 0.0, 1.0, "of the direction of gravity")


@dataclasses.dataclass(frozen=True)
class Sensed:
    """A group of readings.

    Attributes:
        labels: of its numbers; "" for one without a label.
        read: the readings of one world, in SI units.
        scale: what is observed is the reading over this, so that it is about 1.
        unit: of the scale.
        noise: field of `Sensing`; None for a reading without noise.
        doc: what it is.
    """

    labels: tuple[str, ...]
    read: Callable[[Sensors], Vector]
    scale: float
    unit: str
    noise: str | None
    doc: str


def down(sensors: Sensors) -> Float[Array, " 3"]:
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
    return servo.idle_current + per_torque * jnp.abs(sensors.servo_torque[: len(ACTED)])


#: What the robot senses. Loads are the servos' torques, currents what their motors' supply shows of them: no sign.
SENSED: Final[dict[str, Sensed]] = {
    "servo_angle": Sensed(
        ACTED, lambda s: s.servo_angle[: len(ACTED)], 1.0, "rad", "servo_angle_noise", "angles of the servos"
    ),
    "servo_load": Sensed(
        ACTED, lambda s: s.servo_torque[: len(ACTED)], 0.1, "N m", "servo_load_noise", "torques of the servos"
    ),
    "servo_current": Sensed(ACTED, current, 0.5, "A", "servo_current_noise", "currents of the servos' motors"),
    "knee_angle": Sensed(LIMBS, lambda s: s.knee_angle, 1.0, "rad", "knee_angle_noise", "angles of the knees"),
    "foot_contact": Sensed(LIMBS, contact, 1.0, "1", None, "whether a foot bears load"),
    "gyro": Sensed(_AXES, lambda s: s.gyro, 3.0, "rad/s", "gyro_noise", "angular velocity of the torso"),
    "accelerometer": Sensed(
        _AXES, lambda s: s.accelerometer, 9.81, "m/s^2", "accelerometer_noise", "acceleration of the torso"
    ),
    "tilt": Sensed(_AXES, down, 1.0, "1", "tilt_noise", "direction of gravity, which an IMU with fusion knows"),
}
#: Other inputs of a policy: the gait's phase as cosine and sine, the command, where it is beside the path, the path's
#: curvature there, and its own last action.
TOLD: Final = ("phase", "command", "path", "curvature", "action")
#: Default observation of a policy.
OBSERVED: Final = (
    "servo_angle",
    "servo_load",
    "knee_angle",
    "foot_contact",
    "gyro",
    "accelerometer",
    "phase",
    "command",
    "path",
    "action",
)
#: Points of the ground that the critic sees, left of and ahead of the torso [m].
SCANNED: Final = tuple((side, ahead) for ahead in (-0.1, 0.0, 0.1, 0.2) for side in (0.04, 0.0, -0.04))


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
        groups: names of `SENSED` and `TOLD`, in the order in which they are observed.
        commands: names of what is commanded.
        actions: names of the actions.
        phase, path: whether the controller has a phase and a path.
        delayed: largest delay of readings, in control ticks.
        noisy: whether there is noise.
        dt: length of a control tick [s].
        own: name and readings of each group of one's own, observed after those of `SENSED`.
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
        known = (*SENSED, *TOLD)
        for name in self.groups:
            if name not in known:
                raise ParameterError(f"observe has {name!r}: allowed is {', '.join(known)}, or {NAMED}.")

    @property
    def sensed(self) -> dict[str, Sensed]:
        """The groups that come from sensors, by name."""
        return {name: SENSED[name] for name in self.groups if name in SENSED} | dict(self.own)

    @property
    def sees_path(self) -> bool:
        """Whether an observation says where the path is."""
        return self.path and not {"path", "curvature"}.isdisjoint(self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """Of every number of an observation, such as `gyro.x`."""
        told = {
            "phase": ("cos", "sin") if self.phase else (),
            "command": self.commands,
            "path": ("error", "heading") if self.path else (),
            "curvature": ("path",) if self.path else (),
            "action": self.actions,
        }
        labels = {name: group.labels for name, group in self.sensed.items()}
        labels |= {name: told[name] for name in TOLD if name in self.groups}
        return tuple(f"{name}.{label}".rstrip(".") for name, several in labels.items() for label in several)

    def readings(self, sensors: Sensors) -> Vector:
        """Current sensor readings, scaled."""
        parts = [group.read(sensors) / group.scale for group in self.sensed.values()]
        return jnp.concatenate(parts) if parts else jnp.zeros(0)

    def memory(self, readings: Vector) -> Float[Array, "ticks k"]:
        """Readings of the last ticks, at the start: newest first."""
        return jnp.tile(readings, (self.delayed, 1))

    def remembered(self, memory: Float[Array, "ticks k"], readings: Vector) -> Float[Array, "ticks k"]:
        """The memory one tick later."""
        return jnp.concatenate([readings[None], memory[:-1]]) if self.delayed else memory

    def observe(
        self, sensing: Sensing, memory: Float[Array, "ticks k"], sensors: Sensors, told: Told, key: Any
    ) -> Vector:
        """The observation: readings, as late and as noisy as `sensing` says, and the policy's other inputs.

        `memory` has earlier readings, newest first; between two ticks they are interpolated. `key` is of the noise.
        """
        readings = self.readings(sensors)
        if self.delayed:
            newest_first = jnp.concatenate([readings[None], memory])
            ticks = jnp.clip(jnp.asarray(sensing.delay) / self.dt, 0.0, self.delayed)
            before = jnp.clip(jnp.floor(ticks).astype(jnp.int32), 0, self.delayed - 1)
            share = ticks - before
            readings = newest_first[before] + share * (newest_first[before + 1] - newest_first[before])
        if self.noisy:
            spread = []
            for group in self.sensed.values():
                noise = 0.0 if group.noise is None else getattr(sensing, group.noise)
                spread.append(jnp.broadcast_to(jnp.asarray(noise) / group.scale, (len(group.labels),)))
            noise = jax.random.normal(key, readings.shape, readings.dtype)
            readings = readings + jnp.concatenate(spread) * noise
        return jnp.concatenate([readings, self.told(told, sensors)])

    def informed(self, command: Any, control: Any, path: PathPoint | None, action: Vector, geometry: Geometry) -> Told:
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
            parts["path"] = jnp.stack([told.path.error / 0.1, heading(told.path, sensors, told.geometry)])
            parts["curvature"] = jnp.reshape(told.path.curvature * 0.5, 1)
        chosen = [parts[name] for name in TOLD if name in self.groups and name in parts]
        return jnp.concatenate(chosen) if chosen else jnp.zeros(0)


def privileged_names(observed: Sequence[str], drawn: Sequence[str], path: bool) -> tuple[str, ...]:
    """Of every number that `privileged` gives."""
    return (
        *(f"exact.{name}" for name in observed),
        *(f"velocity.{axis}" for axis in _AXES),
        *(f"down.{axis}" for axis in _AXES),
        "height",
        *(f"foot_force.{limb}" for limb in LIMBS),
        "tail_force",
        *(f"foot_height.{limb}" for limb in LIMBS),
        *(f"ground.{side:g}.{ahead:g}" for side, ahead in SCANNED),
        *(() if path else ("course",)),
        "time_left",
        *(f"drawn.{name}" for name in drawn),
    )


def privileged(
    exact: Vector,
    sensors: Sensors,
    ground: Callable[[Any, Any], Array],
    yaw: Scalar,
    time_left: Scalar,
    drawn: Vector,
    path: bool,
) -> Vector:
    """What the critic knows: the observation without delay and noise (`exact`), motion, ground, and body.

    `ground` is its height at (x, y) [m], `yaw` that of the torso [rad], `time_left` the share of the episode, `drawn`
    what was drawn for it, in [-1, 1], and `path` is whether the observation says where the robot heads.
    """
    x, y, z = sensors.position
    # The torso's left and ahead on the ground.
    left, ahead = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]), jnp.stack([jnp.sin(yaw), -jnp.cos(yaw)])
    velocity = sensors.linear_velocity
    ours = jnp.stack([velocity[:2] @ left, velocity[:2] @ ahead, velocity[2]])
    beneath = ground(x, y)
    feet = sensors.foot_position[:, 2] - ground(sensors.foot_position[:, 0], sensors.foot_position[:, 1])
    points = jnp.asarray(SCANNED)
    seen = ground(
        x + points[:, 0] * left[0] + points[:, 1] * ahead[0], y + points[:, 0] * left[1] + points[:, 1] * ahead[1]
    )
    force = jnp.append(sensors.foot_force, sensors.tail_force)
    height = jnp.reshape(z - beneath, 1)
    course = () if path else (jnp.reshape(yaw, 1),)
    return jnp.concatenate(
        [
            exact,
            ours / 0.1,
            down(sensors),
            height / 0.05,
            jnp.tanh(force / 2.0),
            feet / 0.01,
            jnp.clip((seen - beneath) / 0.01, -5.0, 5.0),
            *course,
            jnp.reshape(time_left, 1),
            drawn,
        ]
    )
