"""The columns of a table of runs: built-in metrics with unit, meaning and better direction, and other columns."""

from __future__ import annotations

import dataclasses
from typing import Final

from nermo_mjx.robot import LIMBS

ANGLES: Final = ("roll", "pitch", "yaw")
#: Pairs of feet, and their indices in `LIMBS`.
PAIRS: Final = {"front": slice(0, 2), "rear": slice(2, 4)}


#: Better directions of a metric, and the word of summaries and figures for each.
SIDES: Final = {"high": "max", "low": "min", "zero": "nearest zero"}


@dataclasses.dataclass(frozen=True)
class Metric:
    """Unit and meaning of a metric, and which direction is better: one of `SIDES`, or None if none is."""

    unit: str
    doc: str
    better: str | None = None


METRICS: Final[dict[str, Metric]] = {
    "speed": Metric("m/s", "distance over duration", "high"),
    "distance": Metric(
        "m", "way along the pilot's path, or along the smoothed heading, while measured"
    ),
    "duration": Metric("s", "time measured"),
    "lateral_drift": Metric(
        "m", "displacement along x, left of the straight pilot's line, while measured", "zero"
    ),
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
    "picture_motion": Metric(
        "rad/s", "speed of far things across the eyes' pictures, root mean square", "low"
    ),
    "cross_track_peak": Metric(
        "m", "largest distance from the pilot's path; NaN for a pilot without one", "low"
    ),
    "cross_track_rms": Metric(
        "m", "root mean square of the distance from the pilot's path; NaN without a path", "low"
    ),
    "cross_track_walked": Metric(
        "m", "largest distance of a gait cycle's mean position from the pilot's path", "low"
    ),
    "cross_track_noise": Metric(
        "m", "sway: root mean square of that distance about each gait cycle's mean", "low"
    ),
    "turning_radius": Metric(
        "m", "radius of the circle fitted to the cycles' mean positions; NaN if straight"
    ),
    "turn_rate": Metric("rad/s", "yaw gained over duration, positive to the left"),
    "slip": Metric("m/s", "mean horizontal speed of loaded feet", "low"),
    **{
        f"slip_{limb}": Metric("m/s", f"the same of the {limb.replace('_', ' ')} foot", "low")
        for limb in LIMBS
    },
    **{
        f"duty_{limb}": Metric("1", f"share of time with the {limb.replace('_', ' ')} foot loaded")
        for limb in LIMBS
    },
    **{
        f"loaded_{pair}": Metric("1", f"share of time with a {pair} foot loaded, mean of the pair")
        for pair in PAIRS
    },
    **{
        f"swing_loaded_{pair}": Metric(
            "1", f"share of its commanded swing with a {pair} foot loaded, mean of the pair"
        )
        for pair in PAIRS
    },
    "strides": Metric(
        "1", "whole strides measured, touch-down to touch-down, of the foot that made the fewest"
    ),
    "stride_length": Metric("m", "way of the torso in a stride, mean of all feet's"),
    "stride_length_cv": Metric(
        "1", "standard deviation over mean of a foot's strides, of three or more", "low"
    ),
    "stride_time": Metric("s", "from touch-down to touch-down, mean of all feet's strides"),
    "stance_time": Metric("s", "time of a stride with its foot loaded, mean of all feet's strides"),
    "duty_factor": Metric("1", "as walked: stance time over stride time"),
    **{
        f"load_{limb}": Metric("N", f"mean force on the {limb.replace('_', ' ')} foot")
        for limb in LIMBS
    },
    "front_load_share": Metric("1", "share of the front feet in the load of all feet"),
    "tail_time": Metric("1", "share of time with the tail loaded"),
    "tail_load_share": Metric("1", "share of the tail in the load of feet and tail"),
    "servo_work": Metric("J", "positive mechanical work of all servos while measured", "low"),
    "servo_net_work": Metric(
        "J", "mechanical work of all servos while measured, less what they take back"
    ),
    "servo_damper_work": Metric(
        "J", "work that the dampers of the servos' joints take of it", "low"
    ),
    "joint_damper_work": Metric(
        "J", "work that the dampers of knees, ankles, spine and tail take of it"
    ),
    "constraint_work": Metric("J", "what is left of it: taken by contact and tendons, or stored"),
    **{
        f"limited_{group}": Metric(
            "1", f"share of time with the torque of the {group.replace('_', ' ')} at its limit"
        )
        for group in ("front_hips", "rear_hips", "front_knees", "rear_knees", "spine")
    },
    "cost_of_transport": Metric("1", "servo work over weight and distance; NaN below 1 mm", "low"),
    "motor_current": Metric(
        "A", "mean current in the motors of all servos, by their torque", "low"
    ),
    "servo_current": Metric("A", "mean current that all servos draw from the battery", "low"),
    "electrical_power": Metric("W", "mean electrical power of all servos", "low"),
    "electrical_cost_of_transport": Metric(
        "1", "electrical energy of all servos over weight and distance; NaN below 1 mm", "low"
    ),
    "charge": Metric("C", "drawn by all servos while measured", "low"),
    "battery_time": Metric("s", "time in which servos and electronics empty the battery", "high"),
    "servo_clamped": Metric(
        "1", "share of time with a servo asked for an angle beyond its range", "low"
    ),
    "airborne_time": Metric("1", "share of time without any contact"),
    "penetration": Metric("m", "depth of the deepest contact since the start", "low"),
    "sunk_time": Metric("1", "share of time with a contact deeper than the sole is thick", "low"),
    "fell": Metric("1", "1 if the torso tilted past 60 degrees or came to the ground", "low"),
    "diverged": Metric("1", "1 if the simulation lost its numbers", "low"),
    "failure_time": Metric(
        "s", "end of the first control tick in which it fell or diverged; NaN if it did neither"
    ),
}

#: Metrics of a run with switches, see `transitions`.
TRANSITION: Final[dict[str, Metric]] = {
    "transition_roll": Metric(
        "rad", "largest roll to either side while switches act, and a cycle longer", "low"
    ),
    "transition_slip": Metric("m/s", "mean horizontal speed of loaded feet in that time", "low"),
    "transition_time": Metric(
        "s",
        "how much later it has its new speed than at once; NaN if it changes by less than 5 %",
        "low",
    ),
}

#: Columns of a table of runs that are neither parameters nor metrics, and their meanings.
RUN_COLUMNS: Final = {
    "row": "position of the run in the sweep",
    "variant": "index of the variant",
    "repeat": "index of the repeat within its variant",
    "seed": "seed of the row's random draws",
    "body": "body of the identified ensemble; 0 is the default one",
    "status": "ok, or how the run ended",
    "code": "which code made the row, as run.json names it",
}

#: The headings of lists of metrics, by the first metric below each.
HEADINGS: Final = {
    "speed": "Walk",
    "roll_mean": "Attitude",
    "head_pitch_mean": "Head and eyes",
    "cross_track_peak": "Path",
    "slip": "Feet",
    "servo_work": "Energy",
    "servo_clamped": "Checks",
}


def headed() -> dict[str, str]:
    """The heading of each built-in metric.

    >>> headed()["roll_std"], headed()["electrical_cost_of_transport"]
    ('Attitude', 'Energy')
    """
    headings, heading = {}, ""
    for name in METRICS:
        headings[name] = heading = HEADINGS.get(name, heading)
    return headings
