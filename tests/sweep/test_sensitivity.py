# Tests of sweep/sensitivity.py
"""What a metric hangs on: Ishigami's function, whose indices are known, given samples, noise, runs that fell."""

from __future__ import annotations

import json
import types
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import call, json_of

from nermo_mjx import ParameterError, read_table, run_sweep, sensitivity
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep import Sweep, sample
from nermo_mjx.sweep.sampling import saltelli_points

NAMES = ("frequency", "stride", "duty")
SPEC = {"vary": {name: {"uniform": [0.55, 0.75]} for name in NAMES}, "plots": False}
#: Ishigami and Homma (1990) with a = 7 and b = 0.1: variances of the terms, in closed form.
FIRST, SECOND = 0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2, 7**2 / 8
PAIR = 0.1**2 * np.pi**8 * (1 / 18 - 1 / 50)
WHOLE = FIRST + SECOND + PAIR
KNOWN = {
    ("frequency", "first"): FIRST / WHOLE,
    ("stride", "first"): SECOND / WHOLE,
    ("duty", "first"): 0.0,
    ("frequency", "total"): (FIRST + PAIR) / WHOLE,
    ("stride", "total"): SECOND / WHOLE,
    ("duty", "total"): PAIR / WHOLE,
}


class Ishigami:
    """A simulator whose speed is Ishigami's function of three parameters; more friction adds noise, some runs fall."""

    engine = "fake"

    def __init__(self, falls: float = np.inf) -> None:
        self.falls = falls

    def run(self, values, run, *, progress=None, notify=None):
        a, b, c = (np.pi * (values[name] - 0.65) / 0.1 for name in NAMES)
        speed = (
            np.sin(a)
            + 7 * np.sin(b) ** 2
            + 0.1 * c**4 * np.sin(a)
            + 10 * (values.get("contact.friction", 1.0) - 1)
        )
        fell = speed > self.falls
        metrics = {"speed": speed, "slip": np.full(len(speed), 0.1), "fell": fell.astype(float)}
        return types.SimpleNamespace(
            metrics=metrics, status=np.where(fell, "fell", "ok"), engine="fake", steps=1
        )


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep with Saltelli's design, of pairs, too."""
    folder = tmp_path_factory.mktemp("ishigami")
    spec = SPEC | {"sample": {"saltelli": {"points": 1024, "second_order": True}}, "chunk": 2000}
    run_sweep(spec, folder, simulator=Ishigami())
    return folder


def indices(analysis) -> dict[tuple[str, str], dict]:
    return {
        (line["parameter"], line["order"]): line
        for line in analysis.table.to_pylist()
        if not line["second"]
    }


def test_ishigamis_indices_are_those_in_closed_form(out: Path) -> None:
    """First, total and of pairs, each within its interval, and within 0.04."""
    analysis = sensitivity(out)
    assert analysis.method == "sobol"
    assert np.isnan(analysis.noise)
    for key, line in indices(analysis).items():
        assert line["index"] == pytest.approx(KNOWN[key], abs=0.04), key
        assert line["low"] <= KNOWN[key] <= line["high"] or KNOWN[key] == 0
    pairs = {
        (line["parameter"], line["second"]): line
        for line in analysis.table.to_pylist()
        if line["order"] == "second"
    }
    assert set(pairs) == {("frequency", "stride"), ("frequency", "duty"), ("stride", "duty")}
    assert pairs["frequency", "duty"]["index"] == pytest.approx(PAIR / WHOLE, abs=0.06)
    assert abs(pairs["frequency", "stride"]["index"]) < 0.06


def test_the_sweep_itself_finds_them(out: Path) -> None:
    """The summary has them, and so has a table beside it."""
    summary = json.loads((out / "summary.json").read_text())["sensitivity"]
    assert (summary["metric"], summary["method"]) == ("speed", "sobol")
    assert summary["indices"] == sensitivity(out).about()["indices"]
    assert pq.read_table(out / "sensitivity.parquet").num_rows == len(summary["indices"]) == 9


@pytest.mark.release
def test_a_given_sample_tells_the_first_indices(tmp_path: Path) -> None:
    """By RBD-FAST, called by its name, with the sentence that interactions are not known."""
    run_sweep(
        SPEC | {"sample": {"latin_hypercube": 2000}, "chunk": 2000}, tmp_path, simulator=Ishigami()
    )
    analysis = sensitivity(tmp_path)
    assert analysis.method == "rbd_fast"
    assert "Interactions are not known" in analysis.notes[0]
    for (name, order), line in indices(analysis).items():
        assert order == "first"
        assert line["index"] == pytest.approx(KNOWN[name, order], abs=0.06)


def test_noise_is_in_the_total_indices_and_is_told(tmp_path: Path) -> None:
    """Uniform friction of width 1 adds a variance of 100 / 12 to a run, and of 100 / 96 to the mean of two.

    The two are in different halves of the range. Independent ones would give 100 / 24; the sweep can only tell that it
    is at most what the spread of the two gives.
    """
    spec = SPEC | {"sample": {"saltelli": 1024}, "chunk": 4000}
    spec["randomize"] = {
        "repeats": 2,
        "contact.friction": {"uniform": [0.5, 1.5]},
        "start.x": {"uniform": [0, 0.001]},
    }
    run_sweep(spec, tmp_path, simulator=Ishigami())
    analysis, variance = sensitivity(tmp_path), 100 / 96
    assert variance / (WHOLE + variance) < analysis.noise < 0.7
    assert "at most 59.2 % of the variance" in analysis.notes[-2]
    assert analysis.notes[-1] == "Profile exact."
    for (name, order), line in indices(analysis).items():
        noise = variance if order == "total" else 0.0
        assert line["index"] == pytest.approx(
            (KNOWN[name, order] * WHOLE + noise) / (WHOLE + variance), abs=0.07
        )


