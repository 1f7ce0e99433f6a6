"""Table and numbers of docs/benchmarks/rematch.md and docs/gradients.md, as JSON.

python docs/answers/rematch.py FILE.jsonl
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pandas as pd

SECONDS = 40.0
METHODS = {"exact": "exact", "secants": "secants", "secants, L-BFGS": "lbfgs", "CMA-ES": "cma"}
#: Objective -> its title, the factor from the minimized value to what is told, and places.
OBJECTIVES = {"speed": ("speed [mm/s]", -100.0, 1), "transport": ("transport", 1.0, 2)}


def main(path: Path) -> dict[str, str]:
    searches = pd.DataFrame(json.loads(line) for line in path.read_text().splitlines())
    searches = searches[searches.cpu_s == SECONDS].reset_index(drop=True)
    searches[["aim", "parameters", "method", "seed"]] = pd.DataFrame(searches.of.tolist())
    lines = [
        f"| objective | parameters | start | {' | '.join(METHODS)} |",
        "|---|---|---|---|---|---|---|",
    ]
    found = {}
    for (aim, parameters), each in searches.groupby(["aim", "parameters"]):
        title, factor, places = OBJECTIVES[aim]
        cells = [f"{factor * each.began.mean():.{places}f}"]
        for method, name in METHODS.items():
            runs = each[each.method == method]
            best = runs.found.max() < each[each.method != method].found.min()
            told = f"{factor * runs.found.mean():.{places}f}"
            ends = sorted(factor * runs.found)
            cells.append(f"{f'**{told}**' if best else told} ({runs.walks.mean():.0f})")
            found[f"rematch.{aim}_{parameters}_{name}"] = told
            found[f"rematch.{aim}_{parameters}_{name}_range"] = (
                f"{ends[0]:.{places}f} to {ends[-1]:.{places}f}"
            )
        lines.append(f"| {title} | {parameters} | {' | '.join(cells)} |")
    return {"rematch.table": "\n".join(lines)} | found


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1])), indent=1))
