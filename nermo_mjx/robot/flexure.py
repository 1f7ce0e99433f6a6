"""Compliant joints as chains of hinges.

Knees, ankles and spine joints are flexures, leaves that bend. One hinge with a torsion spring stands for a leaf by
default. A chain of n hinges divides it into n equal parts, with a hinge in the middle of each that is n times as stiff
as the leaf: in series they are as stiff as the one hinge, and with growing n they approach an elastica.

All hinges of a chain belong to one body, so neither bodies nor masses are added: MuJoCo applies the joints of a body
one after the other. No leaf's length is published. Here it is `SpineGeometry.segment_length`, the distance of the
vertebrae at a joint, in the legs as well; and the leaves are straight in the published stance, in which a chain
therefore coincides with one hinge.
"""

from __future__ import annotations

import re
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.robot.parameters import LEGS, SPINE

#: Most hinges of a chain: MuJoCo allows a body six degrees of freedom.
MOST_HINGES: Final = 6
_COMPLIANT: Final = re.compile(r"knee|ankle|(joint|vertical)_\d")
_HINGE: Final = "_hinge_"


def add_hinges(part: mujoco.MjSpec, hinges: int) -> None:
    """Turn every compliant joint of a leg or the spine into a chain, named `JOINT_hinge_1` to `JOINT_hinge_N`.

    Args:
        part: before it is attached, so that the angles of all hinges are in its unit.
        hinges: of each chain; one is left as it is.
    """
    if hinges == 1:
        return
    for joint in [joint for joint in part.joints if _COMPLIANT.fullmatch(joint.name)]:
        body, name = joint.parent, joint.name
        for number in range(1, hinges + 1):
            hinge = joint if number == 1 else body.add_joint(type=joint.type, axis=joint.axis)
            hinge.name = f"{name}{_HINGE}{number}"


def place_hinges(spec: mujoco.MjSpec, hinges: int) -> None:
    """Put the hinges of every chain along its leaf, in the robot's zero pose."""
    for joint in spec.joints:
        _, chained, number = joint.name.partition(_HINGE)
        if chained:
            share = (int(number) - 0.5) / hinges - 0.5
            joint.pos = share * SPINE.segment_length * _direction(joint, hinges)


def chain_of(joint: str) -> str:
    """The compliant joint that a hinge belongs to, and any other joint itself.

    >>> chain_of("front_left_knee_hinge_2"), chain_of("neck")
    ('front_left_knee', 'neck')
    """
    return joint.partition(_HINGE)[0]


def _direction(joint: Any, hinges: int) -> np.ndarray:
    """Unit vector along a leaf in its body's frame, away from the torso.

    The spine's leaves run along x. Those of the legs halve the angle between the links that they join, which run
    along -z.
    """
    name = chain_of(joint.name)
    if name.startswith("spine"):
        return np.array([1.0, 0.0, 0.0])
    turn = hinges * joint.ref * joint.axis[0] if name.endswith("knee") else -LEGS[name.split("_")[0]].theta3
    return np.array([0.0, -np.sin(turn / 2), -np.cos(turn / 2)])
