"""The rows of a sweep: which values each run gets. They depend on the sweep alone, never on chunks, order or engine."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.stats import qmc

from nermo_mjx.sweep.spec import Sweep


@dataclasses.dataclass(frozen=True)
class Rows:
    """Columns of equal length n, one entry a run.

    Attributes:
        variant: index of the variant, (n,) int.
        repeat: index of the repeat within its variant, (n,) int.
        seed: seed of the row's random draws, (n,) int below 2^53 (exact in JSON).
        values: varied and randomized parameters, name -> (n,) float.
    """

    variant: np.ndarray
    repeat: np.ndarray
    seed: np.ndarray
    values: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.variant)

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, in that order."""
        values = {name: column[index] for name, column in self.values.items()}
        return Rows(self.variant[index], self.repeat[index], self.seed[index], values)


def sample(sweep: Sweep) -> Rows:
    """All rows of a sweep, repeats of a variant side by side.

    A grid runs through the product of its axes, the last one fastest. Sobol and Latin hypercube points come from
    `scipy.stats.qmc`, scrambled with the sweep's seed. The draws of a row are seeded by (seed, variant, repeat).
    """
    points = _grid(sweep) if sweep.sampler == "grid" else _low_discrepancy(sweep)
    variant = np.repeat(np.arange(sweep.variants), sweep.repeats)
    repeat = np.tile(np.arange(sweep.repeats), sweep.variants)
    seed = np.array([_row_seed(sweep.seed, *row) for row in zip(variant.tolist(), repeat.tolist(), strict=True)])
    values = {name: column[variant] for name, column in points.items()}
    if sweep.draws:
        shares = np.stack([np.random.default_rng(each).random(len(sweep.draws)) for each in seed.tolist()])
        values |= {draw.name: draw.at(shares[:, i]) for i, draw in enumerate(sweep.draws)}
    return Rows(variant, repeat, seed, values)


def _grid(sweep: Sweep) -> dict[str, np.ndarray]:
    mesh = np.meshgrid(*(axis.values() for axis in sweep.axes), indexing="ij")
    return {axis.name: column.ravel() for axis, column in zip(sweep.axes, mesh, strict=True)}


def _low_discrepancy(sweep: Sweep) -> dict[str, np.ndarray]:
    dimensions, rng = len(sweep.axes), np.random.default_rng(sweep.seed)
    if sweep.sampler == "sobol":
        # A power of two keeps the sequence balanced; its first points are the sample.
        exponent = max(sweep.samples - 1, 0).bit_length()
        shares = qmc.Sobol(dimensions, rng=rng).random_base2(exponent)[: sweep.samples]
    else:
        shares = qmc.LatinHypercube(dimensions, rng=rng).random(sweep.samples)
    return {axis.name: axis.at(shares[:, i]) for i, axis in enumerate(sweep.axes)}


def _row_seed(*entropy: int) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(11))
