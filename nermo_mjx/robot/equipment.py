"""What the assembled robot is equipped with: masses, springs and dampers, servos, sensors, and contact pairs.

The numbers come from the table of masses and the parameter trees; the functions here write them into a MuJoCo
specification (`spec`), which `robot.assembly` compiles.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.robot.masses import ROBOT_MASSES, is_front, part_of
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.parameters import (
    AUTHOR_CONTACT_MIDPOINT,
    AUTHOR_CONTACT_ONSET,
    AUTHOR_GAIN_SHARES,
    AUTHOR_TAIL_SOFTNESS,
    AUTHOR_TENDON_SOLIMP,
    AUTHOR_TORQUE_SHARES,
    LEGS,
    LIMBS,
    SERVOS,
    SPINE_GEOMETRY,
    servo_kind,
    servo_range,
)
from nermo_mjx.robot.parts import load_part
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.robot.scene import SceneGeoms

# ---
# Compliant joints as chains of hinges.
#
# Knees, ankles and spine joints are flexures, leaves that bend. One hinge with a torsion spring stands for a leaf by
# default. A chain of n hinges divides it into n equal parts, with a hinge in the middle of each that is n times as
# stiff as the leaf: in series they are as stiff as the one hinge, and with growing n they approach an elastica.
#
# All hinges of a chain belong to one body, so neither bodies nor masses are added: MuJoCo applies the joints of a body
# one after the other. No leaf's length is published. Here it is `SpineGeometry.segment_length`, the distance of the
# vertebrae at a joint, in the legs as well; and the leaves are straight in the published stance, in which a chain
# therefore coincides with one hinge.


#: Most hinges of a chain: MuJoCo allows a body six degrees of freedom.
MAX_HINGES: Final = 6
_COMPLIANT_JOINT: Final = re.compile(r"knee|ankle|(joint|vertical)_\d")
_HINGE_INFIX: Final = "_hinge_"


def add_hinges(part: mujoco.MjSpec, hinges: int) -> None:
    """Turn every compliant joint of a leg or the spine into a chain, named `JOINT_hinge_1` to `JOINT_hinge_N`.

    Args:
        part: Specification of the part before it is attached, so that the angles of all hinges have the part's unit.
        hinges: Number of hinges of each chain; with 1, nothing changes.
    """
    if hinges == 1:
        return
    for joint in [joint for joint in part.joints if _COMPLIANT_JOINT.fullmatch(joint.name)]:
        body, name = joint.parent, joint.name
        for number in range(1, hinges + 1):
            hinge = joint if number == 1 else body.add_joint(type=joint.type, axis=joint.axis)
            hinge.name = f"{name}{_HINGE_INFIX}{number}"


def place_hinges(spec: mujoco.MjSpec, hinges: int) -> None:
    """Put the hinges of every chain along its leaf, in the robot's zero pose."""
    for joint in spec.joints:
        _, infix, number = joint.name.partition(_HINGE_INFIX)
        if infix:
            # Fraction of the leaf's length between the middle of the leaf and the hinge, from -0.5 to 0.5.
            fraction = (int(number) - 0.5) / hinges - 0.5
            joint.pos = fraction * SPINE_GEOMETRY.segment_length * _direction(joint, hinges)


def chain_of(joint: str) -> str:
    """Return the name of the compliant joint to which a hinge belongs; any other joint's name is returned unchanged.

    >>> chain_of("front_left_knee_hinge_2"), chain_of("neck")
    ('front_left_knee', 'neck')
    """
    return joint.partition(_HINGE_INFIX)[0]


def _direction(joint: Any, hinges: int) -> np.ndarray:
    """Unit vector along a leaf in its body's frame, away from the torso.

    A leaf of the spine runs along x. A leaf of a leg halves the angle between the two links that it joins; the links
    run along -z. In the zero pose, this angle is the reference angle of the knee (`ref`, divided among its hinges), or
    theta_3 at the ankle.
    """
    name = chain_of(joint.name)
    if name.startswith("spine"):
        return np.array([1.0, 0.0, 0.0])
    link_angle = (
        hinges * joint.ref * joint.axis[0]
        if name.endswith("knee")
        else -LEGS[name.split("_")[0]].theta3
    )
    return np.array([0.0, -np.sin(link_angle / 2), -np.cos(link_angle / 2)])


