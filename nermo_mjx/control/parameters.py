"""The parameters of the controller: arrays that sweeps vary and gradients tune.

Each class is a group of parameters, and each parameter is declared once by `quantity(default, unit, low, high, meaning)`.
The end of the file contains the published gaits, profiles and turning strategies as values of these parameters. The
comments call the author of the thesis and of github.com/a-rohr/mouse_controller "the author".
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Final, Literal, get_args

import numpy as np

from nermo_mjx.control.head_and_tail import Head, Tail
from nermo_mjx.robot.assembly import RobotConfig
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import (
    FRONT_LEG,
    GAIT_CODES,
    GAIT_PATTERNS,
    LIMBS,
    REAR_LEG,
    ProfileChoice,
    ProfileRate,
)
from nermo_mjx.robot.quantity import choice, flat, group, of_type, parameter_tree, quantity

# ---
# Parameters of the trajectory 'free' (`control.stepping.FreeStepping`): differences between limbs, displacements of the
# foot paths, and offsets of servo angles (trim).
#
# All of them are offsets or factors relative to the published gait. With the default values, the gait is the published
# one.


#: Labels of the values of one parameter: two pairs of limbs, then four limbs. A limb has the sum of the value of its pair
#: and of its own value (for `stride`, the product).
PAIRS_AND_LIMBS = ("front", "rear", *LIMBS)
#: Number of points of a foot path: touch-down, three in stance, lift-off, three in swing.
FOOT_POINTS = 8


def _of_limbs(default: float, unit: str, low: float, high: float, doc: str) -> Any:
    """A parameter with a value for each pair of limbs and for each limb."""
    return quantity((default,) * len(PAIRS_AND_LIMBS), unit, low, high, doc, labels=PAIRS_AND_LIMBS)


@parameter_tree
class Limb:
    """Differences between limbs, for the trajectory 'free'; see `PAIRS_AND_LIMBS`."""

    stride: Any = _of_limbs(1.0, "1", 0.0, 2.0, "the limb's stride, as a share of that of the gait")
    lift: Any = _of_limbs(0.0, "m", -0.02, 0.02, "higher mid-swing than stance.swing_amplitude")
    duty: Any = _of_limbs(0.0, "1", -0.4, 0.4, "longer stance than duty, as a share of the cycle")
    phase: Any = _of_limbs(0.0, "1", -0.5, 0.5, "later stance than offset, as a share of the cycle")


def _foot_path() -> Any:
    """A parameter with the displacements of all points of a foot path, y1 to y8 and z1 to z8."""
    return quantity(
        (0.0,) * 2 * FOOT_POINTS,
        "m",
        -0.02,
        0.02,
        "y backward or z up, 1 touch-down, 2-4 stance, 5 lift-off, 6-8 swing",
        labels=tuple(f"{axis}{point}" for axis in "yz" for point in range(1, FOOT_POINTS + 1)),
    )


@parameter_tree
class FootPaths:
    """Displacements of eight points of a foot path, for the trajectory 'free'.

    A limb has the sum of the displacements of its pair and of its own displacements.
    """

    front: Any = _foot_path()
    rear: Any = _foot_path()
    front_left: Any = _foot_path()
    front_right: Any = _foot_path()
    rear_left: Any = _foot_path()
    rear_right: Any = _foot_path()


@parameter_tree
class Trim:
    """Offsets of servo angles, for the trajectory 'free'.

    A limb has the sum of the offset of its pair and of its own offset.
    """

    spine: Any = quantity(0.0, "rad", -0.4, 0.4, "added to the spine servo, positive left")
    hip: Any = _of_limbs(0.0, "rad", -0.5, 0.5, "added to the hip servo, positive backward")
    knee: Any = _of_limbs(0.0, "rad", -0.5, 0.5, "added to the knee servo")


#: Number of harmonics of the Fourier series of the spine.
SPINE_HARMONICS = 6


@parameter_tree
class Gait:
    """Timing of the feet's contact, and length of their steps (5.21, 5.22, Tables A.2, A.6)."""

    frequency: Any = quantity(0.67, "Hz", 1e-3, 5.0, "gait cycles per second")
    stride: Any = quantity(
        1.0,
        "1",
        0.0,
        1.2,
        "excursion of the feet relative to the body, as a share of stance.max_stride",
    )
    duty: Any = quantity(0.5, "1", 0.01, 1.0, "stance share of the gait cycle", open_high=True)
    gait_factor: Any = quantity(
        2.0, "1", 0.5, 100.0, "strides of body travel per cycle (5.21); 1 / duty where not given"
    )
    commanded_speed: Any = quantity(
        1.0, "m/s", 0.0, 10.0, "commanded speed on the controller's clock; the stride saturates"
    )
    offset: Any = quantity(
        (0.5, 0.0, 0.0, 0.5),
        "1",
        0.0,
        1.0,
        "cycle share at which the limb's stance starts",
        labels=LIMBS,
    )


