"""The servo, the same for all joints: its output turns about x, the horn is at the origin, the case at x < 0."""

from __future__ import annotations

from typing import Final

from nermo_mjx.robot.meshes.numbers import MM, SERVO_WIDTH
from nermo_mjx.robot.meshes.shapes import Shape, block, join, turned_part
from nermo_mjx.robot.parameters import SERVO_DEPTH

#: Depth along the axis, and reach before and behind it [mm]; approximately the case of a Power HD-DSM44.
DEPTH: Final = MM * SERVO_DEPTH
BEFORE: Final = 6.0
BEHIND: Final = 13.0


def servo() -> Shape:
    """Case in three shells, mounting ears, gear boss."""
    w = SERVO_WIDTH / 2
    lid = block((-4.6, -BEFORE, -w), (0.0, BEHIND, w), 0.7)
    middle = block((-15.4, -BEFORE + 0.25, -w + 0.25), (-4.0, BEHIND - 0.25, w - 0.25), 0.5)
    bottom = block((-DEPTH, -BEFORE, -w), (-15.0, BEHIND, w), 0.7)
    ears = block((-6.0, -BEFORE - 1.8, -w + 0.8), (-4.9, BEHIND + 1.8, w - 0.8), 0.3)
    boss = turned_part([(-0.5, 3.6), (0.5, 3.4), (0.5, 2.2), (2.0, 2.0)], 14)
    return join(lid, middle, bottom, ears, boss)
