"""Numbers of docs/howto/train.md, as JSON.

python docs/answers/trainings.py flat DIR     # of DIR/train_residual-0 and DIR/train_own-0, by trainings.py
python docs/answers/trainings.py minute DIR   # of DIR/summary.json, by policy_in_a_minute.py
python docs/answers/trainings.py pushed DIR   # of DIR, a training; pushes its policy and the controller alone
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd

PUSHED = Path(__file__).parents[1] / "benchmarks" / "pushed.py"


def speeds(scenes: dict[str, Any]) -> dict[str, str]:
    return {who: f"{1e3 * scenes['flat'][who]['speed']:.0f}" for who in ("policy", "alone")}


def flat(out: Path) -> dict[str, str]:
    told = speeds(json.loads((out / "train_residual-0" / "summary.json").read_text())["scenes"])
    walks = pd.read_parquet(out / "train_own-0" / "evaluation.parquet")
    walks = walks[(walks.controller == "policy") & (walks.status == "ok")]
    commanded, walked = 1e3 * walks["command.speed"], 1e3 * walks.speed
    return {f"trained.{who}": speed for who, speed in told.items()} | {
        "own.slowest": f"{walked.min():.0f}",
        "own.fastest": f"{walked.max():.0f}",
        "own.error": f"{(walked - commanded).abs().median():.0f}",
        "own.correlation": f"{walked.corr(commanded):.2f}",
    }


def minute(out: Path) -> dict[str, str]:
    found = json.loads((out / "summary.json").read_text())
    seconds, gains = found["wall_seconds"], found["gain"]
    return {
        "minute.reached": f"{sum(found['reached'])} of {found['seeds']}",
        "minute.seconds": f"{min(seconds):.0f} to {max(seconds):.0f}",
        "minute.gains": f"{min(gains):.1f} to {max(gains):.1f}",
    }


def pushed(out: Path) -> dict[str, str]:
    scenes = json.loads((out / "summary.json").read_text())["scenes"]
    told = {f"price.{who}_speed": speed for who, speed in speeds(scenes).items()}
    walks = (
        pd.read_parquet(out / "evaluation.parquet")
        .groupby("controller")[["cost_of_transport", "slip"]]
        .median()
    )
    for who, (cost, slip) in zip(walks.index, walks.to_numpy(), strict=True):
        name = "policy" if who == "policy" else "alone"
        told |= {f"price.{name}_cost": f"{cost:.1f}", f"price.{name}_slip": f"{1e3 * slip:.0f}"}
    done = subprocess.run(
        [sys.executable, PUSHED, out / "policy.npz"], text=True, stdout=subprocess.PIPE, check=True
    )
    falls: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        who, rest = line[:17].strip(), line[17:].split()
        falls.setdefault("policy" if who == "policy" else "alone", []).append(rest[2])
    for name, (_, *each) in falls.items():  # without the weakest push
        told[f"price.{name}_falls"] = f"{', '.join(each[:-1])} and {each[-1]}"
    return told


if __name__ == "__main__":
    what, out = sys.argv[1], Path(sys.argv[2])
    print(json.dumps({"flat": flat, "minute": minute, "pushed": pushed}[what](out), indent=1))
