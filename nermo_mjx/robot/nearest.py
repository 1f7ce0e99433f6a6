"""The name that was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, allowed: Iterable[str]) -> str | None:
    """The allowed name nearest to another, or the one that ends like it (`amplitude`: `spine.amplitude`); None if no
    one is near."""
    names = list(allowed)
    found = difflib.get_close_matches(name, names, n=1)
    found += [full for full in names if full.rpartition(".")[2] == name.rpartition(".")[2]]
    return found[0] if found else None
