"""Legs: links with clevis joints, torsion springs at the knees, grooved pulleys and rubber paws.

A left leg in its own frames (x outward): the tendon runs in the plane x = 0, between the two cheeks of the upper leg.
"""

from __future__ import annotations

import itertools
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from nermo_mjx.robot.geometry import Geometry, leg_geometry
from nermo_mjx.robot.meshes.shapes import (
    MM,
    SERVO_WIDTH,
    TENDON,
    Shape,
    ball,
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
    BODY,
    EYE,
    FRONT_LEG,
    LEGS,
    PULLEY_RIM,
    REAR_LEG,
    SERVO_DEPTH,
    SPINE,
    TAIL,
    LegGeometry,
)
from nermo_mjx.robot.parts import TILT_AXIS, rounded, to_obj

#: Ratio of the rear legs' thickness to the front legs'.
STOUT: Final = {"front": 1.0, "rear": 1.12}
#: Inner and outer face of a cheek of the upper leg, and half the thickness of the link between the cheeks [mm].
CHEEK: Final = (1.65, 3.1)
TONGUE: Final = 1.35
#: Half the width of a pulley [mm].
PULLEY_WIDTH: Final = 1.5


def leg_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of both pairs of legs, by file name."""
    shapes = {"leg_paw": paw()}
    shapes["leg_pulley"] = grooved_pulley(MM * FRONT_LEG.pulley_radius, PULLEY_WIDTH)
    shapes["leg_pulley_holes"] = pulley_holes(MM * FRONT_LEG.pulley_radius, PULLEY_WIDTH)
    for pair in LEGS:
        leg, stout = leg_geometry(geometry, pair), STOUT[pair]
        shapes[f"{pair}_upper"] = upper(leg, stout)
        shapes[f"{pair}_lower"] = lower(leg, stout)
        shapes[f"{pair}_foot"] = foot(leg, stout)
        shapes[f"{pair}_spring"] = knee_spring(leg, stout)
    return shapes


def grooved_pulley(radius: float, half_width: float, tendon: float = TENDON) -> Shape:
    """A pulley about the x axis; a tendon of radius `tendon` lies in its groove, its middle at `radius` [mm]."""
    rim, floor, w = radius + MM * PULLEY_RIM, radius - tendon - 0.1, half_width
    profile = [
        (-w, rim), (-0.55, floor), (0.55, floor), (w - 0.1, rim), (w, radius - 1.0), (w - 0.4, radius - 1.4),
        (w - 0.4, 2.4), (w + 0.4, 2.0),
    ]  # fmt: skip
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
    tongue = plate(strut((0.0, 0.0), (0.0, 5.0 - length), 2.2 * stout, 1.5 * stout), -TONGUE, TONGUE)
    fork = plate(strut((0.0, 4.8 - length), (0.0, -length), 1.4 * stout, 1.7 * stout), 1.0, 2.1, 0.25)
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
    knuckle = turned_part([(-0.95, 1.5 * stout), (-0.75, 1.7 * stout), (0.75, 1.7 * stout), (0.95, 1.5 * stout)], 14)
    return join(loft(rings), knuckle)


def paw() -> Shape:
    """The rubber sole about its centre: a pad and three toes, 7 mm wide."""
    toes = [ball((x, 0.0, -0.3), (1.25, 2.3, 1.75), 8, 5) for x in (-2.15, 0.0, 2.15)]
    return join(ball((0.0, 0.0, 0.5), (3.3, 2.15, 2.1), 10, 5), *toes)


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
# The servo, the same for all joints: its output turns about x, the horn is at the origin, the case at x < 0.


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


# ---
# The hip: the bracket of the rear legs' stacked servos and of the spine's servo, and the tail's support.
#
# The frame is that of the spine end: x left, y back, z up.


#: The bar toward the spine, and the rump: y, middle z, half-width, half-height [mm].
NECK: Final = ((0.5, 0.6, 4.0, 3.4), (3.0, -2.2, 5.0, 2.4), (7.0, -4.2, 7.0, 1.8), (11.0, -4.4, 8.0, 1.6))
RUMP: Final = ((20.0, -9.4, 11.0, 6.6), (25.0, -8.6, 10.0, 6.0), (29.5, -7.0, 7.0, 4.6), (32.0, -5.8, 3.6, 2.6))


def hip_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the hip, by file name."""
    place = geometry.hip
    x, y, z = (MM * float(value) for value in (place.x, place.y, place.z))
    upper = z + MM * REAR_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - BEFORE, y + BEHIND
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
        "hip_core": join(core, beam(NECK, 0.9), beam(RUMP, 2.4), mast),
    }


