"""The rows of a sweep: which values each run gets. They depend on the sweep alone, never on chunks, order or engine."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
from scipy.stats import qmc

from nermo_mjx.robot import identified
from nermo_mjx.specs.walk import unread
from nermo_mjx.sweep.axes import Axis, saltelli_points
from nermo_mjx.sweep.spec import Sweep

#: Rows made at once where a column of all rows is wanted.
_BLOCK = 65_536


@dataclasses.dataclass(frozen=True)
class Rows:
    """Columns of equal length n, one entry per run.

    Attributes:
        variant: index of the variant, (n,) int.
        repeat: index of the repeat within its variant, (n,) int.
        seed: seed of the row's random draws, (n,) int below 2^53 (exact in JSON).
        values: varied and randomized parameters, name -> (n,) float; NaN where the row's structure does not read one.
        structure: place of the row's structure in the sweep's, (n,) int.
        body: index in the identified ensemble, (n,) int; None if bodies are not drawn.
    """

    variant: np.ndarray
    repeat: np.ndarray
    seed: np.ndarray
    values: dict[str, np.ndarray]
    structure: np.ndarray
    body: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.variant)

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, in that order; a mask will do, too."""
        values = {name: column[index] for name, column in self.values.items()}
        body = None if self.body is None else self.body[index]
        fixed = (self.variant[index], self.repeat[index], self.seed[index])
        return Rows(*fixed, values, self.structure[index], body)


