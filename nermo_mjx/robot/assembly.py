"""Assembly of the robot, and of its test stands, from the MJCF files of `mjcf/`.

The files hold the geometry; this module joins them and writes what the parameter trees and the table of masses hold:
masses, springs, dampers, servos, contact, sensors. Every build starts from the left limbs' files; right is mirrored.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.robot.interface import SERVOS, servo_range
from nermo_mjx.robot.masses import is_front, part_of
from nermo_mjx.robot.mirror import mirror
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.parameters import LIMBS, ROUTINGS
from nermo_mjx.robot.quantity import ParameterError

ROBOTS: Final = ("nermo_lite",)
TAILS: Final = ("rigid", "articulated")
CONES: Final = ("elliptic", "pyramidal")

#: Rotor and gear inertia seen at the joint [kg m^2], as in the author's model.
ARMATURE: Final = {"servo": 0.00065, "knee": 0.000065, "ankle": 0.000065, "spine": 0.00065, "tail": 0.00065}
TAIL_STIFFNESS: Final = 1.2
TAIL_DAMPING: Final = 0.01
#: Knee angle at which the torsion spring rests [rad].
KNEE_REST: Final = {"front": np.radians(50.0), "rear": np.radians(75.0)}
#: Tendons are massless and inextensible: their limit is as stiff as the time step allows.
TENDON_SOLREF: Final = (0.004, 1.0)
TENDON_SOLIMP: Final = (0.95, 0.99, 0.0002, 0.5, 2.0)

#: Joint angles of the published stance, hip and knee [rad]. The model's zero pose (qpos0) stands in it, so that
#: MuJoCo's reference inertias are those of the standing robot.
STANCE: Final = {"front": (0.8165, 1.4782), "rear": (-0.9712, 2.1480)}
#: Pulley angles that just tighten the tendons of that stance [rad], by routing.
STANCE_PULLEY: Final = {
    "type1": {"front": 2.0114, "rear": -1.1922},
    "type2": {"front": 0.1208, "rear": 0.7110},
    "type3": {"front": 0.1315, "rear": 0.6623},
}
#: Height of the spine base in that stance [m].
STANCE_HEIGHT: Final = 0.0794

#: Trunk geoms that may touch the ground when the robot falls; spheres, so that each costs MJX one contact.
TRUNK: Final = ("torso_chest", "hip_pelvis", "head_skull")


@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """Which robot to build; every name is resolved before anything compiles.

    Attributes:
        robot: `nermo_lite`.
        scene: name of a file in `mjcf/scenes`.
        tail: `rigid` (default: a third faster) or `articulated`, 19 joints; same mass and centre of mass.
        routing: of the leg tendons, `type3` through the hip axis (the robot), `type1`, `type2`.
        cone: of the friction, `elliptic` or `pyramidal`.
        timestep: of the physics [s].
    """

    robot: str = "nermo_lite"
    scene: str = "flat"
    tail: str = "rigid"
    routing: str = "type3"
    cone: str = "elliptic"
    timestep: float = 0.002

    def __post_init__(self) -> None:
        for field, allowed in (
            ("robot", ROBOTS), ("scene", scenes()), ("tail", TAILS), ("routing", ROUTINGS), ("cone", CONES),
        ):  # fmt: skip
            if getattr(self, field) not in allowed:
                raise ParameterError(
                    f"{field} is {getattr(self, field)!r}: allowed is {' or '.join(map(repr, allowed))}."
                )
        if not 1e-5 <= self.timestep <= 0.004:
            raise ParameterError(f"timestep is {self.timestep!r}: allowed is [1e-05, 0.004] s.")


def mjcf_directory() -> Path:
    """Where the MJCF files are: inside the installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "mjcf"
    return inside if inside.is_dir() else package.parent / "mjcf"


def scenes() -> tuple[str, ...]:
    """Names of the scenes that come with the package."""
    return tuple(sorted(path.stem for path in (mjcf_directory() / "scenes").glob("*.xml")))


def assemble(config: RobotConfig | None = None, parameters: ModelParameters | None = None) -> mujoco.MjSpec:
    """The whole robot in its scene, as an editable `MjSpec`."""
    config, parameters = config or RobotConfig(), parameters or ModelParameters()
    spec = _load(f"scenes/{config.scene}")
    spec.modelname = f"{config.robot}_{config.scene}"
    _attach(spec, spec.worldbody, "torso", plain=("torso", "root", "imu"))
    _attach(spec, spec.frame("torso_spine_mount"), "spine")
    _attach(spec, spec.frame("torso_neck_mount"), "head", plain=("head", "neck"))
    _attach(spec, spec.frame("spine_end"), "hip")
    for limb in LIMBS:
        trunk = "torso" if limb.startswith("front") else "hip"
        _attach_leg(spec, spec.frame(f"{trunk}_{limb}_mount"), limb, config.routing)
    _attach(spec, spec.frame("hip_tail_mount"), "tail")
    if config.tail == "rigid":
        _stiffen_tail(spec)
    _pose(spec, config.routing)
    _finish(spec, config, parameters)
    _add_sensors(spec)
    _add_contacts(spec, parameters)
    return spec


