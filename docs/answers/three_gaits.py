"""The table of README.md: the optima of `sweeps/three_gaits.yaml` in two profiles, as JSON.

python docs/answers/three_gaits.py PROFILE DIR   # writes DIR/PROFILE.yaml, the same sweep in another profile
python docs/answers/three_gaits.py table DIR     # of DIR/exact/optimum.csv and DIR/as_published/optimum.csv
"""

from __future__ import annotations

import csv
import json
import math
import sys
from pathlib import Path

SPEC = Path(__file__).parents[2] / "sweeps" / "three_gaits.yaml"
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


if __name__ == "__main__":
    what, out = sys.argv[1], Path(sys.argv[2])
    if what == "table":
        optima = {profile: out / profile / "optimum.csv" for profile in ("exact", "as_published")}
        print(json.dumps({"answers": table(optima)}, indent=1, ensure_ascii=False))
    else:
        (out / f"{what}.yaml").write_text(
            SPEC.read_text().replace("robot: nermo_lite\n", f"robot: nermo_lite\nprofile: {what}\n")
        )