#: Rotor and gear inertia seen at the joint [kg m^2], as in the author's model.
ARMATURE: Final = {
    "servo": 0.00065,
    "knee": 0.000065,
    "ankle": 0.000065,
    "spine": 0.00065,
    "tail": 0.00065,
}
#: Stiffness [N m/rad] and damping [N m s/rad] of each joint of the articulated tail, as in the author's model.
TAIL_STIFFNESS: Final = 1.2
TAIL_DAMPING: Final = 0.01
#: Knee angle at which the torsion spring rests [rad].
KNEE_REST_RAD: Final = {"front": np.radians(50.0), "rear": np.radians(75.0)}
#: Tendons are massless and almost inextensible, so the limit of their length is stiff. Its time constant [s] is this
#: value, or two time steps if they are longer, because MuJoCo's solver is unstable below them.
TENDON_TIME_CONSTANT: Final = 0.004
TENDON_SOLIMP: Final = (0.95, 0.99, 0.0002, 0.5, 2.0)
#: The last four values of `solimp` for the tendons of the legs; the first one is `build.tendon_impedance`. These tendons
#: go slack and taut in each step, so their impedance rises gently, to 0.99 over 0.1 mm. Under the standing robot they
#: yield by 0.07 to 0.08 mm. With the same values for its tendons, the spine would bend by 14 % less at small angles.
LEG_TENDON_ONSET: Final = (0.99, 0.0001, 0.5, 2.0)
#: Trunk geoms that may touch the ground when the robot falls; spheres, so that each costs MJX one contact.
TRUNK_GEOMS: Final = ("torso_chest", "hip_pelvis", "head_skull")
#: The group of the visual geoms.
VISUAL_GROUP: Final = 2
#: Parts of the tail that may touch the ground, with the site that measures the force (geom, site): the tip and, with
#: the articulated tail, the three segments before it. The tail is rigid vertically, so the tip touches first; when it
#: is bent sideways under a rolling body, the others may.
TAIL_TIP: Final = ("tail_tip", "tail_touch")
TAIL_SEGMENTS: Final = tuple((f"tail_ground_{i}", f"tail_touch_{i}") for i in (16, 17, 18))
#: Geoms with this suffix touch obstacles only. TRUNK_GEOMS and the soles alone would let a shoulder, a knee or the nose
#: penetrate a box: these spheres and capsules complete the robot's outline, except for its tail and 2 mm of the soft
#: paws. A scene without obstacles is built without them, so they cost nothing there.
BUMPER_SUFFIX: Final = "_bumper"


#: The names of the feet's geoms end with one of these suffixes.
FOOT_SUFFIXES: Final = ("_sole", "_ankle")
#: Radius of the lower front legs, and length of the straight part of the soles' capsules in the author's model [m]. The
#: capsules lie across the robot (`LATERAL_QUATERNION`).
ANKLE_RADIUS: Final = 0.002
SOLE_WIDTH: Final = 0.007
LATERAL_QUATERNION: Final = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)


def set_masses(spec: mujoco.MjSpec, robot: str, parameters: ModelParameters) -> None:
    """Give every moving body the mass, centre of mass and inertia of its part; geoms weigh nothing."""
    for geom in spec.geoms:
        if geom.group == VISUAL_GROUP:
            geom.mass = 0.0
    front, rear = ROBOT_MASSES[robot]
    # Factors on the masses in the table, by `is_front`.
    scales = {True: float(parameters.mass.front / front), False: float(parameters.mass.rear / rear)}
    geometry = parameters.geometry
    for body in spec.bodies[1:]:
        part = part_of(body.name, robot, geometry)
        body.explicitinertial = True
        scale = scales[is_front(body.name)]
        body.mass, body.inertia = scale * part.mass, scale * np.array(part.inertia)
        body.ipos, body.iquat = np.array(part.com), np.array([1.0, 0, 0, 0])
    for body in spec.bodies[1:]:
        site = part_of(body.name, robot).site
        if site is not None:
            # The table gives the centre of mass in the frame of this site. The compiler resolves the pose of the site
            # in the body from nested frames.
            frame, offset = load_part("spine", geometry).compile().site(site), np.zeros(3)
            mujoco.mju_rotVecQuat(offset, np.array(body.ipos), frame.quat)
            body.ipos, body.iquat = frame.pos + offset, frame.quat


