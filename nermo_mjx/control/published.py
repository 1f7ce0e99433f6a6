"""The published gaits, turning strategies and controller, as named values of the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.parameters import GAIT_PATTERNS, LIMBS

#: Control rate of the published foot tracking lag [Hz], and the share of the foot error that it closed per tick.
PUBLISHED_TRACKING = {"rate": 80.0, "gain": 0.11}
PUBLISHED_CLOCK_RATIO = 0.4
#: The published pilot is a PD from the cross-track error to the turn rate, and limit-cycles: it aims at a point 12 mm
#: ahead at 0.08 m/s, a tenth of the trunk, reacts to the torso's sway, and ignores that a turn rate of 0.4 changes the
#: legs' strides by only 1 %. The profile `exact` is guided by curvature instead (`guidance`).
PUBLISHED_PILOT = {"pilot.error_gain": 40.0, "pilot.change_gain": 300.0, "pilot.guidance": 0.0}
#: Weights (leg, spine) of the three published turning strategies.
STEERING: dict[str, tuple[float, float]] = {"leg": (1.0, 0.0), "spine": (0.0, 1.0), "mix": (1.0, 1.0)}
#: Measured over expected curvature (`turning.path_curvature`), by type of steering. Measured without a path, at
#: constant turn rates with expected radii of 0.5 and 1 m: mean over three gaits, three frequencies and strides
#: of 0.8 and 1.0 (docs/experiments.md has the spread).
GRIP: dict[str, float] = {"leg": 0.525, "spine": 1.13, "mix": 1.04}
#: The robot as it was built, by the hardware's figures (docs/experiments.md has what was fitted and what chosen), with
#: the author's foot tracking in real time.
AS_BUILT = {"tracking.foot_gain": PUBLISHED_TRACKING["gain"], "spine.max_servo_angle": 0.3}
AS_BUILT_BODY = {"build.spine_slack": 0.0006, "build.asymmetry": 0.1, "stiffness.spine": 0.9}
PROFILES: tuple[str, ...] = ("exact", "as_published", "as_built")
#: Profiles of the published simulation, which experiments show side by side.
SIMULATED: tuple[str, ...] = PROFILES[:2]


def published_values(gait: str, *, steering: str = "leg", profile: str = "exact") -> dict[str, float]:
    """Named parameter values of a published gait, turning strategy and profile (one of `PROFILES`).

    The values are keyed as `quantities(ControlParameters)` names them, for `replace_quantities`. Those of the body are
    in `body_values`.

    Raises:
        ParameterError: an unknown gait, steering or profile.
    """
    pattern = GAIT_PATTERNS[choice("gait", gait, GAIT_PATTERNS)]
    leg, spine = STEERING[choice("steering", steering, STEERING)]
    choice("profile", profile, PROFILES)
    values = {"duty": pattern.duty, "gait_factor": pattern.gait_factor}
    values |= {"turning.leg": leg, "turning.spine": spine, "pilot.grip": GRIP[steering]}
    values |= {f"offset.{limb}": offset for limb, offset in zip(LIMBS, pattern.offsets, strict=True)}
    if profile == "as_published":
        values |= {"tracking.foot_gain": PUBLISHED_TRACKING["gain"], "tracking.clock_ratio": PUBLISHED_CLOCK_RATIO}
        values |= PUBLISHED_PILOT
    if profile == "as_built":
        values |= AS_BUILT
    return values


def body_values(profile: str) -> dict[str, float]:
    """Named parameter values of the body in a profile: those of `as_built`; nothing in the others.

    >>> body_values("exact")
    {}
    """
    return dict(AS_BUILT_BODY) if profile == "as_built" else {}


def with_gait_factor(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values; if they name a duty factor but no gait factor, with its gait factor 1 / duty (A.2).

    While a foot is in stance, for the share d of a cycle, the body moves by one stride: 1 / d strides per cycle
    (erratum 20).
    """
    if "duty" in values and "gait_factor" not in values:
        return {**values, "gait_factor": 1.0 / values["duty"]}
    return dict(values)
