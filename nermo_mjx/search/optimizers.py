"""The optimizers of a search, by the name of its method."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import warnings
from typing import Final

import numpy as np
from scipy.stats import qmc

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.search.asking import Asked, Optimizer
from nermo_mjx.search.scoring import Scores
from nermo_mjx.search.space import Space
from nermo_mjx.search.spec import Search

#: The library of each method, beside NumPy and SciPy.
LIBRARIES: Final = {"cma": "cma", "nsga2": "pymoo", "cma_me": "ribs", "cma_mega": "ribs"}


class SobolSample(Optimizer):
    """Points of one Sobol sequence, starting with the published gait: the baseline for all methods."""

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        self._batch, self._first = batch, space.first
        self._points, self._begun = qmc.Sobol(space.dimensions, rng=np.random.default_rng(search.sweep.seed)), False

    def ask(self) -> Asked:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # one point less than a power of two: the published gait stands for it
            if self._begun:
                return Asked(self._points.random(self._batch))
            self._begun = True
            return Asked(np.concatenate([self._first[None], self._points.random(self._batch - 1)]))

    def tell(self, found: Scores) -> None:
        """The points do not depend on it."""


def make_optimizer(search: Search, batch: int) -> Optimizer:
    """The optimizer of a search, at its beginning.

    Args:
        batch: points of a batch; some methods change it during the search.

    Raises:
        ParameterError: its library is not installed.
    """
    check_library(search.method)
    space = Space(search)
    if search.method == "sobol":
        return SobolSample(space, search, batch)
    if search.method == "cma":
        from nermo_mjx.search.evolution import Evolution

        return Evolution(space, search, batch)
    if search.method == "nsga2":
        from nermo_mjx.search.genetic import Genetic

        return Genetic(space, search, batch)
    from nermo_mjx.search.diversity import Diversity

    return Diversity(space, search, batch)


def check_library(method: str) -> None:
    """Raises `ParameterError` unless what a method needs is installed."""
    library = LIBRARIES.get(method)
    if library is not None and importlib.util.find_spec(library) is None:
        raise ParameterError(f"method is {method}, which needs {library}: pip install 'nermo-mjx[search]'.")


def made_by(method: str) -> str:
    """Name and version of what chooses the points, for the table's metadata."""
    library = LIBRARIES.get(method, "scipy")
    return f"{library} {importlib.metadata.version(library)}"
