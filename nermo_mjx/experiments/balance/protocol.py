"""The balance test as a `physics.engine.Loop`: stand on four feet, bend the spine, lift one leg, swing it.

Servo angles are a pure function of (parameters, time); all eight cases and both profiles are one batch. The published
test commands joint angles instead of feet, so only the clock of the profile `as_published` applies: the same angles
2.5 times as fast. Its foot tracking lag belongs to the inverse kinematics, which is not used here.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from nermo_mjx.control import fusion
from nermo_mjx.control.parameters import Spine
from nermo_mjx.kinematics.leg import forward, four_legs, inverse
from nermo_mjx.robot import Robot, ServoAngles
from nermo_mjx.robot.geometry import Geometry

#: Neutral stance of the balance test (q1, q2) of each limb [rad]: `balance_stance` of the reference parameters.
STANCE: Final = np.array([[0.42, 0.60], [0.42, 0.60], [-0.15, -0.66], [-0.15, -0.66]])
#: Change of q2 that compresses a leg fully [rad]. Erratum 14: 0.6 in front, 0.7 behind; the text says "rear" twice.
COMPRESSION: Final = np.array([-0.6, -0.6, 0.7, 0.7])
#: The whole range of the hip and shoulder [rad], through which the lifted leg swings.
SWING_RANGE: Final = (-0.7, 0.7)
ROUTING: Final = "type3"


@dataclasses.dataclass(frozen=True)
class Phase:
    """A phase of the protocol, in seconds of its clock: changes happen within `ramp`, then hold."""

    begin: float
    end: float
    ramp: float

    @property
    def still(self) -> tuple[float, float]:
        """The second half of the hold, when everything is at rest."""
        return (self.begin + self.ramp + self.end) / 2, self.end


#: `stand`: a perturbed start eases into the stance; `shift`: the spine bends (with SBC); `lift`: the leg is compressed;
#: `swing`: it goes from where it is to one end of its range, to the other, and back, a third of the phase each.
PHASES: Final = {
    "stand": Phase(0.0, 1.0, 0.4),
    "shift": Phase(1.0, 2.0, 0.5),
    "lift": Phase(2.0, 3.0, 0.5),
    "swing": Phase(3.0, 6.0, 3.0),
}
DURATION: Final = PHASES["swing"].end


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BalanceParameters:
    """One world of the test.

    Attributes:
        lifted: 1 for the limb that is lifted, else 0.
        sbc: 1 with spine balance compensation, else 0.
        clock_ratio: simulated seconds per second of the protocol.
        spine: limit of the servo, d_lift of (5.35), share of the offset compensation (5.31).
        start: initial offsets of the legs' q1 and q2 from the stance [rad].
        servo_speed: maximum rate of change of a servo's target [rad/s].
    """

    lifted: Float[ArrayLike, " 4"]
    sbc: Float[ArrayLike, ""]
    clock_ratio: Float[ArrayLike, ""]
    spine: Spine
    start: Float[ArrayLike, "4 2"]
    servo_speed: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BalanceState:
    """The loop's state: ticks done, and servo targets [rad]."""

    tick: Array
    ctrl: Float[Array, " n_servos"]


def ramp(time: ArrayLike, begin: float, duration: float) -> Float[Array, "*batch"]:
    """0 before `begin`, 1 after `begin + duration`, between them the minimum-jerk polynomial."""
    share = jnp.clip((jnp.asarray(time) - begin) / duration, 0.0, 1.0)
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def during(time: ArrayLike, phase: str) -> Float[Array, "*batch"]:
    """Progress of a phase's ramp, in [0, 1]."""
    return ramp(time, PHASES[phase].begin, PHASES[phase].ramp)


@dataclasses.dataclass(frozen=True, eq=False)
class BalanceLoop:
    """Implements `physics.engine.Loop` for the balance test; no sensor is read, as published."""

    robot: Robot
    dt: float = 0.01

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per control tick."""
        return round(self.dt / self.robot.config.timestep)

    def init(self, params: BalanceParameters, sensordata: Float[Array, " n"]) -> BalanceState:
        """See `Loop.init`."""
        return BalanceState(jnp.zeros((), jnp.int32), self.servos(params, 0.0).vector(self.robot.servos))

    def step(
        self, params: BalanceParameters, state: BalanceState, sensordata: Float[Array, "steps n"]
    ) -> tuple[BalanceState, Float[Array, " n_servos"]]:
        """See `Loop.step`."""
        wanted = self.servos(params, state.tick * self.dt / params.clock_ratio).vector(self.robot.servos)
        reach = params.servo_speed * self.dt
        ctrl = state.ctrl + jnp.clip(wanted - state.ctrl, -reach, reach)
        return BalanceState(state.tick + 1, ctrl), ctrl

    def spine_servo(self, params: BalanceParameters) -> Float[Array, ""]:
        """Servo angle that balances the robot on the three other feet [rad] (5.35, 5.45); 0 without SBC."""
        feet = forward(four_legs(Geometry()), STANCE, ROUTING).foot
        angle = fusion.balance(params.spine, self.robot.mass_model, feet, jnp.asarray(params.lifted) < 0.5, Geometry())
        return jnp.asarray(params.sbc) * fusion.fuse(params.spine, jnp.zeros(()), angle)

    def servos(self, params: BalanceParameters, time: ArrayLike) -> ServoAngles:
        """Commanded angles at a time of the protocol [s], continuous in time.

        A spine bent by 0.1 rad per joint raises one hip by 5 mm and lowers the other by 4 mm, so three legs of neutral
        length would tilt the robot towards the foot to be lifted. The loaded feet compensate for that (5.31).
        """
        spine = during(time, "shift") * self.spine_servo(params)
        lifted = jnp.asarray(params.lifted)[:, None]
        legs = four_legs(Geometry())
        shift = (1.0 - lifted) * fusion.compensation(params.spine, spine, Geometry())
        level = inverse(legs, forward(legs, STANCE, ROUTING).foot + shift, ROUTING).servo
        # Exactly the stance if there is nothing to compensate: a round trip through the foot would lose some digits.
        stance = jnp.where(shift[:, 1:] == 0.0, jnp.asarray(STANCE, level.dtype), level)
        angles = stance + (1.0 - during(time, "stand")) * params.start

        compression = np.stack([np.zeros(4), COMPRESSION], axis=-1)
        angles = angles + lifted * during(time, "lift") * compression
        first, middle, last = (ramp(time, PHASES["swing"].begin + part, 1.0) for part in range(3))
        low, high = SWING_RANGE
        rest = STANCE[:, 0]
        swing = first * (low - rest) + middle * (high - low) + last * (rest - high)
        hip, knee = angles[:, 0] + lifted[:, 0] * swing, angles[:, 1]
        zero = jnp.zeros_like(spine)
        return ServoAngles(hip=hip, knee=knee, spine=spine, neck=zero, tail=zero)
