"""Draws the visual meshes: rewrites `mjcf/meshes/*.obj`, after a number or a shape of the robot has changed.

    python docs/meshes.py

Shapes that follow the lengths of a world are drawn by `nermo_mjx.robot.meshes`; those here are the same in all worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator

from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.meshes import body
from nermo_mjx.robot.meshes.body import (
    DISC_HALF_HEIGHT,
    RIBS,
    SERVO_CASE_BACK,
    SERVO_CASE_DEPTH,
    SERVO_CASE_FRONT,
    TENDON_EXIT,
    TENDON_OFFSET,
)
from nermo_mjx.robot.meshes.shapes import (
    MM,
    SERVO_WIDTH,
    Shape,
    beam,
    block,
    creased,
    join,
    loft,
    rotation,
    superellipse,
    tube,
    turned_part,
)
from nermo_mjx.robot.parameters import EYE_GEOMETRY, FRONT_LEG, SPINE_GEOMETRY, TAIL_GEOMETRY
from nermo_mjx.robot.parts import TILT_AXIS, hundredths

#: Half the width of a leg's pulley [mm].
PULLEY_WIDTH: Final = 1.5


# ---
# Limbs, servos, spine, chest.


def paw() -> Shape:
    """The rubber sole about its centre: a pad and three toes, 7 mm wide."""
    toes = [ball((x, 0.0, -0.3), (1.25, 2.3, 1.75), 8, 5) for x in (-2.15, 0.0, 2.15)]
    return join(ball((0.0, 0.0, 0.5), (3.3, 2.15, 2.1), 10, 5), *toes)


def servo() -> Shape:
    """Case in three shells, mounting ears, gear boss."""
    w = SERVO_WIDTH / 2
    lid = block((-4.6, -SERVO_CASE_FRONT, -w), (0.0, SERVO_CASE_BACK, w), 0.7)
    middle = block(
        (-15.4, -SERVO_CASE_FRONT + 0.25, -w + 0.25), (-4.0, SERVO_CASE_BACK - 0.25, w - 0.25), 0.5
    )
    bottom = block((-SERVO_CASE_DEPTH, -SERVO_CASE_FRONT, -w), (-15.0, SERVO_CASE_BACK, w), 0.7)
    ears = block(
        (-6.0, -SERVO_CASE_FRONT - 1.8, -w + 0.8), (-4.9, SERVO_CASE_BACK + 1.8, w - 0.8), 0.3
    )
    boss = turned_part([(-0.5, 3.6), (0.5, 3.4), (0.5, 2.2), (2.0, 2.0)], 14)
    return join(lid, middle, bottom, ears, boss)


def rear_stub() -> Shape:
    """From the last joint into the hip, in the joint's frame."""
    return join(
        body.end_disc().turned("z", np.pi),
        body.waisted(body.pose_along(np.eye(4), TENDON_EXIT), body.pose_along(np.eye(4), 4.5)),
    )


def segment() -> Shape:
    """Between two joints of Nermo 4.1, whose axes cross: a disc on a hub, with an eyelet on each of four sides."""
    length = MM * SPINE_GEOMETRY.dh[SPINE_GEOMETRY.lateral_joints[0]][1]
    hub = turned_part([(TENDON_EXIT, 3.0), (length - TENDON_EXIT, 3.0)], 8)
    disc = turned_part([(length / 2 - 0.8, 6.6), (length / 2 + 0.8, 6.6)], 16)
    eyelet = turned_part([(TENDON_EXIT - 0.15, 1.15), (length - TENDON_EXIT + 0.15, 1.15)], 5)
    eyelets = [eyelet.moved(y=side * TENDON_OFFSET) for side in (1, -1)] + [
        eyelet.moved(z=side * TENDON_OFFSET) for side in (1, -1)
    ]
    return join(hub, disc, *eyelets)


def flexure() -> Shape:
    """The leaf that bends in every joint: thin sideways, tall, with a bead along its middle."""
    leaf = block(
        (-TENDON_EXIT - 0.4, -0.55, -DISC_HALF_HEIGHT + 1.0),
        (TENDON_EXIT + 0.4, 0.55, DISC_HALF_HEIGHT - 1.0),
        0.2,
    )
    bead = turned_part([(0.8 - DISC_HALF_HEIGHT, 1.1), (DISC_HALF_HEIGHT - 0.8, 1.1)], 8)
    return join(leaf, bead.transformed(rotation("y", np.pi / 2)))


def rib(y: float, width: float, bottom: float, forward: float) -> Shape:
    """A closed hoop of flat strip from the back beam around to the breastbone."""
    top = body.back(y) - 0.4
    t = 2 * np.pi * np.arange(24) / 24
    middle, half = (top + bottom) / 2, (top - bottom) / 2
    x = width * np.sign(np.sin(t)) * np.abs(np.sin(t)) ** 0.8
    path = np.column_stack([x, y - forward * (1 - np.cos(t)) / 2, middle + half * np.cos(t)])
    return tube(path, (1.6, 0.7), 4, up=(0.0, 1.0, 0.0), closed=True)


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


def ball(centre: Sequence[float], radii: Sequence[float], sides: int = 14, rows: int = 8) -> Shape:
    """An ellipsoid [mm]."""
    t = np.linspace(0.2, np.pi - 0.2, rows)
    unit = turned_part(np.stack([-np.cos(t), np.sin(t)], axis=1), sides)
    return Shape(unit.vertices * np.asarray(radii, float) + np.asarray(centre, float), unit.faces)


# ---
# The head: a lofted skull that narrows to the snout, round ears, and two cameras for eyes.
#
# In the head's frame: the neck's axis is z, the head looks along -y.