class Sample:
    """All rows of a sweep, each made on demand; repeats of a variant are adjacent.

    Structures run slowest. For each of them a grid runs through the product of its axes, the last one fastest. Sobol
    and Latin hypercube points come from `scipy.stats.qmc`, scrambled with the sweep's seed, and are the same for all
    structures. The draws of a row, its body among them, are seeded by the sweep's seed, the repeat, and the varied
    parameters: not by the structure, so that runs of two structures have the same draws and can be compared one by one.
    A grid of millions of rows takes no memory; of a sampler, its points do: one number per variant and axis.
    """

    def __init__(self, sweep: Sweep, shares: np.ndarray | None = None) -> None:
        """
        Args:
            shares: points in the unit cube (variants, axes) instead of the sampler's, as a search asks for them.
        """
        self.sweep = sweep
        self._axes: dict[str, Axis] = {axis.name: axis for axis in sweep.axes}
        self._listed = {axis.name: axis.listed() for axis in sweep.axes} if sweep.sampler == "grid" else {}
        self._ends = np.cumsum(sweep.counts) if shares is None else np.array([len(shares)])
        dimensions, rng = len(sweep.axes), np.random.default_rng(sweep.seed)
        if shares is None and sweep.sampler == "saltelli":
            shares = saltelli_points(dimensions, sweep.samples, sweep.second_order, sweep.seed)
        elif shares is None and sweep.sampler == "latin_hypercube":
            shares = qmc.LatinHypercube(dimensions, rng=rng).random(sweep.samples)
        elif shares is None and sweep.sampler == "sobol":
            # A power of two keeps the sequence balanced; its first points are the sample, and only they are kept.
            exponent = max(sweep.samples - 1, 0).bit_length()
            shares = qmc.Sobol(dimensions, rng=rng).random_base2(exponent)[: sweep.samples].copy()
        self._shares = shares
        self._read = [[axis.name for axis in sweep.read_axes(structure)] for structure in sweep.structures]
        self._unread = [
            {name for name in (*sweep.varied, *(draw.name for draw in sweep.draws)) if unread(structure.setup, name)}
            for structure in sweep.structures
        ]

    def __len__(self) -> int:
        return self.sweep.variants * self.sweep.repeats

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, (n,) int, in that order."""
        sweep, (variant, repeat) = self.sweep, self._places(index)
        structure = self._structure_of(variant)
        points = {name: self._point(name, variant, structure) for name in sweep.varied}
        seed = self._seeds(variant, repeat, points)
        values = {name: self._masked(name, points[name], structure) for name in sweep.varied}
        body = None
        drawn = len(sweep.draws) + bool(sweep.bodies)
        if drawn:
            shares = [np.random.default_rng(each).random(drawn) for each in seed.tolist()]
            columns = np.reshape(shares, (len(variant), drawn)).T
            for draw, column in zip(sweep.draws, columns, strict=False):
                value = np.where(repeat == 0, 0.0, draw.at(column)) if draw.implied else draw.at(column)
                values[draw.name] = self._masked(draw.name, value, structure)
            if sweep.bodies:  # after the others, which are the same with and without it
                ensemble = identified.bodies()
                body = ensemble.at(columns[-1])
                values |= ensemble.take(body)
        return Rows(variant, repeat, seed, values, structure, body)

    def column(self, name: str) -> np.ndarray:
        """One varied or randomized parameter of all rows, (rows,)."""
        result = np.empty(len(self))
        for start in range(0, len(self), _BLOCK):
            index = np.arange(start, min(start + _BLOCK, len(self)))
            if name in self.sweep.varied:  # the others cost a random generator a row
                variant = self._places(index)[0]
                structure = self._structure_of(variant)
                result[index] = self._masked(name, self._point(name, variant, structure), structure)
            else:
                result[index] = self.take(index).values[name]
        return result

    def structures(self) -> np.ndarray:
        """Place of the structure of each row in the sweep's, (rows,) int."""
        if len(self._ends) == 1:
            return np.zeros(len(self), int)
        return self._structure_of(self._places(np.arange(len(self)))[0])

    def _places(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variant and repeat of rows."""
        variant, repeat = np.divmod(np.asarray(index, dtype=np.int64), self.sweep.repeats)
        return variant, repeat

    def _structure_of(self, variant: np.ndarray) -> np.ndarray:
        if self.sweep.rows is not None:
            return self.sweep.rows.structure[variant]
        return np.searchsorted(self._ends, variant, side="right")

    def _point(self, name: str, variant: np.ndarray, structure: np.ndarray) -> np.ndarray:
        """A varied parameter where the variants are, NaN where the grid has no such axis for a structure."""
        if self.sweep.rows is not None:
            return self.sweep.rows.values[name][variant]
        local = variant - np.concatenate([[0], self._ends])[structure]
        if self._shares is not None:
            return self._axes[name].at(self._shares[local, list(self._axes).index(name)])
        result = np.full(len(variant), np.nan)
        for at in np.unique(structure):
            names, here = self._read[at], structure == at
            if name in names:
                places = np.unravel_index(local[here], [len(self._listed[each]) for each in names])
                result[here] = self._listed[name][places[names.index(name)]]
        return result

    def _masked(self, name: str, values: np.ndarray, structure: np.ndarray) -> np.ndarray:
        """Values, NaN where nothing reads them."""
        blind = [at for at, names in enumerate(self._unread) if name in names]
        return np.where(np.isin(structure, blind), np.nan, values) if blind else values

    def _seeds(self, variant: np.ndarray, repeat: np.ndarray, points: dict[str, np.ndarray]) -> np.ndarray:
        """Seeds of rows, (n,) int."""
        names = sorted(points)
        table = np.column_stack([points[name] + 0.0 for name in names]) if names else np.empty((len(variant), 0))
        known, seeds = ~np.isnan(table), np.empty(len(variant), np.int64)
        for i, each in enumerate(repeat.tolist()):
            content = zip(names, table[i].tolist(), known[i], strict=True)
            text = [f"{self.sweep.seed} {each}", *(f"{name} {value!r}" for name, value, there in content if there)]
            digest = hashlib.blake2b(" ".join(text).encode(), digest_size=8).digest()
            seeds[i] = int.from_bytes(digest, "little") >> 11
        return seeds


def sample(sweep: Sweep) -> Rows:
    """All rows of a sweep at once; see `Sample`."""
    rows = Sample(sweep)
    return rows.take(np.arange(len(rows)))