@parameter_tree
class Stance:
    """Neutral positions and lift of the feet, in the leg's frame (Table A.7)."""

    front_y: Any = quantity(
        FRONT_LEG.neutral_foot[0], "m", -0.03, 0.03, "neutral foot behind the shoulder axis"
    )
    front_z: Any = quantity(
        FRONT_LEG.neutral_foot[1], "m", -0.062, -0.025, "neutral front foot height"
    )
    rear_y: Any = quantity(
        REAR_LEG.neutral_foot[0], "m", -0.03, 0.03, "neutral foot behind the hip axis"
    )
    rear_z: Any = quantity(
        REAR_LEG.neutral_foot[1], "m", -0.072, -0.030, "neutral rear foot height"
    )
    swing_amplitude: Any = quantity(0.010, "m", 0.0, 0.03, "foot lift at mid-swing")
    stance_amplitude: Any = quantity(0.005, "m", 0.0, 0.02, "foot push-down at mid-stance")
    max_stride: Any = quantity(0.060, "m", 0.0, 0.08, "excursion of the feet at stride = 1")


@parameter_tree
class Spine:
    """Motion of the spine in addition to steering (5.31-5.35, 5.45, 5.46)."""

    amplitude: Any = quantity(0.4, "rad", 0.0, 0.6, "servo amplitude of the stride extension")
    phase: Any = quantity(
        0.0,
        "rad",
        -2 * np.pi,
        2 * np.pi,
        "psi of q_sp = A cos(2 pi phase + psi), the stride extension",
    )
    max_servo_angle: Any = quantity(
        0.4, "rad", 0.01, 0.6, "q_max, servo limit of the fusion (5.45)"
    )
    fusion_exponent: Any = quantity(
        1.0, "1", 0.1, 10.0, "s, how turning fades the other mode (5.46)"
    )
    offset_compensation: Any = quantity(
        0.0, "1", 0.0, 1.0, "share of the hip's rise taken by the rear legs (5.31)"
    )
    offset_at_feet: Any = quantity(
        0.0,
        "1",
        0.0,
        1.0,
        "what rises: 0 the hips, as in (5.31), 1 the rear feet, as in the author's code",
    )
    balance_share: Any = quantity(1.0, "1", 0.0, 1.0, "share of the angle of the mode 'balance'")
    balance_lift: Any = quantity(
        0.009, "m", 0.0, 0.03, "d_lift, wanted distance of the COM inside the triangle"
    )
    sagittal_amplitude: Any = quantity(
        0.3, "rad", 0.0, 0.6, "vertical servo's amplitude, spine mode 'sagittal_extension'"
    )
    sagittal_phase: Any = quantity(
        0.785,
        "rad",
        -2 * np.pi,
        2 * np.pi,
        "psi of -A cos(2 pi phase + psi), vertical servo; at 0 it is most flexed as the cycle begins",
    )
    pitch_gain: Any = quantity(
        2.0, "1", -10.0, 10.0, "vertical servo's angle per pitch, spine mode 'pitch_balance'"
    )
    pitch_damping: Any = quantity(
        0.0, "s", -1.0, 1.0, "vertical servo's angle per pitch rate, spine mode 'pitch_balance'"
    )
    harmonics: Any = quantity(
        (0.0,) * 2 * SPINE_HARMONICS,
        "rad",
        -0.6,
        0.6,
        "servo amplitude of cos or sin(k 2 pi phase), spine mode 'harmonics'",
        labels=tuple(
            f"{part}{order}" for order in range(1, SPINE_HARMONICS + 1) for part in ("cos", "sin")
        ),
    )


