"""The meshes that follow the robot's lengths; `docs/meshes.py` draws those that are the same in all worlds.

Legs are links with clevis joints and torsion springs at the knees. A left leg in its own frames (x outward): the tendon
runs in the plane x = 0, between the two cheeks of the upper leg.
"""

from __future__ import annotations

import itertools
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.robot.geometry import Geometry, leg_geometry
from nermo_mjx.robot.meshes.shapes import (
    MM,
    SERVO_WIDTH,
    TENDON_RADIUS,
    Shape,
    beam,
    block,
    creased,
    dh_pose,
    frame_plate,
    join,
    loft,
    plate,
    rotation,
    rounded_rectangle,
    strut,
    superellipse,
    tube,
    turned_part,
)
from nermo_mjx.robot.parameters import (
    BODY_GEOMETRY,
    FRONT_LEG,
    LEGS,
    PULLEY_RIM,
    REAR_LEG,
    SERVO_DEPTH,
    SPINE_GEOMETRY,
    LegGeometry,
)
from nermo_mjx.robot.parts import hundredths

#: Ratio of the rear legs' thickness to the front legs'.
LEG_THICKNESS_RATIOS: Final = {"front": 1.0, "rear": 1.12}
#: Inner and outer face of a cheek of the upper leg, and half the thickness of the link between the cheeks [mm].
CHEEK: Final = (1.65, 3.1)
TONGUE: Final = 1.35


def leg_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of both pairs of legs, by file name."""
    shapes = {}
    for pair in LEGS:
        leg, stout = leg_geometry(geometry, pair), LEG_THICKNESS_RATIOS[pair]
        shapes[f"{pair}_upper"] = upper(leg, stout)
        shapes[f"{pair}_lower"] = lower(leg, stout)
        shapes[f"{pair}_foot"] = foot(leg, stout)
        shapes[f"{pair}_spring"] = knee_spring(leg, stout)
    return shapes


def grooved_pulley(radius: float, half_width: float, tendon: float = TENDON_RADIUS) -> Shape:
    """A pulley about the x axis; a tendon of radius `tendon` lies in its groove, its middle at `radius` [mm]."""
    rim, floor, w = radius + MM * PULLEY_RIM, radius - tendon - 0.1, half_width
    profile = [
        (-w, rim),
        (-0.55, floor),
        (0.55, floor),
        (w - 0.1, rim),
        (w, radius - 1.0),
        (w - 0.4, radius - 1.4),
        (w - 0.4, 2.4),
        (w + 0.4, 2.0),
    ]
    return turned_part(profile, 20)


def pulley_holes(radius: float, half_width: float, count: int = 5) -> Shape:
    """Dark discs that look like lightening holes in the pulley and make its rotation visible."""
    middle, size = (radius + 0.9) / 2, (radius - 4.1) / 2.9
    disc = turned_part([(0.0, size), (half_width - 0.36, size)], 8)
    angles = 2 * np.pi * np.arange(count) / count
    return join(*(disc.moved(y=middle * np.cos(a), z=middle * np.sin(a)) for a in angles))


def upper(leg: LegGeometry, stout: float) -> Shape:
    """From the hip servo's horn to the knee: two cheeks with a bridge between them."""
    length, (near, far) = MM * leg.l1, CHEEK
    outline = strut((0.0, 0.0), (0.0, -length), 3.3 * stout, 2.4 * stout)
    window = strut((0.0, -6.2), (0.0, 5.6 - length), 1.5 * stout, 0.9 * stout)
    cheek = frame_plate(outline, window, near, far)
    # The bridge lies on the side away from the tendon.
    bridge = block((-near - 0.3, -0.8, -0.64 * length), (near + 0.3, 0.8, -0.30 * length))
    horn = turned_part([(-4.2, 3.0), (-far - 0.2, 3.3), (-near, 3.3), (-near + 0.2, 2.0)], 16)
    return join(cheek, cheek.mirrored(), bridge.moved(y=-1.5 * leg.knee_direction), horn)


