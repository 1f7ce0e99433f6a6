"""Parameters of the trajectory 'free' (`free_stepping`): of each limb, of the points of its foot's path, and trim.

All are offsets to the published gait, and factors of it; with their defaults the gait is the published one.
"""

from __future__ import annotations

from typing import Any

from nermo_mjx.robot.parameters import LIMBS
from nermo_mjx.robot.quantity import parameter_tree, quantity

#: Pairs of limbs, then limbs: the value of a pair applies to both of its limbs, and that of a limb is added to it.
PAIRS_AND_LIMBS = ("front", "rear", *LIMBS)
#: Points of a foot's path: touch-down, three in stance, lift-off, three in swing.
FOOT_POINTS = 8


def _of_limbs(default: float, unit: str, low: float, high: float, doc: str) -> Any:
    return quantity((default,) * len(PAIRS_AND_LIMBS), unit, low, high, doc, labels=PAIRS_AND_LIMBS)


@parameter_tree
class Limb:
    """Differences between limbs, with the trajectory 'free'. The values of a pair and of its limb are combined."""

    stride: Any = _of_limbs(1.0, "1", 0.0, 2.0, "the limb's stride, as a share of that of the gait")
    lift: Any = _of_limbs(0.0, "m", -0.02, 0.02, "higher mid-swing than stance.swing_amplitude")
    duty: Any = _of_limbs(0.0, "1", -0.4, 0.4, "longer stance than duty, as a share of the cycle")
    phase: Any = _of_limbs(0.0, "1", -0.5, 0.5, "later stance than offset, as a share of the cycle")


def _foot_path() -> Any:
    return quantity(
        (0.0,) * 2 * FOOT_POINTS,
        "m",
        -0.02,
        0.02,
        "y backward or z up, 1 touch-down, 2-4 stance, 5 lift-off, 6-8 swing",
        labels=tuple(f"{axis}{point}" for axis in "yz" for point in range(1, FOOT_POINTS + 1)),
    )


@parameter_tree
class FootPaths:
    """Displacements of eight points of a foot's path, with the trajectory 'free'. A pair's are added to its limb's."""

    front: Any = _foot_path()
    rear: Any = _foot_path()
    front_left: Any = _foot_path()
    front_right: Any = _foot_path()
    rear_left: Any = _foot_path()
    rear_right: Any = _foot_path()


@parameter_tree
class Trim:
    """Offsets of servo angles, with the trajectory 'free'. A pair's value is added to its limb's."""

    spine: Any = quantity(0.0, "rad", -0.4, 0.4, "added to the spine servo, positive left")
    hip: Any = _of_limbs(0.0, "rad", -0.5, 0.5, "added to the hip servo, positive backward")
    knee: Any = _of_limbs(0.0, "rad", -0.5, 0.5, "added to the knee servo")
