"""`load_part` reads a part of the robot from `mjcf/` and writes the geometry into it: positions, lengths, tendon limits.

A part is one MJCF file. It contains the structure, the visuals, and all values that are not in the tables of
`nermo_mjx.robot.parameters`. A function such as `_leg` changes one kind of part, in the frame of the part. All positions
are linear in the values of the geometry; `nermo_mjx.physics.variation` requires this.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.robot.geometry import Geometry, dh_table, lead_height, leg_geometry, tendon_limit
from nermo_mjx.robot.meshes.shapes import Shape
from nermo_mjx.robot.parameters import (
    AUTHOR_EYELET_OFFSET,
    AUTHOR_EYELETS,
    BODY_GEOMETRY,
    EYE_GEOMETRY,
    IDLER_RADIUS,
    LEGS,
    ROUTINGS,
    SERVO_INSET,
    SPINE_GEOMETRY,
    TAIL_GEOMETRY,
)

# ---
# Mesh files: Wavefront OBJ in millimetres, rounded to 0.01 mm, without normals, so that they are small and a diff of
# them is readable.


@functools.lru_cache(maxsize=128)
def read_obj(path: Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices [mm] and faces of a mesh file, which `docs/meshes.py` writes."""
    # Lines by their first word: "v" for a vertex, "f" for a face, whose indices begin at 1.
    rows: dict[str, list[list[str]]] = {"v": [], "f": []}
    for line in path.read_text(encoding="ascii").splitlines():
        kind, *values = line.split()
        rows[kind].append(values)
    return np.array(rows["v"], float), np.array(rows["f"], int) - 1


def hundredths(shape: Shape) -> Int[np.ndarray, "V 3"]:
    """The vertices of a shape in the unit of its mesh file [0.01 mm]."""
    # The offset 1e-5 is larger than rounding errors, so that a value between two hundredths is rounded to the same one
    # on all platforms.
    return np.rint(100.0 * shape.vertices + 1e-5).astype(int)


# ---
# Location of the MJCF files, and loading one of them.