def set_joints(spec: mujoco.MjSpec, parameters: ModelParameters, hinges: int = 1) -> None:
    """Set springs, dampers and rotor inertias (Table A.1). The back-EMF of a servo adds to the damping of its joint.

    Args:
        hinges: Number of hinges of each compliant joint. Together, in series, they have the values of the parameters.
    """
    stiffness = parameters.stiffness
    damping = parameters.damping
    brake = float(parameters.servo.brake)
    for joint in spec.joints:
        # The last word of the name, such as "knee" of "front_left_knee_hinge_2".
        kind = chain_of(joint.name).rstrip("_0123456789").rsplit("_", 1)[-1]
        if joint.name.startswith("tail_joint"):
            _compliant(joint, TAIL_STIFFNESS, TAIL_DAMPING, ARMATURE["tail"])
        elif is_spine_joint(joint.name):
            _compliant(joint, stiffness.spine, damping.spine, ARMATURE["spine"], hinges=hinges)
        elif kind == "knee":
            pair = joint.name.split("_")[0]
            side = 1.0 if "left" in joint.name else -1.0
            spring = getattr(stiffness, f"{pair}_knee") * (1.0 + side * parameters.build.asymmetry)
            _compliant(joint, spring, damping.knee, ARMATURE["knee"], KNEE_REST_RAD[pair], hinges)
        elif kind == "ankle":
            _compliant(joint, stiffness.ankle, damping.ankle, ARMATURE["ankle"], hinges=hinges)
        elif kind == "hip":
            _compliant(joint, 0.0, damping.hip + brake, ARMATURE["servo"])
        elif kind in ("pulley", "neck", "tilt"):
            _compliant(joint, 0.0, damping.pulley + brake, ARMATURE["servo"])


def is_spine_joint(joint: str) -> bool:
    """Whether the joint of this name is one of the spine's compliant joints, lateral or vertical."""
    return chain_of(joint).rstrip("0123456789") in ("spine_joint_", "spine_vertical_")


#: Kinds of compliant joints, in the order of `Sensors.joint_velocity`.
COMPLIANT_KINDS: Final = ("knee", "ankle", "spine", "tail")


def compliant_kind(joint: str) -> str | None:
    """Return the one of `COMPLIANT_KINDS` to which the joint of this name belongs, or None.

    >>> compliant_kind("front_left_knee_hinge_2"), compliant_kind("spine_vertical_1"), compliant_kind("front_left_hip")
    ('knee', 'spine', None)
    """
    if is_spine_joint(joint):
        return "spine"
    kind = "tail" if joint.startswith("tail_joint") else chain_of(joint).rpartition("_")[2]
    return kind if kind in COMPLIANT_KINDS else None


def _compliant(
    joint: Any,
    stiffness: Any,
    damping: Any,
    armature: float,
    rest_angle: float = 0.0,
    hinges: int = 1,
) -> None:
    """Set the spring, damper and rotor inertia of a joint, which is a hinge of a chain or the whole joint."""
    # MuJoCo's stiffness and damping are coefficients of a polynomial in the angle; only the linear one is used.
    joint.stiffness, joint.damping = (
        np.array([hinges * value, 0.0, 0.0]) for value in (stiffness, damping)
    )
    joint.armature, joint.springref = hinges * armature, rest_angle / hinges


def pair_of(tendon: str) -> str | None:
    """Return `front`, `rear` or `spine`, the part to which the tendon of this name belongs; None for the tail."""
    part = tendon.split("_")[0]
    return part if part in ("front", "rear", "spine") else None


def set_tendons(spec: mujoco.MjSpec, parameters: ModelParameters, robot: str) -> None:
    """Make every tendon's length limit as stiff as the time step permits, and add the slack and softness (`build.*`)
    of the built robot."""
    is_author = robot == "author"
    time_constant = max(TENDON_TIME_CONSTANT, 2.0 * spec.option.timestep)
    for tendon in spec.tendons:
        tendon.solref_limit = np.array([time_constant, 1.0])
        tendon.solimp_limit = np.array(AUTHOR_TENDON_SOLIMP if is_author else TENDON_SOLIMP)
        pair = pair_of(tendon.name)
        if pair in LEGS and not is_author:
            tendon.solimp_limit = np.array(
                [float(parameters.build.tendon_impedance), *LEG_TENDON_ONSET]
            )
        if pair is None and is_author:
            tendon.solref_limit = np.array([time_constant * np.sqrt(AUTHOR_TAIL_SOFTNESS), 1.0])
        if pair is not None:
            # The stiffness of the limit is proportional to 1 / time_constant^2.
            softness = float(getattr(parameters.build, f"{pair}_softness"))
            tendon.solref_limit = np.array([time_constant * np.sqrt(softness), 1.0])
            tendon.range = np.array(tendon.range) + np.array(
                [0.0, float(parameters.build.slack(pair))]
            )


