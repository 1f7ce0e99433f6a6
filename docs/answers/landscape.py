"""Numbers and table of docs/landscape/report.md.

python docs/answers/landscape.py stiff DIR   # writes DIR/stiff.yaml: the tuning with stiff soles and tendons
python docs/answers/landscape.py table DIR   # JSON, from DIR/landscape and DIR/stiff
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import pandas as pd
from gradients import HARD
from ruamel.yaml import YAML

from nermo_mjx.optimize.landscape import rows_of

SPEC = Path(__file__).parents[2] / "sweeps" / "tune_speed.yaml"


def judged(content: dict[str, Any], share: float) -> list[str]:
    """Median error of each parameter's secants of this share of the bounds."""
    of = [{row["share"]: row for row in each["widths"]} for each in content["parameters"].values()]
    return [f"{100 * rows[share]['median_relative_error']:.2g}" for rows in of]


def table(content: dict[str, Any]) -> str:
    lines = ["| parameter | width | of the bounds | median error |", "| --- | --: | --: | --: |"]
    for name, width, share, _, error, _ in rows_of(content):
        lines.append(f"| {name} | {width} | {share} | {error} |")
    return "\n".join(lines)


def ends(out: Path, name: str) -> dict[str, str]:
    """Best and worst objective along a parameter's line, and where the best is [degrees]."""
    points = pd.read_parquet(out / "landscape.parquet")
    line = points[(points.line == name) & (points.centre == -1)]
    best = line.loc[line.objective.idxmin()]
    at = f"{math.degrees(best[name]):.3g}"
    found = {"best": f"{best.objective:.3f}", "at": at, "worst": f"{line.objective.max():.3f}"}
    return {f"landscape.{name.split('.')[1]}_{what}": each for what, each in found.items()}


if __name__ == "__main__":
    what, out = sys.argv[1], Path(sys.argv[2])
    if what == "stiff":
        yaml = YAML()
        spec = yaml.load(SPEC)
        spec["set"] |= HARD
        out.mkdir(parents=True, exist_ok=True)
        yaml.dump(spec, out / "stiff.yaml")
    else:
        soft, stiff = (json.loads((out / name / "landscape.json").read_text()) for name in ("landscape", "stiff"))
        found = {"landscape.table": table(soft)}
        for name, content in (("soft", soft), ("stiff", stiff)):
            for parameter, error in zip(("amplitude", "phase"), judged(content, 0.02), strict=True):
                found[f"landscape.{name}_{parameter}"] = error
        found["landscape.walks"] = f"{soft['evaluations']}"
        for parameter in soft["parameters"]:
            found |= ends(out / "landscape", parameter)
        print(json.dumps(found, indent=1, ensure_ascii=False))
