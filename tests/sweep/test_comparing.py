# Tests of sweep/comparing.py
"""Comparisons: pairing, intervals against numpy, SciPy and simulation, what is beyond noise, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from command import call, json_of
from fakes.sweep_fake import FakeSimulator
from matplotlib.text import Text
from scipy import stats

from nermo_mjx import ParameterError, compare, read_table, run_sweep
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep import Sweep
from nermo_mjx.sweep.comparing import figures_of_comparison
from nermo_mjx.sweep.counting import two_stage
from nermo_mjx.sweep.table import Columns

GAITS, SPINES, FREQUENCIES = (
    ("trot", "walking_trot", "lateral_walk"),
    ("none", "stride_extension"),
    (0.4, 0.6, 0.8),
)
#: Share by which the spine makes each gait faster.
GAIN = {"trot": 0.2, "walking_trot": 0.0, "lateral_walk": -0.1}
RANDOM = {
    "spine": "stride_extension",
    "plots": False,
    "vary": {"frequency": [0.5, 0.9], "spine.amplitude": [0.0, 0.4]},
    "randomize": {"repeats": 12, "contact.friction": {"uniform": [0.9, 1.1]}},
}


def table(
    repeats: int = 8, noise: float = 0.02, seeds: str = "own", fell: tuple[str, ...] = ()
) -> pa.Table:
    """A table over gait, spine and frequency, whose columns of names are as those of a sweep over structures."""
    rng, rows = np.random.default_rng(1), []
    for gait in GAITS:
        for spine in SPINES:
            for frequency in FREQUENCIES:
                rows += [(gait, spine, frequency, repeat) for repeat in range(repeats)]
    gaits, spines, frequencies, repeat = (np.array(column) for column in zip(*rows, strict=True))
    gain = np.where(spines == "none", 0.0, [GAIN[gait] for gait in gaits])
    # What runs of one seed share: as large as all else.
    common = {key: rng.normal() for key in {(g, f, r) for g, _, f, r in rows}}
    shared = np.array([common[g, f, r] for g, _, f, r in rows]) if seeds == "shared" else 0.0
    speed = 0.1 * frequencies * (1 + gain) + noise * 0.1 * (
        rng.normal(size=len(rows)) + 10 * shared
    )
    status = np.where(np.isin(gaits, fell) & (spines != "none") & (repeat == 0), "fell", "ok")
    index_of_key = {key: i for i, key in enumerate(common)}
    seed = (
        np.arange(len(rows))
        if seeds == "own"
        else np.array([index_of_key[g, f, r] for g, _, f, r in rows])
    )
    columns = Columns()
    for name, values in {"row": np.arange(len(rows)), "repeat": repeat, "seed": seed}.items():
        columns.add(name, values, "index", "1", name)
    for name, values in {"gait": gaits, "spine": spines}.items():
        columns.add(name, values, "varied", "1", name, scale="structure")
    columns.add("frequency", frequencies, "varied", "Hz", "frequency", scale="linear")
    columns.add("speed", np.where(status == "ok", speed, 0.0), "metric", "m/s", "speed")
    columns.add("slip", rng.normal(size=len(rows)), "metric", "m", "slip")
    shake = np.where(spines == "none", 2.0, 1.0) + 0.01 * rng.normal(size=len(rows))
    columns.add("shake", shake, "metric", "rad", "a custom metric", better="low")
    columns.add("fell", (status == "fell").astype(float), "metric", "1", "fell")
    columns.add("status", status, "status", "1", "status")
    return columns.table({"sampler": "grid"})


def speed_of(comparison, **group):
    """The line on the speed of one group."""
    rows = [
        row
        for row in comparison.rows(comparison.others[0], grouped=True)
        if row["metric"] == "speed"
    ]
    return next(row for row in rows if all(row[name] == value for name, value in group.items()))


def test_what_helps_is_found_where_it_helps_and_nowhere_else() -> None:
    """The trot gains 20 %, the lateral walk loses 10 %, the walking trot neither; each is within its interval."""
    comparison = compare(table(), by="spine", groups=["gait", "frequency"])
    assert (comparison.base, comparison.others) == ("none", ("stride_extension",))
    for gait, gain in GAIN.items():
        for frequency in FREQUENCIES:
            row = speed_of(comparison, gait=gait, frequency=frequency)
            assert row["beyond_noise"] == (gain != 0), row
            assert row["difference"] == pytest.approx(0.1 * frequency * gain, abs=0.003)
            assert row["relative"] == pytest.approx(row["difference"] / row["base_mean"])
            assert (row["variants"], row["runs_base"], row["runs_other"]) == (1, 8, 8)
    overall = comparison.about()["metrics"]
    assert overall["shake"]["beyond_noise"]
    assert overall["shake"]["better"] == "low"
    assert not overall["slip"]["beyond_noise"]


def test_differences_are_means_over_variants_of_differences_of_means() -> None:
    """As pandas-free NumPy has them from the table, whatever the order of its rows."""
    data = table(repeats=3)
    comparison_row = compare(
        data.take(np.random.default_rng(0).permutation(data.num_rows)), by="spine", groups=["gait"]
    )
    columns = {
        name: data.column(name).to_numpy() for name in ("gait", "spine", "frequency", "speed")
    }

    def mean(gait: str, spine: str, frequency: float) -> float:
        is_selected = (
            (columns["gait"] == gait)
            & (columns["spine"] == spine)
            & (columns["frequency"] == frequency)
        )
        return float(columns["speed"][is_selected].mean())

    for gait in GAITS:
        differences = [
            mean(gait, SPINES[1], frequency) - mean(gait, SPINES[0], frequency)
            for frequency in FREQUENCIES
        ]
        row = speed_of(comparison_row, gait=gait)
        assert row["difference"] == pytest.approx(np.mean(differences))
        assert row["low"] < row["difference"] < row["high"]


@pytest.mark.parametrize(
    ("variants", "repeats", "spread"),
    [(1, 3, 0.0), (1, 10, 0.0), (6, 4, 0.0), (6, 4, 2.0), (30, 2, 0.5)],
)
def test_intervals_hold_the_truth_in_95_of_100_cases(
    variants: int, repeats: int, spread: float
) -> None:
    """Of 600 drawn experiments with known difference; `spread` is that of the variants over that of the repeats."""
    trials, rng = 600, np.random.default_rng(5)
    effect = 1 + spread * rng.normal(size=(variants, trials))
    values = [
        sign * ((effect[v] if sign > 0 else 0) + rng.normal(size=(repeats, trials)))
        for sign in (-1, 1)
        for v in range(variants)
    ]
    cell = np.repeat(np.arange(2 * variants), repeats)
    interval = two_stage(np.concatenate(values), cell, np.tile(np.arange(variants), 2))
    covered = np.mean((interval.low <= 1) & (interval.high >= 1))
    assert 0.91 <= covered <= 0.99
    false = np.mean(
        two_stage(
            np.concatenate(values) - np.repeat([0, 1], len(cell) // 2)[:, None],
            cell,
            np.tile(np.arange(variants), 2),
        ).p
        <= 0.05
    )
    assert false <= 0.09


def test_one_variant_of_many_repeats_has_scipys_interval() -> None:
    """There the second stage is all there is: the percentile interval of `scipy.stats.bootstrap`."""
    sample = np.random.default_rng(2).exponential(size=300)
    interval = two_stage(sample[:, None], np.zeros(300, int), np.zeros(1, int))
    expected = stats.bootstrap(
        (sample,), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert (interval.low[0], interval.high[0]) == pytest.approx(tuple(expected), abs=0.02)
    assert interval.p[0] < 0.001


def test_a_mean_of_very_many_variants_has_the_normal_interval() -> None:
    """Its standard error is that of the variants' means, whatever the noise of their runs."""
    variants, rng = 12_000, np.random.default_rng(4)
    values = rng.normal(0.5, 1.0, (2 * variants, 2))
    interval = two_stage(values, np.repeat(np.arange(variants), 2), np.arange(variants))
    means = values.reshape(variants, 2, 2).mean(axis=1)
    half = 1.96 * means.std(axis=0, ddof=1) / np.sqrt(variants)
    np.testing.assert_allclose(interval.estimate, means.mean(axis=0))
    np.testing.assert_allclose(interval.high - interval.low, 2 * half, rtol=0.05)


