"""Which runs are compared with which: variants that both sides have, groups of them, and seeds that both share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.sweep.comparing.arms import Arm, Value, absent, check_name, shown
from nermo_mjx.sweep.comparing.bootstrap import Interval, two_stage
from nermo_mjx.sweep.results import HELD


@dataclasses.dataclass(frozen=True)
class Side:
    """The runs of one side in common variants.

    Attributes:
        arm: those runs, (n,).
        variant: the common variant of each, (n,), from 0.
        seed: of its random draws, (n,).
    """

    arm: Arm
    variant: np.ndarray
    seed: np.ndarray

    def take(self, chosen: np.ndarray) -> Side:
        """The runs where a mask holds."""
        return Side(self.arm.take(chosen), self.variant[chosen], self.seed[chosen])


@dataclasses.dataclass(frozen=True)
class Pairing:
    """Two sides over common variants.

    A key that one side lacks, because nothing reads it there, does not distinguish variants: on the other side all its
    runs are averaged, or in groups by this key those of one value.

    Attributes:
        base, other: their runs.
        variants: how many there are in common.
        values: the keys of the common variants, name -> (variants,).
        alone: keys that one side has alone.
        notes: what is averaged or left out, in sentences.
    """

    base: Side
    other: Side
    variants: int
    values: Mapping[str, np.ndarray]
    alone: tuple[str, ...]
    notes: tuple[str, ...]

    def groups(self, names: Sequence[str]) -> Iterator[tuple[dict[str, Value], Pairing]]:
        """One pairing for each combination of values of some keys."""
        label = np.zeros(self.variants, int)
        for name in names:
            check_name(name, [*self.values, *self.alone], "for")
            if name in self.alone:
                continue
            code = _codes(self.values[name])
            label = np.unique(label * (code.max(initial=0) + 1) + code, return_inverse=True)[1]
        for each in np.unique(label):
            here = label == each
            first = int(here.argmax())
            sides = (side.take(here[side.variant]) for side in (self.base, self.other))
            whole = dataclasses.replace(self, base=next(sides), other=next(sides))
            known = {name: self.values[name][first].item() for name in names if name in self.values}
            for values, part in whole._by_value([name for name in names if name in self.alone]):
                yield {name: (known | values)[name] for name in names}, part

    def _by_value(self, names: Sequence[str]) -> Iterator[tuple[dict[str, Value], Pairing]]:
        """One pairing for each combination of values of keys that one side has alone."""
        if not names:
            yield {}, self
            return
        of_base = not absent(self.base.arm.keys[names[0]]).all()
        own = self.base if of_base else self.other
        column = own.arm.keys[names[0]]
        for value in np.unique(column[~absent(column)]):
            kept = own.take(column == value)
            part = dataclasses.replace(self, base=kept) if of_base else dataclasses.replace(self, other=kept)
            for more, smallest in part._by_value(names[1:]):
                yield {names[0]: value.item(), **more}, smallest


def pair(base: Arm, other: Arm) -> Pairing:
    """Match the variants of two sides by their keys; what only one side has is left out.

    Raises:
        ParameterError: they have no variant in common.
    """
    names = list(dict.fromkeys((*base.keys, *other.keys)))
    base, other = (_with_keys(arm, names) for arm in (base, other))
    codes, notes = (np.zeros(len(base.rows), int), np.zeros(len(other.rows), int)), list[str]()
    values: dict[str, np.ndarray] = {}
    alone: list[str] = []
    split = len(base.rows)
    for name in names:
        sides = [arm.keys[name] for arm in (base, other)]
        lacking = [bool(absent(side).all()) for side in sides]
        if any(lacking):
            if not all(lacking):
                one = base if lacking[1] else other
                alone.append(name)
                notes.append(f"{name} varies in {one.name} alone, and is averaged there, but for groups by it.")
            continue
        joined = np.concatenate(sides)
        values[name] = joined
        code = _codes(joined)
        both = np.unique(np.concatenate(codes) * (code.max(initial=0) + 1) + code, return_inverse=True)[1]
        codes = both[:split], both[split:]
    common = np.intersect1d(*codes)
    if not len(common):
        raise ParameterError(f"{base.name} and {other.name} have no variant in common: {_apart(base, other)}")
    everything = np.concatenate(codes)
    place = np.full(int(everything.max()) + 1, -1)
    place[common] = np.arange(len(common))
    variants = [place[code] for code in codes]
    for arm, variant, code in zip((base, other), variants, codes, strict=True):
        if len(left := np.setdiff1d(code, common)):
            notes.append(f"{len(left):,} variants are in {arm.name} alone, and left out "
                         f"({int((variant < 0).sum()):,} runs).")  # fmt: skip
    _, first = np.unique(everything, return_index=True)
    first = first[np.isin(everything[first], common)]
    known = all("seed" in arm.results.schema.names for arm in (base, other))
    seeds = (arm.column("seed") if known else np.full(len(arm.rows), i) for i, arm in enumerate((base, other)))
    paired = [Side(arm.take(at >= 0), at[at >= 0], seed[at >= 0])
             for arm, at, seed in zip((base, other), variants, seeds, strict=True)]  # fmt: skip
    kept = {name: column[first] for name, column in values.items()}
    return Pairing(paired[0], paired[1], len(common), kept, tuple(alone), tuple(notes))


@dataclasses.dataclass(frozen=True)
class Differences:
    """The difference between the sides, metric by metric, (m,) each.

    Attributes:
        names: the metrics.
        base, other: means over the variants.
        known_base: whether the base's mean is beyond its noise, so that something is relative to it.
        interval: of the difference, other minus base.
        variants: that have a number on both sides.
        runs_base, runs_other: runs with a number, in these variants.
    """

    names: tuple[str, ...]
    base: np.ndarray
    other: np.ndarray
    known_base: np.ndarray
    interval: Interval
    variants: np.ndarray
    runs_base: np.ndarray
    runs_other: np.ndarray


#: A metric, its means and whether the base's is known, counts as in `Differences`, and its interval.
_Found = tuple[str, tuple[float, float, float], tuple[int, int, int], Interval]
#: Metrics that say what became of a run; all runs have them.
OF_ALL_RUNS = ("fell", "diverged")


def differences(pairing: Pairing, metrics: Sequence[str]) -> Differences:
    """Compare the metrics of a pairing. Failed runs count in `fell` and `diverged` alone."""
    sides = (pairing.base, pairing.other)
    well = [side.arm.results.well[side.arm.rows] for side in sides]
    found: list[_Found] = []
    at_once = max(1, HELD // max(len(pairing.base.seed) + len(pairing.other.seed), 1))
    for start in range(0, len(metrics), at_once):
        names = metrics[start : start + at_once]
        columns = [{name: column[side.arm.rows] for name, column in side.arm.results.columns(names)} for side in sides]
        masks = {name: [np.isfinite(column[name]) & (good | (name in OF_ALL_RUNS))
                        for column, good in zip(columns, well, strict=True)] for name in names}  # fmt: skip
        alike: dict[bytes, list[str]] = {}
        for name, mask in masks.items():
            alike.setdefault(b"".join(each.tobytes() for each in mask), []).append(name)
        for few in alike.values():
            numbers = [np.stack([column[name] for name in few], axis=1) for column in columns]
            found += _compare(sides, numbers, masks[few[0]], few)
    found.sort(key=lambda each: metrics.index(each[0]))
    intervals = [each[3] for each in found]
    joined = Interval(*(np.concatenate([getattr(each, field.name) for each in intervals])
                        for field in dataclasses.fields(Interval)))  # fmt: skip
    base, other, known = np.array([each[1] for each in found]).reshape(-1, 3).T
    counts = np.array([each[2] for each in found]).reshape(-1, 3).T
    return Differences(tuple(each[0] for each in found), base, other, known > 0, joined, *counts)


def _compare(
    sides: tuple[Side, Side], numbers: list[np.ndarray], masks: list[np.ndarray], names: list[str]
) -> Iterator[_Found]:
    """Metrics of which the same runs have a number."""
    kept = [side.take(mask) for side, mask in zip(sides, masks, strict=True)]
    numbers = [each[mask] for each, mask in zip(numbers, masks, strict=True)]
    both = np.intersect1d(kept[0].variant, kept[1].variant)
    inside = [np.isin(side.variant, both) for side in kept]
    kept = [side.take(mask) for side, mask in zip(kept, inside, strict=True)]
    numbers = [each[mask] for each, mask in zip(numbers, inside, strict=True)]
    variant = [np.searchsorted(both, side.variant) for side in kept]
    if not len(both):
        nothing = Interval(*(np.full(1, np.nan) for _ in range(4)))
        yield from ((name, (np.nan, np.nan, 0.0), (0, 0, 0), nothing) for name in names)
        return
    order = _shared_seeds(kept, variant)
    if order is None:  # each variant has a cell of either side
        cell, values = np.concatenate([variant[0], variant[1] + len(both)]), np.concatenate([-numbers[0], numbers[1]])
        owner = np.tile(np.arange(len(both)), 2)
    else:  # runs with the same seed are paired: what they share cancels in the difference
        cell, values, owner = variant[0][order[0]], numbers[1][order[1]] - numbers[0][order[0]], np.arange(len(both))
    interval = two_stage(values, cell, owner)
    means = [_mean_of_means(each, at, len(both)) for each, at in zip(numbers, variant, strict=True)]
    counts = (len(both), len(variant[0]), len(variant[1]))
    known = np.abs(means[0]) > 2 * numbers[0].std(axis=0) / np.sqrt(len(numbers[0]))
    for i, name in enumerate(names):
        own = Interval(*(getattr(interval, field.name)[i : i + 1] for field in dataclasses.fields(Interval)))
        yield name, (float(means[0][i]), float(means[1][i]), float(known[i])), counts, own


def _shared_seeds(sides: list[Side], variant: list[np.ndarray]) -> list[np.ndarray] | None:
    """The orders in which the runs of both sides pair by variant and seed; None where any seed is on one side alone."""
    order = [np.lexsort((side.seed, at)) for side, at in zip(sides, variant, strict=True)]
    keys = [np.stack([at[index], side.seed[index]]) for side, at, index in zip(sides, variant, order, strict=True)]
    once = keys[0].shape[1] == np.unique(keys[0], axis=1).shape[1]
    return order if once and np.array_equal(keys[0], keys[1]) else None


def _mean_of_means(values: np.ndarray, variant: np.ndarray, variants: int) -> np.ndarray:
    """Mean over the variants of the means of their runs (n, m), (m,)."""
    total = np.zeros((variants, values.shape[1]))
    np.add.at(total, variant, values)
    mean: np.ndarray = (total / np.bincount(variant, minlength=variants)[:, None]).mean(axis=0)
    return mean


def _with_keys(arm: Arm, names: Sequence[str]) -> Arm:
    """The runs with a key for each of the names, absent where they have none."""
    return dataclasses.replace(arm, keys={name: np.full(len(arm.rows), np.nan) for name in names} | dict(arm.keys))


def _codes(values: np.ndarray) -> np.ndarray:
    """A whole number for each different value: numbers by their order, names in the order in which they come."""
    _, first, code = np.unique(values, return_index=True, return_inverse=True)
    codes: np.ndarray = np.argsort(np.argsort(first))[code] if values.dtype.kind == "U" else code
    return codes


def _apart(base: Arm, other: Arm) -> str:
    """The first key of which they share no value, in words."""
    for name, column in base.keys.items():
        here, there = (np.unique(each[~absent(each)]) for each in (column, other.keys.get(name, column)))
        if len(here) and len(there) and not len(np.intersect1d(here, there)):
            first, second = (", ".join(map(shown, each[:4].tolist())) + (", ..." if len(each) > 4 else "")
                             for each in (here, there))  # fmt: skip
            return f"{name} is {first} in the one and {second} in the other."
    return "each combination of values is in one of them alone."