@parameter_tree
class Turning:
    """Distribution of the turn rate to legs and spine (5.38, 5.39).

    The published strategies have the weights (leg, spine): lb (1, 0) turns by the legs, sb (0, 1) by the spine, and mb
    (1, 1) by both.
    """

    exponent: Any = quantity(
        5.0, "1", 0.0, 20.0, "t of c(a) = sign(a)|a|^t; 0 turns leg modulation off"
    )
    leg: Any = quantity(1.0, "1", 0.0, 1.0, "share of the turn rate given to the legs")
    spine: Any = quantity(0.0, "1", 0.0, 1.0, "share of the turn rate given to the spine")


@parameter_tree
class Pilot:
    """The pilot: guidance by curvature, the published PD controller, and the path to follow."""

    guidance: Any = quantity(
        1.0, "1", 0.0, 1.0, "share of the turn rate for the curvature that leads back to the path"
    )
    look_ahead: Any = quantity(
        0.9,
        "m",
        0.02,
        10.0,
        "way on which the guidance takes back most of a cross-track error, on a line; shorter on a bend",
    )
    damping: Any = quantity(1.0, "1", 0.0, 10.0, "damping ratio of the way back to the path")
    bandwidth: Any = quantity(
        1.6, "rad", 0.0, 5.0, "bandwidth of the guidance's observer, per gait cycle"
    )
    grip: Any = quantity(
        0.525, "1", 0.1, 2.0, "turn that the guidance expects of the robot, over that without slip"
    )
    error_gain: Any = quantity(
        0.0, "1/m", 0.0, 1000.0, "PD: turn rate per metre of cross-track error"
    )
    change_gain: Any = quantity(
        0.0,
        "1/m",
        0.0,
        10000.0,
        "PD: turn rate per metre of its change per 1/100 s of the controller's clock",
    )
    output_limit: Any = quantity(1.0, "1", 0.0, 1.0, "largest turn rate")
    turn_rate: Any = quantity(0.0, "1", -1.0, 1.0, "turn rate held by the pilot 'open_loop'")
    radius: Any = quantity(1.0, "m", 0.05, 1000.0, "radius of the pilot 'arc'")
    direction: Any = quantity(1.0, "1", -1.0, 1.0, "side of the pilot 'arc': +1 left, -1 right")


@parameter_tree
class Tracking:
    """Imperfections of the published controller: lag of the feet and rate of its clock; the defaults have none."""

    foot_gain: Any = quantity(
        1.0,
        "1",
        0.0,
        1.0,
        "share of the foot error closed per 1/100 s of the controller's clock; 1 is exact",
        open_low=True,
    )
    clock_ratio: Any = quantity(
        1.0, "1", 0.05, 2.0, "simulated seconds per second of the controller's clock"
    )


@parameter_tree
class ControlParameters:
    """All parameters of the controller; every leaf may have leading batch axes.

    The kinematics of the controller uses `geometry`. Its parameters have the same names as those of the robot's model, so
    that one value sets both. None means the published geometry, as constants.
    """

    gait: Gait = flat(Gait)
    stance: Stance = group(Stance)
    spine: Spine = group(Spine)
    limb: Limb = group(Limb)
    foot: FootPaths = group(FootPaths)
    trim: Trim = group(Trim)
    turning: Turning = group(Turning)
    pilot: Pilot = group(Pilot)
    head: Head = group(Head)
    tail: Tail = group(Tail)
    tracking: Tracking = group(Tracking)
    geometry: Geometry | None = None


