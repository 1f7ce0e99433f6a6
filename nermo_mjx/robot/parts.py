"""Writes the robot's numbers into the parts of `mjcf/`: positions, lengths, and limits of the tendons.

The files hold the structure, the visuals and everything that is defined nowhere else. Each function takes one part as
read, in its own frame, and the geometry; all positions are linear in the geometry's numbers, which `physics.variation`
relies on.
"""

from __future__ import annotations

import functools
import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.robot.geometry import Geometry, dh_table, lead_height, leg_geometry, tendon_limit
from nermo_mjx.robot.meshes.shapes import Shape
from nermo_mjx.robot.parameters import BODY, EYE, IDLER_RADIUS, LEGS, ROUTINGS, SERVO_INSIDE, SPINE, TAIL

# ---
# Mesh files: Wavefront OBJ in millimetres, to a hundredth, without normals; small, and readable in a diff.


def to_obj(shape: Shape) -> str:
    """The text of a mesh file."""
    lines = ["v " + " ".join(_number(value) for value in row) for row in _hundredths(shape).tolist()]
    lines += ["f {} {} {}".format(*face) for face in (shape.faces + 1).tolist()]
    return "\n".join(lines) + "\n"


@functools.lru_cache(maxsize=128)
def read_obj(path: Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices [mm] and faces of a file that `to_obj` wrote."""
    rows: dict[str, list[list[str]]] = {"v": [], "f": []}
    for line in path.read_text(encoding="ascii").splitlines():
        kind, *values = line.split()
        rows[kind].append(values)
    return np.array(rows["v"], float), np.array(rows["f"], int) - 1


def rounded(shape: Shape) -> Shape:
    """The shape as its mesh file has it."""
    return Shape(_hundredths(shape) / 100, shape.faces)


def _hundredths(shape: Shape) -> Int[np.ndarray, "V 3"]:
    # An offset larger than rounding errors, so that all platforms round to the same hundredth.
    return np.rint(100.0 * shape.vertices + 1e-5).astype(int)


def _number(hundredths: int) -> str:
    return f"{hundredths / 100:.2f}".rstrip("0").rstrip(".") if hundredths else "0"


# ---
# Location of the MJCF files, and reading one of them.


def mjcf_directory() -> Path:
    """The folder of the MJCF files: inside the installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "mjcf"
    return inside if inside.is_dir() else package.parent / "mjcf"


def scene_files() -> tuple[str, ...]:
    """Names of the scenes of `mjcf/scenes`."""
    return tuple(sorted(path.stem for path in (mjcf_directory() / "scenes").glob("*.xml")))


#: Changes the tree of an MJCF file.
Edit = Callable[[ET.Element], None]


def load_file(name: str, edit: Edit | None = None) -> mujoco.MjSpec:
    """The specification in `mjcf/NAME.xml`, editable, with its meshes inside.

    Args:
        name: of the file.
        edit: changes the tree of the file before it is compiled.
    """
    path = mjcf_directory() / f"{name}.xml"
    if edit is None:
        spec = mujoco.MjSpec.from_file(str(path))
    else:
        root = ET.parse(path).getroot()
        edit(root)
        included = {
            each.get("file", ""): (path.parent / each.get("file", "")).read_bytes() for each in root.iter("include")
        }
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"), include=included)
    # Meshes become part of the specification: an assembled or exported model compiles anywhere, without files.
    for mesh in spec.meshes:
        vertices, faces = read_obj(mjcf_directory() / spec.meshdir / mesh.file)
        mesh.uservert, mesh.userface, mesh.file = vertices.ravel(), faces.ravel(), ""
    spec.meshdir = ""
    return spec


# ---
# Turning and mirroring. The right half of the robot is mirrored from the left: there is one file per pair of limbs.


def mirror(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Mirror a model at its y-z plane (x -> -x), with its meshes, in place; returns it.

    Joints keep their axes, which must lie along x: both sides then share one sign convention (positive swings
    backward), and a hinge along x is its own mirror image.

    Raises:
        ValueError: a joint whose axis is not along x.
    """
    for joint in spec.joints:
        if np.any(np.abs(joint.axis[1:]) > 1e-12):
            raise ValueError(f"joint {joint.name} has axis {joint.axis}: a mirrored limb needs hinges along x.")
        joint.pos = _point(joint.pos)
    for element in (*spec.bodies[1:], *spec.geoms, *spec.sites, *spec.frames):
        element.pos = _point(element.pos)
        element.quat = _rotation(element.quat)
        euler = element.alt.euler
        if not np.isnan(euler[0]):
            element.alt.euler = np.array([euler[0], -euler[1], -euler[2]])
    for mesh in spec.meshes:
        mesh.scale = _point(mesh.scale)
    for geom in spec.geoms:
        if not np.isnan(geom.fromto[0]):
            geom.fromto = np.concatenate([_point(geom.fromto[:3]), _point(geom.fromto[3:])])
    return spec


def turn(element: Any, x: float, y: float, z: float) -> None:
    """Give an element of a specification its orientation: Euler angles about the axes x, y, z that turn along,
    in the unit of its file."""
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_EULER
    element.alt.euler = np.array([x, y, z])


def _point(pos: np.ndarray) -> np.ndarray:
    return np.array([-pos[0], pos[1], pos[2]])


def _rotation(quat: np.ndarray) -> np.ndarray:
    return np.array([quat[0], quat[1], -quat[2], -quat[3]])


# ---
# The tail's chain of segments, built from its numbers: bodies, joints, eyelets of the tendons, and contact geoms.


#: Half the width of the pulley [m], and the positions of the eyelets along a segment of the published length [m].
_TAIL_PULLEY_WIDTH: Final = 0.0010
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
    spec.geom("pulley").size = np.array([SPINE.pulley_radius, _TAIL_PULLEY_WIDTH, 0.0])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, (x, y) in (("side", TAIL.side), ("rim", TAIL.tie), ("0", (TAIL.eyelet, 0.0100))):
            spec.site(f"{side}_{name}").pos = np.array([sign * x, y, 0.0])


def _draw(spec: mujoco.MjSpec, segment: Any, i: int, end: np.ndarray, width: float) -> None:
    """A bead as wide as its eyelets, reaching to the next joint, and a cord through the joint."""
    bead, name = spec.mesh("segment"), f"segment_{i}"
    across = width / TAIL.eyelet
    # The last one ends at the tip, and is no shorter than the others.
    long = math.hypot(end[1], end[2]) / TAIL.spacing if i <= len(TAIL.drops) else 1.0
    spec.add_mesh(
        name=name, uservert=bead.uservert, userface=bead.userface, scale=1e-3 * np.array([across, long, across])
    )
    drawn = segment.add_geom(spec.find_default("visual"), meshname=name)
    turn(drawn, math.atan2(end[2], end[1]), 0.0, 0.0)
    half = 0.001 * end / end[1]
    cord = segment.add_geom(spec.find_default("cord"), size=[0.36 * width, 0.0, 0.0])
    cord.fromto = np.concatenate([-half, half])


#: From the shoulder's or hip's axis to the end of the capsule about its servos, left, back and up [m].
_SERVOS: Final = {"torso": (-0.0063, 0.0003, 0.0074), "hip": (-0.0063, 0.0021, 0.0059)}
#: Half the width of the spine's pulley [m].
_PULLEY_WIDTH: Final = 0.0015
#: Digits of the tendons' limits [m]; with more, walks would differ from recorded ones in their last bits.
_DIGITS: Final = {"leg": 10, "straight": 8}


def load_part(name: str, geometry: Geometry, robot: str = "nermo_lite") -> mujoco.MjSpec:
    """The part `mjcf/NAME.xml` with its numbers filled in.

    >>> round(float(load_part("front_leg", Geometry()).body("lower").pos[2]), 4)
    -0.0295

    Args:
        name: `torso`, `head`, `spine`, `hip`, `front_leg`, `rear_leg` (left ones) or `tail`.
        geometry: leaves of shape ().
        robot: that the part belongs to; see `nermo_41`.
    """
    spec = load_file(name, EDITS.get(name) if robot == "nermo_41" else None)
    if name in _PLACED:
        _PLACED[name](spec, geometry)
    return spec


def _torso(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    for name in ("neck_mount", "neck_servo"):
        spec.frame(name).pos = np.array(BODY.neck)
    _limbs(spec, "front", geometry)


def _head(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    """The cameras in front of the lenses; a camera's own axes are right, up and back."""
    for name, side in (("left_eye", 1.0), ("right_eye", -1.0)):
        c, s, level, rise = np.cos(EYE.outward), side * np.sin(EYE.outward), np.cos(EYE.up), np.sin(EYE.up)
        ahead = np.array([s * level, -c * level, rise])
        up = np.array([-s * rise, c * rise, level])
        camera, quat = spec.camera(name), np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([np.cross(ahead, up), up, -ahead], axis=-1).ravel())
        camera.pos, camera.quat = np.array(EYE.place) * [side, 1.0, 1.0] + EYE.dome * ahead, quat
    if spec.joint("head_tilt") is not None:
        place_head_tilt(spec)


def _hip(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    spec.frame("spine_servo").pos = np.array(SPINE.pulley_position)
    spec.frame("tail_mount").pos = np.array(TAIL.mount)
    _limbs(spec, "rear", geometry)


def _limbs(spec: mujoco.MjSpec, pair: str, geometry: Geometry) -> None:
    """Mounts of a pair of limbs, their servos, and the capsule that is the servos' outline."""
    place = geometry.shoulder if pair == "front" else geometry.hip
    axis, height = np.array([place.x, place.y, place.z], float), LEGS[pair].pulley_height
    for side, mirrored in (("left", (1.0, 1.0, 1.0)), ("right", (-1.0, 1.0, 1.0))):
        for name, inside, up in (
            (f"{pair}_{side}_mount", 0.0, 0.0),
            (f"{side}_hip_servo", SERVO_INSIDE, 0.0),
            (f"{side}_knee_servo", SERVO_INSIDE, height),
        ):
            spec.frame(name).pos = mirrored * (axis + np.array((-inside, 0.0, up)))
    end = axis + _SERVOS["torso" if pair == "front" else "hip"]
    spec.geom("bumper").fromto = np.concatenate([end * [-1.0, 1.0, 1.0], end])


def _leg(spec: mujoco.MjSpec, pair: str, geometry: Geometry) -> None:
    leg = leg_geometry(geometry, pair)
    centre = np.array([0.0, leg.pulley_height])
    for site, place in (
        ("guide", leg.guide), ("side", centre + leg.side), ("rim", leg.tie), ("rim_type1", leg.tie_type1),
        ("rim_idler", leg.tie_idler),
        ("lead", (0.0, lead_height(leg))), ("idler_side", (-2.0 * leg.knee_direction * IDLER_RADIUS, 0.0)),
    ):  # fmt: skip
        spec.site(site).pos = np.array([0.0, *place])
    spec.geom("pulley").size[0], spec.geom("idler").size[0] = leg.pulley_radius, IDLER_RADIUS
    spec.geom("sole").size[0] = float(geometry.foot.radius)
    spec.body("pulley").pos = np.array([0.0, *centre])
    down = {element: np.array([0.0, 0.0, -float(length)]) for element, length in (
        ("knee", leg.l1), ("attachment", leg.l2), ("ankle", leg.l3), ("foot", leg.l4),
    )}  # fmt: skip
    spec.body("lower").pos = spec.geom("spring").pos = down["knee"]
    spec.site("attachment").pos = down["attachment"]
    spec.body("foot").pos = down["ankle"]
    turn(spec.body("foot"), -leg.theta3, 0.0, 0.0)
    for element in (spec.geom("paw"), spec.geom("sole"), spec.site("foot"), spec.site("touch")):
        element.pos = down["foot"]
    for bumper, beside, end in (("upper_bumper", 0.001, "knee"), ("lower_bumper", 0.0015, "ankle")):
        spec.geom(bumper).fromto = np.array([beside, 0.0, 0.0, beside, 0.0, down[end][2]])
    for routing in ROUTINGS:
        spec.tendon(routing).range = np.array([0.0, round(tendon_limit(leg, routing), _DIGITS["leg"])])


def _spine(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    rows = dh_table(geometry)
    for i, (alpha, a, theta, _) in enumerate(rows):
        frame = spec.frame("end" if i == len(rows) - 1 else f"row_{i}")
        frame.pos = np.array([float(a), 0.0, 0.0])
        # The table and the file are in degrees.
        turn(frame, *np.round(np.degrees([alpha, 0.0, theta]), 9))
    half, beside = SPINE.segment_length / 2, SPINE.segment_offset
    ratio = float(geometry.spine.pulley_radius) / SPINE.pulley_radius
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for i in range(2 * len(SPINE.lateral_joints)):
            # In front of and behind each joint; in its frame x is back and -y left.
            spec.site(f"{side}_{i}").pos = np.array([half if i % 2 else -half, -sign * beside, 0.0])
        x, y = SPINE.tie
        spec.site(f"{side}_rim").pos = np.array([sign * x * ratio, y * ratio, 0.0])
        x, y = SPINE.side
        spec.site(f"{side}_side").pos = np.array([sign * x, y, 0.0]) + SPINE.pulley_position
    spec.body("pulley").pos = np.array(SPINE.pulley_position)
    spec.geom("pulley").size = np.array([float(geometry.spine.pulley_radius), _PULLEY_WIDTH, 0.0])
    if spec.body("vertical_pulley") is not None:
        place_vertical_spine(spec, ratio)
        spec.geom("vertical_pulley").size = spec.geom("pulley").size
    _limit_to_straight(spec)


def _tail(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    add_tail(spec, float(geometry.tail.length))
    _limit_to_straight(spec)


def _limit_to_straight(spec: mujoco.MjSpec) -> None:
    """Make the antagonists just taut when all joints are straight and their servo is at 0."""
    for tendon in spec.tendons:
        tendon.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    model = spec.copy().compile()
    for tendon in spec.tendons:
        tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        length = float(model.tendon_length0[model.tendon(tendon.name).id])
        tendon.range = np.array([0.0, round(length, _DIGITS["straight"])])


_PLACED: Final[dict[str, Callable[[mujoco.MjSpec, Geometry], None]]] = {
    "torso": _torso,
    "head": _head,
    "hip": _hip,
    "spine": _spine,
    "front_leg": lambda spec, geometry: _leg(spec, "front", geometry),
    "rear_leg": lambda spec, geometry: _leg(spec, "rear", geometry),
    "tail": _tail,
}


def stance_height(geometry: Geometry) -> float:
    """Height of the spine base when the front feet stand at their neutral positions on level ground [m]."""
    return float(geometry.foot.radius) - float(geometry.shoulder.z) - LEGS["front"].neutral_foot[1]


# ---
# The additional parts of Nermo 4.1: vertical joints in the spine with their servo, and a head that tilts.
#
# Both robots come from the same MJCF files; here the parts that only 4.1 has are added to the trees of `spine.xml` and
# `head.xml`. Each vertical row of Table 5.3, a fixed frame in Nermo-Lite, gets a body with a hinge, which makes eight
# joints with alternating axes.
#
# The thesis gives the chain, the mass, the length and the number of servos of Nermo 4.1, but not how its tendons run.
# Servo, guide and tilt axis are those of the author's later model (github.com/a-rohr/mouse_controller, commit 22caf00,
# `models/dynamic_4l_t3.xml`). Its tendons run 7.5 mm above and 3 mm below the joints from one pulley: pulling in the
# lower one needs 2.5 times as much of the upper one as the pulley releases, so in simulation its spine flexes by 0.06
# rad per joint and then stalls. Here both run at the same distance from the axes as the lateral tendons,
# `SpineGeometry.segment_offset`, and (5.26) holds for both servos. Each tendon crosses the joints of the other plane on
# their axes, so that neither servo bends the other plane.


#: Pulley of the vertical spine's servo, from the spine base: centre [m] and pitch [rad].
PULLEY: Final = (0.0, -0.0355, 0.0055)
PULLEY_PITCH: Final = np.radians(6.0)
#: Where both tendons are tied, at its front and just outside the rim, and how far beside its centre they pass it [m].
TIE: Final = 0.0065125
SIDE: Final = 0.010
#: Where both tendons leave the torso, from the spine base [m].
GUIDE: Final = (0.0, -0.0200, 0.0070)
#: Axis of the head's tilt from the foot of the neck's axis [m].
TILT_AXIS: Final = (0.0, -0.0106, 0.0144)
#: How much further forward the head sits than Nermo-Lite's [m]. Its nose is then 53 mm in front of the tilt axis, as in
#: the author's model, and 405 mm in front of the tip of the tail, as published.
HEAD_FORWARD: Final = 0.0160

_COUNT: Final = len(SPINE.vertical_joints)
#: The side of a joint on which the sites of the upper and lower tendon lie; a vertical joint's z is left.
_SIGNS: Final = {"above": 1.0, "below": -1.0, "left": 1.0, "right": -1.0}


def _add_vertical_spine(root: ET.Element) -> None:
    """Give `spine.xml` vertical joints, with the pulley and the two tendons that bend them."""
    world, asset, tendon = (_found(root, name) for name in ("worldbody", "asset", "tendon"))
    for parent in list(root.iter()):
        for geom in parent.findall("geom[@mesh]"):
            if geom.get("mesh", "").startswith(("vertebra", "front")):
                parent.remove(geom)
        if parent.get("name", "").startswith("vertebra") and parent.tag == "body":
            parent.append(_geom("segment"))
    for number, row in enumerate(SPINE.vertical_joints, 1):
        _add_joint(root, _found(root, f".//frame[@name='row_{row}']"), number)
    _add_pulley(world)
    ET.SubElement(asset, "mesh", name="segment", file="spine_segment.obj")
    ET.SubElement(asset, "mesh", name="servo", file="servo.obj")
    for side in ("left", "right"):
        _lead(_found(tendon, f"spatial[@name='{side}']"), side)
    tendon.extend([_vertical_tendon("above", "right"), _vertical_tendon("below", "left")])


def _add_joint(root: ET.Element, frame: ET.Element, number: int) -> None:
    """The vertical joint `number` (from 1), in the frame of its row: x back, y up, z left, so that a positive angle
    lifts the hip.

    In the neutral spine the tendons run straight across it, though the spine bends there.
    """
    link = ET.Element("body", name=f"link_{number}")
    link.append(ET.Element("joint", {"name": f"vertical_{number}", "class": "spine", "axis": "0 0 1"}))
    link.extend([_geom("segment"), _geom("flexure", "rubber", euler="90 0 0")])
    link.extend(_site(f"{name}_{2 * number - 1}") for name in ("above", "below"))
    for child in list(frame):
        frame.remove(child)
        link.append(child)
    frame.extend(_site(f"{name}_{2 * number - 2}") for name in ("above", "below"))
    if number > 1:
        frame.extend(_site(f"{name}_axis_{number}") for name in ("left", "right"))
    frame.append(link)
    if number < _COUNT:
        lateral = _found(root, f".//site[@name='left_{2 * number - 2}']/..")
        lateral.extend(_site(f"{name}_axis_{number}") for name in ("above", "below"))


def _add_pulley(world: ET.Element) -> None:
    world.extend(_site(name) for name in ("vertical_left_side", "vertical_right_side", "vertical_guide"))
    servo = ET.SubElement(world, "frame", name="vertical_servo")
    servo.append(_geom("servo", "case", pos="0 0 -0.002", euler="0 -90 0"))
    pulley = ET.SubElement(world, "body", name="vertical_pulley")
    ET.SubElement(pulley, "joint", name="vertical_pulley", type="hinge", axis="0 0 1")
    ET.SubElement(pulley, "geom", {"name": "vertical_pulley", "class": "pulley", "size": "0.001 0.001"})
    pulley.extend([_geom("pulley", "metal"), _geom("pulley_holes", "case"), _site("vertical_rim")])


def _lead(tendon: ET.Element, side: str) -> None:
    """Lead a lateral tendon over the axes of the vertical joints between its segments."""
    for number in range(_COUNT, 1, -1):
        behind = _found(tendon, f"site[@site='{side}_{2 * number - 2}']")
        tendon.insert(list(tendon).index(behind), ET.Element("site", site=f"{side}_axis_{number}"))


def _vertical_tendon(name: str, side: str) -> ET.Element:
    """From the front of the pulley around one side of it, over the guide, and through all vertical joints."""
    tendon = ET.Element("spatial", name=name, limited="true", range="0 1", width="0.0005", material="tendon")
    ET.SubElement(tendon, "site", site="vertical_rim")
    ET.SubElement(tendon, "geom", geom="vertical_pulley", sidesite=f"vertical_{side}_side")
    for site in ("vertical_guide", *_passed(name)):
        ET.SubElement(tendon, "site", site=site)
    return tendon


def _passed(name: str) -> Iterator[str]:
    """The sites of a vertical tendon: before and behind each vertical joint, and the axis of the lateral one."""
    for number in range(1, _COUNT + 1):
        yield from (f"{name}_{2 * number - 2}", f"{name}_{2 * number - 1}")
        if number < _COUNT:
            yield f"{name}_axis_{number}"


def place_vertical_spine(spec: mujoco.MjSpec, ratio: float) -> None:
    """Position the parts that were added to `spine.xml`.

    Args:
        spec: of the spine.
        ratio: of the pulley's radius to the published one.
    """
    half, beside = SPINE.segment_length / 2, SPINE.segment_offset
    for name, sign in _SIGNS.items():
        for i, number in itertools.product((0, 1), range(1, _COUNT + 1)):
            if name in ("above", "below"):
                spec.site(f"{name}_{2 * number - 2 + i}").pos = np.array([(-half, half)[i], sign * beside, 0.0])
        for number in range(1, _COUNT + 1):
            axis = spec.site(f"{name}_axis_{number}")
            if axis is not None:
                axis.pos = np.array([0.0, 0.0, sign * beside])
    for element in (spec.body("vertical_pulley"), spec.frame("vertical_servo")):
        element.pos = np.array(PULLEY)
    spec.body("vertical_pulley").quat = np.array([np.cos(PULLEY_PITCH / 2), np.sin(PULLEY_PITCH / 2), 0.0, 0.0])
    for side in ("left", "right"):
        spec.site(f"vertical_{side}_side").pos = np.add(PULLEY, (_SIGNS[side] * SIDE, 0.0, 0.0))
    spec.site("vertical_guide").pos = np.array(GUIDE)
    spec.site("vertical_rim").pos = np.array([0.0, -TIE * ratio, 0.0])


def _add_head_tilt(root: ET.Element) -> None:
    """Put the head of `head.xml` on a bracket that pans, with the axis about which it tilts; positive is nose down."""
    world = _found(root, "worldbody")
    head = _found(world, "body[@name='head']")
    pan, *shell = list(head)
    for element in (pan, *shell):
        head.remove(element)
    world.remove(head)
    neck = ET.SubElement(world, "body", name="neck")
    neck.extend([pan, _geom("bracket"), head])
    ET.SubElement(head, "joint", name="head_tilt", type="hinge", axis="1 0 0")
    ET.SubElement(head, "frame", name="shell").extend(shell)
    ET.SubElement(_found(root, "asset"), "mesh", name="bracket", file="head_bracket.obj")


def place_head_tilt(spec: mujoco.MjSpec) -> None:
    """Put the head on its tilt axis."""
    spec.body("head").pos = np.array(TILT_AXIS)
    spec.frame("shell").pos = np.array([0.0, -HEAD_FORWARD, 0.0]) - TILT_AXIS


#: The edits that turn a part of Nermo-Lite into that of Nermo 4.1, by the name of its file.
EDITS: Final[dict[str, Callable[[ET.Element], None]]] = {"spine": _add_vertical_spine, "head": _add_head_tilt}


def _found(element: ET.Element, path: str) -> ET.Element:
    found = element.find(path)
    assert found is not None, path
    return found


def _site(name: str) -> ET.Element:
    return ET.Element("site", {"name": name, "class": "marker"})


def _geom(mesh: str, material: str = "", **place: str) -> ET.Element:
    given = {"material": material} if material else {}
    return ET.Element("geom", {"class": "visual", "mesh": mesh, **given, **place})
