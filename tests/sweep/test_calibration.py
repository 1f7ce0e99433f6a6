# Tests of sweep/comparing.py, sweep/counting.py
"""How often intervals hold the truth, how many findings are false, and how many differences are found, on data whose
truth is known. The table of docs/comparisons.md is made here: python tests/sweep/test_calibration.py."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from nermo_mjx import compare
from nermo_mjx.sweep.counting import two_stage
from nermo_mjx.sweep.table import Columns

PAGE = Path(__file__).parents[2] / "docs" / "comparisons.md"
VARIANTS, REPEATS, RATIOS = (1, 2, 3, 4, 8, 16), (2, 4, 16), (0.3, 1.0, 3.0)
NOISES = ("normal noise", "skewed noise", "skewed differences")
#: Data sets of each entry of the table: their share has a standard error of 0.004.
TRIALS = 3000
#: Of one variant, the runs of two sides without common seeds.
UNBALANCED = ((2, 3), (2, 16), (4, 8), (4, 16), (8, 16))


def covered(interval, truth=0.0) -> float:
    """The share of intervals that hold the truth."""
    return float(np.mean((interval.low <= truth) & (truth <= interval.high)))


def pairs(
    rng: np.random.Generator, variants: int, repeats: int, ratio: float, noise: str = "normal noise"
) -> float:
    """Coverage of the mean over variants whose true differences spread `ratio` times as far as those of a pair.

    Of one variant, the truth is its own difference. Skewed noise is exponential on both sides; skewed differences are
    so themselves, as where the noise of one side alone is skewed.
    """
    cell = np.repeat(np.arange(variants), repeats)
    apart = ratio * rng.normal(size=(variants, TRIALS))
    shape = (len(cell), TRIALS)
    pair = rng.normal(size=shape) if noise == "normal noise" else rng.exponential(size=shape) - 1
    if noise == "skewed noise":
        pair = (pair - rng.exponential(size=shape) + 1) / np.sqrt(2)
    interval = two_stage(apart[cell] + pair, cell, np.arange(variants))
    return covered(interval, apart[0] if variants == 1 else 0.0)


def sides(rng: np.random.Generator, counts: tuple[int, int], ratio: float) -> float:
    """Coverage of one variant whose two sides have no seed in common, where their noise differs by the ratio."""
    base, other_values = (
        scale * rng.normal(size=(n, TRIALS)) for n, scale in zip(counts, (1.0, ratio), strict=True)
    )
    cell = np.repeat([0, 1], counts)
    return covered(two_stage(np.concatenate([-base, other_values]), cell, np.zeros(2, int)))


@functools.cache
def coverages() -> dict[tuple, float]:
    """Coverage by what is compared."""
    rng, coverage_by_case = np.random.default_rng(51), dict[tuple, float]()
    for variants in VARIANTS:
        for noise in NOISES:
            for repeats in REPEATS:
                for ratio in RATIOS:
                    coverage_by_case["pairs", variants, noise, repeats, ratio] = pairs(
                        rng, variants, repeats, ratio, noise
                    )
    for counts in UNBALANCED:
        for ratio in RATIOS:
            coverage_by_case["sides", counts, ratio] = sides(rng, counts, ratio)
    return coverage_by_case


def page() -> str:
    """The tables of the page: the first with the lowest share over the spreads of the variants, and over their numbers
    where there are several."""
    coverage_by_case, lines = coverages(), list[str]()
    lines += [
        f"| pairs of each variant | {' | '.join(map(str, REPEATS))} |",
        f"|---|{'---:|' * len(REPEATS)}",
    ]
    for noise in NOISES:
        for name, variants in (
            ("1 variant", VARIANTS[:1]),
            (f"2 to {VARIANTS[-1]} variants", VARIANTS[1:]),
        ):
            cells = [
                min(
                    coverage_by_case["pairs", n, noise, repeats, ratio]
                    for n in variants
                    for ratio in RATIOS
                )
                for repeats in REPEATS
            ]
            lines.append(f"| {name}, {noise} | {' | '.join(f'{share:.2f}' for share in cells)} |")
    lines += ["", f"| relative spread | {' | '.join(f'{ratio:g}' for ratio in RATIOS)} |"]
    lines.append(f"|---|{'---:|' * len(RATIOS)}")
    for counts in UNBALANCED:
        cells = [coverage_by_case["sides", counts, ratio] for ratio in RATIOS]
        lines.append(
            f"| {counts[0]} runs against {counts[1]} | {' | '.join(f'{share:.2f}' for share in cells)} |"
        )
    return "\n".join(lines)


@pytest.mark.release
@pytest.mark.parametrize("what", ["pairs", "sides"])
def test_intervals_hold_the_truth_as_often_as_they_say(what: str) -> None:
    """At least 93 of 100 times. More than 97 where noise dominates: it is a lower bound for the spread of few variants;
    and where few runs stand against many, whose spread they do not show. Two runs of a side that spreads three times as
    far as the three of the other hold it 92 times only: two may be alike by chance. So do differences that are skewed
    themselves within one variant, 88 to 92 times: few of them do not show their tail."""
    for key, share in coverages().items():
        if key[0] == what == "pairs":
            least = 0.87 if key[1:3] == (1, "skewed differences") else 0.93
            assert least <= share <= (0.975 if key[1] == 1 or key[4] >= 3 else 0.99), key
        elif key[0] == what:
            assert share >= (0.91 if key == ("sides", (2, 3), 0.3) else 0.93), key


def test_the_page_has_the_table_of_this_test() -> None:
    """Made by `page`; a hundredth may differ by the machine."""
    page_text = PAGE.read_text()
    table = page_text[page_text.index("| pairs of each variant") :]
    numbers, page_numbers = (
        np.array([*map(float, re.findall(r" (\d\.\d\d) \|", text))]) for text in (table, page())
    )
    assert [line.split("|")[1] for line in page().splitlines() if line] == [
        line.split("|")[1] for line in table.splitlines() if line.startswith("|")
    ]
    np.testing.assert_allclose(numbers, page_numbers, atol=0.011)


# --- through `compare`: every metric of a table is a data set of its own


def table(speeds: np.ndarray, fell: np.ndarray | None = None, common: bool = True) -> pa.Table:
    """A table of runs (variants, 2 sides, repeats) of many metrics (..., m), whose seeds may be common to the sides."""
    metrics = speeds.shape[-1]
    indices = np.indices(speeds.shape[:3]).reshape(3, -1)
    columns = Columns()
    seed = (indices[0] * 2 + (0 if common else 1) * indices[1]) * 1000 + indices[2]
    for name, values in {
        "row": np.arange(indices.shape[1]),
        "repeat": indices[2],
        "seed": seed,
    }.items():
        columns.add(name, values, "index", "1", name)
    columns.add(
        "spine",
        np.array(["none", "bending"], object)[indices[1]],
        "varied",
        "1",
        "spine",
        scale="structure",
    )
    columns.add("frequency", 0.4 + 0.001 * indices[0], "varied", "Hz", "frequency", scale="linear")
    for i, column in enumerate(speeds.reshape(-1, metrics).T):
        columns.add(f"speed{i}", column, "metric", "m/s", "speed")
    status = (
        np.full(indices.shape[1], "ok") if fell is None else np.where(fell.ravel(), "fell", "ok")
    )
    columns.add("status", status, "status", "1", "status")
    return columns.table({"sampler": "grid"})


@pytest.mark.parametrize("common", [True, False], ids=["paired", "apart"])
@pytest.mark.parametrize(("variants", "repeats"), [(1, 4), (2, 16), (3, 8), (8, 3)])
def test_a_lost_run_keeps_the_coverage(variants: int, repeats: int, common: bool) -> None:
    """One run of the base fell: with common noise ten times that of a pair, which cancels only in pairs."""
    rng, trials = np.random.default_rng(variants), 600
    shape = (variants, 2, repeats, trials)
    apart = rng.normal(size=(variants, 1, trials)) * (variants > 1)
    speeds = rng.normal(size=shape) + (
        10 * rng.normal(size=(variants, 1, repeats, trials)) if common else 0
    )
    speeds[:, 1] += 1 + apart
    fell = np.zeros(shape[:3], bool)
    fell[0, 0, 0] = True
    rows = compare(table(speeds, fell, common), by="spine").rows("bending")
    share = np.mean([row["low"] <= 1 <= row["high"] for row in rows])
    assert 0.92 <= share <= 0.99, share  # 600 data sets: a standard error of 0.009
    assert {row["runs_base"] for row in rows} == {variants * repeats - 1}
    assert {row["runs_other"] for row in rows} == {variants * repeats - common}
    if common:
        assert (
            np.median([row["high"] - row["low"] for row in rows])
            < 25 / np.sqrt(variants * repeats) * 4
        )


@pytest.mark.parametrize(("groups", "families"), [(10, 80), (150, 12), (1000, 3)])
def test_findings_are_as_many_and_as_true_as_scipys(groups: int, families: int) -> None:
    """A tenth of the groups differ: against paired t tests adjusted by Benjamini and Hochberg."""
    rng, repeats = np.random.default_rng(groups), 8
    speeds = rng.normal(size=(groups, 2, repeats, families))
    real = np.arange(groups) % 10 == 0
    speeds[real, 1] += 3.0
    comparison = compare(table(speeds), by="spine", groups=["frequency"])
    ours = np.full((groups, families), False)
    for row in comparison.rows("bending", grouped=True):
        ours[row["group"], int(row["metric"].removeprefix("speed"))] = row["beyond_noise"]
    p = stats.ttest_rel(speeds[:, 1], speeds[:, 0], axis=1).pvalue
    expected = stats.false_discovery_control(p, axis=0) <= 0.05
    assert ours[real].sum() >= 0.9 * expected[real].sum() > 0
    false = ours[~real].sum(axis=0) / np.maximum(ours.sum(axis=0), 1)
    assert false.mean() <= 0.05 + 2 * false.std() / np.sqrt(families)
    nothing = compare(table(speeds[~real]), by="spine", groups=["frequency"])
    any_of = {row["metric"] for row in nothing.rows("bending", grouped=True) if row["beyond_noise"]}
    assert len(any_of) <= 0.05 * families + 2 * np.sqrt(0.05 * families)


@pytest.mark.parametrize("groups", [120, 150, 1000])
def test_a_lone_difference_is_found_among_any_number_of_groups(groups: int) -> None:
    """5 m/s with a noise of 0.01 m/s, in one group: a share of resamples could not be small enough to tell it."""
    speeds = 0.01 * np.random.default_rng(0).normal(size=(groups, 2, 8, 1))
    speeds[70, 1] += 5.0
    rows = compare(table(speeds), by="spine", groups=["frequency"]).rows("bending", grouped=True)
    assert [row["group"] for row in rows if row["beyond_noise"]] == [70]
    assert rows[70]["p"] == pytest.approx(
        stats.ttest_rel(speeds[70, 1, :, 0], speeds[70, 0, :, 0]).pvalue
    )


if __name__ == "__main__":
    print(page())


@pytest.mark.parametrize("runs", [2, 3, 4])
def test_ties_of_a_metric_with_steps_do_not_make_a_certain_mean(runs: int) -> None:
    """Normal noise rounded to its standard deviation: two equal values were an interval without width in 27 of 100."""
    values = np.round(np.random.default_rng(0).normal(0.3, 1.0, (runs, TRIALS)))
    steps = np.arange(-8, 10)
    truth = float(np.sum(steps * (stats.norm.cdf(steps + 0.2) - stats.norm.cdf(steps - 0.8))))
    interval = two_stage(values, np.zeros(runs, int), np.zeros(1, int))
    assert covered(interval, truth) > 0.92
    # Equal differences of a metric without steps are certain: the observed values tell its resolution.
    observed = np.random.default_rng(1).normal(size=(50, 1))
    certain = two_stage(np.zeros((2, 1)), np.zeros(2, int), np.zeros(1, int), None, observed)
    assert certain.high[0] - certain.low[0] < 0.5