def test_points_that_fell_are_left_out_and_counted(tmp_path: Path) -> None:
    """Whole blocks, since the estimators need all rows of one."""
    run_sweep(
        SPEC | {"sample": {"saltelli": 256}, "chunk": 2000},
        tmp_path,
        simulator=Ishigami(falls=12.0),
    )
    notes = " ".join(sensitivity(tmp_path).notes)
    assert "runs fell or were lost" in notes
    assert "of 256 points are left out" in notes


def test_runs_without_a_number_are_not_said_to_have_fallen(out: Path) -> None:
    """NaN in a metric of runs that ended well, beside others that fell."""
    table = read_table(out)
    speed, status = (
        table.column("speed").to_numpy().copy(),
        np.array(table.column("status").to_pylist(), object),
    )
    speed[:20] = np.nan

    def notes(**columns: object) -> str:
        changed = table
        for name, values in columns.items():
            column_index = changed.schema.get_field_index(name)
            changed = changed.set_column(column_index, changed.schema.field(name), pa.array(values))
        return sensitivity(changed).notes[0]

    assert notes(speed=speed) == "20 of 8,192 runs have no number, 20 variants with all of theirs."
    status[5:30] = "diverged"
    sentence = "25 of 8,192 runs fell or were lost and 5 of 8,192 runs have no number, 30 variants with all of theirs."
    assert notes(speed=speed, status=status.tolist()) == sentence


@pytest.mark.release
def test_a_share_below_0_is_told_to_be_noise(tmp_path: Path) -> None:
    """RBD-FAST of a linear function that one parameter has no effect on."""

    class Linear(Ishigami):
        def run(self, values, run, **how):
            result = super().run(values, run, **how)
            result.metrics["speed"] = values["frequency"] + 2 * values["stride"]
            return result

    notes_said = []
    for seed in range(4):
        spec = SPEC | {"sample": {"sobol": 128}, "seed": seed}
        run_sweep(spec, tmp_path / str(seed), simulator=Linear())
        analysis = sensitivity(tmp_path / str(seed))
        below = any(line["index"] < 0 for line in analysis.table.to_pylist())
        assert any("below 0 is the estimate's noise" in note for note in analysis.notes) == below
        notes_said.append(below)
    assert any(notes_said)


def test_the_design_begins_as_a_smaller_one_and_changes_one_parameter_at_a_time() -> None:
    """So more points can follow; each block is two points and those between them."""
    design = saltelli_points(3, 8, False, 1).reshape(8, 5, 3)
    np.testing.assert_array_equal(design.reshape(-1, 3), saltelli_points(3, 16, False, 1)[:40])
    for block in design:
        for i in range(3):
            expected = block[0].copy()
            expected[i] = block[4][i]
            np.testing.assert_array_equal(block[i + 1], expected)
    sweep = Sweep.from_dict(SPEC | {"sample": {"saltelli": 8}, "seed": 1})
    assert sweep.variants == len(sample(sweep)) == 40
    np.testing.assert_allclose(
        sample(sweep).values["stride"], 0.55 + 0.2 * design.reshape(-1, 3)[:, 1]
    )
    pairs = Sweep.from_dict(SPEC | {"sample": {"saltelli": {"points": 8, "second_order": True}}})
    assert pairs.variants == 8 * 8
    assert Sweep.from_text(pairs.to_yaml()).digest() == pairs.digest() != sweep.digest()


@pytest.mark.release
def test_the_command_writes_what_plot_and_status_know(out: Path, tmp_path: Path) -> None:
    """JSON, a table for people, and figures that come out the same."""
    assert (
        json_of("sensitivity", out, "--out", tmp_path / "report")["indices"][0]["parameter"]
        == "frequency"
    )
    figure = (tmp_path / "report" / "plots" / "speed-sensitivity.png").read_bytes()
    assert call("plot", tmp_path / "report").exit_code == 0
    assert (tmp_path / "report" / "plots" / "speed-sensitivity.png").read_bytes() == figure
    plot_result = call("plot", out, "--out", tmp_path / "plots")
    assert plot_result.exit_code == 0, plot_result.output
    assert (tmp_path / "plots" / "speed-sensitivity.png").read_bytes() == figure
    assert "stride" in call("sensitivity", out).stdout


def test_what_tells_nothing_says_why(out: Path, tmp_path: Path) -> None:
    """A grid, an unknown metric, one that is the same everywhere, too few variants, a wrong number of points."""
    grid = {"vary": {name: [0.6, 0.7] for name in NAMES}, "plots": False}
    run_sweep(grid, tmp_path / "grid", simulator=Ishigami())
    run_sweep(SPEC | {"sample": {"sobol": 16}}, tmp_path / "few", simulator=Ishigami())
    for folder, metric, message in (
        (tmp_path / "grid", "speed", "sample is grid, whose variants are not drawn at random"),
        (out, "sped", "metric is 'sped': not one of the table; did you mean 'speed'?"),
        (out, "slip", "metric is 'slip', which is the same in all variants"),
        (tmp_path / "few", "speed", "16 variants went well: RBD-FAST needs 65 or more."),
    ):
        with pytest.raises(ParameterError) as error:
            sensitivity(folder, metric)
        assert message in str(error.value)
    with pytest.raises(
        SpecError, match=r"1: field 'sample.saltelli' is 100: expected a power of two, such as 64"
    ):
        Sweep.from_text("{sample: {saltelli: 100}, vary: {stride: {uniform: [0.5, 0.6]}}}")