def servo_shares(servos: Sequence[str], robot: str, is_simplified: bool) -> np.ndarray:
    """Shares of `servo.kp` and of `servo.torque_limit` that servos have, (n, 2), without `servo.spine_torque`.

    Args:
        servos: Names, as in `SERVOS`.
        robot: Robot that they belong to.
        is_simplified: Whether the servos of the robot `author` have one gain.
    """
    gains = AUTHOR_GAIN_SHARES if robot == "author" and not is_simplified else {}
    torques = AUTHOR_TORQUE_SHARES if robot == "author" else {}
    kinds = map(servo_kind, servos)
    return np.array([(gains.get(kind, 1.0), torques.get(kind, 1.0)) for kind in kinds])


def add_servos(
    spec: mujoco.MjSpec,
    routing: str,
    parameters: ModelParameters,
    robot: str = "nermo_lite",
    is_simplified: bool = True,
) -> None:
    """Add proportional servos with damping; the torque limit applies to the sum of both torques."""
    servo = parameters.servo
    joints = {joint.name for joint in spec.joints}
    for name in SERVOS:
        target = servo_joint(name)
        if target in joints:
            actuator = spec.add_actuator(
                name=f"{name}_servo", target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            gain_share, torque_share = servo_shares([name], robot, is_simplified)[0]
            actuator.set_to_position(kp=float(servo.kp) * gain_share, kv=float(servo.kv))
            actuator.ctrllimited = True
            margin = float(servo.knee_range) if name.endswith("_knee") else 0.0
            actuator.ctrlrange = servo_range(name, routing, robot) + margin * np.array([-1.0, 1.0])
            limit = float(servo.stall_torque) * torque_share
            limit *= float(servo.spine_torque) if name == "spine" else 1.0
            actuator.forcelimited, actuator.forcerange = True, np.array([-limit, limit])


def servo_joint(servo: str) -> str:
    """Return the joint that a servo turns. The servos of hips, neck and head turn their joints, the others a pulley."""
    if servo.endswith("_knee"):
        return servo.removesuffix("knee") + "pulley"
    return {
        "head": "head_tilt",
        **{name: f"{name}_pulley" for name in ("spine", "spine_vertical", "tail")},
    }.get(servo, servo)


def add_sensors(spec: mujoco.MjSpec) -> None:
    """Add the sensors that `Sensors` reads, in the order of its fields."""
    kind, objects = mujoco.mjtSensor, mujoco.mjtObj
    site, actuator = objects.mjOBJ_SITE, objects.mjOBJ_ACTUATOR

    def add(name: str, sensor: Any, objtype: Any, target: str) -> None:
        spec.add_sensor(name=name, type=sensor, objtype=objtype, objname=target)

    add("position", kind.mjSENS_FRAMEPOS, site, "imu")
    add("orientation", kind.mjSENS_FRAMEQUAT, site, "imu")
    add("linear_velocity", kind.mjSENS_FRAMELINVEL, site, "imu")
    add("gyro", kind.mjSENS_GYRO, site, "imu")
    add("accelerometer", kind.mjSENS_ACCELEROMETER, site, "imu")
    for reading in ("angle", "velocity", "torque"):
        sensor = {"angle": "ACTUATORPOS", "velocity": "ACTUATORVEL", "torque": "ACTUATORFRC"}[
            reading
        ]
        for servo in spec.actuators:
            add(f"{servo.name}_{reading}", getattr(kind, f"mjSENS_{sensor}"), actuator, servo.name)
    for limb in LIMBS:
        for joint in spec.joints:
            if chain_of(joint.name) == f"{limb}_knee":
                add(f"{joint.name}_angle", kind.mjSENS_JOINTPOS, objects.mjOBJ_JOINT, joint.name)
    for limb in LIMBS:
        add(f"{limb}_foot_force", kind.mjSENS_TOUCH, site, f"{limb}_touch")
    for limb in LIMBS:
        add(f"{limb}_foot_position", kind.mjSENS_FRAMEPOS, site, f"{limb}_foot")
    for limb in LIMBS:
        add(f"{limb}_foot_velocity", kind.mjSENS_FRAMELINVEL, site, f"{limb}_foot")
    for compliant in COMPLIANT_KINDS:
        for joint in spec.joints:
            if compliant_kind(joint.name) == compliant:
                add(f"{joint.name}_velocity", kind.mjSENS_JOINTVEL, objects.mjOBJ_JOINT, joint.name)
    for geom, touch in _tail_ground(spec):
        add(f"{geom}_force", kind.mjSENS_TOUCH, site, touch)
    # The sensor returns the distance (data field) of the contact with the smallest distance (reduction 1), and of one
    # contact only.
    contact_sensor = spec.add_sensor(
        name="contact_distance", type=kind.mjSENS_CONTACT, objtype=objects.mjOBJ_UNKNOWN
    )
    contact_sensor.intprm = [1 << int(mujoco.mjtConDataField.mjCONDATA_DIST), 1, 1]


def _tail_ground(spec: mujoco.MjSpec) -> list[tuple[str, str]]:
    """Geoms of the tail that can touch the ground, with their touch sites; of a rigid tail, only its tip can."""
    return [pair for pair in (TAIL_TIP, *TAIL_SEGMENTS) if spec.geom(pair[0]) is not None]


def add_contacts(
    spec: mujoco.MjSpec,
    scene: SceneGeoms,
    parameters: ModelParameters,
    trunk_contacts: bool,
    capsules: bool,
    begins_at_zero: bool = True,
) -> None:
    """Declare the few contact pairs that matter; there are no other collisions.

    Args:
        scene: Geoms of the scene that can touch the robot.
        trunk_contacts: Whether the spheres of `TRUNK_GEOMS` touch the ground, too. They always touch obstacles.
        capsules: Whether soles are capsules instead of spheres, and the ankles of the front legs touch the ground, too.
        begins_at_zero: Whether the force of a sole begins at zero, or with the impedance of the author's model.
    """
    contact = parameters.contact
    time_constant = max(float(contact.time_constant), 2.0 * spec.option.timestep)
    solref = np.array([time_constant, float(contact.damping_ratio)])
    onset, midpoint = (
        (0.0, 0.5) if begins_at_zero else (AUTHOR_CONTACT_ONSET, AUTHOR_CONTACT_MIDPOINT)
    )
    solimp = np.array([onset, float(contact.impedance), float(contact.width), midpoint, 2.0])
    # Geom -> friction: of the geoms with the soft contact of the soles, and of the geoms with MuJoCo's default contact.
    soft_friction = {f"{limb}_sole": contact.friction for limb in LIMBS}
    for limb in LIMBS if capsules else ():
        sole = spec.geom(f"{limb}_sole")
        if limb.startswith("front"):
            ankle = spec.body(f"{limb}_foot").add_geom(
                sole.classname, name=f"{limb}_ankle", size=[ANKLE_RADIUS, 0, 0]
            )
            soft_friction[ankle.name] = contact.friction
        sole.type, sole.size[1], sole.quat = (
            mujoco.mjtGeom.mjGEOM_CAPSULE,
            SOLE_WIDTH / 2,
            LATERAL_QUATERNION,
        )
    soft_friction |= {geom: contact.tail_friction for geom, _ in _tail_ground(spec)}
    hard_friction = dict.fromkeys(TRUNK_GEOMS if trunk_contacts else (), contact.trunk_friction)
    for ground in scene.ground:
        for part, friction in (soft_friction | hard_friction).items():
            pair = _add_pair(spec, ground, part, friction)
            if part in soft_friction:
                pair.solref, pair.solimp = solref, solimp
    bumpers = [geom for geom in spec.geoms if geom.name.endswith(BUMPER_SUFFIX)]
    if not scene.obstacles:
        for geom in bumpers:
            spec.delete(geom)
        return
    outline = (*TRUNK_GEOMS, *(f"{limb}_sole" for limb in LIMBS), *(geom.name for geom in bumpers))
    for obstacle, part in itertools.product(scene.obstacles, outline):
        _add_pair(spec, obstacle, part, contact.obstacle_friction)


def _add_pair(spec: mujoco.MjSpec, scenery: str, part: str, friction: Any) -> Any:
    pair = spec.add_pair(name=f"{scenery}_{part}", geomname1=scenery, geomname2=part, condim=3)
    # Two tangential coefficients; the torsional and rolling ones have no effect with three dimensions (`condim`).
    pair.friction = np.array([float(friction), float(friction), 0.005, 0.0001, 0.0001])
    return pair


def contact_kinds(model: mujoco.MjModel, scene: SceneGeoms) -> dict[str, np.ndarray]:
    """Ids of the contact pairs by kind: `sole`, `tail` and `trunk` with the ground, and any part with an `obstacle`."""
    kinds: dict[str, list[int]] = {"sole": [], "tail": [], "trunk": [], "obstacle": []}
    for i, geoms in enumerate(
        zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    ):
        names = {model.geom(geom).name for geom in geoms}
        if names & set(scene.obstacles):
            kinds["obstacle"].append(i)
        else:
            (part,) = names - set(scene.ground)
            kinds[
                "sole"
                if part.endswith(FOOT_SUFFIXES)
                else "trunk"
                if part in TRUNK_GEOMS
                else "tail"
            ].append(i)
    return {kind: np.array(ids, int) for kind, ids in kinds.items()}


# ---
# How stiff and how damped a servo may be at a time step, before its discrete dynamics alternate instead of settling.
#
# A servo of inertia I turns by tau = kp (u - q) - kv w. Euler's method is explicit in both, w' = w + h tau / I and
# q' = q + h w', so that the eigenvalues z of a step are the roots of
#
#     z^2 - (2 - a - b) z + 1 - a = 0,    a = h kv / I,    b = h^2 kp / I.
#
# They lie in the unit circle if and only if b + 2 a < 4 (Jury's criterion), that is
#
#     h^2 kp + 2 h kv < 4 I.
#
# The bound of kp alone is 4 I / h^2, and the bound of kv alone is 2 I / h; beyond it, the torque jumps from limit to
# limit in each step. I is at least the armature, because MuJoCo adds the armature to the positive inertia of the bodies.
# The joints' damping, in which Euler's method is implicit, only widens the bound. The standing robot starts to alternate
# at 1.01 times the bound.


#: Allowed fraction of the bound: closer to it, a servo settles, but rings for longer than a control period.
ALLOWED_SHARE: Final = 0.9
#: Allowed fraction of the bound of kp: without damping, the rest of the body is enough to make a stiff servo ring.
ALLOWED_STIFFNESS_SHARE: Final = 0.75


def highest_kp(timestep: float, kv: float) -> float:
    """The highest proportional gain [N m/rad] at a time step [s], with a damping kv [N m s/rad]."""
    inertia = 4.0 * ARMATURE["servo"]
    return (
        min(ALLOWED_STIFFNESS_SHARE * inertia, ALLOWED_SHARE * inertia - 2.0 * timestep * kv)
        / timestep**2
    )


def highest_kv(timestep: float, kp: Any) -> Any:
    """The highest damping [N m s/rad] at a time step [s], with gains kp [N m/rad] of any shape."""
    return (4.0 * ALLOWED_SHARE * ARMATURE["servo"] - timestep**2 * kp) / (2.0 * timestep)


def check_servo(kp: Any, kv: Any, timestep: float) -> None:
    """Reject servos whose stiffness and damping together are too high for the time step.

    Args:
        kp, kv: Gains [N m/rad] and damping [N m s/rad], of any shapes that broadcast.
        timestep: Time step of the physics [s].

    Raises:
        ParameterError: A pair is too high; the message names the pair with the largest excess.
    """
    kp, kv = np.broadcast_arrays(np.asarray(kp, float), np.asarray(kv, float))
    excess = kv - highest_kv(timestep, kp) * (1.0 + 1e-6)
    if (excess > 0.0).any():
        worst = np.unravel_index(np.argmax(excess), excess.shape)
        raise ParameterError(
            f"servo.kv is {kv[worst]:g}: allowed is [0, {highest_kv(timestep, float(kp[worst])):g}] N m s/rad beside "
            f"servo.kp {kp[worst]:g} N m/rad at a time step of {timestep:g} s."
        )