def assemble_leg(limb: str, routing: str = "type3", parameters: ModelParameters | None = None) -> mujoco.MjSpec:
    """One leg on a test stand: its hip axis is fixed at the world's origin, without gravity or ground."""
    if limb not in LIMBS:
        raise ParameterError(f"limb is {limb!r}: allowed is one of {', '.join(LIMBS)}.")
    config = RobotConfig(routing=routing)
    spec = _stand(f"{limb}_leg_stand")
    _attach_leg(spec, spec.worldbody, limb, routing)
    _pose(spec, routing)
    _finish(spec, config, parameters or ModelParameters())
    return spec


def assemble_spine(parameters: ModelParameters | None = None) -> mujoco.MjSpec:
    """The spine on a test stand: its base is fixed at the world's origin, without gravity; the hip hangs free."""
    spec = _stand("spine_stand")
    _attach(spec, spec.worldbody, "spine")
    _attach(spec, spec.frame("spine_end"), "hip")
    _finish(spec, RobotConfig(), parameters or ModelParameters())
    return spec


def _load(name: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(mjcf_directory() / f"{name}.xml"))


def _stand(name: str) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.option.gravity = np.zeros(3)
    return spec


def _attach(spec: mujoco.MjSpec, place: Any, name: str, plain: tuple[str, ...] = ()) -> None:
    """Attach the file `name` with its name as prefix, but for the elements in `plain`, which keep their names."""
    frame = place if isinstance(place, mujoco.MjsFrame) else place.add_frame()
    spec.attach(_load(name), prefix=f"{name}_", frame=frame)
    for kind in (spec.body, spec.joint, spec.site, spec.frame, spec.camera):
        for short in plain:
            element = kind(f"{name}_{short}")
            if element is not None:
                element.name = short


def _attach_leg(spec: mujoco.MjSpec, place: Any, limb: str, routing: str) -> None:
    pair, side = limb.split("_")
    leg = _load(f"{pair}_leg")
    for tendon in list(leg.tendons):
        if tendon.name != routing:
            leg.delete(tendon)
        else:
            tendon.name = "tendon"
    if side == "right":
        mirror(leg)
    frame = place if isinstance(place, mujoco.MjsFrame) else place.add_frame()
    spec.attach(leg, prefix=f"{limb}_", frame=frame)


def _stiffen_tail(spec: mujoco.MjSpec) -> None:
    """Freeze the tail's joints: the compiler then fuses its segments into the hip, with their mass where it was."""
    for element in (*spec.tendons, *spec.joints):
        if element.name.startswith("tail_"):
            spec.delete(element)
    spec.compiler.fusestatic = True


def _pose(spec: mujoco.MjSpec, routing: str) -> None:
    """Make the published stance the model's zero pose; joint values still count from the straight leg."""
    for pair, (hip, knee) in STANCE.items():
        pulley = STANCE_PULLEY[routing][pair]
        for joint in spec.joints:
            angle = {"hip": hip, "knee": knee, "pulley": pulley}.get(joint.name.rsplit("_", 1)[-1])
            if joint.name.startswith(pair) and angle is not None:
                turn = angle * joint.axis[0]
                joint.parent.quat = np.array([np.cos(turn / 2), np.sin(turn / 2), 0.0, 0.0])
                joint.ref = angle
    torso = spec.body("torso")
    if torso is not None:
        torso.pos = np.array([0.0, 0.0, STANCE_HEIGHT])


def _finish(spec: mujoco.MjSpec, config: RobotConfig, parameters: ModelParameters) -> None:
    option = spec.option
    option.timestep = config.timestep
    # Euler is implicit in the joints' damping, which is stiff, and explicit in the servos', which is not. With implicitfast
    # the engines differ while a servo saturates: MJX keeps the derivative of its damping, C drops it.
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{config.cone.upper()}")
    option.impratio = 3.0
    # A world that diverges must stay diverged, to be flagged, not start anew.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _set_masses(spec, parameters)
    _set_joints(spec, parameters)
    for tendon in spec.tendons:
        tendon.solref_limit = np.array(TENDON_SOLREF)
        tendon.solimp_limit = np.array(TENDON_SOLIMP)
    _add_servos(spec, config, parameters)


def _set_masses(spec: mujoco.MjSpec, parameters: ModelParameters) -> None:
    default, mass = ModelParameters().mass, parameters.mass
    share = {True: float(mass.front / default.front), False: float(mass.rear / default.rear)}
    for body in spec.bodies[1:]:
        part = part_of(body.name)
        body.explicitinertial = True
        scale = share[is_front(body.name)]
        body.mass, body.inertia = scale * part.mass, scale * np.array(part.inertia)
        body.ipos, body.iquat = np.array(part.com), np.array([1.0, 0, 0, 0])
    for body in spec.bodies[1:]:
        site = part_of(body.name).site
        if site is not None:
            pos, quat = _site_in_body("spine", site)
            turned = np.zeros(3)
            mujoco.mju_rotVecQuat(turned, np.array(body.ipos), quat)
            body.ipos, body.iquat = pos + turned, quat


