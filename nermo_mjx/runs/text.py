"""Text output of a run: JSON for programs, Markdown for readers."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

#: Content of an empty cell.
MISSING: Final = "–"


def plain(value: Any) -> Any:
    """The value as plain JSON: arrays as lists, non-finite numbers as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy and JAX
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def to_json(content: Mapping[str, Any]) -> bytes:
    """A JSON file's content; see `plain`."""
    return (json.dumps(plain(content), indent=2, allow_nan=False) + "\n").encode()


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], sides: str = "") -> str:
    """A Markdown table; `sides` has one letter per column, l or r, by default all l."""
    rules = ["--:" if side == "r" else "---" for side in sides or "l" * len(headings)]
    texts = [headings, rules, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in texts) + "\n"


def listed(about: Mapping[str, Any] | None) -> str:
    """Names with their values, as in "numpy 2.3, jax 0.8"."""
    return ", ".join(f"{name} {value}" for name, value in (about or {}).items())