def with_geometry(params: Any) -> Any:
    """The parameters of a controller with a `geometry`, so that its values can be named.

    `ControlParameters` that are nested in the parameters of another controller get a `geometry`, too.
    """
    if isinstance(params, ControlParameters):
        return dataclasses.replace(params, geometry=params.geometry or Geometry())
    if not dataclasses.is_dataclass(params) or isinstance(params, type):
        return params
    values = {field.name: getattr(params, field.name) for field in dataclasses.fields(params)}
    changed = {
        name: new for name, value in values.items() if (new := with_geometry(value)) is not value
    }
    return dataclasses.replace(params, **changed) if changed else params


# ---
# The published gaits, turning strategies and controller, as named values of the parameters.


#: Rate on the controller's clock to which `tracking.foot_gain` and `pilot.change_gain` refer [Hz]. Both loops of the
#: author's code had this rate during the tests (1 July to 12 August 2021; later 50, 80 and 50 Hz).
PUBLISHED_RATE_HZ: Final = 100.0
#: Share of the foot error that the author's velocity-space kinematics closes per tick (0.11 since c66c3df, 2 August 2021).
PUBLISHED_TRACKING_SHARE: Final = 0.11
#: Simulated seconds per second of the author's controller, which runs on the wall clock: steps of 2 ms at 200 Hz. This
#: value is inferred from the author's code and is not published; three published values were used in this inference
#: (docs/experiments.md).
PUBLISHED_CLOCK_RATIO = 0.4


def tracking_share(rate: float, closed: float = PUBLISHED_TRACKING_SHARE) -> float:
    """`tracking.foot_gain` of the author's foot tracking: share of the foot error closed per 1/100 s.

    The author's code uses the foot of two ticks before, f(k) = f(k-1) + g (target - f(k-2)), and therefore lags less than
    f(k) = f(k-1) + g (target - f(k-1)). The slow root of this recursion is (1 + sqrt(1 - 4 g)) / 2: it closes 12.6 % of
    the error per tick for g = 0.11. The fast root is 0.126, so that its share of the error vanishes within a few ticks.

    >>> round(tracking_share(100.0), 4)
    0.1258

    Args:
        rate: Rate of the author's loop [Hz].
        closed: Gain g, in [0, 1/4].
    """
    remainder = 0.5 * (1.0 + math.sqrt(1.0 - 4.0 * closed))
    return 1.0 - remainder ** (rate / PUBLISHED_RATE_HZ)


