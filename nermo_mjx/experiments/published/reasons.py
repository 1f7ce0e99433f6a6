"""Why a figure of the profile `exact` does not hold: what was found, and by which test.

The numbers are of the C engine, by `nermo-mjx experiment ... --set NAME=X`; docs/experiments.md has the whole table.
"""

from __future__ import annotations

from typing import Final

#: Experiment -> figure's name -> reason.
REASONS: Final[dict[str, dict[str, str]]] = {
    "straight-line": {},
    "turning": {},
    "balance": {},
    "maze": {},
    "body": {},
}
