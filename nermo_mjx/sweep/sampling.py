"""The rows of a sweep: which values each run gets. They depend on the sweep alone, never on chunks, order or engine."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.stats import qmc

from nermo_mjx.robot import identified
from nermo_mjx.sweep.axes import Axis
from nermo_mjx.sweep.spec import Sweep

#: Rows made at once where a column of all rows is wanted.
_BLOCK = 65_536


@dataclasses.dataclass(frozen=True)
class Rows:
    """Columns of equal length n, one entry a run.

    Attributes:
        variant: index of the variant, (n,) int.
        repeat: index of the repeat within its variant, (n,) int.
        seed: seed of the row's random draws, (n,) int below 2^53 (exact in JSON).
        values: varied and randomized parameters, name -> (n,) float.
        body: index in the identified ensemble, (n,) int; None if bodies are not drawn.
    """

    variant: np.ndarray
    repeat: np.ndarray
    seed: np.ndarray
    values: dict[str, np.ndarray]
    body: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.variant)

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, in that order."""
        values = {name: column[index] for name, column in self.values.items()}
        body = None if self.body is None else self.body[index]
        return Rows(self.variant[index], self.repeat[index], self.seed[index], values, body)


class Sample:
    """All rows of a sweep, each made when it is asked for; repeats of a variant stand side by side.

    A grid runs through the product of its axes, the last one fastest. Sobol and Latin hypercube points come from
    `scipy.stats.qmc`, scrambled with the sweep's seed. The draws of a row, its body among them, are seeded by (seed,
    variant, repeat).
    A grid of millions of rows takes no memory; of a sampler, its points do: one number a variant and axis.
    """

    def __init__(self, sweep: Sweep, shares: np.ndarray | None = None) -> None:
        """
        Args:
            shares: points in the unit cube (variants, axes) instead of the sampler's, as a search asks for them.
        """
        self.sweep = sweep
        self._axes: dict[str, Axis] = {axis.name: axis for axis in sweep.axes}
        self._listed = {axis.name: axis.values() for axis in sweep.axes} if sweep.sampler == "grid" else {}
        self._shares = None if sweep.sampler == "grid" else _low_discrepancy(sweep) if shares is None else shares

    def __len__(self) -> int:
        return self.sweep.variants * self.sweep.repeats

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, (n,) int, in that order."""
        sweep, (variant, repeat) = self.sweep, self._places(index)
        pairs = zip(variant.tolist(), repeat.tolist(), strict=True)
        seed = np.array([_row_seed(sweep.seed, *pair) for pair in pairs], dtype=np.int64)
        values = {name: self._varied(name, variant) for name in self._axes}
        body = None
        drawn = len(sweep.draws) + bool(sweep.bodies)
        if drawn:
            shares = [np.random.default_rng(each).random(drawn) for each in seed.tolist()]
            columns = np.reshape(shares, (len(variant), drawn)).T
            values |= {draw.name: draw.at(column) for draw, column in zip(sweep.draws, columns, strict=False)}
            if sweep.bodies:  # after the others, which are the same with and without it
                ensemble = identified.bodies()
                body = ensemble.at(columns[-1])
                values |= ensemble.take(body)
        return Rows(variant, repeat, seed, values, body)

    def column(self, name: str) -> np.ndarray:
        """One varied or randomized parameter of all rows, (rows,)."""
        result = np.empty(len(self))
        for start in range(0, len(self), _BLOCK):
            index = np.arange(start, min(start + _BLOCK, len(self)))
            varied = name in self._axes  # the others cost a random generator a row
            result[index] = self._varied(name, self._places(index)[0]) if varied else self.take(index).values[name]
        return result

    def _places(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variant and repeat of rows."""
        variant, repeat = np.divmod(np.asarray(index, dtype=np.int64), self.sweep.repeats)
        return variant, repeat

    def _varied(self, name: str, variant: np.ndarray) -> np.ndarray:
        at = list(self._axes).index(name)
        if self._shares is not None:
            return self._axes[name].at(self._shares[variant, at])
        places = np.unravel_index(variant, [len(values) for values in self._listed.values()])
        return self._listed[name][places[at]]


def sample(sweep: Sweep) -> Rows:
    """All rows of a sweep at once; see `Sample`."""
    rows = Sample(sweep)
    return rows.take(np.arange(len(rows)))


def _low_discrepancy(sweep: Sweep) -> np.ndarray:
    """Points of a sampler in the unit cube, (variants, axes)."""
    dimensions, rng = len(sweep.axes), np.random.default_rng(sweep.seed)
    if sweep.sampler == "latin_hypercube":
        return qmc.LatinHypercube(dimensions, rng=rng).random(sweep.samples)
    # A power of two keeps the sequence balanced; its first points are the sample, and only they are kept.
    exponent = max(sweep.samples - 1, 0).bit_length()
    return qmc.Sobol(dimensions, rng=rng).random_base2(exponent)[: sweep.samples].copy()


def _row_seed(*entropy: int) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(11))
