"""What pages quote of a notebook's outputs, as JSON: `python docs/answers/notebooks.py`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import nbformat

TRAINING = Path(__file__).parents[2] / "notebooks" / "07_train_a_policy.ipynb"


def main() -> dict[str, str]:
    cells = nbformat.read(TRAINING, as_version=4).cells
    texts = [output.get("text", "") for cell in cells for output in cell.get("outputs", [])]
    speeds = dict(re.findall(r"^(policy|alone) +(\d+) mm/s", "\n".join(texts), re.MULTILINE))
    return {f"sight.{who}": speed for who, speed in speeds.items()}


if __name__ == "__main__":
    print(json.dumps(main(), indent=1))
