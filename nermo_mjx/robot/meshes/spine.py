"""The spine: vertebrae between the lateral joints, their flexures, the stubs at both ends, and the tendon's pulley.

In a joint's frame x is back and -y left; the tendons run parallel to x, beside the axis.
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np
from jaxtyping import Float

from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.meshes.leg import grooved_pulley, pulley_holes
from nermo_mjx.robot.meshes.numbers import MM, dh_pose
from nermo_mjx.robot.meshes.shapes import Shape, block, join, loft, rotation, rounded_rectangle, turned_part
from nermo_mjx.robot.parameters import SPINE

#: Where a tendon leaves a vertebra before the next joint [mm], and how far beside the axis.
EXIT: Final = MM * SPINE.segment_length / 2
BESIDE: Final = MM * SPINE.segment_offset
#: Half-height of the end discs, and half-width of the body between them [mm].
HEIGHT: Final = 4.6
WAIST: Final = 3.3
#: Half the width of the pulley [mm].
PULLEY_WIDTH: Final = 1.2


def spine_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the spine, by file name."""
    joints = SPINE.lateral_joints
    shapes = {
        f"vertebra_{i}": vertebra(dh_pose(here, there, geometry))
        for i, (here, there) in enumerate(itertools.pairwise(joints), 1)
    }
    shapes["spine_front"] = front_stub(geometry)
    shapes["spine_rear"] = rear_stub()
    shapes["spine_flexure"] = flexure()
    shapes["spine_segment"] = segment()
    radius = MM * float(geometry.spine.pulley_radius)
    upright = rotation("y", -np.pi / 2)
    shapes["spine_pulley"] = grooved_pulley(radius, PULLEY_WIDTH).transformed(upright)
    shapes["spine_pulley_holes"] = pulley_holes(radius, PULLEY_WIDTH).transformed(upright)
    return shapes


def end_disc() -> Shape:
    """The disc from which the tendons come: an oval with an eyelet on each side, from x = -EXIT - 1.5 to -EXIT."""
    oval = turned_part([(-EXIT - 1.5, 0.9), (-EXIT - 1.2, 1.0), (-EXIT - 0.3, 1.0), (-EXIT, 0.9)], 12)
    oval = Shape(oval.vertices * [1.0, BESIDE + 0.4, HEIGHT], oval.faces)
    eyelet = turned_part([(-EXIT - 1.8, 1.25), (-EXIT + 0.15, 1.25)], 6)
    return join(oval, eyelet.moved(y=BESIDE), eyelet.moved(y=-BESIDE))


def vertebra(after: Float[np.ndarray, "4 4"]) -> Shape:
    """From one joint to the next, whose pose is `after`: two discs, the body between them, and a spinous process."""
    front = end_disc().turned("z", np.pi)
    rear = end_disc().transformed(after[:3, :3], after[:3, 3])
    return join(
        front, rear, _body(_pose_along(np.eye(4), EXIT), after @ _pose_along(np.eye(4), -EXIT)), _process(after)
    )


def front_stub(geometry: Geometry) -> Shape:
    """From the torso's frame to the first joint, in the torso's frame."""
    joint = dh_pose(-1, SPINE.lateral_joints[0], geometry)
    disc = end_disc().transformed(joint[:3, :3], joint[:3, 3])
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = rotation("z", np.pi / 2), (0.0, -4.0, -0.4)
    return join(disc, _body(start, joint @ _pose_along(np.eye(4), -EXIT)))


def rear_stub() -> Shape:
    """From the last joint into the hip, in the joint's frame."""
    return join(end_disc().turned("z", np.pi), _body(_pose_along(np.eye(4), EXIT), _pose_along(np.eye(4), 4.5)))


def segment() -> Shape:
    """Between two joints of Nermo 4.1, whose axes cross: a disc on a hub, with an eyelet on each of four sides."""
    length = MM * SPINE.dh[SPINE.lateral_joints[0]][1]
    hub = turned_part([(EXIT, 3.0), (length - EXIT, 3.0)], 8)
    disc = turned_part([(length / 2 - 0.8, 6.6), (length / 2 + 0.8, 6.6)], 16)
    eyelet = turned_part([(EXIT - 0.15, 1.15), (length - EXIT + 0.15, 1.15)], 5)
    eyelets = [eyelet.moved(y=side * BESIDE) for side in (1, -1)] + [eyelet.moved(z=side * BESIDE) for side in (1, -1)]
    return join(hub, disc, *eyelets)


def flexure() -> Shape:
    """The leaf that bends in every joint: thin sideways, tall, with a bead along its middle."""
    leaf = block((-EXIT - 0.4, -0.55, -HEIGHT + 1.0), (EXIT + 0.4, 0.55, HEIGHT - 1.0), 0.2)
    bead = turned_part([(0.8 - HEIGHT, 1.1), (HEIGHT - 0.8, 1.1)], 8)
    return join(leaf, bead.transformed(rotation("y", np.pi / 2)))


def _pose_along(pose: np.ndarray, x: float) -> np.ndarray:
    moved = np.eye(4)
    moved[0, 3] = x
    return pose @ moved


def _body(start: np.ndarray, end: np.ndarray) -> Shape:
    """A waisted bar from one frame's origin to the other's, its section across their x axes."""
    rings = []
    for share, swell in ((0.0, 1.15), (0.2, 1.0), (0.5, 0.82), (0.8, 1.0), (1.0, 1.15)):
        centre = (1 - share) * start[:3, 3] + share * end[:3, 3]
        axes = (1 - share) * start[:3, :3] + share * end[:3, :3]
        section = rounded_rectangle(WAIST * swell, 0.72 * HEIGHT * swell, 1.2)
        rings.append(centre + section @ axes[:, 1:].T)
    return loft(rings)


def _process(after: np.ndarray) -> Shape:
    """The fin on a vertebra's back, leaning to the rear."""
    middle = after[:3, 3] / 2
    rings = []
    for height, reach, width, lean in ((2.0, 3.4, 1.5, 0.0), (HEIGHT, 2.4, 1.1, 0.6), (HEIGHT + 2.6, 1.2, 0.7, 1.9)):
        section = rounded_rectangle(reach, width, 0.5)
        rings.append(middle + np.column_stack([section[:, 0] + lean, section[:, 1], np.full(8, height)]))
    return loft(rings)