def lower(leg: LegGeometry, stout: float) -> Shape:
    """From the knee to the ankle: a tongue between the cheeks above, a fork below; the tendon is tied to a lug."""
    length, tie, side = MM * leg.l3, MM * leg.l2, leg.knee_direction
    tongue = plate(
        strut((0.0, 0.0), (0.0, 5.0 - length), 2.2 * stout, 1.5 * stout), -TONGUE, TONGUE
    )
    fork = plate(
        strut((0.0, 4.8 - length), (0.0, -length), 1.4 * stout, 1.7 * stout), 1.0, 2.1, 0.25
    )
    yoke = block((-2.1, -1.35 * stout, 3.6 - length), (2.1, 1.35 * stout, 5.8 - length), 0.4)
    lug = plate(strut((0.0, 0.6 - tie), (1.6 * side, -tie), 1.3, 0.8), -TONGUE + 0.3, TONGUE - 0.3)
    return join(tongue, fork, fork.mirrored(), yoke, lug)


def foot(leg: LegGeometry, stout: float) -> Shape:
    """From the ankle into the paw, slimmer where it flexes."""
    length = MM * leg.l4
    stations = (
        (0.0, 1.9, 1.0),
        (-2.0, 1.8, 1.0),
        (-0.35 * length, 1.25, 1.05),
        (-0.6 * length, 1.2, 1.2),
        (-length + 1.5, 1.6, 1.9),
    )
    rings = []
    for z, depth, width in stations:
        section = superellipse(width, 0.9 * depth * stout, 3.0, 10)
        rings.append(np.column_stack([section, np.full(10, z)]))
    knuckle = turned_part(
        [(-0.95, 1.5 * stout), (-0.75, 1.7 * stout), (0.75, 1.7 * stout), (0.95, 1.5 * stout)], 14
    )
    return join(loft(rings), knuckle)


def knee_spring(leg: LegGeometry, stout: float) -> Shape:
    """A torsion spring on the knee's pin, outside the outer cheek; its end lies along the upper leg."""
    turns, radius, wire, start = 3, 2.2 * stout, 0.3, CHEEK[1] + 0.1
    t, side = np.linspace(0.0, 1.0, 8 * turns + 1), leg.knee_direction
    angle = (np.pi if side > 0 else 0.0) + 2 * np.pi * turns * t * side
    coil = np.column_stack([start + wire + 1.3 * t, radius * np.cos(angle), radius * np.sin(angle)])
    end = [start + wire, -radius * side, 8.5 * stout]
    spring = tube(np.concatenate([[end], coil]), (wire, wire), 3, up=(1.0, 0.0, 0.0))
    pin = turned_part([(-CHEEK[1] - 0.4, 1.2), (start + 1.7, 1.2), (start + 1.9, 0.9)], 10)
    return join(spring, pin)


# ---
# The case of a servo: its output turns about x, the horn is at the origin, the case at x < 0.


#: Depth along the axis, and reach before and behind it [mm]; approximately the case of a Power HD-DSM44.
SERVO_CASE_DEPTH: Final = MM * SERVO_DEPTH
SERVO_CASE_FRONT: Final = 6.0
SERVO_CASE_BACK: Final = 13.0


# ---
# The hip: the bracket of the rear legs' stacked servos and of the spine's servo, and the tail's support.
#
# The frame is that of the spine end: x left, y back, z up.


#: The bar toward the spine, and the rump: y, middle z, half-width, half-height [mm].
NECK_SECTIONS: Final = (
    (0.5, 0.6, 4.0, 3.4),
    (3.0, -2.2, 5.0, 2.4),
    (7.0, -4.2, 7.0, 1.8),
    (11.0, -4.4, 8.0, 1.6),
)
RUMP_SECTIONS: Final = (
    (20.0, -9.4, 11.0, 6.6),
    (25.0, -8.6, 10.0, 6.0),
    (29.5, -7.0, 7.0, 4.6),
    (32.0, -5.8, 3.6, 2.6),
)


