"""Numbers of a tuning and of a landscape, for docs/gallery.md and docs/landscape/report.md, as JSON.

python docs/answers/gradients.py tuning DIR
python docs/answers/gradients.py landscape DIR
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from nermo_mjx.optimize import Tuning
from nermo_mjx.optimize.landscape import MEASURES, TABLE, lines_of, rows_of
from nermo_mjx.runs.files import parquet_table


def tuned(directory: Path) -> dict[str, str]:
    """Speeds of start and best point [mm/s], from starts that the tuning has not seen, and its steps to the best."""
    best = json.loads((directory / "best.json").read_text())
    speeds = {f"tuned.{name}": f"{1e3 * best['verified'][name]['metrics']['speed']:.0f}" for name in ("start", "best")}
    return speeds | {"tuned.steps": f"{best['iteration']}"}


def landscape(directory: Path) -> dict[str, str]:
    """The table of widths, all of nine secants with the slope's sign, and the range of speeds of each line."""
    content = json.loads((directory / MEASURES).read_text())
    widths = [width for each in content["parameters"].values() for width in each["widths"]]
    assert all(width["secants"] == 9 and width["sign_agreement"] == 1.0 for width in widths)
    lines = ["| parameter | width | of the bounds | median error |", "|---|--:|--:|--:|"]
    lines += [f"| {name} | {width} | {share} | {error} |" for name, width, share, _, error, _ in rows_of(content)]
    found = {"landscape": "\n".join(lines)}
    for line in lines_of(Tuning.from_file(directory / "tuning.yaml"), parquet_table(directory / TABLE)):
        wide = next(width for width in line.measures() if width["share"] == 0.02)
        found[f"landscape.{line.tuned.name}"] = f"{100 * wide['median_relative_error']:.2g} %"
        speeds = -100.0 * line.value  # the file's scale is 0.1 m/s
        found[f"landscape.{line.tuned.name}.speeds"] = f"{speeds.min():.1f} to {speeds.max():.1f}"
    return found


if __name__ == "__main__":
    what, directory = sys.argv[1], Path(sys.argv[2])
    print(json.dumps({"tuning": tuned, "landscape": landscape}[what](directory), indent=1, ensure_ascii=False))