def test_runs_of_one_seed_are_compared_with_each_other() -> None:
    """Their common part cancels: the interval is several times narrower than without."""
    data = table(seeds="shared")
    column_index = data.schema.get_field_index("seed")
    without = data.set_column(
        column_index, data.schema.field("seed"), pa.array(np.arange(data.num_rows))
    )
    widths = [
        speed_of(compare(runs, by="spine", groups=["gait", "frequency"]))
        for runs in (data, without)
    ]
    paired, apart = (row["high"] - row["low"] for row in widths)
    assert paired < 0.4 * apart


def test_runs_that_fell_are_counted_and_compared_but_not_averaged() -> None:
    """One of eight repeats fell with the spine: the speed leaves it out, `fell` has it, and each line counts it."""
    comparison = compare(table(fell=("lateral_walk",)), by="spine", groups=["gait"])
    row = speed_of(comparison, gait="lateral_walk")
    assert (row["failed_base"], row["failed_other"]) == (0, 3)
    assert (row["runs_base"], row["runs_other"]) == (24, 21)
    assert row["difference"] == pytest.approx(-0.1 * 0.06, abs=0.002)
    falls = [
        row for row in comparison.rows("stride_extension", grouped=True) if row["metric"] == "fell"
    ]
    assert [row["difference"] for row in falls] == pytest.approx([0, 0, 1 / 8])
    assert comparison.status == {"none": {"ok": 72}, "stride_extension": {"fell": 3, "ok": 69}}


