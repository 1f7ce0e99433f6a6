"""The tail's chain of segments, built from its numbers: bodies, joints, eyelets of the tendons, and contact geoms."""

from __future__ import annotations

import math
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.robot.mirror import turn
from nermo_mjx.robot.parameters import SPINE, TAIL

#: Half the width of the pulley [m], and the positions of the eyelets along a segment of the published length [m].
_PULLEY_WIDTH: Final = 0.0010
_EYELET: Final = 0.5 * TAIL.spacing
#: The last segments, numbered from 1, whose ends may touch the ground besides the tip.
_GROUNDED: Final = (16, 17, 18)


def add_tail(spec: mujoco.MjSpec, length: float) -> None:
    """Place the base of `mjcf/tail.xml` and append the segments.

    Args:
        spec: as it was read.
        length: from the first joint backward to the centre of the tip [m]; the whole chain is stretched to it.
    """
    stretch = length / TAIL.length
    ends = [(TAIL.spacing, drop) for drop in TAIL.drops] + [TAIL.tip]
    _base(spec, round(math.atan2(TAIL.drops[0], TAIL.spacing), 6))
    parent, place = spec.worldbody, np.array([0.0, *TAIL.first_joint])
    for i, (along, drop) in enumerate(ends, 1):
        end = np.array([0.0, along * stretch, -drop * stretch])
        width = round(TAIL.eyelet - TAIL.taper * (i - 1), 6)
        parent = parent.add_body(name=f"segment_{i}", pos=place)
        parent.add_joint(spec.find_default("tail"), name=f"joint_{i}")
        _draw(spec, parent, i, end, width)
        eyelets = {side: f"{side}_{i}" for side in ("left", "right")}
        for sign, (side, name) in zip((1.0, -1.0), eyelets.items(), strict=True):
            middle = end * (_EYELET / along)
            parent.add_site(spec.find_default("marker"), name=name, pos=[sign * width, middle[1], middle[2]])
            spec.tendon(side).wrap_site(name)
        if i in _GROUNDED or i == len(ends):
            last = i == len(ends)
            geom, site = ("tip", "touch") if last else (f"ground_{i}", f"touch_{i}")
            radius = TAIL.tip_radius if last else width
            parent.add_geom(spec.find_default("ground"), name=geom, pos=end, size=[radius, 0.0, 0.0])
            parent.add_site(spec.find_default("touch"), name=site, pos=end)
        place = end
    spec.delete(spec.mesh("segment"))


def _base(spec: mujoco.MjSpec, pitch: float) -> None:
    """The pulley and the first eyelets, in a frame that points along the first segment."""
    turn(spec.frame("base"), -pitch, 0.0, 0.0)
    spec.geom("pulley").size = np.array([SPINE.pulley_radius, _PULLEY_WIDTH, 0.0])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, (x, y) in (("side", TAIL.side), ("rim", TAIL.tie), ("0", (TAIL.eyelet, 0.0100))):
            spec.site(f"{side}_{name}").pos = np.array([sign * x, y, 0.0])


def _draw(spec: mujoco.MjSpec, segment: Any, i: int, end: np.ndarray, width: float) -> None:
    """A bead as wide as its eyelets, reaching to the next joint, and a cord through the joint."""
    bead, name = spec.mesh("segment"), f"segment_{i}"
    across = width / TAIL.eyelet
    # The last one ends at the tip, and is no shorter than the others.
    long = math.hypot(end[1], end[2]) / TAIL.spacing if i <= len(TAIL.drops) else 1.0
    spec.add_mesh(name=name, uservert=bead.uservert, userface=bead.userface,
                  scale=1e-3 * np.array([across, long, across]))  # fmt: skip
    drawn = segment.add_geom(spec.find_default("visual"), meshname=name)
    turn(drawn, math.atan2(end[2], end[1]), 0.0, 0.0)
    half = 0.001 * end / end[1]
    cord = segment.add_geom(spec.find_default("cord"), size=[0.36 * width, 0.0, 0.0])
    cord.fromto = np.concatenate([-half, half])
