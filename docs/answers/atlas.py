"""Numbers of the atlas in docs/searches.md, as JSON: `python docs/answers/atlas.py DIR`, the search's directory."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pandas as pd


def main(out: Path) -> dict[str, str]:
    cells = pd.read_parquet(out / "atlas.parquet")
    return {"atlas.cells": f"{len(cells):,}", "atlas.fastest": f"{1e3 * cells.speed.max():.0f}"}


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1])), indent=1))
