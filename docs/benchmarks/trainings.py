"""The table of trained policies, trainings.txt: each file's seeds, commit and figures on unseen bodies.

    python docs/benchmarks/trainings.py sweeps/train_residual.yaml --seeds 0 1 2 --out runs

A training stands in OUT/NAME-SEED, and one that is complete is not made again. A row has the median over the seeds, and
the lowest and the highest. `trainings.jsonl` keeps every training; a file's latest run with a commit is shown.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from measuring import append, run_of

from nermo_mjx.runs.files import replace_file

HERE = Path(__file__).parent
KEPT = HERE / "trainings.jsonl"
FIGURES = {"speed": ("speed [mm/s]", 1e3, 0), "cost_of_transport": ("cost of transport", 1.0, 2)}


def trained(spec: str, seed: int, out: Path) -> list[dict[str, Any]]:
    """Train one seed; what its evaluation found on each scene."""
    folder = out / f"{Path(spec).stem}-{seed}"
    command = ["nermo-mjx", "train", spec, "--seed", str(seed), "--out", str(folder)]
    summary = folder / "summary.json"
    if not (summary.exists() and json.loads(summary.read_text())["complete"]):
        subprocess.run([sys.executable, "-m", "nermo_mjx", *command[1:], "--quiet"], check=True)
    found = json.loads(summary.read_text())
    about = {
        "file": spec,
        "seed": seed,
        "steps": found["steps"],
        "cpu": found["environment_cpu"] + found["learner_cpu"],
    }
    return [{**about, "scene": scene, **walkers} for scene, walkers in found["scenes"].items()]


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: one row for each file and scene."""
    titles = [f"{title}, {who}" for title, *_ in FIGURES.values() for who in ("policy", "alone")]
    heads = ["file", "scene", "seeds", "success [%]", *titles, "processor [min]", "commit"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    rows = {(case["file"], case["scene"]): (run, []) for run in runs for case in run["cases"]}
    for run in runs:
        for case in run["cases"]:
            kept, cases = rows[case["file"], case["scene"]]
            cases.extend([case] if kept is run else [])
    for (file, scene), (run, cases) in rows.items():
        cells = [f"`{Path(file).name}`", scene, ", ".join(str(case["seed"]) for case in cases)]
        cells.append(spread([100 * case["policy"]["success"] for case in cases], 0))
        for name, (_, factor, digits) in FIGURES.items():
            cells += [
                spread([factor * case[who][name] for case in cases], digits)
                for who in ("policy", "alone")
            ]
        cells += [spread([case["cpu"] / 60 for case in cases], 1), f"`{run['commit'][:7]}`"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def spread(values: list[float], digits: int) -> str:
    """The median, and the lowest and highest of several."""
    low, middle, high = (f"{value:.{digits}f}" for value in np.quantile(values, [0.0, 0.5, 1.0]))
    return middle if low == high else f"{middle} [{low}, {high}]"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("specs", nargs="*", metavar="FILE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--out", type=Path, default=Path("runs"))
    args = parser.parse_args()
    cases = [
        case for spec in args.specs for seed in args.seeds for case in trained(spec, seed, args.out)
    ]
    if cases:
        append(KEPT, run_of(cases))
    runs = [json.loads(line) for line in KEPT.read_text().splitlines()]
    replace_file(HERE / "trainings.txt", table(runs).encode())


if __name__ == "__main__":
    main()
