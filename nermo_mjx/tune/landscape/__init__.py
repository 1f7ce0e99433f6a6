"""Whether gradients can be trusted: exact slopes beside secants of several widths, on lines through the start."""

from nermo_mjx.tune.landscape.run import LandscapeResult, run_landscape

__all__ = ["LandscapeResult", "run_landscape"]