def changed(data: pa.Table, **columns: object) -> pa.Table:
    """A table with other values in some columns."""
    for name, values in columns.items():
        column_index = data.schema.get_field_index(name)
        data = data.set_column(
            column_index, data.schema.field(name), pa.array(values, data.schema.field(name).type)
        )
    return data


def one_less(data: pa.Table, side: str, how: str, places: int = 1) -> pa.Table:
    """A table of which some runs of a side, the first of a variant, have no speed: they fell, diverged, or lack it."""
    side_rows = np.flatnonzero(np.array(data.column("spine").to_pylist()) == side)[:places]
    speed, status = (
        data.column("speed").to_numpy().copy(),
        np.array(data.column("status").to_pylist(), object),
    )
    status[side_rows], speed[side_rows] = ("ok", np.nan) if how == "no number" else (how, 9.0)
    return changed(data, speed=speed, status=status.tolist())


@pytest.mark.parametrize("how", ["fell", "diverged", "no number"])
@pytest.mark.parametrize("side", SPINES)
def test_a_lost_run_takes_its_partner_with_it_and_no_other(side: str, how: str) -> None:
    """The difference is that of all other pairs, to the last digit, as beyond noise as before, and it is said."""
    data = table(seeds="shared")
    rows = compare(one_less(data, side, how), by="spine", groups=["gait", "frequency"])
    without_both = one_less(one_less(data, SPINES[0], how), SPINES[1], how)
    for row, expected in zip(
        rows.rows("stride_extension") + rows.rows("stride_extension", grouped=True),
        (oracle := compare(without_both, by="spine", groups=["gait", "frequency"])).rows(
            "stride_extension"
        )
        + oracle.rows("stride_extension", grouped=True),
        strict=True,
    ):
        if row["metric"] == "speed":
            for name in (
                "difference",
                "low",
                "high",
                "p",
                "beyond_noise",
                "base_mean",
                "runs_base",
                "runs_other",
            ):
                assert row[name] == expected[name], name
            assert row["paired"] == row["variants"]
    everything = rows.rows("stride_extension")[0]
    assert everything["metric"] == "speed"
    lost, whole = ("base", "other") if side == "none" else ("other", "base")
    assert (everything[f"lost_{lost}"], everything[f"lost_{whole}"]) == (pytest.approx(1 / 72), 0)
    assert (everything["left_out"], everything["runs_base"], everything["runs_other"]) == (
        1,
        71,
        71,
    )
    assert everything[f"failed_{lost}"] == (how != "no number")
    slip = rows.rows("stride_extension")[1]
    assert slip["lost_base"] + slip["lost_other"] == pytest.approx((how != "no number") / 72)
    assert rows.notes[0] == rows.lost[0]
    assert f"1 of 72 runs of {side} (1 {how})" in rows.lost[0]
    assert "may not be the same robots" in rows.lost[0]
    assert any(
        "is lost or not there: 1, of none and stride_extension" in note for note in rows.notes
    )


def test_pairs_are_those_of_common_seeds_and_others_are_said_to_be_none() -> None:
    """More repeats on one side are left out; a variant without a common seed is compared as two samples."""
    data = table(seeds="shared", noise=0.05)
    is_kept = (np.array(data.column("spine").to_pylist()) == "none") | (
        data.column("repeat").to_numpy() < 5
    )
    longer = compare(data.filter(pa.array(is_kept)), by="spine")
    row, other_row = (
        longer.rows("stride_extension")[0],
        compare(data.filter(pa.array(data.column("repeat").to_numpy() < 5)), by="spine").rows(
            "stride_extension"
        )[0],
    )
    assert (row["difference"], row["low"], row["left_out"]) == (
        other_row["difference"],
        other_row["low"],
        27,
    )
    assert any("is lost or not there: 27, of" in note for note in longer.notes)
    seed = data.column("seed").to_numpy().copy()
    alone = (np.array(data.column("gait").to_pylist()) == "lateral_walk") & (
        np.array(data.column("spine").to_pylist()) == "none"
    )
    seed[alone] += 10_000
    mixed = compare(changed(data, seed=seed), by="spine", groups=["gait", "frequency"])
    assert mixed.rows("stride_extension")[0]["paired"] == 6
    assert any("Not paired: 3 of 9 variants" in note for note in mixed.notes)
    speed = data.to_pandas().set_index(["gait", "frequency", "spine"])["speed"]
    row = speed_of(mixed, gait="lateral_walk", frequency=0.4)
    expected = stats.ttest_ind(
        speed["lateral_walk", 0.4, "stride_extension"],
        speed["lateral_walk", 0.4, "none"],
        equal_var=False,
    )
    assert row["p"] == pytest.approx(expected.pvalue)
    assert (row["low"], row["high"]) == pytest.approx(tuple(expected.confidence_interval()))
    row = speed_of(mixed, gait="trot", frequency=0.4)
    expected = stats.ttest_rel(speed["trot", 0.4, "stride_extension"], speed["trot", 0.4, "none"])
    assert row["p"] == pytest.approx(expected.pvalue)
    assert (row["low"], row["high"]) == pytest.approx(tuple(expected.confidence_interval()))


