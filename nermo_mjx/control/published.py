"""The published gaits, turning strategies and controller, as named values of the parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.parameters import GAIT_PATTERNS, LIMBS

#: Rate of the controller's clock for which `tracking.foot_gain` and the pilot's gain on the change of the error hold
#: [Hz]: that of both loops of the author's code while he tested (1 July to 12 August 2021; later 50, 80 and 50).
PUBLISHED_RATE: Final = 100.0
#: Share of the foot error that his velocity-space kinematics closes per tick (0.11 since c66c3df, 2 August 2021).
PUBLISHED_TRACKING: Final = 0.11
#: Simulated seconds per second of his controller: steps of 2 ms at 200 Hz of the wall clock, on which his controller
#: runs. Inferred from his code, not stated; recognised with three figures in view (docs/experiments.md).
PUBLISHED_CLOCK_RATIO = 0.4


def tracking_share(rate: float, closed: float = PUBLISHED_TRACKING) -> float:
    """`tracking.foot_gain` of the author's foot tracking: share of the foot error closed per 1/100 s.

    His code subtracts the foot of the tick before, f(k) = f(k-1) + g (target - f(k-2)). So it lags by one tick less
    than f(k) = f(k-1) + g (target - f(k-1)) would: its slow root is (1 + sqrt(1 - 4 g)) / 2, which closes 12.6 % a tick
    for g = 0.11. The fast root, 0.126, is gone after one tick.

    >>> round(tracking_share(100.0), 4)
    0.1258

    Args:
        rate: of his loop [Hz].
        closed: g, in [0, 1/4].
    """
    left = 0.5 * (1.0 + math.sqrt(1.0 - 4.0 * closed))
    return 1.0 - left ** (rate / PUBLISHED_RATE)


#: The published simulation: what the author's repository (a-rohr/mouse_controller) held while he tested, at every
#: commit from c66c3df (2 August 2021, the maze) over 0a07c54 (3 August, the turns) and 583a152 (5 August) to 736e7ec
#: (8 August). That the tests ran with these commits is inferred from the scenes and gains that they add; the thesis
#: gives no dates.
#: The neutral feet stood so from 19 July (5a98d92) to 2 September (03fdad3); those of Table A.7, the default of
#: `Stance`, enter on 26 September (a99147f; erratum 23). His pilot, a PD from the cross-track error to the turn rate,
#: turns the spine whatever its mode. Its gains are those of c66c3df; 30 and 300 (583a152) and 40 and 300 (736e7ec)
#: make it oscillate.
AS_PUBLISHED: Final = {
    "stance.front_y": -0.005, "stance.front_z": -0.038, "stance.rear_y": 0.010, "stance.rear_z": -0.042,
    "tracking.foot_gain": tracking_share(PUBLISHED_RATE), "tracking.clock_ratio": PUBLISHED_CLOCK_RATIO,
    "spine.offset_at_feet": 1.0, "pilot.error_gain": 25.0, "pilot.change_gain": 200.0, "pilot.guidance": 0.0,
}  # fmt: skip
#: His body, from his model of the same days, whose physics no later commit of that year changes: torque limits of legs
#: (0.4 N m) and spine (0.157), damping, the masses in front and behind as compiled, and MuJoCo's default friction of
#: the tail. His servos have gains of 200 and 300 N m/rad without damping, which only their torque limits keep stable.
#: Here they have 60 with 0.05 N m s/rad, with which his own model is 3 % faster (docs/published_set_up.md).
AS_PUBLISHED_BODY: Final = {
    "servo.kp": 60.0, "servo.kv": 0.05, "servo.torque_limit": 0.4, "servo.spine_torque": 0.3925,
    "servo.speed": 100.0, "damping.knee": 0.005, "damping.ankle": 0.005, "damping.spine": 0.01,
    "mass.front": 0.2122, "mass.rear": 0.1257, "contact.tail_friction": 1.0,
}  # fmt: skip
#: Weights (leg, spine) of the three published turning strategies.
STEERING: dict[str, tuple[float, float]] = {"leg": (1.0, 0.0), "spine": (0.0, 1.0), "mix": (1.0, 1.0)}


class ProfileSteering(str):
    """A turning strategy that was not given: it is that of the profile and changes with the profile."""


def steering_of(profile: str) -> ProfileSteering:
    """The turning strategy of a profile, unless one is given: the author's code turns by the spine.

    >>> steering_of("exact"), steering_of("as_published")
    ('leg', 'spine')
    """
    return ProfileSteering("spine" if profile == "as_published" else "leg")


#: Measured over expected curvature (`turning.path_curvature`), by type of steering. Measured without a path, at
#: constant turn rates with expected radii of 0.5 and 1 m: mean over three gaits, three frequencies and strides
#: of 0.8 and 1.0 (docs/experiments.md has the spread).
GRIP: dict[str, float] = {"leg": 0.525, "spine": 1.13, "mix": 1.04}
#: The robot as it was built, by the hardware's figures (docs/experiments.md has what was fitted and what chosen), at
#: the stride of its straight line (Table 6.1), with the author's foot tracking in real time, at the 80 Hz of his loop
#: from 27 August 2021 (192674c) on.
AS_BUILT = {"tracking.foot_gain": tracking_share(80.0), "spine.max_servo_angle": 0.3, "stride": 0.8}
AS_BUILT_BODY = {"build.spine_slack": 0.0006, "build.asymmetry": 0.1, "stiffness.spine": 0.9}
PROFILES: tuple[str, ...] = ("exact", "as_published", "as_built")
#: Profiles of the published simulation, which experiments show side by side.
SIMULATED: tuple[str, ...] = PROFILES[:2]


def published_values(gait: str, *, steering: str | None = None, profile: str = "exact") -> dict[str, float]:
    """Named parameter values of a published gait, turning strategy and profile (one of `PROFILES`).

    The values are keyed as `quantities(ControlParameters)` names them, for `replace_quantities`. Those of the body are
    in `body_values`. Without a turning strategy it is `steering_of` the profile.

    Raises:
        ParameterError: an unknown gait, steering or profile.
    """
    pattern = GAIT_PATTERNS[choice("gait", gait, GAIT_PATTERNS)]
    choice("profile", profile, PROFILES)
    steering = steering_of(profile) if steering is None else choice("steering", steering, STEERING)
    leg, spine = STEERING[steering]
    values = {"duty": pattern.duty, "gait_factor": pattern.gait_factor}
    values |= {"turning.leg": leg, "turning.spine": spine, "pilot.grip": GRIP[steering]}
    values |= {f"offset.{limb}": offset for limb, offset in zip(LIMBS, pattern.offsets, strict=True)}
    return values | {"exact": {}, "as_published": AS_PUBLISHED, "as_built": AS_BUILT}[profile]


def body_values(profile: str) -> dict[str, float]:
    """Named parameter values of the body in a profile; nothing in `exact`.

    >>> body_values("exact"), body_values("as_published")["servo.kp"]
    ({}, 60.0)
    """
    return dict({"exact": {}, "as_published": AS_PUBLISHED_BODY, "as_built": AS_BUILT_BODY}[profile])


def with_gait_factor(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values; if they name a duty factor but no gait factor, with its gait factor 1 / duty (A.2).

    While a foot is in stance, for the share d of a cycle, the body moves by one stride: 1 / d strides per cycle
    (erratum 20).
    """
    if "duty" in values and "gait_factor" not in values:
        return {**values, "gait_factor": 1.0 / values["duty"]}
    return dict(values)