def hip_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the hip, by file name."""
    hip = geometry.hip
    x, y, z = (MM * float(value) for value in (hip.x, hip.y, hip.z))
    upper = z + MM * REAR_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - SERVO_CASE_FRONT, y + SERVO_CASE_BACK
    side, inner = x - 5.0, x - 23.4
    bracket = [
        block((-side, low + 0.6, z + w), (side, high - 0.6, upper - w), 0.4),
        block((-side, low + 0.6, z - w - 1.4), (side, high - 0.6, z - w), 0.5),
    ]
    lid = block((inner, low + 0.6, upper + w), (side, high - 0.6, upper + w + 1.4), 0.5)
    wall = block((inner - 1.2, low, z - w - 1.4), (inner, high, upper + w + 1.4), 0.4)
    core = block((-11.0, low + 3.0, z - w - 1.0), (11.0, high + 2.5, z + w + 1.0), 1.2)
    mast = block((-4.5, 19.5, -6.0), (4.5, 29.0, 3.6), 1.2)
    return {
        "hip_bracket": join(*bracket, lid.with_mirror_image(), wall.with_mirror_image()),
        "hip_core": join(core, beam(NECK_SECTIONS, 0.9), beam(RUMP_SECTIONS, 2.4), mast),
    }


# ---
# The spine: vertebrae between the lateral joints, their flexures, the stubs at both ends, and the tendon's pulley.
#
# In a joint's frame x is back and -y left; the tendons run parallel to x, beside the axis.


#: Where a tendon leaves a vertebra before the next joint [mm], and how far beside the axis.
TENDON_EXIT: Final = MM * SPINE_GEOMETRY.segment_length / 2
TENDON_OFFSET: Final = MM * SPINE_GEOMETRY.segment_offset
#: Half-height of the end discs, and half-width of the body between them [mm].
DISC_HALF_HEIGHT: Final = 4.6
WAIST: Final = 3.3
#: Half the width of the pulley [mm].
SPINE_PULLEY_WIDTH: Final = 1.2


def spine_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the spine, by file name."""
    joints = SPINE_GEOMETRY.lateral_joints
    shapes = {
        f"vertebra_{i}": vertebra(dh_pose(joint, next_joint, geometry))
        for i, (joint, next_joint) in enumerate(itertools.pairwise(joints), 1)
    }
    shapes["spine_front"] = front_stub(geometry)
    radius = MM * float(geometry.spine.pulley_radius)
    upright = rotation("y", -np.pi / 2)
    shapes["spine_pulley"] = grooved_pulley(radius, SPINE_PULLEY_WIDTH).transformed(upright)
    shapes["spine_pulley_holes"] = pulley_holes(radius, SPINE_PULLEY_WIDTH).transformed(upright)
    return shapes


def end_disc() -> Shape:
    """The disc from which the tendons come: an oval with an eyelet on each side, from x = -TENDON_EXIT - 1.5 to -TENDON_EXIT."""
    oval = turned_part(
        [
            (-TENDON_EXIT - 1.5, 0.9),
            (-TENDON_EXIT - 1.2, 1.0),
            (-TENDON_EXIT - 0.3, 1.0),
            (-TENDON_EXIT, 0.9),
        ],
        12,
    )
    oval = Shape(oval.vertices * [1.0, TENDON_OFFSET + 0.4, DISC_HALF_HEIGHT], oval.faces)
    eyelet = turned_part([(-TENDON_EXIT - 1.8, 1.25), (-TENDON_EXIT + 0.15, 1.25)], 6)
    return join(oval, eyelet.moved(y=TENDON_OFFSET), eyelet.moved(y=-TENDON_OFFSET))