# ---
# The spine: vertebrae between the lateral joints, their flexures, the stubs at both ends, and the tendon's pulley.
#
# In a joint's frame x is back and -y left; the tendons run parallel to x, beside the axis.


#: Where a tendon leaves a vertebra before the next joint [mm], and how far beside the axis.
EXIT: Final = MM * SPINE.segment_length / 2
BESIDE: Final = MM * SPINE.segment_offset
#: Half-height of the end discs, and half-width of the body between them [mm].
HEIGHT: Final = 4.6
WAIST: Final = 3.3
#: Half the width of the pulley [mm].
SPINE_PULLEY_WIDTH: Final = 1.2


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
    shapes["spine_pulley"] = grooved_pulley(radius, SPINE_PULLEY_WIDTH).transformed(upright)
    shapes["spine_pulley_holes"] = pulley_holes(radius, SPINE_PULLEY_WIDTH).transformed(upright)
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


# ---
# The chest: a back beam and a breastbone joined by flexible ribs, electronics inside, the shoulders' bracket ahead.
#
# In the torso's frame, the spine base: x left, y back, z up.


#: Where the neck's servo turns the head [mm].
TORSO_NECK: Final = tuple(MM * value for value in BODY.neck)
#: The back beam: y, middle z, half-width, half-height [mm].
BEAM: Final = (
    (-2.0, -0.6, 5.2, 3.0), (-9.0, -1.8, 4.4, 2.4), (-24.0, -4.4, 3.8, 2.0), (-44.0, -7.4, 4.0, 2.0),
    (-62.0, -10.2, 5.2, 2.2), (-74.0, -12.0, 6.0, 2.2),
)  # fmt: skip
#: The breastbone, likewise.
BREASTBONE: Final = (
    (-11.0, -44.5, 1.6, 1.1), (-17.0, -46.3, 2.6, 1.1), (-34.0, -49.8, 3.2, 1.1), (-50.0, -49.6, 3.6, 1.1),
    (-60.0, -44.0, 4.0, 1.1), (-63.0, -38.0, 4.0, 1.1),
)  # fmt: skip
#: Ribs: y at the back beam, half-width, lowest z, and how far its breastbone end lies in front of its back end [mm].
RIBS: Final = (
    (-13.0, 19.5, -45.5, 3.0),
    (-21.5, 21.8, -48.5, 2.5),
    (-30.0, 22.8, -50.0, 2.0),
    (-38.5, 22.6, -50.5, 1.5),
)


def torso_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the torso, by file name."""
    return {
        "torso_frame": frame(geometry),
        "torso_ribs": join(*(rib(*numbers) for numbers in RIBS)),
        "torso_board": board(),
        "torso_chips": chips(),
        "torso_battery": battery(),
    }


def back(y: float) -> float:
    """Height of the back beam's middle at y [mm]."""
    stations = np.array(BEAM)[::-1]
    return float(np.interp(y, stations[:, 0], stations[:, 1]))


def rib(y: float, width: float, bottom: float, forward: float) -> Shape:
    """A closed hoop of flat strip from the back beam around to the breastbone."""
    top = back(y) - 0.4
    t = 2 * np.pi * np.arange(24) / 24
    middle, half = (top + bottom) / 2, (top - bottom) / 2
    x = width * np.sign(np.sin(t)) * np.abs(np.sin(t)) ** 0.8
    path = np.column_stack([x, y - forward * (1 - np.cos(t)) / 2, middle + half * np.cos(t)])
    return tube(path, (1.6, 0.7), 4, up=(0.0, 1.0, 0.0), closed=True)