#: The skull's sections: y, middle z, half-width, half-height [mm].
SECTIONS: Final = (
    (6.4, 13.6, 1.6, 1.6),
    (5.6, 13.8, 5.6, 5.2),
    (2.5, 14.2, 9.6, 8.6),
    (-4.0, 15.0, 12.6, 11.2),
    (-12.0, 15.4, 13.8, 12.2),
    (-20.0, 14.8, 12.6, 11.4),
    (-28.0, 13.0, 9.4, 8.9),
    (-35.0, 11.7, 6.6, 6.3),
    (-41.0, 11.1, 4.5, 4.3),
    (-45.2, 11.0, 2.9, 2.8),
    (-46.6, 11.0, 1.2, 1.2),
)
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
    return _at_eye(
        turned_part([(0.0, 4.35), (0.7, 4.35), (1.15, 4.0), (1.15, 3.4), (0.6, 3.1)], 16)
    )


def lens() -> Shape:
    """The glass dome."""
    t = np.linspace(0.25, np.pi / 2, 4)[::-1]
    profile = [*((0.2 + 1.7 * np.cos(a), 3.25 * np.sin(a)) for a in t)]
    return _at_eye(turned_part(profile, 14))


def _at_eye(shape: Shape) -> Shape:
    turned = (
        shape.turned("z", -np.pi / 2)
        .turned("x", -EYE_GEOMETRY.up)
        .turned("z", EYE_GEOMETRY.outward)
    )
    return turned.moved(*(MM * each for each in EYE_GEOMETRY.place))


# ---
# The tail: a stem from the hip with the socket of its pulley, and one bead that is scaled along the tail.
#
# In the tail's frames: y along the tail, the tendons beside it.


#: Spacing of the joints, and distance of the first eyelets from the middle [mm].
SPACING: Final = MM * TAIL_GEOMETRY.spacing
BESIDE_TAIL: Final = MM * TAIL_GEOMETRY.eyelet
#: The stem, from the rump to the fork around the pulley: y, middle z, half-width, half-height [mm].
STEM: Final = ((-19.0, 0.4, 6.0, 3.0), (-10.0, 0.2, 4.8, 2.8), (-2.0, 0.0, 4.0, 2.6))


def tail_shapes() -> dict[str, Shape]:
    """Meshes of the tail, by file name."""
    return {"tail_base": base(), "tail_segment": tail_segment()}


def tail_segment() -> Shape:
    """A bead from joint to joint, with an eyelet for a tendon on each side."""
    end = SPACING - 0.4
    bead = _along(
        [(0.4, 2.8), (0.9, 3.4), (2.8, 3.75), (5.4, 3.2), (end - 0.4, 2.6), (end, 2.0)], 12
    )
    bar = block((-BESIDE_TAIL - 1.0, 3.1, -0.9), (BESIDE_TAIL + 1.0, 4.9, 0.9), 0.45)
    return join(bead, bar)


def base() -> Shape:
    """The stem, the fork around the pulley, and the collar from which the tail comes."""
    collar = _along([(6.9, 5.0), (7.6, 5.6), (10.6, 5.6), (11.6, 4.4)], 16)
    eyelet = _along([(9.0, 1.1), (11.0, 1.1)], 8)
    cheeks = [block((-4.0, -3.0, z - 0.7), (4.0, 9.5, z + 0.7), 0.4) for z in (-2.6, 2.6)]
    return join(
        collar, eyelet.moved(x=BESIDE_TAIL), eyelet.moved(x=-BESIDE_TAIL), beam(STEM, 1.2), *cheeks
    )


def _along(profile: list[tuple[float, float]], sides: int) -> Shape:
    return turned_part(profile, sides).transformed(rotation("z", np.pi / 2))


# ---
# All files.


def mesh_texts() -> dict[str, str]:
    """The text of every file in `mjcf/meshes`, by the file's name."""
    geometry, radius = Geometry(), MM * FRONT_LEG.pulley_radius
    shapes = (
        body.shapes(geometry)
        | head_shapes()
        | tail_shapes()
        | {
            "servo": servo(),
            "leg_paw": paw(),
            "leg_pulley": body.grooved_pulley(radius, PULLEY_WIDTH),
            "leg_pulley_holes": body.pulley_holes(radius, PULLEY_WIDTH),
            "spine_rear": rear_stub(),
            "spine_flexure": flexure(),
            "spine_segment": segment(),
            "torso_ribs": join(*(rib(*numbers) for numbers in RIBS)),
            "torso_board": board(),
            "torso_chips": chips(),
            "torso_battery": battery(),
        }
    )
    return {f"{name}.obj": to_obj(creased(shape)) for name, shape in sorted(shapes.items())}


def to_obj(shape: Shape) -> str:
    """The text of a mesh file."""
    lines = ["v " + " ".join(_number(value) for value in row) for row in hundredths(shape).tolist()]
    lines += ["f {} {} {}".format(*face) for face in (shape.faces + 1).tolist()]
    return "\n".join(lines) + "\n"


def _number(hundredths: int) -> str:
    return f"{hundredths / 100:.2f}".rstrip("0").rstrip(".") if hundredths else "0"


def main() -> None:
    """Write all files, and remove obsolete ones."""
    folder, texts = Path(__file__).parents[1] / "mjcf" / "meshes", mesh_texts()
    for path in folder.glob("*.obj"):
        if path.name not in texts:
            path.unlink()
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii", newline="\n")
    print(f"{len(texts)} meshes, {sum(map(len, texts.values())) / 1000:.0f} kB, in {folder}")


if __name__ == "__main__":
    main()