def test_runs_with_the_same_seed_count_once() -> None:
    """Each run of one side twice in the table makes nothing surer."""
    data = table(seeds="shared")
    twice = np.flatnonzero(np.array(data.column("spine").to_pylist()) == "none")
    with_repeats = data.take(np.concatenate([np.arange(data.num_rows), twice]))
    once, again = (
        compare(runs, by="spine").rows("stride_extension")[0] for runs in (data, with_repeats)
    )
    for name in ("difference", "low", "high", "p"):
        assert once[name] == pytest.approx(again[name])


def test_a_comparison_of_yes_and_no_is_no_surer_than_the_test_of_signs() -> None:
    """All four runs of a variant fell with the spine and none without: p is 1/8, and no interval has width 0."""
    data = table(repeats=4, seeds="shared")
    is_selected = (np.array(data.column("gait").to_pylist()) == "lateral_walk") & (
        data.column("frequency").to_numpy() == 0.4
    )
    fell = is_selected & (np.array(data.column("spine").to_pylist()) != "none")
    data = changed(data, fell=fell.astype(float), status=np.where(fell, "fell", "ok").tolist())
    rows = compare(data, by="spine", groups=["gait", "frequency"]).rows(
        "stride_extension", grouped=True
    )
    row = next(
        row
        for row in rows
        if (row["metric"], row["gait"], row["frequency"]) == ("fell", "lateral_walk", 0.4)
    )
    assert (row["difference"], row["p"], row["beyond_noise"]) == (1.0, 1 / 8, False)
    assert np.isnan([row["low"], row["high"]]).all()


@pytest.mark.parametrize("last", [7 * 0.1, np.nextafter(0.7, 1), np.nextafter(0.7, 0)])
def test_values_that_differ_in_their_last_digits_are_one(last: float) -> None:
    """In variants, groups and values that are compared, of one table or two."""
    data = table()
    frequency = data.column("frequency").to_numpy().copy()
    frequency[frequency == 0.6] = 0.7
    spine = np.array(data.column("spine").to_pylist())
    rounded = changed(
        data, frequency=np.where((frequency == 0.7) & (spine != "none"), last, frequency)
    )
    data = changed(data, frequency=frequency)
    for options in ({"groups": ["frequency"]}, {"where": {"frequency": 0.7}}):
        expected, actual = (
            compare(runs, by="spine", **options).table.to_pandas() for runs in (data, rounded)
        )
        expected, actual = (
            runs.drop(columns="frequency", errors="ignore") for runs in (expected, actual)
        )
        assert expected.equals(actual)
    assert compare(data, rounded).rows("table (B)")[0]["variants"] == 18
    assert compare(rounded, by="frequency").others == compare(data, by="frequency").others


