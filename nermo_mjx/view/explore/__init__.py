"""A page for the browser that shows all runs of a sweep's or a search's directory, or an atlas."""

from nermo_mjx.view.explore.page import KINDS, MOST_RECORDINGS, explore

__all__ = ["KINDS", "MOST_RECORDINGS", "explore"]