def frame(geometry: Geometry) -> Shape:
    """Back beam with its crests, breastbone, and the bracket that holds four servos and the neck's."""
    crests = [crest(y) for y in (*(numbers[0] for numbers in RIBS), -47.0, -55.0)]
    return join(beam(BEAM, 1.0), *crests, beam(BREASTBONE, 0.5), *shoulders(geometry))


def crest(y: float) -> Shape:
    """A fin on the back beam, where a rib is clamped."""
    rings = []
    for up, reach, width, lean in ((0.5, 2.6, 2.0, 0.0), (2.6, 2.0, 1.4, 0.5), (4.4, 1.0, 0.8, 1.6)):
        section = rounded_rectangle(width, reach, 0.5)
        rings.append(np.column_stack([section[:, 0], section[:, 1] + y + lean, np.full(8, back(y) + up)]))
    return loft(rings)


def shoulders(geometry: Geometry) -> list[Shape]:
    """The bracket between and around the stacked servos of both front legs."""
    place = geometry.shoulder
    x, y, z = (MM * float(value) for value in (place.x, place.y, place.z))
    upper = z + MM * FRONT_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - BEFORE, y + BEHIND
    side = x - 5.0
    plates = [
        block((-side, low + 0.8, upper + w), (side, high - 0.8, upper + w + 1.4), 0.5),
        block((-side, low + 0.8, z + w), (side, high - 0.8, upper - w), 0.4),
        block((-side, low + 0.8, z - w - 1.4), (side, high - 0.8, z - w), 0.5),
    ]
    core = block((-13.6, low, z - w - 1.0), (13.6, high, upper + w + 1.0), 1.0)
    post = block((-5.6, low - 1.5, upper + w - 1.0), (5.6, high, back(-60.0) + 1.0), 1.0)
    # The neck's servo stands upright before the bracket; its clamp reaches around it.
    clamp = block((-7.0, TORSO_NECK[1] - 8.0, TORSO_NECK[2] - 17.0), (7.0, low + 2.0, TORSO_NECK[2] - 8.5), 1.2)
    collar = turned_part([(-2.2, 7.2), (-1.7, 7.6), (-0.5, 7.6), (0.0, 7.0)], 18)
    return [*plates, core, post, clamp, Shape(collar.vertices[:, [1, 2, 0]] + TORSO_NECK, collar.faces)]


def board() -> Shape:
    """The circuit board across the chest."""
    return block((-13.5, -47.0, -24.2), (13.5, -12.0, -22.8), 0.3)


def chips() -> Shape:
    """The components on the board."""
    return join(
        block((-5.0, -33.0, -23.0), (5.0, -23.0, -21.2), 0.3),
        block((-11.5, -44.0, -23.0), (-6.5, -38.0, -21.4), 0.3),
        block((5.0, -45.0, -23.0), (11.5, -38.5, -19.8), 0.4),
        block((-9.0, -17.0, -23.0), (9.0, -13.2, -19.6), 0.4),
        block((8.0, -34.0, -23.0), (11.0, -22.0, -21.8), 0.3),
    )


def battery() -> Shape:
    """The pack below the board."""
    return block((-13.0, -46.0, -43.0), (13.0, -12.5, -26.5), 2.0)


# ---
# The head: a lofted skull that narrows to the snout, round ears, and two cameras for eyes.
#
# In the head's frame: the neck's axis is z, the head looks along -y.