def test_a_thousand_groups_take_seconds_and_say_how_far_they_are() -> None:
    """100,000 runs in 1,000 groups: the processor's time of a group is a thousandth of that of all, or less."""
    groups, runs = 1000, 100
    row_index = np.arange(groups * runs)
    columns, rng = Columns(), np.random.default_rng(0)
    for name, values in {
        "row": row_index,
        "repeat": row_index % 50,
        "seed": row_index // runs * 50 + row_index % 50,
    }.items():
        columns.add(name, values, "index", "1", name)
    columns.add(
        "spine",
        np.array(SPINES, object)[row_index // 50 % 2],
        "varied",
        "1",
        "spine",
        scale="structure",
    )
    columns.add(
        "frequency", 0.4 + 0.001 * (row_index // runs), "varied", "Hz", "frequency", scale="linear"
    )
    for name in ("speed", "slip", "shake"):
        columns.add(name, rng.normal(size=len(row_index)), "metric", "1", name)
    columns.add(
        "status", np.where(rng.random(len(row_index)) < 0.02, "fell", "ok"), "status", "1", "status"
    )
    shares: list[float] = []
    comparison = compare(
        columns.table({"sampler": "grid"}), by="spine", groups=["frequency"], progress=shares.append
    )
    assert len(comparison.rows("stride_extension", grouped=True)) == 3 * groups
    assert shares == sorted(shares)
    assert shares[0] == 0 < shares[-1] < 1


def test_the_table_fits_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 80 columns rows that say nothing and columns of less importance are left out, and named; --all has them."""
    data = table(seeds="shared")
    number = {"electrical_cost_of_transport": 1.0, "never_measured": np.nan}
    for name, value in number.items():
        field = pa.field(
            name, pa.float64(), metadata={"role": "metric", "unit": "1", "description": name}
        )
        data = data.append_column(field, pa.array(np.full(data.num_rows, value)))
    (tmp_path / "results").mkdir()
    pq.write_table(
        one_less(data, "none", "fell"), tmp_path / "results" / "part-aa-0000000000000000.parquet"
    )
    arguments = ("compare", tmp_path, "--by", "spine", "--for", "frequency")
    monkeypatch.setenv("COLUMNS", "80")
    output = call(*arguments).stdout
    rows = [
        line
        for line in output.splitlines()
        if re.match(r"(metric|speed|slip|shake|fell|frequency|─| +0\.)", line)
    ]
    assert len(rows) > 8
    assert max(map(len, rows)) <= 80
    assert output.startswith(
        "Lost for speed, electrical cost of transport: 1 of 72 runs of none (1 fell)"
    )
    assert re.search(r"^metric +unit +difference +95 % interval +.*lost", output, re.MULTILINE)
    assert re.search(r"^speed +mm/s .*1\.4 %, 0 %", output, re.MULTILINE)
    assert not re.search(r"^(never_measured|electrical_cost_of_transport)", output, re.MULTILINE)
    assert (
        "but with --all: rows equal on both sides (5); rows without a run (1); the columns none"
        in output
    )
    whole = call(*arguments, "--all").stdout
    assert re.search(r"^never_measured .*no run has it", whole, re.MULTILINE)
    assert re.search(r"^electrical_cost_of_transport ", whole, re.MULTILINE)
    assert "variants" in whole
    monkeypatch.delenv("COLUMNS")
    assert call(*arguments).stdout == whole


def test_several_values_are_each_compared_with_the_base() -> None:
    """Of the gaits, with the trot by name, over the frequencies of one spine."""
    comparison = compare(table(), by="gait", base="trot", where={"spine": "none"})
    assert (comparison.base, comparison.others) == ("trot", ("walking_trot", "lateral_walk"))
    assert [entry["other"] for entry in comparison.about()["comparisons"]] == [
        "walking_trot",
        "lateral_walk",
    ]
    assert all(
        entry["metrics"]["speed"]["variants"] == 3 for entry in comparison.about()["comparisons"]
    )


def test_a_base_may_have_a_unit() -> None:
    for base in (0.4, "0.4", "0.4 Hz"):
        assert compare(table(), by="frequency", base=base).base == "0.4"
        assert compare(table(), by="gait", where={"frequency": base}).base == "trot"
    with pytest.raises(ParameterError, match=r"^base is '0\.4 m': the table has 0\.4"):
        compare(table(), by="frequency", base="0.4 m")


def test_without_repeats_there_is_no_interval_and_a_sentence_says_so() -> None:
    """One run of one variant gives no estimate of noise; two variants do."""
    data = table(repeats=1)
    comparison = compare(data, by="spine", where={"gait": "trot", "frequency": 0.4})
    row = comparison.rows("stride_extension")[0]
    assert np.isnan(row["low"])
    assert row["beyond_noise"] is None
    assert "give repeats" in comparison.notes[0]
    assert json.loads(json.dumps(row["difference"])) > 0
    assert np.isfinite(
        compare(data, by="spine", where={"gait": "trot"}).rows("stride_extension")[0]["low"]
    )


def test_two_directories_are_paired_over_what_both_have(tmp_path: Path) -> None:
    """A sweep that fixes what the other varies is compared with that value; where it has no effect, it is averaged."""
    vary = {"frequency": [0.5, 0.7, 0.9]}
    run_sweep(RANDOM, tmp_path / "both", simulator=FakeSimulator())
    run_sweep(
        RANDOM | {"vary": vary, "set": {"spine.amplitude": 0.4}},
        tmp_path / "bent",
        simulator=FakeSimulator(),
    )
    run_sweep(
        RANDOM | {"vary": vary, "spine": "none"}, tmp_path / "stiff", simulator=FakeSimulator()
    )
    same = compare(tmp_path / "bent", tmp_path / "both")
    row = same.rows(same.others[0])[0]
    assert row["variants"] == 2
    assert abs(row["relative"]) < 0.02
    assert any("2 variants are in" in note for note in same.notes)
    comparison = compare(tmp_path / "stiff", tmp_path / "both")
    assert comparison.rows(comparison.others[0])[0]["relative"] == pytest.approx(0.1, abs=0.02)
    assert any("spine: none and stride_extension" in note for note in comparison.notes)
    assert any("spine.amplitude varies in" in note for note in comparison.notes)


def test_structures_of_a_sweep_pair_and_a_parameter_of_one_of_them_makes_groups(
    tmp_path: Path,
) -> None:
    """The stiff spine reads no amplitude: its runs stand against those of each one, in pairs where seeds are shared."""
    vary = {
        "spine": ["none", "stride_extension"],
        "frequency": [0.5, 0.9],
        "spine.amplitude": [0.2, 0.4],
    }
    spec = {key: value for key, value in RANDOM.items() if key != "spine"} | {"vary": vary}
    spec["compare"] = {"by": "spine", "for": ["spine.amplitude", "frequency"]}
    summary = run_sweep(spec, tmp_path / "both", simulator=FakeSimulator()).summary
    assert summary["rows"] == (2 + 4) * 12
    gains = {
        tuple(group["for"].values()): group["metrics"]["speed"]
        for group in summary["comparison"]["groups"]
    }
    assert set(gains) == {(0.2, 0.5), (0.2, 0.9), (0.4, 0.5), (0.4, 0.9)}
    for (amplitude, _), speed in gains.items():
        assert speed["relative"] == pytest.approx(
            amplitude / 2, abs=0.03
        )  # as the fake robot gains
        assert (speed["runs_base"], speed["runs_other"]) == (12, 12)
    alike = spec | {
        "vary": {"spine": vary["spine"], "frequency": [0.5, 0.9]},
        "compare": {"by": "spine"},
    }
    same = run_sweep(alike, tmp_path / "alike", simulator=FakeSimulator()).summary["comparison"][
        "metrics"
    ]["speed"]
    assert (
        same["difference"] == same["low"] == same["high"] == 0
    )  # the same draws, and an amplitude that is not named


@pytest.mark.release
def test_a_file_asks_for_its_comparison(tmp_path: Path) -> None:
    """Summary, table and figures have it; `plot` makes the same bytes, and it may be asked for later."""
    spec = RANDOM | {"compare": {"by": "spine.amplitude", "for": ["frequency"]}}
    run_sweep(RANDOM, tmp_path, simulator=FakeSimulator())
    result = run_sweep(
        spec | {"plots": True}, tmp_path, simulator=FakeSimulator(fail_at=0, error=AssertionError())
    )
    comparison = json.loads((tmp_path / "summary.json").read_text())["comparison"]
    assert (comparison["base"], comparison["other"]) == ("0", "0.4")
    assert [group["for"] for group in comparison["groups"]] == [
        {"frequency": 0.5},
        {"frequency": 0.9},
    ]
    assert comparison["groups"][0]["metrics"]["speed"]["relative"] == pytest.approx(0.2, abs=0.02)
    assert pq.read_table(tmp_path / "comparison.parquet").num_rows == 3 * len(comparison["metrics"])
    assert Sweep.from_file(tmp_path / "sweep.yaml").compare is not None
    assert {"differences.png", "speed-gain-by-frequency.png"} <= {
        path.name for path in result.plots
    }
    expected = compare(tmp_path, by="spine.amplitude", groups=["frequency"]).about()["metrics"][
        "speed"
    ]
    assert comparison["metrics"]["speed"] == pytest.approx(expected)


def test_the_command_prints_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """JSON as other programs rely on it, a directory that `plot` and `status` know, and tables in one file."""
    monkeypatch.delenv("COLUMNS", raising=False)  # a plain pipe gets all rows and columns
    run_sweep(RANDOM, tmp_path / "sweep", simulator=FakeSimulator())
    arguments = ("compare", tmp_path / "sweep", "--by", "spine.amplitude", "--for", "frequency")
    speed = json_of(*arguments, "--out", tmp_path / "gain")["metrics"]["speed"]
    assert speed["low"] < speed["difference"] < speed["high"]
    plots = {path.name: path.read_bytes() for path in (tmp_path / "gain" / "plots").glob("*.*g")}
    assert {"differences.svg", "speed-gain-by-frequency.png"} <= set(plots)
    assert call("plot", tmp_path / "gain").exit_code == 0
    assert plots == {
        path.name: path.read_bytes() for path in (tmp_path / "gain" / "plots").glob("*.*g")
    }
    status = json_of("status", tmp_path / "gain")
    assert (status["kind"], status["complete"]) == ("comparison", True)
    output = call(*arguments, "--out", tmp_path / "gain.csv")
    assert "0.4 minus 0, profile exact" in output.stdout
    assert "24 ok" in output.stdout
    assert re.search(r"^speed +mm/s +\d\d\.", output.stdout, re.MULTILINE)
    assert re.search(r"^roll_std +deg ", output.stdout, re.MULTILINE)
    assert "speed [mm/s]: 0.4 minus 0, profile exact" in output.stdout
    stored = pq.read_table(tmp_path / "gain" / "comparison.parquet")
    assert pa.csv.read_csv(tmp_path / "gain.csv").num_rows == stored.num_rows


def test_figures_mark_what_is_beyond_noise(drawing) -> None:
    """Filled marks as many as the table has findings, for each gait a line, and the runs that fell below."""
    comparison = compare(table(fell=("lateral_walk",)), by="spine", groups=["gait", "frequency"])
    figures = dict(figures_of_comparison(comparison.table))
    assert list(figures) == ["differences", "speed-gain-by-gait-and-frequency"]
    figure = figures["speed-gain-by-gait-and-frequency"]
    filled = sum(
        (marks.get_facecolor()[:, :3] < 1).any(axis=1).sum()
        for marks in figure.axes[0].collections
        if len(marks.get_offsets()) > 0 and len(marks.get_facecolor())
    )
    rows = [
        row for row in comparison.rows("stride_extension", grouped=True) if row["metric"] == "speed"
    ]
    assert filled == sum(row["beyond_noise"] for row in rows) > 0
    texts = " ".join(
        text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))
    )
    assert "gait lateral walk" in texts
    assert "3 of the other fell" in texts
    assert "frequency [Hz]" in texts


def test_a_difference_names_its_profiles(drawing, tmp_path: Path) -> None:
    """The comparison and each figure's note do, where one profile holds, where two differ, and where some do."""

    def named(comparison) -> set[str]:
        """What the figures' notes say of profiles."""
        texts = [
            figure_text.get_text()
            for _, figure in figures_of_comparison(comparison.table)
            for figure_text in figure.findobj(Text)
        ]
        return {
            name for text in texts for name in re.findall(r"^(profile.*?);", text, re.MULTILINE)
        }

    run_sweep(RANDOM, tmp_path / "exact", simulator=FakeSimulator())
    run_sweep(
        RANDOM | {"profile": "as_published"}, tmp_path / "published", simulator=FakeSimulator()
    )
    single = compare(tmp_path / "exact", by="spine.amplitude", groups=["frequency"])
    assert (single.about()["profiles"], named(single)) == (["exact"], {"profile exact"})
    two = compare(tmp_path / "exact", tmp_path / "published")
    clock = "(as_published simulates 2.5 times the given frequency by default)"
    assert (two.profiles, named(two)) == (
        ("exact", "as_published"),
        {f"profiles exact and as_published {clock}"},
    )
    varied = {name: value for name, value in RANDOM.items() if name != "vary"} | {
        "vary": {"profile": ["exact", "as_published"], "spine.amplitude": [0.0, 0.4]}
    }
    run_sweep(varied, tmp_path / "varied", simulator=FakeSimulator())
    assert compare(tmp_path / "varied", by="profile").profiles == ("exact", "as_published")
    selected = compare(tmp_path / "varied", by="spine.amplitude", where={"profile": "as_published"})
    assert selected.profiles == ("as_published",)
    assert named(compare(table(), by="spine")) == {"profile not recorded"}


def test_a_gain_in_speed_stands_beside_both_costs(drawing) -> None:
    """In one figure, and first among the differences; what has a better direction stands before what has none."""
    data = table()
    for name, share in (
        ("cost_of_transport", 0.9),
        ("electrical_cost_of_transport", 1.1),
        ("yaw_min", 1.5),
    ):
        cost = np.where(np.array(data.column("spine").to_pylist()) == "none", 1.0, share)
        field = pa.field(
            name, pa.float64(), metadata={"role": "metric", "unit": "1", "description": name}
        )
        data = data.append_column(
            field, pa.array(cost * (1 + 0.001 * np.arange(len(cost)) / len(cost)))
        )
    comparison = compare(data, by="spine", groups=["gait", "frequency"])
    figures = dict(figures_of_comparison(comparison.table))
    assert list(figures) == ["differences", "gains-by-gait-and-frequency"]
    titles = [ax.get_title() for ax in figures["gains-by-gait-and-frequency"].axes]
    assert titles == ["Speed", "Mechanical cost of transport", "Electrical cost of transport"]
    for ax, sign in zip(figures["gains-by-gait-and-frequency"].axes, (0, -1, 1), strict=True):
        heights = np.concatenate(
            [line.get_ydata() for line in ax.get_lines() if len(line.get_xdata()) == 3]
        )
        assert not sign or (np.sign(heights) == sign).all()
    listed = [label.get_text() for label in figures["differences"].axes[0].get_yticklabels()]
    assert listed[:3] == titles
    assert listed[-1] == "Yaw, minimum"


def test_a_panel_may_lack_a_line_of_the_others(drawing) -> None:
    """The lateral walk is on flat ground alone: the panel of the other scene has the lines of the trots."""
    data = table(repeats=4)
    is_there = (data.column("repeat").to_numpy() % 2 == 1) & (
        np.array(data.column("gait").to_pylist()) != "lateral_walk"
    )
    metadata = {"role": "varied", "unit": "1", "description": "scene", "scale": "structure"}
    scene = pa.array(np.where(is_there, "planks", "flat").tolist())
    data = data.append_column(pa.field("scene", pa.string(), metadata=metadata), scene)
    comparison = compare(data, by="spine", groups=["gait", "frequency", "scene"])
    figure = dict(figures_of_comparison(comparison.table))[
        "speed-gain-by-gait-and-frequency-and-scene"
    ]
    lines = [sum(len(line.get_xdata()) == 3 for line in ax.get_lines()) for ax in figure.axes]
    assert sorted(lines) == [2, 3]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"by": "spin"},
            "by is 'spin', which is not varied; did you mean 'spine'? Varied: gait, spine, frequency.",
        ),
        (
            {"by": "spine", "base": "balance"},
            "base is 'balance': the table has none, stride_extension.",
        ),
        (
            {"by": "spine", "groups": ["gate"]},
            "for is 'gate', which is not varied; did you mean 'gait'?",
        ),
        (
            {"by": "spine", "where": {"frequency": 0.5}},
            "where frequency is 0.5: the table has 0.4, 0.6, 0.8",
        ),
        (
            {"by": "spine", "drawn": ["sped"]},
            "metric is 'sped', which no table has or one lacks; did you",
        ),
        ({}, "compare two directories, or with by two values of a column in one"),
    ],
)
def test_what_cannot_be_compared_says_why(asked: dict, said: str) -> None:
    """In a sentence with what there is."""
    with pytest.raises(ParameterError) as error:
        compare(table(repeats=1), **asked)
    assert said in str(error.value)


