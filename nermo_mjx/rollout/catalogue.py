"""The built-in metrics of every run: name, unit, meaning, and which direction is better."""

from __future__ import annotations

import dataclasses
from typing import Final

from nermo_mjx.robot import LIMBS

ANGLES: Final = ("roll", "pitch", "yaw")
#: Pairs of feet, and their indices in `LIMBS`.
PAIRS: Final = {"front": slice(0, 2), "rear": slice(2, 4)}


@dataclasses.dataclass(frozen=True)
class Metric:
    """Unit and meaning of a metric, and which direction is better: `high`, `low`, or None if neither is."""

    unit: str
    doc: str
    better: str | None = None


METRICS: Final[dict[str, Metric]] = {
    "speed": Metric("m/s", "distance over duration", "high"),
    "distance": Metric("m", "way along the pilot's path, or along the smoothed heading, while measured"),
    "duration": Metric("s", "time measured"),
    "lateral_drift": Metric("m", "displacement along x, left of the straight pilot's line, while measured"),
    **{
        f"{angle}_{statistic}": Metric("rad", f"{statistic} of the torso's {angle}", better)
        for angle in ANGLES
        for statistic, better in (("mean", None), ("std", "low"), ("min", None), ("max", None))
    },
    **{
        f"head_{angle}_{statistic}": Metric("rad", f"{statistic} of the head's {angle}", better)
        for angle in ("pitch", "yaw")
        for statistic, better in (("mean", None), ("std", "low"))
    },
    "picture_motion": Metric("rad/s", "speed of far things across the eyes' pictures, root mean square", "low"),
    "cross_track_peak": Metric("m", "largest distance from the pilot's path; NaN for a pilot without one", "low"),
    "cross_track_rms": Metric("m", "root mean square of the distance from the pilot's path; NaN without a path", "low"),
    "cross_track_walked": Metric("m", "largest distance of a gait cycle's mean position from the pilot's path", "low"),
    "turning_radius": Metric("m", "radius of the circle fitted to the cycles' mean positions; NaN if straight"),
    "turn_rate": Metric("rad/s", "yaw gained over duration, positive to the left"),
    "slip": Metric("m/s", "mean horizontal speed of loaded feet", "low"),
    **{f"slip_{limb}": Metric("m/s", f"the same of the {limb.replace('_', ' ')} foot", "low") for limb in LIMBS},
    **{f"duty_{limb}": Metric("1", f"share of time with the {limb.replace('_', ' ')} foot loaded") for limb in LIMBS},
    **{f"loaded_{pair}": Metric("1", f"share of time with a {pair} foot loaded, mean of the pair") for pair in PAIRS},
    **{
        f"swing_loaded_{pair}": Metric("1", f"share of its commanded swing with a {pair} foot loaded, mean of the pair")
        for pair in PAIRS
    },
    **{f"load_{limb}": Metric("N", f"mean force on the {limb.replace('_', ' ')} foot") for limb in LIMBS},
    "front_load_share": Metric("1", "share of the front feet in the load of all feet"),
    "tail_time": Metric("1", "share of time with the tail loaded"),
    "tail_load_share": Metric("1", "share of the tail in the load of feet and tail"),
    "servo_work": Metric("J", "positive mechanical work of all servos while measured", "low"),
    "cost_of_transport": Metric("1", "servo work over weight and distance; NaN below 1 mm", "low"),
    "motor_current": Metric("A", "mean current in the motors of all servos, by their torque", "low"),
    "servo_current": Metric("A", "mean current that all servos draw from the battery", "low"),
    "electrical_power": Metric("W", "mean electrical power of all servos", "low"),
    "charge": Metric("C", "drawn by all servos while measured", "low"),
    "battery_time": Metric("s", "time in which servos and electronics empty the battery", "high"),
    "fell": Metric("1", "1 if the torso tilted past 60 degrees or came to the ground", "low"),
    "diverged": Metric("1", "1 if the simulation lost its numbers", "low"),
    "failure_time": Metric("s", "end of the first control tick in which it fell or diverged; NaN if it did neither"),
}  # fmt: skip
