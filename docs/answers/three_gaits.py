"""The table and numbers of README.md: the optima of `sweeps/three_gaits.yaml` in two profiles, as JSON.

python docs/answers/three_gaits.py PROFILE DIR   # writes DIR/PROFILE.yaml, the same sweep in another profile
python docs/answers/three_gaits.py table DIR     # of DIR/exact/optimum.csv and DIR/as_published/optimum.csv
python docs/answers/three_gaits.py film DIR      # DIR/three_gaits.gif, of the sweep DIR/exact
"""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np

from nermo_mjx import Recording
from nermo_mjx.sweep.optimum import optimum_in
from nermo_mjx.sweep.replay import recording_file

ROOT = Path(__file__).parents[2]
SPEC = ROOT / "sweeps" / "three_gaits.yaml"
#: Seconds of the film: two gait cycles.
SECONDS = 2.5
HEAD = ("profile", "gait", "amplitude, phase", "gain in speed", "mechanical cost", "electrical cost")


def table(optima: dict[str, Path]) -> str:
    """Rows of each profile, from the file of its optima."""
    lines = [f"| {' | '.join(HEAD)} |", "|---|---|---|---|---|---|"]
    for profile, path in optima.items():
        with path.open() as file:
            told = {(row["gait"], row["metric"]): row for row in csv.DictReader(file)}
        for gait in dict.fromkeys(gait for gait, _ in told):
            speed = told[gait, "speed"]
            assert int(speed["pairs"]) == 24
            cells = [f"`{profile}`", gait.replace("_", " ")]
            cells.append(f"{float(speed['spine.amplitude']):g} rad, {math.degrees(float(speed['spine.phase'])):.0f}°")
            for metric in ("speed", "cost_of_transport", "electrical_cost_of_transport"):
                mean, low, high = (100 * float(told[gait, metric][f"relative{end}"]) for end in ("", "_low", "_high"))
                cells.append(f"{mean:+.1f} % [{low:.1f}, {high:.1f}]")
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def worst(sweep: Path) -> str:
    """The most that a point of the maps costs of the base's speed [%]."""
    sought = optimum_in(sweep)
    assert sought is not None
    return f"{-100 * min(np.nanmin(each.mean / each.base_mean - 1.0) for each in sought.answers):.0f}"


def film(sweep: Path, out: Path) -> None:
    """The last cycles of the best points and their bases, from above."""
    sought = optimum_in(sweep)
    assert sought is not None
    files = []
    for row in sought.shown_rows():
        recording = Recording.load(recording_file(sweep, row))
        files.append(sweep / f"{recording.metadata['kept']}.npz")
        recording.between(recording.time[-1] - SECONDS, recording.time[-1]).save(files[-1])
    small = ["--camera", "top", "--width", "360", "--height", "150", "--fps", "12"]
    subprocess.run([sys.executable, "-m", "nermo_mjx", "render", *files, *small, "--out", out], check=True)


if __name__ == "__main__":
    what, out = sys.argv[1], Path(sys.argv[2])
    if what == "table":
        optima = {profile: out / profile / "optimum.csv" for profile in ("exact", "as_published")}
        found = {"answers": table(optima), "answers.worst": worst(out / "exact")}
        print(json.dumps(found, indent=1, ensure_ascii=False))
    elif what == "film":
        film(out / "exact", out / "three_gaits.gif")
    else:
        (out / f"{what}.yaml").write_text(
            SPEC.read_text().replace("robot: nermo_lite\n", f"robot: nermo_lite\nprofile: {what}\n")
        )