#: Controller of the published simulation: the values in the author's repository (a-rohr/mouse_controller) at the time of
#: the tests, at every commit from c66c3df (2 August 2021, the maze) over 0a07c54 (3 August, the turns) and 583a152
#: (5 August) to 736e7ec (8 August). The scenes and gains that these commits add suggest that the tests ran with them; the
#: thesis contains no dates.
#: The neutral feet had these positions from 19 July (5a98d92) to 2 September (03fdad3). The positions of Table A.7, which
#: are the defaults of `Stance`, are in the repository from 26 September (a99147f; erratum 23). The author's pilot, a PD
#: controller from the cross-track error to the turn rate, turns the spine in every mode. The gains are those of c66c3df;
#: with 30 and 300 (583a152) or 40 and 300 (736e7ec) the pilot oscillates.
PUBLISHED_PROFILE: Final = {
    "stance.front_y": -0.005,
    "stance.front_z": -0.038,
    "stance.rear_y": 0.010,
    "stance.rear_z": -0.042,
    "tracking.foot_gain": tracking_share(PUBLISHED_RATE_HZ),
    "tracking.clock_ratio": PUBLISHED_CLOCK_RATIO,
    "spine.offset_at_feet": 1.0,
    "pilot.error_gain": 25.0,
    "pilot.change_gain": 200.0,
    "pilot.guidance": 0.0,
}
#: The author's model of the same days (in MuJoCo 3.17), whose physics no later commit of that year changes: gains and
#: torque limits of the servos, damping, the masses in front and behind as compiled, the contact of the soles, and
#: MuJoCo's default friction of the tail. Constants that are no parameters are `robot.parameters.AUTHOR_...`.
#: The feet of that model are not where the author's kinematics has them (erratum 25), and that controller does
#: not know it. Tendons are limited to 62.000 mm in front, 60.000 behind and 74.050 in the spine, where path and l_t0 are 61.275,
#: 60.275 and 74.003. These limits have MuJoCo's default softness, which is relative to a tendon's inertia in the model's
#: zero pose. That pose differs from the one here: a softness is 25, the square of the ratio of the time constants,
#: times the ratio of these inverse inertias, 0.040 in front, 0.723 behind and 1.002 in the spine. The rear legs are
#: mounted 10 degrees up on a hip that is pitched by 14.9 degrees down, with axes 0.45 mm further forward and 0.55 mm
#: lower than in Table A.5.
AUTHOR_BODY: Final = {
    "servo.kp": 300.0,
    "servo.kv": 0.0,
    "servo.torque_limit": 0.4,
    "servo.spine_torque": 0.3925,
    "servo.speed": 1000.0,
    "servo.knee_range": 0.55,
    "damping.knee": 0.005,
    "damping.ankle": 0.005,
    "damping.spine": 0.01,
    "mass.front": 0.2122,
    "mass.rear": 0.1257,
    "contact.tail_friction": 1.0,
    "contact.time_constant": 0.008,
    "contact.damping_ratio": 2.0,
    "contact.impedance": 0.95,
    "contact.width": 0.001,
    "build.front_slack": 0.000725,
    "build.rear_slack": -0.000275,
    "build.spine_slack": 0.000047,
    "build.front_softness": 1.0,
    "build.rear_softness": 18.07,
    "build.spine_softness": 25.05,
    "build.tendon_impedance": 0.9,
    "build.rear_tilt": math.radians(-4.9),
    "geometry.hip.y": 0.00825,
    "geometry.hip.z": -0.01045,
    "geometry.foot.radius": 0.002,
}
#: Values with which a simplification replaces those of the author's model.
SIMPLIFIED_VALUES: Final = {
    "servos": {"servo.kp": 60.0, "servo.kv": 0.05, "servo.speed": 100.0},
    "contact": {"contact.width": 0.0005},
}


def author_body(simplifications: str = RobotConfig.simplifications) -> dict[str, float]:
    """Named parameter values of the robot model `author`, with some of `SIMPLIFICATIONS`.

    >>> author_body()["servo.kp"], author_body("servos+contact")["servo.kp"]
    (300.0, 60.0)

    Args:
        simplifications: names joined by +, as in `RobotConfig`.
    """
    values = dict(AUTHOR_BODY)
    for name in simplifications.split("+"):
        values |= SIMPLIFIED_VALUES.get(name, {})
    return values


#: The body of the profile `as_published`.
PUBLISHED_BODY: Final = author_body()
#: Former name, in scripts.
AS_PUBLISHED_BODY: Final = PUBLISHED_BODY
SteeringName = Literal["leg", "spine", "mix"]
#: Weights (leg, spine) of the three published turning strategies.
STEERING: dict[str, tuple[float, float]] = {
    "leg": (1.0, 0.0),
    "spine": (0.0, 1.0),
    "mix": (1.0, 1.0),
}


def steering_of(profile: str) -> ProfileChoice:
    """The default turning strategy of a profile: the author's code turns by the spine.

    >>> steering_of("exact"), steering_of("as_published")
    ('leg', 'spine')
    """
    return ProfileChoice("spine" if profile == "as_published" else "leg")


def robot_choices(profile: str) -> dict[str, ProfileChoice]:
    """Default choices of a `RobotConfig` in a profile.

    >>> robot_choices("as_published")
    {'robot': 'author', 'tail': 'articulated', 'feet': 'capsules'}
    """
    choices = ("nermo_lite", "rigid", "spheres")
    if profile == "as_published":
        choices = ("author", "articulated", "capsules")
    return dict(zip(("robot", "tail", "feet"), map(ProfileChoice, choices), strict=True))


