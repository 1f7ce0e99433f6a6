"""Searches: the best point, a front between objectives, or an atlas of what is possible.

from nermo_mjx.search import run_search
result = run_search("sweeps/search_speed.yaml", "runs/fast")
result.best["parameters"], result.best["metrics"]["speed"]
"""

from nermo_mjx.search.run import (
    SearchFailed,
    SearchInterrupted,
    SearchProgress,
    SearchResult,
    run_search,
)
from nermo_mjx.search.spec import Search

__all__ = ["Search", "SearchFailed", "SearchInterrupted", "SearchProgress", "SearchResult", "run_search"]
