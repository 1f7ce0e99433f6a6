"""Numbers and tables of docs/nermo_41.md, as JSON.

    python docs/answers/nermo_41.py extension DIR   # of the directory of `sweeps/sagittal_spine.yaml`
    python docs/answers/nermo_41.py walks           # of single walks

The best cells of the sweep are repeated from 16 other starts, on grounds of other friction.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from ruamel.yaml import YAML

from nermo_mjx import Run, Setup, Simulator, run_sweep

ROOT = Path(__file__).parents[2]
Row = dict[str, float]


def compared(directory: Path, metric: str = "speed") -> list[Row]:
    """A metric with the extension and without, for each frequency, amplitude and phase."""
    rows = pq.read_table(directory / "comparison.parquet").to_pylist()
    return [row for row in rows if row["metric"] == metric and row["frequency"] is not None]


def interval(row: Row) -> str:
    gain, low, high = (1e3 * row[name] for name in ("difference", "low", "high"))
    return f"{gain:+.0f} [{low:.0f}, {high:.0f}]"


def extension(directory: Path) -> dict[str, str]:
    """The best cell of each frequency, in the sweep and repeated."""
    spec = YAML(typ="safe").load((ROOT / "sweeps" / "sagittal_spine.yaml").read_text())
    lines = [
        "| frequency | amplitude, phase | held | with the extension | gain in the sweep | gain, repeated |",
        "|---|---|---|---|---|---|",
    ]
    numbers, rows = {}, compared(directory)
    for frequency in dict.fromkeys(row["frequency"] for row in rows):
        cells = [row for row in rows if row["frequency"] == frequency]
        best = max(cells, key=lambda row: row["difference"])
        amplitude, phase = float(best["other"]), best["spine.sagittal_phase"]
        again = spec | {"set": {"spine.sagittal_phase": phase}, "seed": 1, "plots": False}
        again["vary"] = {"frequency": [frequency], "spine.sagittal_amplitude": [0.0, amplitude]}
        again["randomize"] = spec["randomize"] | {"repeats": 16}
        again["compare"] = spec["compare"] | {"for": "frequency"}
        out = directory / f"again-{frequency:g}"
        run_sweep(again, out, engine="c")
        (repeated,) = compared(out)
        lines.append(
            f"| {frequency:g} Hz | {amplitude:g} rad, {math.degrees(phase):.0f}° | {1e3 * repeated['base_mean']:.0f} | "
            f"{1e3 * repeated['other_mean']:.0f} | {interval(best)} | {interval(repeated)} |"
        )
        numbers[f"sagittal.gain_{frequency:g}"] = f"{1e3 * repeated['difference']:.0f}"
        (cost,) = compared(out, "cost_of_transport")
        numbers[f"sagittal.cost_{frequency:g}"] = (
            f"{cost['base_mean']:.0f} to {cost['other_mean']:.0f}"
        )
    slowest = min(row["other_mean"] for row in rows)
    return numbers | {"sagittal": "\n".join(lines), "sagittal.backward": f"{-1e3 * slowest:.0f}"}


def walk(values: dict[str, object], **setup: object) -> dict[str, np.ndarray]:
    """Metrics of walks of ten cycles; angles in degrees, speeds in mm/s."""
    result = Simulator(Setup(**setup), engine="c").run(values, Run(cycles=10, warmup_cycles=3))
    scale = {
        "speed": 1e3,
        "head_yaw_std": np.degrees(1),
        "head_pitch_std": np.degrees(1),
        "pitch_std": np.degrees(1),
    }
    return {name: scale.get(name, 1.0) * np.asarray(each) for name, each in result.metrics.items()}


def walks() -> dict[str, str]:
    """Single walks: the bound of the film, the balance of the pitch, bounds and gallops of both robots, the gaze."""
    found = {}
    for title, spine in (("", "sagittal_extension"), ("_held", "none")):
        speed = walk({"frequency": 1.1}, robot="nermo_41", gait="bound", spine=spine)["speed"]
        found[f"bound{title}"] = f"{speed.item():.0f}"
    for gait in ("trot", "lateral_walk", "bound"):
        both = walk(
            {"frequency": 0.67, "spine.pitch_gain": [0.0, 2.0]},
            robot="nermo_41",
            gait=gait,
            spine="pitch_balance",
        )
        for name, places in (("pitch_std", 1), ("speed", 0)):
            found[f"balance.{gait}.{name}"] = " to ".join(
                f"{each:.{places}f}" for each in both[name]
            )
    found["lite.bound"] = f"{walk({'frequency': 0.67}, gait='bound')['speed'].item():.0f}"
    gallop = {"frequency": 0.67, "spine.sagittal_phase": np.radians(np.arange(0, 360, 45))}
    found["lite.gallop"] = f"{walk({'frequency': 0.67}, gait='gallop')['speed'].item():.0f}"
    found["41.gallop"] = (
        f"{walk({'frequency': 0.67}, robot='nermo_41', gait='gallop')['speed'].item():.0f}"
    )
    best = walk(gallop, robot="nermo_41", gait="gallop", spine="sagittal_extension")["speed"].max()
    found["41.gallop_best"] = f"{best:.0f}"
    for robot in ("nermo_lite", "nermo_41"):
        for head in ("none", "gaze"):
            metrics = walk(
                {"frequency": 0.67},
                robot=robot,
                gait="lateral_walk",
                spine="stride_extension",
                head=head,
            )
            for name in ("pitch", "yaw"):
                found[f"head.{robot}.{head}.{name}"] = f"{metrics[f'head_{name}_std'].item():.1f}"
    return found


if __name__ == "__main__":
    found = extension(Path(sys.argv[2])) if sys.argv[1] == "extension" else walks()
    print(json.dumps(found, indent=1, ensure_ascii=False))
