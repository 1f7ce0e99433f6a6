"""Why a figure of the profile `exact` does not hold: what was found, and by which test."""

from __future__ import annotations

from typing import Final

#: Experiment -> figure's name -> reason.
REASONS: Final[dict[str, dict[str, str]]] = {}