def mjcf_directory() -> Path:
    """The folder of the MJCF files: inside the installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "mjcf"
    return inside if inside.is_dir() else package.parent / "mjcf"


def scene_files() -> tuple[str, ...]:
    """Names of the scenes of `mjcf/scenes`."""
    return tuple(sorted(path.stem for path in (mjcf_directory() / "scenes").glob("*.xml")))


def load_file(name: str) -> mujoco.MjSpec:
    """The specification in `mjcf/NAME.xml`, editable, with its meshes as arrays."""
    spec = mujoco.MjSpec.from_file(str(mjcf_directory() / f"{name}.xml"))
    # Meshes become part of the specification: an assembled or exported model compiles anywhere, without files.
    for mesh in spec.meshes:
        vertices, faces = read_obj(mjcf_directory() / spec.meshdir / mesh.file)
        mesh.uservert, mesh.userface, mesh.file = vertices.ravel(), faces.ravel(), ""
    spec.meshdir = ""
    return spec


# ---
# Turning and mirroring. There is one file for each pair of limbs, which contains the left limb; the right one is
# mirrored.


#: Factors by which mirroring at the y-z plane changes points, Euler angles and quaternions.
_POINT_MIRROR: Final = np.array([-1.0, 1.0, 1.0])
_EULER_MIRROR: Final = np.array([1.0, -1.0, -1.0])
_QUATERNION_MIRROR: Final = np.array([1.0, 1.0, -1.0, -1.0])


def mirror(spec: mujoco.MjSpec) -> None:
    """Mirror a model at its y-z plane (x -> -x), with its meshes, in place.

    Joints keep their axes, which must lie along x: both sides then share one sign convention (positive swings
    backward), and a hinge along x is its own mirror image.

    Raises:
        ValueError: a joint whose axis is not along x.
    """
    for joint in spec.joints:
        if np.any(np.abs(joint.axis[1:]) > 1e-12):
            raise ValueError(
                f"joint {joint.name} has axis {joint.axis}: a mirrored limb needs hinges along x."
            )
        joint.pos = joint.pos * _POINT_MIRROR
    for element in (*spec.bodies[1:], *spec.geoms, *spec.sites, *spec.frames):
        element.pos, element.quat = element.pos * _POINT_MIRROR, element.quat * _QUATERNION_MIRROR
        if not np.isnan(element.alt.euler[0]):
            element.alt.euler = element.alt.euler * _EULER_MIRROR
    for mesh in spec.meshes:
        mesh.scale = mesh.scale * _POINT_MIRROR
    for geom in spec.geoms:
        if not np.isnan(geom.fromto[0]):
            geom.fromto = geom.fromto * np.tile(_POINT_MIRROR, 2)


def turn(element: Any, x: float, y: float, z: float) -> None:
    """Set the orientation of an element by Euler angles about its own axes x, y and z, in the angle unit of its file."""
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_EULER
    element.alt.euler = np.array([x, y, z])


# ---
# The chain of segments of the tail, built from `TAIL_GEOMETRY`: bodies, joints, eyelets of the tendons, contact geoms.


#: Half the width of the pulley [m].
_TAIL_PULLEY_WIDTH: Final = 0.0010
#: Position of the eyelets along a segment of the published length [m].
_EYELET: Final = 0.5 * TAIL_GEOMETRY.spacing
#: Numbers of the segments, from 1, whose ends may touch the ground, in addition to the tip.
_GROUND_SEGMENTS: Final = (16, 17, 18)


def _tail(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    """Place the base of the tail, append its segments, and scale their lengths so that the tail has its length."""
    stretch = float(geometry.tail.length) / TAIL_GEOMETRY.length
    ends = [(TAIL_GEOMETRY.spacing, drop) for drop in TAIL_GEOMETRY.drops]
    ends.append((TAIL_GEOMETRY.tip, 0.0))
    rise = np.array([0.0, 0.0, TAIL_GEOMETRY.rise])
    # The pulley and the first eyelets are in a frame that points along the first segment.
    turn(
        spec.frame("base"),
        -round(math.atan2(TAIL_GEOMETRY.drops[0], TAIL_GEOMETRY.spacing), 6),
        0.0,
        0.0,
    )
    spec.geom("pulley").size = np.array([SPINE_GEOMETRY.pulley_radius, _TAIL_PULLEY_WIDTH, 0.0])
    sides = {"left": 1.0, "right": -1.0}
    for side, sign in sides.items():
        for name, (x, y) in (
            ("side", TAIL_GEOMETRY.side),
            ("rim", TAIL_GEOMETRY.tie),
            ("0", (TAIL_GEOMETRY.eyelet, 0.0100)),
        ):
            spec.site(f"{side}_{name}").pos = np.array([sign * x, y, 0.0])
    parent, position = spec.worldbody, np.array([0.0, *TAIL_GEOMETRY.first_joint])
    for i, (along, drop) in enumerate(ends, 1):
        end = np.array([0.0, along * stretch, -drop * stretch])
        width = round(TAIL_GEOMETRY.eyelet - TAIL_GEOMETRY.taper * (i - 1), 6)
        parent = parent.add_body(name=f"segment_{i}", pos=position)
        parent.add_joint(spec.find_default("tail"), name=f"joint_{i}")
        _draw(spec, parent, i, end, width)
        for side, sign in sides.items():
            middle = end * (_EYELET / along)
            name = f"{side}_{i}"
            parent.add_site(
                spec.find_default("marker"), name=name, pos=[sign * width, middle[1], middle[2]]
            )
            spec.tendon(side).wrap_site(name)
        if i in _GROUND_SEGMENTS or i == len(ends):
            last = i == len(ends)
            geom, site = ("tip", "touch") if last else (f"ground_{i}", f"touch_{i}")
            radius = TAIL_GEOMETRY.tip_radius if last else width
            parent.add_geom(
                spec.find_default("ground"), name=geom, pos=end + rise, size=[radius, 0.0, 0.0]
            )
            parent.add_site(spec.find_default("touch"), name=site, pos=end + rise)
        position = end
    spec.delete(spec.mesh("segment"))
    _limit_to_straight(spec)


def _draw(spec: mujoco.MjSpec, segment: Any, i: int, end: np.ndarray, width: float) -> None:
    """Add the visuals of segment i: a bead that is as wide as its eyelets, and a piece of cord through its joint.

    Args:
        spec: The tail.
        segment: Body of the segment.
        i: Number of the segment, from 1.
        end: Position of the next joint, or of the tip, in the frame of the segment [m].
        width: Distance of the eyelets from the middle [m].
    """
    bead, name = spec.mesh("segment"), f"segment_{i}"
    across = width / TAIL_GEOMETRY.eyelet
    # The last bead ends at the tip, and keeps its length.
    long = (
        math.hypot(end[1], end[2]) / TAIL_GEOMETRY.spacing if i <= len(TAIL_GEOMETRY.drops) else 1.0
    )
    spec.add_mesh(
        name=name,
        uservert=bead.uservert,
        userface=bead.userface,
        scale=1e-3 * np.array([across, long, across]),
    )
    geom = segment.add_geom(
        spec.find_default("visual"), meshname=name, pos=[0.0, 0.0, TAIL_GEOMETRY.rise]
    )
    turn(geom, math.atan2(end[2], end[1]), 0.0, 0.0)
    half = 0.001 * end / end[1]
    cord = segment.add_geom(spec.find_default("cord"), size=[0.36 * width, 0.0, 0.0])
    cord.fromto = np.concatenate([-half, half])


#: End of the capsule around the servos of a pair of limbs, relative to the shoulder or hip axis: left, back, up [m].
_SERVO_CAPSULE_ENDS: Final = {"torso": (-0.0063, 0.0003, 0.0074), "hip": (-0.0063, 0.0021, 0.0059)}
#: Half the width of the spine's pulley [m].
_PULLEY_WIDTH: Final = 0.0015
#: Number of decimals to which the limits of tendons are rounded, of legs and of tendons that are taut when straight.
#: More decimals would change stored reference walks in their last bits.
_DIGITS: Final = {"leg": 10, "straight": 8}


def load_part(name: str, geometry: Geometry, robot: str = "nermo_lite") -> mujoco.MjSpec:
    """The part `mjcf/NAME.xml` with the values of the geometry.

    >>> round(float(load_part("front_leg", Geometry()).body("lower").pos[2]), 4)
    -0.0295

    Args:
        name: Name of the part: `torso`, `head`, `spine`, `hip`, `front_leg`, `rear_leg` (both left) or `tail`.
        geometry: Geometry with leaves of shape ().
        robot: Name of the robot to which the part belongs.
    """
    spec = load_file(f"{name}_41" if robot == "nermo_41" and name in ("spine", "head") else name)
    if name in _PART_FUNCTIONS:
        _PART_FUNCTIONS[name](spec, geometry)
    if name == "spine" and robot == "author":
        _place_author_eyelets(spec)
    return spec


def _torso(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    for name in ("neck_mount", "neck_servo"):
        spec.frame(name).pos = np.array(BODY_GEOMETRY.neck)
    _limbs(spec, "front", geometry)


def _head(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    """Place the cameras in front of the lenses, and the head of Nermo 4.1 at its tilt axis.

    The axes of a camera are right, up and back.
    """
    for name, side in (("left_eye", 1.0), ("right_eye", -1.0)):
        c = np.cos(EYE_GEOMETRY.outward)
        s = side * np.sin(EYE_GEOMETRY.outward)
        level = np.cos(EYE_GEOMETRY.up)
        rise = np.sin(EYE_GEOMETRY.up)
        ahead = np.array([s * level, -c * level, rise])
        up = np.array([-s * rise, c * rise, level])
        camera, quat = spec.camera(name), np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([np.cross(ahead, up), up, -ahead], axis=-1).ravel())
        camera.pos, camera.quat = (
            np.array(EYE_GEOMETRY.place) * [side, 1.0, 1.0] + EYE_GEOMETRY.dome * ahead,
            quat,
        )
    if spec.joint("head_tilt") is not None:
        spec.body("head").pos = np.array(TILT_AXIS)
        spec.frame("shell").pos = np.array([0.0, -HEAD_FORWARD, 0.0]) - TILT_AXIS


def _hip(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    spec.frame("spine_servo").pos = np.array(SPINE_GEOMETRY.pulley_position)
    first_joint = np.add(
        SPINE_GEOMETRY.last_hinge, (float(geometry.tail.y), float(geometry.tail.z))
    )
    spec.frame("tail_mount").pos = np.append(0.0, first_joint - TAIL_GEOMETRY.first_joint)
    _limbs(spec, "rear", geometry)


def _limbs(spec: mujoco.MjSpec, pair: str, geometry: Geometry) -> None:
    """Place the mounts of a pair of limbs, their servos, and the capsule that encloses the servos."""
    joint_position = geometry.shoulder if pair == "front" else geometry.hip
    axis, height = (
        np.array([joint_position.x, joint_position.y, joint_position.z], float),
        LEGS[pair].pulley_height,
    )
    for side, mirrored in (("left", (1.0, 1.0, 1.0)), ("right", (-1.0, 1.0, 1.0))):
        for name, inside, up in (
            (f"{pair}_{side}_mount", 0.0, 0.0),
            (f"{side}_hip_servo", SERVO_INSET, 0.0),
            (f"{side}_knee_servo", SERVO_INSET, height),
        ):
            spec.frame(name).pos = mirrored * (axis + np.array((-inside, 0.0, up)))
    end = axis + _SERVO_CAPSULE_ENDS["torso" if pair == "front" else "hip"]
    spec.geom("bumper").fromto = np.concatenate([end * [-1.0, 1.0, 1.0], end])


def _leg(spec: mujoco.MjSpec, pair: str, geometry: Geometry) -> None:
    leg = leg_geometry(geometry, pair)
    centre = np.array([0.0, leg.pulley_height])
    for site, position in (
        ("guide", leg.guide),
        ("side", centre + leg.side),
        ("rim", leg.tie),
        ("rim_type1", leg.tie_type1),
        ("rim_idler", leg.tie_idler),
        ("lead", (0.0, lead_height(leg))),
        ("idler_side", (-2.0 * leg.knee_direction * IDLER_RADIUS, 0.0)),
    ):
        spec.site(site).pos = np.array([0.0, *position])
    spec.geom("pulley").size[0], spec.geom("idler").size[0] = leg.pulley_radius, IDLER_RADIUS
    spec.geom("sole").size[0] = float(geometry.foot.radius)
    spec.body("pulley").pos = np.array([0.0, *centre])
    down = {
        element: np.array([0.0, 0.0, -float(length)])
        for element, length in (
            ("knee", leg.l1),
            ("attachment", leg.l2),
            ("ankle", leg.l3),
            ("foot", leg.l4),
        )
    }
    spec.body("lower").pos = spec.geom("spring").pos = down["knee"]
    spec.site("attachment").pos = down["attachment"]
    spec.body("foot").pos = down["ankle"]
    turn(spec.body("foot"), -leg.theta3, 0.0, 0.0)
    for element in (spec.geom("paw"), spec.geom("sole"), spec.site("foot"), spec.site("touch")):
        element.pos = down["foot"]
    for bumper, lateral_offset, end in (
        ("upper_bumper", 0.001, "knee"),
        ("lower_bumper", 0.0015, "ankle"),
    ):
        spec.geom(bumper).fromto = np.array(
            [lateral_offset, 0.0, 0.0, lateral_offset, 0.0, down[end][2]]
        )
    for routing in ROUTINGS:
        spec.tendon(routing).range = np.array(
            [0.0, round(tendon_limit(leg, routing), _DIGITS["leg"])]
        )


def _spine(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    rows = dh_table(geometry)
    for i, (alpha, a, theta, _) in enumerate(rows):
        frame = spec.frame("end" if i == len(rows) - 1 else f"row_{i}")
        frame.pos = np.array([float(a), 0.0, 0.0])
        # The table and the file are in degrees.
        turn(frame, *np.round(np.degrees([alpha, 0.0, theta]), 9))
    half, lateral_offset = SPINE_GEOMETRY.segment_length / 2, SPINE_GEOMETRY.segment_offset
    ratio = float(geometry.spine.pulley_radius) / SPINE_GEOMETRY.pulley_radius
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for i in range(2 * len(SPINE_GEOMETRY.lateral_joints)):
            # In front of and behind each joint; in its frame x is back and -y left.
            spec.site(f"{side}_{i}").pos = np.array(
                [half if i % 2 else -half, -sign * lateral_offset, 0.0]
            )
        x, y = SPINE_GEOMETRY.tie
        spec.site(f"{side}_rim").pos = np.array([sign * x * ratio, y * ratio, 0.0])
        x, y = SPINE_GEOMETRY.side
        spec.site(f"{side}_side").pos = (
            np.array([sign * x, y, 0.0]) + SPINE_GEOMETRY.pulley_position
        )
    spec.body("pulley").pos = np.array(SPINE_GEOMETRY.pulley_position)
    spec.geom("pulley").size = np.array([float(geometry.spine.pulley_radius), _PULLEY_WIDTH, 0.0])
    if spec.body("vertical_pulley") is not None:
        place_vertical_spine(spec, ratio)
        spec.geom("vertical_pulley").size = spec.geom("pulley").size
    _limit_to_straight(spec)


def _place_author_eyelets(spec: mujoco.MjSpec) -> None:
    """Move the eyelets of the spine's tendons to where the author's model has them."""
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for joint, (ahead, behind) in enumerate(AUTHOR_EYELETS):
            for number, along in ((2 * joint, -ahead), (2 * joint + 1, behind)):
                spec.site(f"{side}_{number}").pos = np.array(
                    [along, -sign * AUTHOR_EYELET_OFFSET, 0.0]
                )
    _limit_to_straight(spec)


def _limit_to_straight(spec: mujoco.MjSpec) -> None:
    """Set the limits of antagonistic tendons so that both are just taut if all joints are straight and the servo is at 0."""
    for tendon in spec.tendons:
        tendon.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    model = spec.copy().compile()
    for tendon in spec.tendons:
        tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        length = float(model.tendon_length0[model.tendon(tendon.name).id])
        tendon.range = np.array([0.0, round(length, _DIGITS["straight"])])


_PART_FUNCTIONS: Final[dict[str, Callable[[mujoco.MjSpec, Geometry], None]]] = {
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
# Both robots share all MJCF files except `spine_41.xml` and `head_41.xml`.
#
# The thesis contains the chain, the mass, the length and the number of servos of Nermo 4.1, but not the paths of its
# tendons. The servo, the guide and the tilt axis are taken from the author's later model
# (github.com/a-rohr/mouse_controller, commit 22caf00, `models/dynamic_4l_t3.xml`). In this model, the tendons of one
# pulley run 7.5 mm above and 3 mm below the joints: if the pulley pulls the lower tendon, the upper tendon needs 2.5
# times the length that the pulley releases, so that the simulated spine flexes by 0.06 rad per joint and then stalls.
# Here both tendons have the same distance from the axes as the lateral tendons, `SpineGeometry.segment_offset`, so that
# (5.26) holds for both servos. Each tendon crosses the joints of the other plane on their axes, so that a servo bends
# only its own plane.


#: Centre of the pulley of the vertical servo, relative to the spine base [m].
SERVO_PULLEY: Final = (0.0, -0.0355, 0.0055)
#: Pitch of this pulley [rad].
SERVO_PULLEY_PITCH: Final = np.radians(6.0)
#: Distance from the centre of the pulley to the knot of both tendons, at the front just outside the rim [m].
TENDON_KNOT: Final = 0.0065125
#: Lateral distance from the centre of the pulley at which the tendons pass it [m].
TENDON_SIDE: Final = 0.010
#: Point at which both tendons leave the torso, relative to the spine base [m].
TENDON_GUIDE: Final = (0.0, -0.0200, 0.0070)
#: Axis of the tilt of the head, relative to the foot of the neck's axis [m].
TILT_AXIS: Final = (0.0, -0.0106, 0.0144)
#: Distance by which the head is further forward than the head of Nermo-Lite [m]. The nose is then 53 mm in front of the
#: tilt axis, as in the author's model, and 403.6 mm in front of the tip of the tail; the published length is 405 mm.
HEAD_FORWARD: Final = 0.0160


def place_vertical_spine(spec: mujoco.MjSpec, ratio: float) -> None:
    """Place the elements that only `spine_41.xml` contains.

    Args:
        spec: The spine.
        ratio: Radius of the pulley relative to the published radius.
    """
    half, lateral_offset = SPINE_GEOMETRY.segment_length / 2, SPINE_GEOMETRY.segment_offset
    # A vertical joint's z is left, and a lateral one's z is up.
    for name, sign in (("above", 1.0), ("below", -1.0), ("left", 1.0), ("right", -1.0)):
        for site in spec.sites:
            kind, _, number = site.name.rpartition("_")
            if kind == f"{name}_axis":
                site.pos = np.array([0.0, 0.0, sign * lateral_offset])
            elif kind == name and name in ("above", "below"):
                site.pos = np.array(
                    [half if int(number) % 2 else -half, sign * lateral_offset, 0.0]
                )
    for element in (spec.body("vertical_pulley"), spec.frame("vertical_servo")):
        element.pos = np.array(SERVO_PULLEY)
    spec.body("vertical_pulley").quat = np.array(
        [np.cos(SERVO_PULLEY_PITCH / 2), np.sin(SERVO_PULLEY_PITCH / 2), 0.0, 0.0]
    )
    for side, sign in (("left", 1.0), ("right", -1.0)):
        spec.site(f"vertical_{side}_side").pos = np.add(
            SERVO_PULLEY, (sign * TENDON_SIDE, 0.0, 0.0)
        )
    spec.site("vertical_guide").pos = np.array(TENDON_GUIDE)
    spec.site("vertical_rim").pos = np.array([0.0, -TENDON_KNOT * ratio, 0.0])
