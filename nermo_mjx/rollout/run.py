"""How long a run lasts and what part of it is measured."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.protocol import ControllerLike
from nermo_mjx.kinematics import spine
from nermo_mjx.kinematics.body import feet_positions, hips, shoulders
from nermo_mjx.kinematics.leg import LegPose, forward_kinematics, four_legs
from nermo_mjx.physics.lanes import Lanes
from nermo_mjx.robot import LIMBS, ModelParameters, ParameterError, Quantity, Robot, ServoAngles
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.terrains import TerrainShape
from nermo_mjx.rollout.setup import Start
from nermo_mjx.shapes import Array

Length = float | np.ndarray
#: Largest number of seconds, cycles or metres of a run.
LONGEST_RUN_SECONDS: Final = 1e5
#: Units of what is no number of cycles.
_UNITS: Final = {"duration": "s", "warmup": "s", "distance": "m"}
#: Worlds of one batch, and what the engine c takes for one of them [bytes]; others take as much or more.
MOST_WORLDS: Final = 65_536
WORLD_BYTES: Final = 50_000


def too_many(worlds: int) -> str:
    """What is wrong with so many worlds in one batch, for a message before anything of its size is made; or nothing.

    >>> too_many(100_000)
    '100,000 worlds at once take 5.0 GB; allowed are 65,536, 3.3 GB.'
    """
    if worlds <= MOST_WORLDS:
        return ""
    takes, allowed = (f"{count * WORLD_BYTES / 1e9:,.1f} GB" for count in (worlds, MOST_WORLDS))
    return f"{worlds:,} worlds at once take {takes}; allowed are {MOST_WORLDS:,}, {allowed}."


@dataclasses.dataclass(frozen=True)
class Run:
    """How long a run lasts and what part of it is measured: gait cycles, or seconds.

    >>> Run(duration=2.0, warmup=2.5)
    Traceback (most recent call last):
    nermo_mjx.robot.quantity.ParameterError: run.warmup is 2.5: allowed is less than the run's length, 2.

    Each number holds for all worlds, or is an array (n,) with one entry per world. Seconds and metres may be texts,
    such as "8 s", "500 ms" or "30 cm".

    Attributes:
        cycles, warmup_cycles: length of the run, and of its unmeasured start, in gait cycles.
        duration, warmup: the same in simulated seconds; `duration` excludes `cycles`.
        distance: measuring stops at the end of the gait cycle in which the robot has walked this far [m].

    Raises:
        ParameterError: neither or both lengths, a warm-up as long as the run, a value of more than `LONGEST`.
    """

    cycles: Length | None = None
    warmup_cycles: Length | None = None
    duration: Any = None
    warmup: Any = None
    distance: Any = None

    def __post_init__(self) -> None:
        for name in ("cycles", "warmup_cycles", "duration", "warmup", "distance"):
            value, zero_ok = getattr(self, name), name.startswith("warmup")
            if value is None:
                continue
            duration = np.asarray(value)
            if duration.dtype.kind == "U" and name in _UNITS:
                value = Quantity(8.0, _UNITS[name], 0.0, LONGEST_RUN_SECONDS, "of a run").numbers(
                    f"run.{name}", value
                )
                duration = np.asarray(value)
                object.__setattr__(self, name, value)
            if duration.dtype.kind not in "iuf":
                instead = {"cycles": "duration", "warmup_cycles": "warmup"}.get(name)
                seconds = f"; seconds are run.{instead}" if isinstance(value, str) else ""
                raise ParameterError(
                    f"run.{name} is {value!r}: expected a number, or an array of such{seconds}."
                )
            bad = ~(
                (duration <= LONGEST_RUN_SECONDS) & ((duration > 0) | (zero_ok & (duration == 0)))
            )
            if bad.any():
                range_ = f"{'[' if zero_ok else '('}0, {LONGEST_RUN_SECONDS:g}]"
                raise ParameterError(
                    f"run.{name} is {float(duration[bad].flat[0])!r}: allowed is {range_}."
                )
        if self.duration is not None and (
            self.cycles is not None or self.warmup_cycles is not None
        ):
            raise ParameterError(
                "run.duration is given beside run.cycles: give either seconds or gait cycles."
            )
        if self.duration is None and self.warmup is not None:
            raise ParameterError(
                "run.warmup is given without run.duration: with cycles, give run.warmup_cycles."
            )
        length, warmup = np.broadcast_arrays(*self._lengths())
        is_late = warmup >= length
        if is_late.any():
            name = "warmup_cycles" if self.duration is None else "warmup"
            raise ParameterError(
                f"run.{name} is {warmup[is_late].flat[0]:g}: allowed is less than the run's length, "
                f"{length[is_late].flat[0]:g}."
            )

    def _lengths(self) -> tuple[Length, Length]:
        if self.duration is not None:
            return self.duration, 0.0 if self.warmup is None else self.warmup
        cycles = 8.0 if self.cycles is None else self.cycles
        default = np.where(np.asarray(cycles) > 2.0, 2.0, 0.0)
        return cycles, default if self.warmup_cycles is None else self.warmup_cycles

    def seconds(self, cycle_rate: Any) -> tuple[Any, Any]:
        """(end of the warm-up, end of the run) in simulated seconds, shaped as `cycle_rate`, which may be traced.

        >>> [float(each) for each in Run(cycles=8).seconds(0.8)]
        [2.5, 10.0]

        Args:
            cycle_rate: gait cycles per simulated second [1/s].
        """
        length, warmup = self._lengths()
        period = 1.0 / cycle_rate if self.duration is None else cycle_rate**0
        return warmup * period, length * period


# ---
# The start pose of a world: in the posture of its gait, level, at rest, and on the ground.


#: Tendons start longer than their limit by this much, as when loaded [m]. At the limit itself rounding would determine
#: whether a tendon holds or its knee springs loose in the first step.
TAUT: Final = 2e-5
#: Initial penetration of the lowest sole [m]. On the surface rounding would determine whether it touches in the first
#: steps, which moves the robot by 0.1 micrometres.
DEPTH: Final = 1e-5

#: Half-widths of the start's perturbation that makes repeats differ: a millimetre, a degree, a fiftieth of a cycle.
START_SPREAD: Final = {
    "start.x": 1e-3,
    "start.y": 1e-3,
    "start.yaw": math.radians(1.0),
    "start.phase": 0.02,
}


@dataclasses.dataclass(frozen=True, eq=False)
class StartPose:
    """Maps parameters to `qpos`."""

    robot: Robot
    controller: ControllerLike

    def qpos(
        self,
        control: Any,
        start: Start,
        terrain: TerrainShape | None = None,
        body: ModelParameters | None = None,
    ) -> Float[Array, " nq"]:
        """Positions of one world (leaves of shape ()); torso level, the body's mean heading `start.yaw` from -y.

        Args:
            control: the controller's parameters.
            start: position, heading and phase.
            terrain: shape of the ground, see `Terrain.height`.
            body: whose geometry and build it has, by default the published ones.
        """
        geometry = body.geometry if body else Geometry()
        servo = self.controller.initial_servo(control, start.phase)
        pose = self._legs(servo, geometry, body)
        bend = spine.joint_angle(servo.spine, geometry)
        lifted = (
            spine.joint_angle(servo.spine_vertical, geometry)
            if self.robot.joints.spine_vertical
            else None
        )
        axis_height = jnp.concatenate([shoulders(geometry)[:, 2], hips(bend, geometry)[:, 2]])
        # A bent spine turns torso and hip to opposite sides of the robot's heading; the total bend is 4 theta_v.
        yaw = start.yaw + 0.5 * 4 * bend
        # The ground's height differs between feet; the foot that requires the greatest height determines the body's.
        x, y, z = jnp.moveaxis(feet_positions(bend, pose.foot, geometry, lifted), -1, 0)
        cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
        position = start.x + cosine * x - sine * y, start.y + sine * x + cosine * y
        beneath = self.robot.terrain.height(*position, terrain)
        # The vertical spine turns the legs by up to half a radian, the lateral one by a few hundredths.
        below = axis_height + pose.foot[:, 1] if lifted is None else z
        height = jnp.max(geometry.foot.radius - DEPTH - below + beneath)

        joints, half = self.robot.joints, yaw / 2
        zero = jnp.zeros_like(half)
        root = jnp.stack(
            [zero + start.x, zero + start.y, height, jnp.cos(half), zero, zero, jnp.sin(half)]
        )
        qpos = (
            jnp.asarray(self.robot.model.qpos0, float).at[joints.root : joints.root + 7].set(root)
        )
        qpos = (
            qpos.at[np.array(joints.hip)].set(servo.hip).at[np.array(joints.pulley)].set(servo.knee)
        )
        hinges = self.robot.config.hinges  # bend equally
        qpos = qpos.at[np.array(joints.knee)].set(pose.knee_angle[:, None] / hinges)
        qpos = (
            qpos.at[np.array(joints.spine)]
            .set(bend / hinges)
            .at[joints.spine_pulley]
            .set(servo.spine)
        )
        if lifted is None:
            return qpos
        pulley = np.array(joints.spine_vertical_pulley)
        return (
            qpos.at[np.array(joints.spine_vertical)]
            .set(lifted / hinges)
            .at[pulley]
            .set(servo.spine_vertical)
        )

    def _legs(
        self, servo: ServoAngles, geometry: Geometry, body: ModelParameters | None
    ) -> LegPose:
        """Poses of the four legs, with tendons as slack and legs as tilted as the body's."""
        legs = four_legs(geometry)
        pairs = [limb.split("_")[0] for limb in LIMBS]
        slack = jnp.stack([body.build.slack(pair) for pair in pairs]) if body else 0.0
        eased = servo.knee + legs.servo_direction * (TAUT + slack) / legs.pulley_radius
        pose = forward_kinematics(
            legs, jnp.stack([servo.hip, eased], axis=-1), self.robot.config.routing
        )
        if body is None:
            return pose
        tilt = jnp.stack([getattr(body.build, f"{pair}_tilt") for pair in pairs])
        (y, z), cosine, sine = pose.foot.T, jnp.cos(tilt), jnp.sin(tilt)
        return pose._replace(
            foot=jnp.stack([cosine * y - sine * z, sine * y + cosine * z], axis=-1)
        )

    def batch(
        self,
        control: Any,
        start: Start,
        terrain: TerrainShape | None = None,
        body: ModelParameters | None = None,
    ) -> np.ndarray:
        """Positions of all worlds, (n, nq), from leaves with a leading world axis."""
        return np.asarray(self._batched(control, start, terrain, body), float)

    @functools.cached_property
    def _batched(self) -> Lanes:
        return Lanes(self.qpos)
