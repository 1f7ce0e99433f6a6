"""Numbers of the robot, from A. Rohregger, "Digital Nermo" (Master's thesis, TU Munich, 2021), with its errata.

Frames: x to the robot's left, y backward (the head points to -y), z up. SI units and radians.
Limb order everywhere: front left, front right, rear left, rear right.

Sign convention, stated once: positive spine servo angle, positive spine joint angle theta_v, positive turn rate and
positive yaw all mean a turn to the **left** (counter-clockwise seen from above). The lateral joint angles of the DH
chain (Table 5.3) are therefore -theta_v. Erratum: (5.26) and the published code disagree about this sign.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.shapes import Array, PerLimb, Quaternion, Scalars, Spatial

LIMBS: Final = ("front_left", "front_right", "rear_left", "rear_right")
GaitName = Literal["trot", "walking_trot", "lateral_walk", "bound", "gallop"]
GAITS: Final = get_args(GaitName)
#: The author's codes of gaits, which are accepted in place of their names, and shown nowhere.
GAIT_CODES: Final = {"trt": "trot", "trt1": "walking_trot", "lat": "lateral_walk"}
RoutingName = Literal["type1", "type2", "type3", "type3_idler"]
ROUTINGS: Final = get_args(RoutingName)


@dataclasses.dataclass(frozen=True)
class LegGeometry:
    """One leg in its sagittal plane; (y, z) are relative to the hip or shoulder axis O [A.4, A.2.2].

    Attributes:
        l1, l2, l3, l4: upper leg, knee to tendon attachment B, knee to ankle, ankle to foot [m].
        theta3: constant ankle angle [rad].
        pulley_radius: r_p of the knee servo's pulley [m].
        pulley_height: d1, the pulley centre E above O [m].
        tendon_length: l_t0, pulling length of the tendon at servo angle 0 [m].
        knee_direction: s of the leg model, -1 front and +1 rear.
        servo_direction: k of the tendon law, +1 front and -1 rear (the published servo convention).
        guide: C, the fixed guide point of tendon routing type 2 (y, z) [m].
        tie: where the tendon is tied to the pulley, just outside its rim, at servo angle 0, (y, z) from E [m]. MuJoCo
            picks a wrap's side by the mean of its two tangent points, so that a wrap must stay below 180 degrees: the
            point keeps it between 40 and 175 degrees over the servo's range.
        tie_type1, tie_idler: the same for the routings type 1 and type 3 with an idler.
        side: a point on the side where the tendon passes the pulley, (y, z) from E [m]; MuJoCo 3.17 and 4, which decide
            by different rules, lead every routing alike past both legs' points.
        neutral_foot: position of the foot in the published stance, (y, z) from O [m] (Table A.7).
    """

    l1: float
    l2: float
    l3: float
    l4: float
    theta3: float
    pulley_radius: float
    pulley_height: float
    tendon_length: float
    knee_direction: float
    servo_direction: float
    guide: tuple[float, float]
    tie: tuple[float, float]
    tie_type1: tuple[float, float]
    tie_idler: tuple[float, float]
    side: tuple[float, float]
    neutral_foot: tuple[float, float]


FRONT_LEG: Final = LegGeometry(
    l1=0.0295,
    l2=0.0145,
    l3=0.0225,
    l4=0.0145,
    theta3=math.radians(23),
    pulley_radius=0.008,
    pulley_height=0.0128,
    tendon_length=0.033,
    knee_direction=-1.0,
    servo_direction=1.0,
    guide=(-0.004, -0.002),
    tie=(-0.0024771, 0.0076237),
    tie_type1=(0.0076237, -0.0024771),
    tie_idler=(-0.0034826, 0.0072200),
    side=(-0.0130, 0.0),
    neutral_foot=(-0.005, -0.045),
)
REAR_LEG: Final = LegGeometry(
    l1=0.0317,
    l2=0.0200,
    l3=0.0305,
    l4=0.0205,
    theta3=math.radians(73),
    pulley_radius=0.008,
    pulley_height=0.0128,
    tendon_length=0.032,
    knee_direction=1.0,
    servo_direction=-1.0,
    guide=(0.004, -0.002),
    tie=(0.0051526, 0.0061406),
    tie_type1=(-0.0074582, 0.0029379),
    tie_idler=(0.0069528, 0.0039893),
    side=(0.0117820, 0.0054940),
    neutral_foot=(0.000, -0.050),
)
LEGS: Final = {"front": FRONT_LEG, "rear": REAR_LEG}
#: Radius of the idler on the hip axis, of routing `type3_idler` [m]: the hip's axle, by whose site of that radius the
#: author's model leads its tendon (`router_hip` of his leg_rl_assets/rl_t3_asset_exp.xml); otherwise not published.
IDLER_RADIUS: Final = 0.002
#: Distance of a leg servo's output from the plane of its leg, inward, and from there to the end of its case [m].
SERVO_INSET: Final = 0.0038
SERVO_DEPTH: Final = 0.0190
#: How much farther out a pulley's rim is than the middle of its tendon [m].
PULLEY_RIM: Final = 0.0008
#: Radius of the soft ball with which a foot touches the ground [m]: the author's 2 mm, in a skin of 1.8 mm,
#: by which it yields further than his under the standing robot (`model_parameters.Contact`).
FOOT_RADIUS: Final = 0.0038


@dataclasses.dataclass(frozen=True)
class SpineGeometry:
    """The spine: a modified DH chain and the antagonist tendons that bend it.

    Attributes:
        dh: 11 rows (alpha_prev [rad], a_prev [m], theta [rad], d [m]) of Table 5.3.
        lateral_joints: 0-based rows that bend sideways, each by -theta_v (see the module's sign convention).
        vertical_joints: 0-based rows that bend up and down: fused on Nermo-Lite, actuated on Nermo 4.1.
        segment_length: l_v, length of a tendon segment across a straight joint [m] (5.26).
        segment_offset: d_1, its distance from the spine axis [m].
        pulley_radius: r_sp of the spine servo's pulley [m].
        pulley_position: its centre from the spine end, in the hip's frame [m].
        tie: where the left tendon is tied to it, just outside its rim and 120 degrees on, (x, y) from its centre [m].
        side: a point on the side on which the left tendon passes it, (x, y) from its centre [m].
        max_joint_angle: limit of theta_v in the experiments [rad] (A.4.2).
        max_servo_angle: servo angle that bends each joint by about that limit [rad].
    """

    dh: tuple[tuple[float, float, float, float], ...]
    lateral_joints: tuple[int, ...] = (2, 4, 6, 8)
    vertical_joints: tuple[int, ...] = (1, 3, 5, 7)
    segment_length: float = 0.003
    segment_offset: float = 0.00625
    pulley_radius: float = 0.0065
    pulley_position: tuple[float, float, float] = (0.0, 0.0107, 0.0)
    tie: tuple[float, float] = (-0.003256, 0.005640)
    side: tuple[float, float] = (0.0090, 0.0053)
    max_joint_angle: float = 0.1
    max_servo_angle: float = 0.4

    @property
    def last_hinge(self) -> tuple[float, float]:
        """Axis of the last lateral joint from the spine end, backward and up in the hip's frame [m]."""
        _, length, pitch, _ = self.dh[-2]
        return -length * math.cos(pitch), length * math.sin(pitch)


def _row(alpha_deg: float, a: float, theta_deg: float) -> tuple[float, float, float, float]:
    return math.radians(alpha_deg), a, math.radians(theta_deg), 0.0


SPINE_GEOMETRY: Final = SpineGeometry(
    dh=(
        _row(0, 0.0, 90.0),
        _row(90, 0.0016, -10.7),
        _row(-90, 0.0070, 0.0),
        _row(90, 0.0070, -7.0),
        _row(-90, 0.0070, 0.0),
        _row(90, 0.0070, -6.9),
        _row(-90, 0.0070, 0.0),
        _row(90, 0.0070, 9.7),
        _row(-90, 0.0092, 0.0),
        _row(90, 0.0014, 15.0),
        _row(-90, 0.0, -90.0),
    )
)


@dataclasses.dataclass(frozen=True)
class BodyGeometry:
    """Mounting positions of the limbs; left side, the right side mirrors x [A.5, with errata].

    Attributes:
        shoulder: shoulder axis from the spine base, in the torso's frame [m].
        hip: hip axis from the spine end, in the hip's frame [m]. Table A.5 has both from the spine base: the hip at
            (0.0428, 0.0604, -0.0253), the spine end at (0, 0.0517, -0.0154).
        neck: foot of the neck's axis from the spine base, in the torso's frame [m].
    """

    shoulder: tuple[float, float, float] = (0.0368, -0.0615, -0.0324)
    hip: tuple[float, float, float] = (0.0428, 0.0087, -0.0099)
    neck: tuple[float, float, float] = (0.0, -0.080, -0.013)


BODY_GEOMETRY: Final = BodyGeometry()


@dataclasses.dataclass(frozen=True)
class TailGeometry:
    """The tail, as it hangs in the author's model (tail_assets/tail.xml of that model): each joint is lower than the one
    before.

    Attributes:
        position: First joint from the last joint of the spine, backward and up in the hip's frame [m]. At this position
            the tail touches the ground at the same points of the torso's frame as in the author's model, whose spine
            joints differ by up to 2 mm from Table 5.3.
        first_joint: First joint from the mount, backward and up [m].
        spacing: Distance of neighbouring joints, backward [m].
        drops: How much lower each joint lies than the one before it [m].
        rise: How much higher the segments end than the next joint [m].
        tip: Centre of the last segment's end behind the last joint [m].
        eyelet: Distance of the first joint's tendons from the middle [m].
        taper: How much narrower each segment is than the one before it [m].
        tip_radius: Radius of the sphere that touches the ground first [m].
        tie: Point where the left tendon is tied to the servo's pulley, which is like the spine's, (x, y) from its centre
            [m].
        side: Point on the side on which this tendon passes the pulley, likewise [m].
    """

    position: tuple[float, float] = (0.0563967, -0.0223281)
    first_joint: tuple[float, float] = (0.0114, -0.0038)
    spacing: float = 0.0080
    drops: tuple[float, ...] = (
        *(0.00275, 0.00255, 0.00245, 0.00225, 0.0021, 0.00195, 0.0018, 0.00165, 0.0015),
        *(0.00135, 0.0012, 0.00105, 0.0009, 0.00075, 0.0006, 0.00045, 0.0003, 0.0003),
    )
    rise: float = 0.0010
    tip: float = 0.00525
    eyelet: float = 0.0055
    taper: float = 0.0001
    tip_radius: float = 0.0037
    tie: tuple[float, float] = (-0.003256, -0.005640)
    side: tuple[float, float] = (0.0090, -0.0160)

    @property
    def length(self) -> float:
        """From the first joint backward to the centre of the tip [m]."""
        return len(self.drops) * self.spacing + self.tip


TAIL_GEOMETRY: Final = TailGeometry()


@dataclasses.dataclass(frozen=True)
class EyeGeometry:
    """The two cameras that are the robot's eyes; left side, the right side mirrors x. Estimated from pictures of the
    robot.

    Attributes:
        place: centre of the lens from the neck, in the head's frame [m].
        outward, up: angles of its viewing direction from straight ahead [rad].
        dome: distance of the rendering camera in front of the centre of the lens, so that it does not see the robot
        [m].
    """

    place: tuple[float, float, float] = (0.0099, -0.0276, 0.0186)
    outward: float = 0.50
    up: float = 0.16
    dome: float = 0.0025


EYE_GEOMETRY: Final = EyeGeometry()


@dataclasses.dataclass(frozen=True)
class GaitPattern:
    """A gait [A.2, A.6]: stance share of the cycle, stance offsets of the limbs, gait factor of (5.21)."""

    duty: float
    offsets: tuple[float, float, float, float]
    gait_factor: float


GAIT_PATTERNS: Final[dict[str, GaitPattern]] = {
    "trot": GaitPattern(0.50, (0.50, 0.00, 0.00, 0.50), 2.00),
    "walking_trot": GaitPattern(0.60, (0.50, 0.00, 0.00, 0.50), 1.67),
    "lateral_walk": GaitPattern(0.68, (0.63, 0.14, 0.00, 0.54), 1.47),  # lateral sequence walk
    # Not in the thesis. Bound: hind pair, then fore pair, half a cycle apart (Hildebrand, BioScience 39, 1989), with
    # neither flight nor overlap, as in the ideal trot. Gallop: the rotary gallop that the author's code has and does
    # not use (`gallop_rot_parameters` of mouse_parameters_dir.py); gait factor 1 / duty.
    "bound": GaitPattern(0.50, (0.50, 0.50, 0.00, 0.00), 2.00),
    "gallop": GaitPattern(0.30, (0.65, 0.55, 0.00, 0.10), 1.0 / 0.30),
}


# ---
# Named presets of the physics, which set its computational cost.
#
# The figures behind each preset, and the variants that were rejected, are in docs/benchmarks/physics.md.


@dataclasses.dataclass(frozen=True)
class PhysicsPreset:
    """The settings of a preset.

    Attributes:
        timestep: of the physics [s], unless one is given.
        trunk_contacts: whether chest, pelvis and head touch the ground. Without them a fall is reported equally soon,
            but the robot then sinks into the mat. While it walks they touch nothing, but MJX solves for the rows of all
            contacts in every step, and a third of the rows are theirs.
    """

    timestep: float
    trunk_contacts: bool


class ProfileChoice(str):
    """A choice that was not given: it is that of the profile and changes with the profile."""


class ProfileRate(float):
    """A control rate [Hz] that was not given: it is that of the profile and changes with the profile."""


class PresetTimestep(float):
    """A time step [s] that was not given: it is that of the preset and changes with the preset."""


PresetName = Literal["reference", "fast"]
#: `reference` is the model as it was identified. `fast` keeps speeds at the published frequencies within 1.5 % of it,
#: roll and duty within 2.3 %; slip and servo work change more.
PRESETS: Final[Mapping[str, PhysicsPreset]] = {
    "reference": PhysicsPreset(timestep=0.002, trunk_contacts=True),
    "fast": PhysicsPreset(timestep=0.01 / 3, trunk_contacts=False),
}


# ---
# The interface between controller and robot: sensor readings in, servo angles out.


#: Servos in the order of `ctrl`: the tail's exists only with the articulated tail, the last two only on Nermo 4.1
#: (`Robot.servos` names those of one robot).
SERVOS: Final = (
    *(f"{limb}_hip" for limb in LIMBS),
    *(f"{limb}_knee" for limb in LIMBS),
    "spine",
    "neck",
    "tail",
    "spine_vertical",
    "head",
)

#: The servos that a robot lacks, by its number of servos.
_MISSING_SERVOS: Final = {
    10: ("tail", "spine_vertical", "head"),
    11: ("spine_vertical", "head"),
    12: ("tail",),
}

#: Range of each servo [rad], by kind of servo. A knee's is limited to what its tendon can follow: the wrap stays
#: between 40 and 175 degrees.
SERVO_RANGE: Final = {
    "hip": (-1.6, 1.6),
    "front_knee": (-1.25, 1.25),
    "rear_knee": (-0.8, 1.55),
    "spine": (-0.6, 0.6),
    "neck": (-1.0, 1.0),
    "tail": (-1.0, 1.0),
    "spine_vertical": (-0.6, 0.6),
    "head": (-1.0, 1.0),
}


#: The same with routing type 1, whose servo angle includes the tendon's wrap angle, and with an idler, which turns it
#: by a quarter of the hip's angle.
KNEE_RANGE: Final = {
    "type1": {"front_knee": (1.3, 2.8), "rear_knee": (-2.6, -0.35)},
    "type3_idler": {"front_knee": (-1.1, 1.3), "rear_knee": (-0.8, 1.7)},
}


# ---
# The robot model `author`: Nermo-Lite as in the author's MuJoCo model (a-rohr/mouse_controller at 736e7ec). Its values
# of parameters are `control.parameters.author_body`; its other constants follow.


#: Replacements in the model `author`, for speed or for a smooth objective, which `simplifications` names: servos with
#: less gain, and damping; soles whose contact force begins at zero; and no additional iterations against slip, which
#: MJX does not have.
SIMPLIFICATIONS: Final = ("servos", "contact", "noslip")
#: Ranges of the author's servos [rad]; knees have the ranges above, which `servo.knee_range` extends.
AUTHOR_SERVO_RANGE: Final = {"front_hip": (-3.0, 3.0)} | dict.fromkeys(
    ("rear_hip", "spine", "neck", "tail"), (-1.57, 1.57)
)
#: Gains and torque limits of the author's servos as a share of `servo.kp` and `servo.torque_limit`; others have 1. The
#: share of the spine's torque limit is `servo.spine_torque`.
AUTHOR_GAIN_SHARES: Final = {"rear_hip": 2 / 3, "rear_knee": 2 / 3, "neck": 1 / 3}
AUTHOR_TORQUE_SHARES: Final = {"neck": 0.3925, "tail": 1.5}
#: Eyelets of the author's spine: in front of and behind each joint [m], and beside its axis [m].
AUTHOR_EYELETS: Final = ((0.0034, 0.0035), (0.0030, 0.0035), (0.0030, 0.0035), (0.0025, 0.0020))
AUTHOR_EYELET_OFFSET: Final = 0.0065
#: MuJoCo's default impedance of tendon limits, which all tendons of the author have, and the softness of the tail's
#: (`Build`). In the author's contact, the impedance at the first touch and its course.
AUTHOR_TENDON_SOLIMP: Final = (0.9, 0.95, 0.001, 0.5, 2.0)
AUTHOR_TAIL_SOFTNESS: Final = 21.0
AUTHOR_CONTACT_ONSET: Final = 0.9
AUTHOR_CONTACT_MIDPOINT: Final = 0.1
NOSLIP_ITERATIONS: Final = 5


def servo_kind(servo: str) -> str:
    """A servo without its side, as the tables of servos name it.

    >>> servo_kind("front_left_hip"), servo_kind("spine")
    ('front_hip', 'spine')
    """
    return servo.replace("left_", "").replace("right_", "")


def servos_by_count(count: int) -> tuple[str, ...]:
    """Names of the servos of a robot with this number of them, which is all that a recording knows.

    >>> servos_by_count(12)[8:]
    ('spine', 'neck', 'spine_vertical', 'head')
    """
    return tuple(servo for servo in SERVOS if servo not in _MISSING_SERVOS.get(count, ()))[:count]


def servo_range(
    servo: str, routing: str = "type3", robot: str = "nermo_lite"
) -> tuple[float, float]:
    """The range of one of `SERVOS` of a robot [rad]; commands outside it saturate."""
    kind = servo_kind(servo)
    ranges = SERVO_RANGE | KNEE_RANGE.get(routing, {})
    ranges |= AUTHOR_SERVO_RANGE if robot == "author" else {}
    return ranges[kind if kind in ranges else kind.split("_")[1]]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ServoAngles:
    """Commanded servo angles [rad], in the published servo convention.

    Attributes:
        hip: q1 of each limb, 0 straight down, positive swings the leg backward.
        knee: q2 of each limb, the angle of the pulley.
        spine: positive turns left.
        neck: positive looks left.
        tail: positive bends the tail's tip to the left.
        spine_vertical: of Nermo 4.1; positive lifts the hip, which extends the spine.
        head: of Nermo 4.1; positive tilts the nose down.
    """

    hip: PerLimb
    knee: PerLimb
    spine: Scalars
    neck: Scalars
    tail: Scalars
    spine_vertical: Scalars | float = 0.0
    head: Scalars | float = 0.0

    def vector(self, servos: Sequence[str]) -> Float[Array, "*batch n"]:
        """The `ctrl` vector of a robot with these servos, `Robot.servos`."""
        legs = 2 * len(LIMBS)
        single = [
            jnp.broadcast_to(jnp.asarray(getattr(self, name)), self.hip.shape[:-1])
            for name in servos[legs:]
        ]
        return jnp.concatenate([self.hip, self.knee, jnp.stack(single, axis=-1)], axis=-1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensors:
    """Readings of the robot's sensors, from before the physics' last substep.

    Attributes:
        position: IMU in the world [m].
        orientation: IMU quaternion (w, x, y, z); the identity is upright, heading -y.
        linear_velocity: of the IMU in the world [m/s].
        gyro: angular velocity in the IMU's frame [rad/s].
        accelerometer: in the IMU's frame [m/s^2].
        servo_angle, servo_velocity, servo_torque: in the order of `Robot.servos` [rad, rad/s, N m].
        knee_angle: theta_1 of each limb, 0 stretched [rad].
        foot_force: normal contact force of each foot [N].
        foot_position, foot_velocity: of each foot H in the world [m, m/s] (for metrics, not for the controller).
        joint_velocity: of the hinges of knees, ankles, spine and articulated tail [rad/s] (for metrics).
        tail_force: normal contact force of the tail on the ground [N].
        contact_distance: of the deepest contact, negative where bodies overlap [m] (for metrics).
    """

    position: Spatial
    orientation: Quaternion
    linear_velocity: Spatial
    gyro: Spatial
    accelerometer: Spatial
    servo_angle: Float[Array, "*batch n"]
    servo_velocity: Float[Array, "*batch n"]
    servo_torque: Float[Array, "*batch n"]
    knee_angle: PerLimb
    foot_force: PerLimb
    foot_position: Float[Array, "*batch 4 3"]
    foot_velocity: Float[Array, "*batch 4 3"]
    joint_velocity: Float[Array, "*batch n_compliant"]
    tail_force: Scalars
    contact_distance: Scalars


@dataclasses.dataclass(frozen=True)
class Reading:
    """What a robot's sensors give under one name: the names of its numbers, their SI unit, and what they are."""

    names: tuple[str, ...]
    unit: str
    doc: str


def _axes(*names: str, axes: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for name in names for axis in axes)


def _feet(name: str) -> tuple[str, ...]:
    return tuple(f"{limb}_{name}" for limb in LIMBS)


#: Points of the ground that a policy or a critic sees, left of and ahead of the torso [m].
SCAN_POINTS: Final = tuple(
    (side, ahead) for ahead in (-0.1, 0.0, 0.1, 0.2) for side in (0.04, 0.0, -0.04)
)
#: Every reading by its one name, in the model, recordings, saved signals, observations, metrics and messages. A log
#: says apart what a channel is of, and has the last word: its `angle` of the servo `spine` is `spine_servo_angle`.
READINGS: Final[dict[str, Reading]] = {
    "servo_command": Reading((), "rad", "angle that the servo aims at"),
    "position": Reading(_axes("position"), "m", "place of the IMU in the world"),
    "orientation": Reading(_axes("orientation", axes="wxyz"), "1", "quaternion of the IMU"),
    "linear_velocity": Reading(_axes("linear_velocity"), "m/s", "of the IMU in the world"),
    "gyro": Reading(_axes("gyro"), "rad/s", "angular velocity in the IMU's frame"),
    "accelerometer": Reading(_axes("accelerometer"), "m/s^2", "in the IMU's frame"),
    "servo_angle": Reading((), "rad", "angle of the servo"),
    "servo_velocity": Reading((), "rad/s", "velocity of the servo"),
    "servo_torque": Reading((), "N m", "torque of the servo"),
    "knee_angle": Reading(_feet("knee_angle"), "rad", "angle of the knee, 0 stretched"),
    "foot_force": Reading(_feet("foot_force"), "N", "normal contact force of the foot"),
    "foot_position": Reading(_axes(*_feet("foot_position")), "m", "of the foot in the world"),
    "foot_velocity": Reading(_axes(*_feet("foot_velocity")), "m/s", "of the foot in the world"),
    "tail_force": Reading(("tail_force",), "N", "normal contact force of the tail"),
    "contact_distance": Reading(
        ("contact_distance",), "m", "of the deepest contact, negative where bodies overlap"
    ),
    "attitude": Reading(
        ("roll", "pitch", "yaw"), "rad", "of the torso; positive leans left, noses down, turns left"
    ),
    "speed": Reading(("speed",), "m/s", "horizontal speed of the IMU"),
    "foot_contact": Reading(_feet("foot_contact"), "1", "whether a foot bears load"),
    "motor_current": Reading((), "A", "current in the servo's motor, by its torque"),
    "projected_gravity": Reading(
        _axes("projected_gravity"), "1", "direction of gravity in the IMU's frame"
    ),
    "height_scan": Reading(
        tuple(f"height_scan_{1e3 * ahead:g}_{1e3 * side:g}" for side, ahead in SCAN_POINTS),
        "m",
        "height of the ground, so many mm ahead and to the left of the torso, over that beneath it, at most 50 mm",
    ),
}


def reading_names(name: str, servos: tuple[str, ...] = SERVOS) -> tuple[str, ...]:
    """The names of a reading's numbers, of a robot with these servos.

    >>> reading_names("gyro"), reading_names("servo_angle")[8]
    (('gyro_x', 'gyro_y', 'gyro_z'), 'spine_servo_angle')
    """
    return READINGS[name].names or tuple(f"{servo}_{name}" for servo in servos)
