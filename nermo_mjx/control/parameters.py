"""The controller's parameters: arrays that sweeps vary and gradients tune. `ControllerState` holds what changes over
time."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from nermo_mjx.control.free_parameters import FootPaths, Limb, Trim
from nermo_mjx.control.head import Head
from nermo_mjx.control.tail import Tail
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import FRONT_LEG, LIMBS, REAR_LEG
from nermo_mjx.robot.quantity import flat, group, parameter_tree, quantity

#: Harmonics of the spine's Fourier series.
HARMONICS = 6


@parameter_tree
class Gait:
    """Timing of the feet's contact, and length of their steps (5.21, 5.22, Tables A.2, A.6)."""

    frequency: Any = quantity(0.67, "Hz", 0.0, 5.0, "gait cycles per second", open_low=True)
    stride: Any = quantity(1.0, "1", 0.0, 1.2, "stride length, as a share of the maximum")
    duty: Any = quantity(0.5, "1", 0.0, 1.0, "stance share of the gait cycle", open_low=True, open_high=True)
    gait_factor: Any = quantity(
        2.0, "1", 0.5, 100.0, "strides of body travel per cycle (5.21); 1 / duty where not given"
    )
    speed: Any = quantity(1.0, "m/s", 0.0, 10.0, "commanded speed on the controller's clock; the stride saturates")
    offset: Any = quantity(
        (0.5, 0.0, 0.0, 0.5), "1", 0.0, 1.0, "cycle share at which the limb's stance starts", labels=LIMBS
    )


@parameter_tree
class Stance:
    """Neutral positions and lift of the feet, in the leg's frame (Table A.7)."""

    front_y: Any = quantity(FRONT_LEG.neutral_foot[0], "m", -0.03, 0.03, "neutral foot behind the shoulder axis")
    front_z: Any = quantity(FRONT_LEG.neutral_foot[1], "m", -0.062, -0.025, "neutral front foot height")
    rear_y: Any = quantity(REAR_LEG.neutral_foot[0], "m", -0.03, 0.03, "neutral foot behind the hip axis")
    rear_z: Any = quantity(REAR_LEG.neutral_foot[1], "m", -0.072, -0.030, "neutral rear foot height")
    swing_amplitude: Any = quantity(0.010, "m", 0.0, 0.03, "foot lift at mid-swing")
    stance_amplitude: Any = quantity(0.005, "m", 0.0, 0.02, "foot push-down at mid-stance")
    max_stride: Any = quantity(0.060, "m", 0.0, 0.08, "stride length at stride = 1")


@parameter_tree
class Spine:
    """The spine's motion in addition to steering (5.31-5.35, 5.45, 5.46)."""

    amplitude: Any = quantity(0.4, "rad", 0.0, 0.6, "servo amplitude of the stride extension")
    phase: Any = quantity(
        0.0, "rad", -2 * np.pi, 2 * np.pi, "psi of q_sp = A cos(2 pi phase + psi), the stride extension"
    )
    max_servo_angle: Any = quantity(0.4, "rad", 0.01, 0.6, "q_max, servo limit of the fusion (5.45)")
    fusion_exponent: Any = quantity(1.0, "1", 0.1, 10.0, "s, how turning fades the other mode (5.46)")
    offset_compensation: Any = quantity(0.0, "1", 0.0, 1.0, "share of the hip's rise taken by the rear legs (5.31)")
    offset_at_feet: Any = quantity(
        0.0, "1", 0.0, 1.0, "what rises: 0 the hips, as in (5.31), 1 the rear feet, as in the author's code"
    )
    balance_lift: Any = quantity(0.009, "m", 0.0, 0.03, "d_lift, wanted distance of the COM inside the triangle")
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
    pitch_gain: Any = quantity(2.0, "1", -10.0, 10.0, "vertical servo's angle per pitch, spine mode 'pitch_balance'")
    pitch_damping: Any = quantity(
        0.0, "s", -1.0, 1.0, "vertical servo's angle per pitch rate, spine mode 'pitch_balance'"
    )
    harmonics: Any = quantity(
        (0.0,) * 2 * HARMONICS,
        "rad",
        -0.6,
        0.6,
        "servo amplitude of cos or sin(k 2 pi phase), spine mode 'harmonics'",
        labels=tuple(f"{part}{order}" for order in range(1, HARMONICS + 1) for part in ("cos", "sin")),
    )


@parameter_tree
class Turning:
    """How a turn rate is shared between legs and spine (5.38, 5.39). lb = (1, 0), sb = (0, 1), mb = (1, 1)."""

    exponent: Any = quantity(5.0, "1", 0.0, 20.0, "t of c(a) = sign(a)|a|^t; 0 turns leg modulation off")
    leg: Any = quantity(1.0, "1", 0.0, 1.0, "share of the turn rate given to the legs")
    spine: Any = quantity(0.0, "1", 0.0, 1.0, "share of the turn rate given to the spine")


@parameter_tree
class Pilot:
    """The high-level controller: guidance by curvature, the published PD, and the path to follow."""

    guidance: Any = quantity(1.0, "1", 0.0, 1.0, "share of the turn rate for the curvature that leads back to the path")
    look_ahead: Any = quantity(
        0.9,
        "m",
        0.02,
        10.0,
        "way on which the guidance takes back most of a cross-track error, on a line; shorter on a bend",
    )
    damping: Any = quantity(1.0, "1", 0.0, 10.0, "damping ratio of the way back to the path")
    bandwidth: Any = quantity(1.6, "rad", 0.0, 5.0, "bandwidth of the guidance's observer, per gait cycle")
    grip: Any = quantity(0.525, "1", 0.1, 2.0, "turn that the guidance expects of the robot, over that without slip")
    error_gain: Any = quantity(0.0, "1/m", 0.0, 1000.0, "PD: turn rate per metre of cross-track error")
    change_gain: Any = quantity(
        0.0, "1/m", 0.0, 10000.0, "PD: turn rate per metre of its change per 1/100 s of the controller's clock"
    )
    output_limit: Any = quantity(1.0, "1", 0.0, 1.0, "largest turn rate")
    turn_rate: Any = quantity(0.0, "1", -1.0, 1.0, "turn rate held by the pilot 'open_loop'")
    radius: Any = quantity(1.0, "m", 0.05, 1000.0, "radius of the pilot 'arc'")
    direction: Any = quantity(1.0, "1", -1.0, 1.0, "side of the pilot 'arc': +1 left, -1 right")


@parameter_tree
class Tracking:
    """How the published controller differs from the exact one."""

    foot_gain: Any = quantity(
        1.0,
        "1",
        0.0,
        1.0,
        "share of the foot error closed per 1/100 s of the controller's clock; 1 is exact",
        open_low=True,
    )
    clock_ratio: Any = quantity(1.0, "1", 0.05, 2.0, "simulated seconds per second of the controller's clock")


@parameter_tree
class ControlParameters:
    """All parameters of the controller; every leaf may carry leading batch axes.

    Its kinematics uses `geometry`, which has the same names as the body's: a named value sets both. None means the
    published one, as constants.
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
    """A controller's parameters with a `geometry`, so that its values can be named; also if they are nested in
    another's."""
    if isinstance(params, ControlParameters):
        return dataclasses.replace(params, geometry=params.geometry or Geometry())
    if not dataclasses.is_dataclass(params) or isinstance(params, type):
        return params
    own = {field.name: getattr(params, field.name) for field in dataclasses.fields(params)}
    changed = {name: new for name, value in own.items() if (new := with_geometry(value)) is not value}
    return dataclasses.replace(params, **changed) if changed else params
