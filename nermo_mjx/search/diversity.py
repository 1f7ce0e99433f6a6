"""CMA-ME and CMA-MEGA, for an atlas: pyribs's emitters, which search for cells that are empty or can be improved."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from nermo_mjx.search.asking import Asked, Optimizer
from nermo_mjx.search.scoring import Scores, cells_of
from nermo_mjx.search.space import Space
from nermo_mjx.search.spec import Search

#: First standard deviation of CMA-ME, as a fraction of the bounds; of CMA-MEGA, of the gradients' coefficients, and the
#: length of its steps along them.
SIGMA: Final = 0.15
COEFFICIENT_SIGMA: Final = 0.2
LEARNING_RATE: Final = 0.05
EMITTERS: Final = 4
#: Value reported to an emitter for a point outside the atlas.
_WORTHLESS: Final = -1e9


class Diversity(Optimizer):
    """An `Optimizer`. The first batch is a spread of points; then the batch is divided among emitters.

    A batch of CMA-MEGA begins with one point of each emitter, of which it wants gradients, and the next batch is what
    it makes of them. A point outside of the measures' ranges, one that fell, or that breaks a constraint, is not in
    the atlas.
    """

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        with _interpreted():
            from ribs.archives import GridArchive

        self._space, self._search, self._batch = space, search, batch
        self._along = search.method == "cma_mega"
        count = int(search.options.get("emitters", EMITTERS))
        self._count = max(1, min(count, batch // (3 if self._along else 2)))
        measures = search.aim.measures
        self._archive = GridArchive(
            solution_dim=space.dimensions, dims=[each.cells for each in measures],
            ranges=[(each.low, each.high) for each in measures], seed=search.sweep.seed,
        )  # fmt: skip
        self._emitters: list[Any] = []
        self._centres = False
        self._asked = np.empty((0, space.dimensions))
        self._spreads = 0

    def ask(self) -> Asked:
        if not self._emitters:
            self._spreads += 1
            first = (self._spreads - 1) * self._batch
            self._asked = self._space.spread(first + self._batch)[first:]
            return Asked(self._asked)
        if self._centres:
            points = [emitter.ask_dqd() for emitter in self._emitters]
        else:
            points = [emitter.ask() for emitter in self._emitters]
        self._sizes = [len(each) for each in points]
        self._slope = self._space.slope(np.concatenate(points))
        self._asked = self._space.shares(np.concatenate(points))
        return Asked(self._asked, len(self._asked) if self._centres else 0)

    def tell(self, found: Scores) -> None:
        told = self._add(found)
        if not self._emitters:
            if len(self._archive):
                self._begin()
            return
        ends = np.cumsum(self._sizes)
        for emitter, begin, end in zip(self._emitters, ends - self._sizes, ends, strict=True):
            part = slice(begin, end)
            add_info = {name: values[part] for name, values in told["add_info"].items()}
            about = (self._asked[part], told["objective"][part], told["measures"][part])
            if not self._centres:
                emitter.tell(*about, add_info)
            else:
                assert found.jacobian is not None
                # A non-finite gradient is useless.
                jacobian = np.nan_to_num(found.jacobian[part], nan=0.0, posinf=0.0, neginf=0.0)
                emitter.tell_dqd(*about, jacobian * self._slope[part, None, :], add_info)
        self._centres = self._along and not self._centres

    def _add(self, found: Scores) -> dict[str, Any]:
        """Put what has a cell into the archive; what emitters are told of the whole batch."""
        inside = found.allowed & (cells_of(self._search.aim, found.measures) >= 0)
        status, value = np.zeros(len(inside), np.int32), np.full(len(inside), _WORTHLESS)
        objective = np.where(inside, found.quality, _WORTHLESS)
        measures = np.where(np.isfinite(found.measures), found.measures, 0.0)
        if inside.any():
            info = self._archive.add(self._asked[inside], objective[inside], measures[inside])
            status[inside], value[inside] = info["status"], info["value"]
        return {"objective": objective, "measures": measures, "add_info": {"status": status, "value": value}}

    def _begin(self) -> None:
        """Emitters from elites that are evenly spread over the filled cells."""
        with _interpreted():
            from ribs.emitters import EvolutionStrategyEmitter, GradientArborescenceEmitter

        elites = self._archive.data(["solution", "index"], return_type="dict")
        order = np.argsort(elites["index"])
        chosen = order[np.linspace(0, len(order) - 1, self._count).round().astype(int)]
        sizes = [len(part) for part in np.array_split(np.arange(self._batch - self._count * self._along), self._count)]
        options = self._search.options
        for i, (start, size) in enumerate(zip(elites["solution"][chosen], sizes, strict=True)):
            common = {"x0": start, "batch_size": size, "seed": self._search.sweep.seed + i + 1, "ranker": "2imp"}
            self._emitters.append(
                GradientArborescenceEmitter(
                    self._archive, sigma0=options.get("sigma", COEFFICIENT_SIGMA), grad_opt="gradient_ascent",
                    lr=options.get("learning_rate", LEARNING_RATE), **common,
                ) if self._along else EvolutionStrategyEmitter(
                    self._archive, sigma0=options.get("sigma", SIGMA), **common
                )
            )  # fmt: skip
        self._centres = self._along


@contextlib.contextmanager
def _interpreted() -> Iterator[None]:
    """Import pyribs without compiled functions: they save microseconds per batch but take ten seconds to compile."""
    import numba

    config: Any = numba.config
    before, config.DISABLE_JIT = config.DISABLE_JIT, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        config.DISABLE_JIT = before
