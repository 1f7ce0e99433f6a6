"""The stand of the spine: lateral, vertical and combined bends of both robots."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from nermo_mjx.experiments.body import TORQUE
from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.experiments.stands.stand import HINGES, Stand, bend, measured
from nermo_mjx.robot import ModelParameters, assemble_spine
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.parameters import SPINE
from nermo_mjx.robot.quantity import replace_quantities, values_of

NAME: Final = "spine-stand"
#: The spine's end is pushed by up to this force [N].
_MOST: Final = 40.0
#: Change of the servos' angles, from which a speed follows [rad].
_STEP: Final = 0.05
_LATERAL: Final = tuple(f"spine_joint_{i}" for i in range(1, 5))
_VERTICAL: Final = tuple(f"spine_vertical_{i}" for i in range(1, 5))
#: Share of each of the servos in a plane, the lateral and the vertical one; the joints, and the way of the force.
PLANES: Final = {
    "lateral": ((1.0, 0.0), _LATERAL, (-1.0, 0.0, 0.0)),
    "vertical": ((0.0, 1.0), _VERTICAL, (0.0, 0.0, -1.0)),
    "combined": ((1.0, 1.0), _LATERAL + _VERTICAL, (-(0.5**0.5), 0.0, -(0.5**0.5))),
}
ABOUT: Final = {
    "robot": Column("1", "whose spine"),
    "plane": Column("1", "in which it bends: both servos have the same angle in the combined one"),
    "hinges": Column("1", "of each compliant joint"),
    "joint_angle": Column("rad", f"mean of the bent joints at {SPINE.max_servo_angle:g} rad of the servos"),
    "range": Column(
        "m", f"from the hip's place at {SPINE.max_servo_angle:g} rad of the servos to that at the opposite"
    ),
    "force": Column(
        "N", "against the bend, at the hip of the straight spine, at which a servo reaches its torque limit"
    ),
    "speed": Column("m/s", "of the hip per rad/s of the servos, in the straight spine, times their 15 rad/s"),
    "work": Column("J", f"of the servos in a slow bend to {SPINE.max_servo_angle:g} rad of them"),
    "bend": Column("rad", f"of these joints together, each under {TORQUE:g} N m, without tendons"),
}
CASES: Final[tuple[dict[str, Any], ...]] = (
    *({"robot": "nermo_lite", "plane": "lateral", "hinges": hinges} for hinges in HINGES),
    *({"robot": "nermo_41", "plane": plane, "hinges": 1} for plane in PLANES),
)


def run(settings: Settings) -> Outcome:
    """Measure all planes, and chains of hinges; see `measured`."""
    return measured(NAME, settings, ABOUT, CASES, _measure)


def _measure(parameters: ModelParameters, robot: str, plane: str, hinges: int) -> dict[str, float]:
    parameters = _of_robot(parameters, robot)
    shares, joints, way = PLANES[plane]
    share = np.array(shares[: 2 if robot == "nermo_41" else 1])

    def stand() -> Stand:
        return Stand(assemble_spine(parameters, robot, hinges))

    ends = [stand().settle(sign * SPINE.max_servo_angle * share) for sign in (1.0, -1.0)]
    near = [stand().settle(sign * _STEP * share).site("spine_end") for sign in (1.0, -1.0)]
    return {
        "joint_angle": float(np.mean([ends[0].angle(joint) for joint in joints])),
        "range": float(np.linalg.norm(ends[0].site("spine_end") - ends[1].site("spine_end"))),
        "force": stand().settle(0.0 * share).held("spine_end", way, _MOST),
        "speed": float(np.linalg.norm(near[0] - near[1]) / (2 * _STEP) * parameters.servo.speed),
        "work": stand().settle(0.0 * share).work(lambda at: at * SPINE.max_servo_angle * share)[0],
        "bend": bend(assemble_spine(parameters, robot, hinges), joints, TORQUE),
    }


def _of_robot(parameters: ModelParameters, robot: str) -> ModelParameters:
    """The parameters with the robot's masses, unless they are set."""
    default = dict(values_of(ModelParameters()))
    own = {name: value for name, value in mass_values(robot).items()
           if float(dict(values_of(parameters))[name]) == float(default[name])}  # fmt: skip
    return replace_quantities(parameters, {name: np.asarray(value) for name, value in own.items()})
