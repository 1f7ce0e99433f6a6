"""Numbers and tables of docs/benchmarks/physics.md: longer steps against the preset `reference`, as JSON.

python docs/answers/presets.py
"""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np

from nermo_mjx import LIMBS, Run, Setup, Simulator
from nermo_mjx.control.parameters import published_values

RUN = Run(cycles=8, warmup_cycles=2)
GAITS = ("trot", "walking_trot", "lateral_walk")
ATTITUDE = ("roll_std", "pitch_std", "yaw_std")
DUTIES = tuple(f"duty_{limb}" for limb in LIMBS)
GAIT_METRICS = ("speed", "distance", *ATTITUDE, "slip", "servo_work", "cost_of_transport", *DUTIES)
ROWS = {
    "speed, distance": ("speed", "distance"),
    "roll, standard deviation": ("roll_std",),
    "pitch, standard deviation": ("pitch_std",),
    "yaw, standard deviation": ("yaw_std",),
    "slip": ("slip",),
    "servo work, cost of transport": ("servo_work", "cost_of_transport"),
    "duty, front": DUTIES[:2],
    "duty, rear": DUTIES[2:],
}
PHYSICS = {"fast": {"physics": "fast"}, "2.5 ms": {"timestep": 0.0025}, "5 ms": {"timestep": 0.005}}


def walked(
    frequencies: tuple[float, ...], turn_rates: tuple[float, ...], **setup: Any
) -> dict[str, np.ndarray]:
    """Metrics of every gait, frequency and turn rate, without and with the spine."""
    shift = setup.pop("start", {})
    rows = [
        published_values(gait, steering="mix")
        | {"frequency": frequency, "pilot.turn_rate": turn}
        | shift
        for gait, frequency, turn in itertools.product(GAITS, frequencies, turn_rates)
    ]
    values = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    found = []
    for spine in ("none", "stride_extension"):
        simulator = Simulator(Setup(pilot="open_loop", spine=spine, **setup), engine="c")
        result = simulator.run(values, RUN)
        assert set(result.status.tolist()) == {"ok"}, result.status
        found.append({name: np.asarray(metric) for name, metric in result.metrics.items()})
    return {name: np.concatenate([each[name] for each in found]) for name in found[0]}


def changes(
    found: dict[str, np.ndarray], reference: dict[str, np.ndarray], names: tuple[str, ...]
) -> np.ndarray:
    """Relative changes of metrics, as a share."""
    return np.abs(np.concatenate([found[name] / reference[name] - 1 for name in names]))


def percent(each: float) -> str:
    return f"{100 * each:.2g} %" if each < 0.1 else f"{100 * each:.0f} %"


def against() -> dict[str, str]:
    """`fast` and a step of 2.5 ms on 24 walks, straight and turning."""
    args = (0.5, 0.8), (0.0, 0.7)
    reference = walked(*args)
    fast, shorter = (walked(*args, **PHYSICS[name]) for name in ("fast", "2.5 ms"))
    lines = ["| metric | median | largest | largest at 2.5 ms |", "|---|---|---|---|"]
    turning = np.tile(np.repeat([[False, True]], 6, axis=0).ravel(), 2)
    for title, names in ROWS.items():
        ours = changes(fast, reference, names)
        largest = [percent(each.max()) for each in (ours, changes(shorter, reference, names))]
        lines.append(f"| {title} | {percent(np.median(ours))} | {' | '.join(largest)} |")
    radii = [
        np.abs(each["turning_radius"] / reference["turning_radius"] - 1)[turning]
        for each in (fast, shorter)
    ]
    lines.append(
        f"| turning radius | {percent(np.median(radii[0]))} | {' | '.join(percent(e.max()) for e in radii)} |"
    )
    return {
        "presets.against": "\n".join(lines),
        "presets.speed": percent(changes(fast, reference, ("speed",)).max()),
    }


def longest() -> dict[str, str]:
    """`fast` and a step of 5 ms on 18 straight walks, and how far a start that is hardly another moves them."""
    args = (0.5, 0.8, 1.0), (0.0,)
    reference = walked(*args)
    found = {name: walked(*args, **PHYSICS[name]) for name in ("fast", "5 ms")}
    found["shifted"] = walked(*args, start={"start.x": 1e-3, "start.yaw": 1e-3})
    numbers = {}
    for name, each in found.items():
        beyond = changes(each, reference, GAIT_METRICS) > 0.02
        numbers |= {
            f"presets.beyond_{name.replace(' ', '_')}": f"{beyond.sum()}",
            "presets.figures": f"{beyond.size}",
        }
    return numbers


if __name__ == "__main__":
    print(json.dumps(against() | longest(), indent=1, ensure_ascii=False))