def _site_in_body(file: str, site: str) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a site in its body, as the compiler resolves it from the nested frames of one file."""
    model = _load(file).compile()
    return model.site(site).pos, model.site(site).quat


def _set_joints(spec: mujoco.MjSpec, parameters: ModelParameters) -> None:
    stiffness, damping = parameters.stiffness, parameters.damping
    for joint in spec.joints:
        kind = joint.name.rstrip("_0123456789").rsplit("_", 1)[-1]
        if joint.name.startswith("tail_joint"):
            _compliant(joint, TAIL_STIFFNESS, TAIL_DAMPING, ARMATURE["tail"])
        elif kind == "joint":
            _compliant(joint, stiffness.spine, damping.spine, ARMATURE["spine"])
        elif kind == "knee":
            pair = joint.name.split("_")[0]
            _compliant(joint, getattr(stiffness, f"{pair}_knee"), damping.knee, ARMATURE["knee"], KNEE_REST[pair])
        elif kind == "ankle":
            _compliant(joint, stiffness.ankle, damping.ankle, ARMATURE["ankle"])
        elif kind == "hip":
            _compliant(joint, 0.0, damping.hip, ARMATURE["servo"])
        elif kind in ("pulley", "neck"):
            _compliant(joint, 0.0, damping.pulley, ARMATURE["servo"])


def _compliant(joint: Any, stiffness: Any, damping: Any, armature: float, rest: float = 0.0) -> None:
    # Coefficients of a polynomial in the angle; only the linear one is used.
    joint.stiffness, joint.damping = np.array([stiffness, 0.0, 0.0]), np.array([damping, 0.0, 0.0])
    joint.armature, joint.springref = armature, rest


def _add_servos(spec: mujoco.MjSpec, config: RobotConfig, parameters: ModelParameters) -> None:
    """Proportional servos with a damped loop; the torque limit holds for both together, as in the servo's electronics."""
    servo = parameters.servo
    joints = {joint.name for joint in spec.joints}
    for name in SERVOS:
        target = servo_joint(name)
        if target in joints:
            actuator = spec.add_actuator(name=f"{name}_servo", target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=float(servo.kp), kv=float(servo.kv))
            actuator.ctrllimited, actuator.ctrlrange = True, np.array(servo_range(name, config.routing))
            limit = float(servo.torque_limit)
            actuator.forcelimited, actuator.forcerange = True, np.array([-limit, limit])


def servo_joint(servo: str) -> str:
    """The joint a servo turns: a limb's hip directly, the others through their pulley."""
    if servo.endswith("_knee"):
        return servo.removesuffix("knee") + "pulley"
    return {"spine": "spine_pulley", "tail": "tail_pulley"}.get(servo, servo)


def _add_sensors(spec: mujoco.MjSpec) -> None:
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
        sensor = {"angle": "ACTUATORPOS", "velocity": "ACTUATORVEL", "torque": "ACTUATORFRC"}[reading]
        for servo in spec.actuators:
            add(f"{servo.name}_{reading}", getattr(kind, f"mjSENS_{sensor}"), actuator, servo.name)
    for limb in LIMBS:
        add(f"{limb}_knee_angle", kind.mjSENS_JOINTPOS, objects.mjOBJ_JOINT, f"{limb}_knee")
    for limb in LIMBS:
        add(f"{limb}_foot_force", kind.mjSENS_TOUCH, site, f"{limb}_touch")
    for limb in LIMBS:
        add(f"{limb}_foot_position", kind.mjSENS_FRAMEPOS, site, f"{limb}_foot")
    for limb in LIMBS:
        add(f"{limb}_foot_velocity", kind.mjSENS_FRAMELINVEL, site, f"{limb}_foot")


def _add_contacts(spec: mujoco.MjSpec, parameters: ModelParameters) -> None:
    """Declare the few contact pairs that matter; nothing else collides."""
    contact = parameters.contact
    solref = np.array([float(contact.time_constant), float(contact.damping_ratio)])
    solimp = np.array([0.0, float(contact.impedance), float(contact.width), 0.5, 2.0])
    slide = float(contact.friction)
    for limb in LIMBS:
        pair = spec.add_pair(name=f"{limb}_contact", geomname1="floor", geomname2=f"{limb}_sole", condim=3)
        pair.solref, pair.solimp = solref, solimp
        pair.friction = np.array([slide, slide, 0.005, 0.0001, 0.0001])
    for geom in TRUNK:
        spec.add_pair(name=f"{geom}_contact", geomname1="floor", geomname2=geom, condim=3)
