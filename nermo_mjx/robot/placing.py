"""Writes the robot's numbers into the parts of `mjcf/`: positions, lengths, and limits of the tendons.

The files hold the structure, the visuals and everything that is defined nowhere else. Each function takes one part as
read, in its own frame, and the geometry; all positions are linear in the geometry's numbers, which `physics.variation`
relies on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import mujoco
import numpy as np

from nermo_mjx.robot import nermo_41
from nermo_mjx.robot.files import load_file
from nermo_mjx.robot.geometry import Geometry, dh_table, leg_geometry
from nermo_mjx.robot.leg_plane import lead_height, tendon_limit
from nermo_mjx.robot.mirror import turn
from nermo_mjx.robot.parameters import BODY, EYE, IDLER_RADIUS, LEGS, ROUTINGS, SERVO_INSIDE, SPINE, TAIL
from nermo_mjx.robot.tail import add_tail

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
    spec = load_file(name, nermo_41.EDITS.get(name) if robot == "nermo_41" else None)
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
        nermo_41.place_head_tilt(spec)


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
            (f"{pair}_{side}_mount", 0.0, 0.0), (f"{side}_hip_servo", SERVO_INSIDE, 0.0),
            (f"{side}_knee_servo", SERVO_INSIDE, height),
        ):  # fmt: skip
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
        nermo_41.place_vertical_spine(spec, ratio)
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