def test_tables_without_common_variants_are_refused(tmp_path: Path) -> None:
    """The sentence names the parameter that keeps them apart."""
    for name, values in {"a": [0.5, 0.6], "b": [0.7, 0.8]}.items():
        run_sweep(
            RANDOM | {"vary": {"frequency": values}}, tmp_path / name, simulator=FakeSimulator()
        )
    with pytest.raises(
        ParameterError,
        match=r"no variant in common: frequency is 0.5, 0.6 in the one and 0.7, 0.8 in",
    ):
        compare(tmp_path / "a", tmp_path / "b")
    with pytest.raises(SpecError, match="no such directory"):
        compare(tmp_path / "a", tmp_path / "c")


@pytest.mark.parametrize(
    ("section", "said"),
    [
        (
            "{by: frequencies}",
            "2: field 'compare.by' names 'frequencies', which is not varied; did you",
        ),
        ("{base: 1}", "2: field 'compare' has no 'by'"),
        (
            "{by: frequency, base: 0.55}",
            "2: field 'compare.base' is the number 0.55, no value of frequency; allowed",
        ),
        ("{by: stride}", "2: field 'compare.by' names 'stride', which has one value"),
        (
            "{by: frequency, for: frequency}",
            "2: field 'compare.for' names 'frequency', whose values are compared",
        ),
        (
            "{by: frequency, of: speed}",
            "2: field 'compare.of' is not a field of a comparison; allowed are by",
        ),
    ],
)
def test_a_wrong_section_is_refused_before_anything_runs(section: str, said: str) -> None:
    """With line, field and what is allowed."""
    with pytest.raises(SpecError) as error:
        Sweep.from_text(f"vary: {{frequency: [0.5, 0.7], stride: [1.0]}}\ncompare: {section}")
    assert said in str(error.value)


