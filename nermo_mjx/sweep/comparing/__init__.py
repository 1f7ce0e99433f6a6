"""Which structure is better and by how much: sweeps, and parts of one, compared with confidence intervals."""

from nermo_mjx.sweep.comparing.comparison import Comparison, compare

__all__ = ["Comparison", "compare"]