def vertebra(pose: Float[np.ndarray, "4 4"]) -> Shape:
    """From one joint to the next, whose pose is `after`: two discs, the body between them, and a spinous process."""
    front = end_disc().turned("z", np.pi)
    rear = end_disc().transformed(pose[:3, :3], pose[:3, 3])
    return join(
        front,
        rear,
        waisted(pose_along(np.eye(4), TENDON_EXIT), pose @ pose_along(np.eye(4), -TENDON_EXIT)),
        _process(pose),
    )


def front_stub(geometry: Geometry) -> Shape:
    """From the torso's frame to the first joint, in the torso's frame."""
    joint = dh_pose(-1, SPINE_GEOMETRY.lateral_joints[0], geometry)
    disc = end_disc().transformed(joint[:3, :3], joint[:3, 3])
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = rotation("z", np.pi / 2), (0.0, -4.0, -0.4)
    return join(disc, waisted(start, joint @ pose_along(np.eye(4), -TENDON_EXIT)))


def pose_along(pose: np.ndarray, x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return pose @ matrix


def waisted(start: np.ndarray, end: np.ndarray) -> Shape:
    """A waisted bar from one frame's origin to the other's, its section across their x axes."""
    rings = []
    for share, swell in ((0.0, 1.15), (0.2, 1.0), (0.5, 0.82), (0.8, 1.0), (1.0, 1.15)):
        centre = (1 - share) * start[:3, 3] + share * end[:3, 3]
        axes = (1 - share) * start[:3, :3] + share * end[:3, :3]
        section = rounded_rectangle(WAIST * swell, 0.72 * DISC_HALF_HEIGHT * swell, 1.2)
        rings.append(centre + section @ axes[:, 1:].T)
    return loft(rings)


def _process(pose: np.ndarray) -> Shape:
    """The fin on a vertebra's back, leaning to the rear."""
    middle = pose[:3, 3] / 2
    rings = []
    for height, reach, width, lean in (
        (2.0, 3.4, 1.5, 0.0),
        (DISC_HALF_HEIGHT, 2.4, 1.1, 0.6),
        (DISC_HALF_HEIGHT + 2.6, 1.2, 0.7, 1.9),
    ):
        section = rounded_rectangle(reach, width, 0.5)
        rings.append(
            middle + np.column_stack([section[:, 0] + lean, section[:, 1], np.full(8, height)])
        )
    return loft(rings)


# ---
# The chest: a back beam and a breastbone joined by flexible ribs, electronics inside, the shoulders' bracket ahead.
#
# In the torso's frame, the spine base: x left, y back, z up.


#: Where the neck's servo turns the head [mm].
TORSO_NECK: Final = tuple(MM * value for value in BODY_GEOMETRY.neck)
#: The back beam: y, middle z, half-width, half-height [mm].
BEAM: Final = (
    (-2.0, -0.6, 5.2, 3.0),
    (-9.0, -1.8, 4.4, 2.4),
    (-24.0, -4.4, 3.8, 2.0),
    (-44.0, -7.4, 4.0, 2.0),
    (-62.0, -10.2, 5.2, 2.2),
    (-74.0, -12.0, 6.0, 2.2),
)
#: The breastbone, likewise.
BREASTBONE: Final = (
    (-11.0, -44.5, 1.6, 1.1),
    (-17.0, -46.3, 2.6, 1.1),
    (-34.0, -49.8, 3.2, 1.1),
    (-50.0, -49.6, 3.6, 1.1),
    (-60.0, -44.0, 4.0, 1.1),
    (-63.0, -38.0, 4.0, 1.1),
)
#: Ribs: y at the back beam, half-width, lowest z, and how far its breastbone end lies in front of its back end [mm].
RIBS: Final = (
    (-13.0, 19.5, -45.5, 3.0),
    (-21.5, 21.8, -48.5, 2.5),
    (-30.0, 22.8, -50.0, 2.0),
    (-38.5, 22.6, -50.5, 1.5),
)


def back(y: float) -> float:
    """Height of the back beam's middle at y [mm]."""
    stations = np.array(BEAM)[::-1]
    return float(np.interp(y, stations[:, 0], stations[:, 1]))


def torso_frame(geometry: Geometry) -> Shape:
    """Back beam with its crests, breastbone, and the bracket that holds four servos and the neck's."""
    crests = [crest(y) for y in (*(numbers[0] for numbers in RIBS), -47.0, -55.0)]
    return join(beam(BEAM, 1.0), *crests, beam(BREASTBONE, 0.5), *shoulder_bracket(geometry))


def crest(y: float) -> Shape:
    """A fin on the back beam, where a rib is clamped."""
    rings = []
    for up, reach, width, lean in (
        (0.5, 2.6, 2.0, 0.0),
        (2.6, 2.0, 1.4, 0.5),
        (4.4, 1.0, 0.8, 1.6),
    ):
        section = rounded_rectangle(width, reach, 0.5)
        rings.append(
            np.column_stack([section[:, 0], section[:, 1] + y + lean, np.full(8, back(y) + up)])
        )
    return loft(rings)


def shoulder_bracket(geometry: Geometry) -> list[Shape]:
    """The bracket between and around the stacked servos of both front legs."""
    shoulder = geometry.shoulder
    x, y, z = (MM * float(value) for value in (shoulder.x, shoulder.y, shoulder.z))
    upper = z + MM * FRONT_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - SERVO_CASE_FRONT, y + SERVO_CASE_BACK
    side = x - 5.0
    plates = [
        block((-side, low + 0.8, upper + w), (side, high - 0.8, upper + w + 1.4), 0.5),
        block((-side, low + 0.8, z + w), (side, high - 0.8, upper - w), 0.4),
        block((-side, low + 0.8, z - w - 1.4), (side, high - 0.8, z - w), 0.5),
    ]
    core = block((-13.6, low, z - w - 1.0), (13.6, high, upper + w + 1.0), 1.0)
    post = block((-5.6, low - 1.5, upper + w - 1.0), (5.6, high, back(-60.0) + 1.0), 1.0)
    # The neck's servo stands upright before the bracket; its clamp reaches around it.
    clamp = block(
        (-7.0, TORSO_NECK[1] - 8.0, TORSO_NECK[2] - 17.0),
        (7.0, low + 2.0, TORSO_NECK[2] - 8.5),
        1.2,
    )
    collar = turned_part([(-2.2, 7.2), (-1.7, 7.6), (-0.5, 7.6), (0.0, 7.0)], 18)
    return [
        *plates,
        core,
        post,
        clamp,
        Shape(collar.vertices[:, [1, 2, 0]] + TORSO_NECK, collar.faces),
    ]


# ---
# The meshes of an assembled robot.


def shapes(geometry: Geometry) -> dict[str, Shape]:
    """All meshes that follow the geometry, by file name."""
    frame = {"torso_frame": torso_frame(geometry)}
    return frame | hip_shapes(geometry) | spine_shapes(geometry) | leg_shapes(geometry)


def redraw(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    """Replace an assembled robot's meshes from the files by those of its geometry.

    Args:
        spec: of the robot.
        geometry: that it was assembled with.
    """
    # The spine's are attached with its name as prefix.
    meshes = {
        **shapes(geometry),
        **{
            f"spine_{name.removeprefix('spine_')}": shape
            for name, shape in spine_shapes(geometry).items()
        },
    }
    for mesh in spec.meshes:
        # Both sides share one file; the right side is mirrored by its scale.
        shape = meshes.get(mesh.name.replace("_left_", "_").replace("_right_", "_"))
        if shape is not None:
            shape = creased(shape)
            mesh.uservert, mesh.userface = (hundredths(shape) / 100).ravel(), shape.faces.ravel()
