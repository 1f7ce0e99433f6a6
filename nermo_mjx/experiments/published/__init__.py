"""Published figures of each experiment, and how they are measured here.

Source: A. Rohregger, Digital Nermo, Master's thesis, TU Munich, December 2021, chapters 6 and 7 and appendix A. Its
times and speeds are those of its controller's clock; in the profile `as_published` that clock runs 2.5 times slower
than the simulated time, so measured ones are converted before they are compared.
"""

from typing import Final

from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.published import balance, body, maze, stands, straight_line, turning
from nermo_mjx.experiments.published.reasons import REASONS

FIGURES: Final[dict[str, tuple[Figure, ...]]] = {
    "straight-line": straight_line.FIGURES,
    "turning": turning.FIGURES,
    "balance": balance.FIGURES,
    "maze": maze.FIGURES,
    "body": body.FIGURES,
    "leg-stand": stands.LEG_FIGURES,
    "spine-stand": stands.SPINE_FIGURES,
}

__all__ = ["FIGURES", "REASONS"]
