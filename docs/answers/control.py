"""Numbers and tables of docs/control.md: the gaze, the tail's motions, and switches while the robot walks, as JSON.

python docs/answers/control.py
"""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.control.schedule import Switch

RUN = Run(cycles=10, warmup_cycles=3)
FREQUENCIES, GAINS = [0.5, 0.8, 1.2], [0.0, 2.0, 4.0, 6.0]
GAITS, SPINES = ("trot", "walking_trot", "lateral_walk"), ("none", "stride_extension", "balance")


def walked(values: dict[str, Any], run: Run = RUN, **setup: Any) -> dict[str, np.ndarray]:
    """Metrics of walks; angles in degrees and speeds in mm/s."""
    result = Simulator(Setup(**setup), engine="c").run(values, run)
    assert set(result.status.tolist()) == {"ok"}, result.status
    scale = {"speed": 1e3} | {
        name: np.degrees(1.0) for name in result.metrics if name.endswith(("_std", "_roll"))
    }
    return {name: scale.get(name, 1.0) * np.asarray(each) for name, each in result.metrics.items()}


def row(title: str, numbers: Any, places: int) -> str:
    return f"| {title} | {' | '.join(f'{each:.{places}f}' for each in numbers)} |"


def gaze() -> dict[str, str]:
    """The head held, and with the gaze."""
    found = {}
    for robot, frequencies in (("nermo_lite", FREQUENCIES), ("nermo_41", [0.8])):
        for head in ("none", "gaze"):
            found[robot, head] = walked(
                {"frequency": frequencies}, robot=robot, head=head, spine="stride_extension"
            )
    lines = [
        "| held, gazing | " + " | ".join(f"{each:g} Hz" for each in FREQUENCIES) + " |",
        "|---|---|---|---|",
    ]
    held, gazed = found["nermo_lite", "none"], found["nermo_lite", "gaze"]
    for title, metric, places in (
        ("head yaw, standard deviation [degrees]", "head_yaw_std", 1),
        ("head pitch, standard deviation [degrees]", "head_pitch_std", 1),
        ("`picture_motion` [rad/s]", "picture_motion", 2),
    ):
        pairs = zip(held[metric], gazed[metric], strict=True)
        lines.append(
            f"| {title} | {' | '.join(f'{a:.{places}f}, {b:.{places}f}' for a, b in pairs)} |"
        )
    full = {head: found["nermo_41", head] for head in ("none", "gaze")}
    arc = {
        head: walked(
            {"frequency": 0.8, "pilot.radius": 0.5},
            pilot="arc",
            head=head,
            spine="stride_extension",
        )
        for head in ("none", "gaze")
    }
    changes = [
        np.abs(found[robot, "gaze"]["speed"] / found[robot, "none"]["speed"] - 1).max()
        for robot, _ in found
    ]
    return {
        "gaze": "\n".join(lines),
        "gaze.pitch_41": " to ".join(f"{full[head]['head_pitch_std'].item():.1f}" for head in full),
        "gaze.motion_41": " to ".join(
            f"{full[head]['picture_motion'].item():.2f}" for head in full
        ),
        "gaze.speed": f"{100 * max(changes):.1f} %",
        "gaze.arc": " instead of ".join(
            f"{np.ravel(arc[head]['picture_motion'])[0]:.2f}" for head in ("gaze", "none")
        ),
    }


def tail() -> dict[str, str]:
    """Both counter-motions of the articulated tail, at several gains."""
    lines = [row("gain", GAINS, 0), "|---|---|---|---|---|"]
    for motion, gain, spine, metrics in (
        ("counter_yaw", "tail.yaw_gain", "stride_extension", ("yaw_std", "roll_std", "speed")),
        ("counter_roll", "tail.roll_gain", "none", ("roll_std", "speed")),
        ("counter_roll", "tail.roll_gain", "stride_extension", ("roll_std", "speed")),
    ):
        found = walked(
            {"frequency": 0.8, gain: GAINS}, tail="articulated", tail_motion=motion, spine=spine
        )
        for metric in metrics:
            first = (
                f"`{motion}`, {'without' if spine == 'none' else 'with'} the spine: "
                if metric == metrics[0]
                else ""
            )
            lines.append(
                row(
                    first + metric.removesuffix("_std"),
                    found[metric],
                    0 if metric == "speed" else 2,
                )
            )
    return {"tail": "\n".join(lines)}


def switching() -> dict[str, str]:
    """The largest roll between gaits and between modes of the spine, at 20 phases of the cycle, and in steady walks."""
    when = {"frequency": 0.8, "schedule.at.1": 5.0 + np.arange(20) / 20 / 0.8}
    run = Run(cycles=12, warmup_cycles=3)
    found = {}
    for what, several in (("gait", GAITS), ("spine", SPINES)):
        rolls = [
            walked(when, run, **{what: a}, schedule=[Switch(5.0, **{what: b})])["transition_roll"]
            for a, b in itertools.permutations(several, 2)
        ]
        steady = [walked({"frequency": 0.8}, run, **{what: each}) for each in several]
        largest = [
            np.degrees(max(abs(each["roll_min"]), abs(each["roll_max"])).item()) for each in steady
        ]
        found[f"switch.{what}"] = f"{np.max(rolls):.1f}"
        found[f"switch.{what}_steady"] = f"{max(largest):.1f}"
    return found


if __name__ == "__main__":
    print(json.dumps(gaze() | tail() | switching(), indent=1, ensure_ascii=False))