def control_rate_of(profile: str) -> ProfileRate:
    """Rate of the controller in a profile, unless one is given, in simulated time [Hz].

    The author's 100 Hz are those of a clock that runs 2.5 times as fast.

    >>> control_rate_of("exact"), control_rate_of("as_published")
    (100.0, 250.0)
    """
    return ProfileRate(
        PUBLISHED_RATE_HZ / (PUBLISHED_CLOCK_RATIO if profile == "as_published" else 1.0)
    )


#: Ratio of the measured curvature to the expected curvature (`turning.path_curvature`), for each turning strategy. The
#: robot walked without a path at constant turn rates with expected radii of 0.5 and 1 m; the ratio is a mean over three
#: gaits, three frequencies and strides of 0.8 and 1.0 (docs/experiments.md contains its spread).
GRIP: dict[str, float] = {"leg": 0.525, "spine": 1.13, "mix": 1.04}
#: Controller of the built robot, according to the values measured on the hardware (docs/experiments.md lists the fitted
#: and the chosen ones). The stride is that of the straight line (Table 6.1), and the foot tracking is the author's in real
#: time, at 80 Hz as in the author's loop since 27 August 2021 (192674c).
BUILT_PROFILE = {
    "tracking.foot_gain": tracking_share(80.0),
    "spine.max_servo_angle": 0.3,
    "stride": 0.8,
}
BUILT_BODY = {"build.spine_slack": 0.0006, "build.asymmetry": 0.1, "stiffness.spine": 0.9}
ProfileName = Literal["exact", "as_published", "as_built"]
PROFILES: tuple[str, ...] = get_args(ProfileName)


def published_values(
    gait: str, *, steering: str | None = None, profile: str = "exact"
) -> dict[str, float]:
    """Named parameter values of a published gait, turning strategy and profile (one of `PROFILES`).

    >>> published_values("walking_trot") == published_values("trt1")
    True

    The names are those of `quantities(ControlParameters)`, for `replace_quantities`. `body_values` returns the values of
    the body. The default turning strategy is `steering_of(profile)`.

    Raises:
        ParameterError: The gait, the steering or the profile is unknown.
    """
    pattern = GAIT_PATTERNS[
        choice("gait", GAIT_CODES.get(of_type("gait", gait, str, "a name"), gait), GAIT_PATTERNS)
    ]
    choice("profile", profile, PROFILES)
    steering = steering_of(profile) if steering is None else choice("steering", steering, STEERING)
    leg, spine = STEERING[steering]
    values = {"duty": pattern.duty, "gait_factor": pattern.gait_factor}
    values |= {"turning.leg": leg, "turning.spine": spine, "pilot.grip": GRIP[steering]}
    values |= {
        f"offset.{limb}": offset for limb, offset in zip(LIMBS, pattern.offsets, strict=True)
    }
    return (
        values
        | {"exact": {}, "as_published": PUBLISHED_PROFILE, "as_built": BUILT_PROFILE}[profile]
    )


def body_values(profile: str) -> dict[str, float]:
    """Named parameter values of the body in a profile; empty for `exact`.

    >>> body_values("exact"), body_values("as_published")["servo.kp"]
    ({}, 300.0)
    """
    return dict({"exact": {}, "as_published": PUBLISHED_BODY, "as_built": BUILT_BODY}[profile])


def with_gait_factor(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values, with the gait factor 1 / duty (A.2) if they contain a duty factor but no gait factor.

    A foot is in stance for the share `duty` of a cycle. In this time the body moves by one stride, so that it moves by
    1 / duty strides per cycle (erratum 20).
    """
    duty = values.get("duty", 0.0)
    zero = isinstance(duty, int | float | np.ndarray) and not np.all(
        duty
    )  # it has none, and is refused elsewhere
    return (
        dict(values) if zero or "gait_factor" in values else {**values, "gait_factor": 1.0 / duty}
    )
