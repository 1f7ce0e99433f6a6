"""The stand of one leg: what its tendon's routing does to force, speed and work of the knee's servo."""

from __future__ import annotations

from typing import Any, Final

import jax
import numpy as np

from nermo_mjx.experiments.body import TORQUE
from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.experiments.stands.stand import HINGES, Stand, bend, measured
from nermo_mjx.kinematics import leg
from nermo_mjx.robot import ModelParameters, assemble_leg
from nermo_mjx.robot.parameters import LEGS, ROUTINGS

NAME: Final = "leg-stand"
_inverse: Final = jax.jit(leg.inverse, static_argnames="routing")
#: The foot is pulled down by up to this force [N].
_MOST: Final = 20.0
#: Changes of the servos' angles from which speed (knee) and coupling (hip) follow [rad].
_STEP, _SWING = 0.05, 0.2
#: The foot of a swing, as long and as high as in the experiments [m].
_STRIDE, _LIFT = 0.060, 0.010
ABOUT: Final = {
    "pair": Column("1", "front or rear leg"),
    "routing": Column("1", "of the knee's tendon"),
    "hinges": Column("1", "of each compliant joint"),
    "force": Column("N", "downward pull at the neutral foot at which the first servo reaches its torque limit"),
    "speed": Column("m/s", "of the rising foot per rad/s of the knee servo, times that servo's 15 rad/s"),
    "work": Column("J", "of both servos where they drive, in a slow swing of the foot"),
    "coupling": Column("1", "knee's bend per swing of the hip to the side that it bends to, knee servo held"),
    "bend": Column("rad", f"of the knee under {TORQUE:g} N m, without its tendon"),
}
CASES: Final = tuple(
    {"pair": pair, "routing": routing, "hinges": hinges}
    for pair in LEGS
    for routing, hinges in (*((routing, 1) for routing in ROUTINGS), *(("type3", n) for n in HINGES[1:]))
)


def run(settings: Settings) -> Outcome:
    """Measure all routings, and chains of hinges; see `measured`."""
    return measured(NAME, settings, ABOUT, CASES, _measure)


def _measure(parameters: ModelParameters, pair: str, routing: str, hinges: int) -> dict[str, float]:
    limb, neutral = f"{pair}_left", np.array(LEGS[pair].neutral_foot)

    def stand() -> Stand:
        return Stand(assemble_leg(limb, routing, parameters, hinges))

    rest = servo_angles(pair, neutral, routing)
    higher, lower = (stand().settle(rest + np.array([0.0, step])).site(f"{limb}_foot")[2] for step in (_STEP, -_STEP))
    swung = [stand().settle(rest + np.array([angle, 0.0])) for angle in (_SWING, -_SWING)]
    hip, knee = (swung[0].angle(f"{limb}_{joint}") - swung[1].angle(f"{limb}_{joint}") for joint in ("hip", "knee"))
    swing = swing_of(pair, routing)
    return {
        "force": stand().settle(rest).held(f"{limb}_foot", (0.0, 0.0, -1.0), _MOST),
        "speed": float(abs(higher - lower) / (2 * _STEP) * parameters.servo.speed),
        "work": stand().settle(swing(0.0)).work(swing)[1],
        "coupling": LEGS[pair].knee_direction * knee / hip,
        "bend": bend(assemble_leg(limb, routing, parameters, hinges), [f"{limb}_knee"], TORQUE),
    }


def servo_angles(pair: str, foot: np.ndarray, routing: str) -> np.ndarray:
    """Servo angles (..., 2) [rad] that put the foot at (..., 2) = (y, z) [m], in double precision."""
    with jax.enable_x64(True):
        return np.asarray(_inverse(leg.leg_of(LEGS[pair]), foot, routing).servo)


def swing_of(pair: str, routing: str) -> Any:
    """The servo angles of a swing, from 0 to 1: the foot goes forward by the longest stride, on a parabola."""
    share = np.linspace(0.0, 1.0, 101)
    foot = np.stack([_STRIDE * (0.5 - share), 4.0 * _LIFT * share * (1.0 - share)], axis=-1)
    servo = servo_angles(pair, foot + LEGS[pair].neutral_foot, routing)
    return lambda at: [np.interp(at, share, angle) for angle in servo.T]