#: The skull's sections: y, middle z, half-width, half-height [mm].
SECTIONS: Final = (
    (6.4, 13.6, 1.6, 1.6), (5.6, 13.8, 5.6, 5.2), (2.5, 14.2, 9.6, 8.6), (-4.0, 15.0, 12.6, 11.2),
    (-12.0, 15.4, 13.8, 12.2), (-20.0, 14.8, 12.6, 11.4), (-28.0, 13.0, 9.4, 8.9), (-35.0, 11.7, 6.6, 6.3),
    (-41.0, 11.1, 4.5, 4.3), (-45.2, 11.0, 2.9, 2.8), (-46.6, 11.0, 1.2, 1.2),
)  # fmt: skip
RINGS: Final = 14
SIDES: Final = 20
#: The left ear: middle [mm], radius, and its angles outward and backward [rad].
EAR: Final = (12.6, -2.5, 28.0)
EAR_RADIUS: Final = 8.6
EAR_OUT: Final = 0.38
EAR_BACK: Final = 0.18


def head_shapes() -> dict[str, Shape]:
    """Meshes of the head, by file name."""
    return {
        "head_skull": skull(),
        "head_ears": ear(lining=False).with_mirror_image(),
        "head_linings": ear(lining=True).with_mirror_image(),
        "head_cameras": camera().with_mirror_image(),
        "head_rings": ring().with_mirror_image(),
        "head_lenses": lens().with_mirror_image(),
        "head_bracket": bracket(),
        "head_nose": ball((0.0, -46.2, 11.6), (2.3, 1.7, 1.7), 12, 6),
    }


def skull() -> Shape:
    """The shell, and the neck that carries it."""
    stations = np.array(SECTIONS)[::-1]
    smooth = PchipInterpolator(np.arange(len(stations)), stations)
    rings = []
    for y, z, w, h in smooth(np.linspace(0.0, len(stations) - 1, RINGS)):
        section = superellipse(w, h, 2.25, SIDES)
        rings.append(np.column_stack([section[:, 0], np.full(SIDES, y), section[:, 1] + z]))
    neck = turned_part([(0.3, 6.4), (1.2, 6.8), (2.0, 5.2), (8.0, 5.6)], 16)
    return join(loft(rings), Shape(neck.vertices[:, [1, 2, 0]], neck.faces))


def bracket() -> Shape:
    """The bracket of Nermo 4.1 that pans, in the frame of the neck: a disc, a post behind the skull, and its axle."""
    _, y, z = (MM * each for each in TILT_AXIS)
    disc = turned_part([(0.0, 7.0), (2.2, 7.0)], 12)
    disc = Shape(disc.vertices[:, [1, 2, 0]], disc.faces)
    post = block((-3.6, y + 3.2, 1.0), (3.6, y + 6.6, z + 3.6), 0.6)
    axle = turned_part([(-10.4, 2.7), (10.4, 2.7)], 10).moved(y=y, z=z)
    arm = block((-3.0, y - 2.0, z - 2.4), (3.0, y + 4.0, z + 2.4), 0.5)
    return join(disc, post, axle, arm)


def ear(lining: bool) -> Shape:
    """A thin dish that opens forward; `lining` is its inside."""
    r = EAR_RADIUS
    if lining:
        profile = [(1.0, 0.84 * r), (1.9, 0.84 * r), (1.15, 0.45 * r)]
    else:
        profile = [(-0.6, 0.25 * r), (0.3, 0.85 * r), (1.5, r), (2.1, 0.96 * r), (0.5, 0.8 * r)]
    dish = turned_part(profile, 20)
    dish = Shape(dish.vertices * [1.0, 1.0, 1.06], dish.faces)
    # From the lathe's x axis to -y, then outward and back.
    return dish.turned("z", -np.pi / 2).turned("x", -EAR_BACK).turned("z", EAR_OUT).moved(*EAR)


def camera() -> Shape:
    """The barrel that sits in the skull."""
    return _at_eye(turned_part([(-6.0, 3.7), (0.4, 4.1)], 16))


def ring() -> Shape:
    """The ring around the lens."""
    return _at_eye(turned_part([(0.0, 4.35), (0.7, 4.35), (1.15, 4.0), (1.15, 3.4), (0.6, 3.1)], 16))