def test_a_comparison_changes_no_row(tmp_path: Path) -> None:
    """Two sweeps that differ in it alone are one sweep, and give one table."""
    with_comparison = RANDOM | {"compare": {"by": "frequency", "base": 0.9}}
    assert Sweep.from_dict(with_comparison).digest() == Sweep.from_dict(RANDOM).digest()
    assert Sweep.from_text(Sweep.from_dict(with_comparison).to_yaml()) == Sweep.from_dict(
        with_comparison
    )
    for name, spec in {"with": with_comparison, "without": RANDOM}.items():
        run_sweep(spec, tmp_path / name, simulator=FakeSimulator())
    assert read_table(tmp_path / "with").equals(read_table(tmp_path / "without"))


@pytest.mark.release
def test_how_strides_vary_with_the_soles_radius_has_a_command(tmp_path: Path) -> None:
    """A user's sweep: what `compare` says of strides is what pandas finds between touch-downs of the saved series."""
    (tmp_path / "sv.yaml").write_text(
        "gait: trot\nspine: stride_extension\nrun: {cycles: 8, warmup_cycles: 2}\nset: {frequency: 0.8}\n"
        "vary: {geometry.foot.radius: [0.002, 0.004]}\n"
        "save: {sensors: [foot_position, foot_force], rate: 100}\nplots: false\n"
    )
    out = tmp_path / "sv"
    assert call("sweep", tmp_path / "sv.yaml", "--out", out).exit_code == 0
    series = pq.read_table(out / "series").to_pandas()
    expected = []
    for _, walk in series[series.time > 2.5].groupby("row"):
        on = (walk.rear_left_foot_force > 0.02).to_numpy()
        places = walk.rear_left_foot_position_y.to_numpy()[np.flatnonzero(on[1:] & ~on[:-1]) + 1]
        lengths = -np.diff(places)
        expected.append(lengths[lengths > 0.02].mean())
    report = json_of("compare", out, "--by", "geometry.foot.radius", "--metric", "stride_length")
    line = report["metrics"]["stride_length"]
    assert [line["base_mean"], line["other_mean"]] == pytest.approx(expected, rel=0.01)
    output = call(
        "compare", out, "--by", "geometry.foot.radius", "--metric", "stride_length_cv", "--all"
    ).output
    assert re.search(r"stride_length_cv\s+1\s+0\.00\d+\s+0\.00\d+", output), output
    assert "which tells no noise; give repeats" in output
