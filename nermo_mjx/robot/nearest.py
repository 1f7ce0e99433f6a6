"""Suggestions for misspelled names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, allowed: Iterable[str]) -> str | None:
    """The allowed name closest to `name`, or the one that ends with it (`amplitude`: `spine.amplitude`), or None."""
    names = list(allowed)
    found = difflib.get_close_matches(name, names, n=1)
    found += [full for full in names if full.rpartition(".")[2] == name.rpartition(".")[2]]
    return found[0] if found else None
