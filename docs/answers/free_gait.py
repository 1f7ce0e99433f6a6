"""The gaits of two searches, and what docs/searches.md says about them.

python docs/answers/free_gait.py rows DIR    # best points of DIR/published and DIR/free, into sweeps/free_gait.yaml
python docs/answers/free_gait.py table DIR   # of that sweep's directory: table and numbers, as JSON
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
from pathlib import Path

import numpy as np

from nermo_mjx.sweep import read_table

SPEC = Path(__file__).parents[2] / "sweeps" / "free_gait.yaml"
MODES = {
    "published": {"spine": "stride_extension", "trajectory": "cubic"},
    "free": {"spine": "stride_extension+harmonics", "trajectory": "free"},
}
TITLES = {"published": "published form, 14 parameters", "free": "free, 41 parameters"}
METRICS = {"cost_of_transport": (1, 1), "electrical_cost_of_transport": (1, 1), "slip": (1e3, 0)}


def row(best: Path, modes: dict[str, str]) -> str:
    """The best point of a search, as a row of a sweep file."""
    found = json.loads(best.read_text())["parameters"]
    pairs = modes | {name: f"{value:.4f}" for name, value in found.items()}
    text = "- {" + ", ".join(f"{name}: {value}" for name, value in pairs.items()) + "}"
    return textwrap.fill(text, 118, subsequent_indent="  ", break_on_hyphens=False)


def write_rows(directory: Path) -> None:
    rows = "\n".join(row(directory / name / "best.json", modes) for name, modes in MODES.items())
    text = SPEC.read_text()
    SPEC.write_text(
        re.sub(r"(?<=^rows:\n).*(?=^randomize:)", rows + "\n", text, flags=re.DOTALL | re.MULTILINE)
    )


def table(directory: Path) -> dict[str, str]:
    runs = read_table(directory).to_pandas()
    assert (runs["status"] == "ok").all()
    lines = [
        "| gait | speed [mm/s] | cost of transport, mechanical | electrical | slip [mm/s] | roll, std [degrees] |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    means = {}
    for name, modes in MODES.items():
        walks = runs[runs["trajectory"] == modes["trajectory"]]
        mean = means[name] = walks.mean(numeric_only=True)
        speeds = 1e3 * walks["speed"]
        cells = [f"{speeds.mean():.0f} ({speeds.min():.0f} to {speeds.max():.0f})"]
        cells += [
            f"{scale * mean[metric]:.{places}f}" for metric, (scale, places) in METRICS.items()
        ]
        lines.append(
            f"| {TITLES[name]} | {' | '.join(cells)} | {np.degrees(mean['roll_std']):.1f} |"
        )
    change = {
        name: f"{100 * (means['free'][name] / means['published'][name] - 1):+.0f}"
        for name in ("speed", *METRICS)
    }
    return {
        "free.table": "\n".join(lines),
        "free.faster": change["speed"].lstrip("+"),
        "free.mechanical": change["cost_of_transport"],
        "free.electrical": change["electrical_cost_of_transport"],
        **{f"free.{name}": f"{1e3 * mean['speed']:.0f}" for name, mean in means.items()},
    }


if __name__ == "__main__":
    what, directory = sys.argv[1], Path(sys.argv[2])
    if what == "rows":
        write_rows(directory)
    else:
        print(json.dumps(table(directory), indent=1, ensure_ascii=False))