def lens() -> Shape:
    """The glass dome."""
    t = np.linspace(0.25, np.pi / 2, 4)[::-1]
    profile = [*((0.2 + 1.7 * np.cos(a), 3.25 * np.sin(a)) for a in t)]
    return _at_eye(turned_part(profile, 14))


def _at_eye(shape: Shape) -> Shape:
    turned = shape.turned("z", -np.pi / 2).turned("x", -EYE.up).turned("z", EYE.outward)
    return turned.moved(*(MM * each for each in EYE.place))


# ---
# The tail: a stem from the hip with the socket of its pulley, and one bead that is scaled along the tail.
#
# In the tail's frames: y along the tail, the tendons beside it.


#: Spacing of the joints, and distance of the first eyelets from the middle [mm].
SPACING: Final = MM * TAIL.spacing
BESIDE_TAIL: Final = MM * TAIL.eyelet
#: The stem, from the rump to the fork around the pulley: y, middle z, half-width, half-height [mm].
STEM: Final = ((-19.0, 0.4, 6.0, 3.0), (-10.0, 0.2, 4.8, 2.8), (-2.0, 0.0, 4.0, 2.6))


def tail_shapes() -> dict[str, Shape]:
    """Meshes of the tail, by file name."""
    return {"tail_base": base(), "tail_segment": tail_segment()}


def tail_segment() -> Shape:
    """A bead from joint to joint, with an eyelet for a tendon on each side."""
    end = SPACING - 0.4
    bead = _along([(0.4, 2.8), (0.9, 3.4), (2.8, 3.75), (5.4, 3.2), (end - 0.4, 2.6), (end, 2.0)], 12)
    bar = block((-BESIDE_TAIL - 1.0, 3.1, -0.9), (BESIDE_TAIL + 1.0, 4.9, 0.9), 0.45)
    return join(bead, bar)


def base() -> Shape:
    """The stem, the fork around the pulley, and the collar from which the tail comes."""
    collar = _along([(6.9, 5.0), (7.6, 5.6), (10.6, 5.6), (11.6, 4.4)], 16)
    eyelet = _along([(9.0, 1.1), (11.0, 1.1)], 8)
    cheeks = [block((-4.0, -3.0, z - 0.7), (4.0, 9.5, z + 0.7), 0.4) for z in (-2.6, 2.6)]
    return join(collar, eyelet.moved(x=BESIDE_TAIL), eyelet.moved(x=-BESIDE_TAIL), beam(STEM, 1.2), *cheeks)


def _along(profile: list[tuple[float, float]], sides: int) -> Shape:
    return turned_part(profile, sides).transformed(rotation("z", np.pi / 2))


# ---
# All mesh files of the robot.


def mesh_texts() -> dict[str, str]:
    """The text of every file in `mjcf/meshes`, by the file's name."""
    robot = Geometry()
    shapes = torso_shapes(robot) | head_shapes() | spine_shapes(robot) | hip_shapes(robot) | leg_shapes(robot)
    shapes |= tail_shapes() | {"servo": servo()}
    return {f"{name}.obj": to_obj(creased(shape)) for name, shape in sorted(shapes.items())}


def redraw(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    """Replace an assembled robot's meshes from the files by those of its geometry.

    Args:
        spec: of the robot.
        geometry: that it was assembled with.
    """
    shapes = torso_shapes(geometry) | hip_shapes(geometry) | leg_shapes(geometry)
    shapes |= {f"spine_{name.removeprefix('spine_')}": shape for name, shape in spine_shapes(geometry).items()}
    for mesh in spec.meshes:
        # Both sides share one file; the right side is mirrored by its scale.
        shape = shapes.get(mesh.name.replace("_left_", "_").replace("_right_", "_"))
        if shape is not None:
            drawn = rounded(creased(shape))
            mesh.uservert, mesh.userface = drawn.vertices.ravel(), drawn.faces.ravel()
