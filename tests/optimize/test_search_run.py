# Tests of optimize/search_run.py, optimize/search_directory.py, optimize/search_results.py
"""Searches over a fake robot in closed form: what they find, that they repeat, and that a kill costs one batch."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.search_fake import ATLAS, BEST, FALLS, FRONT, SPEED, WALK, FakeSimulator, walk
from tiers import needs

from nermo_mjx.optimize import run_search
from nermo_mjx.runs import Interrupted, JobFailed, Watch
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.rows import part_files
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep import read_table

#: Not imported here, which would take two seconds in each process of tests.
pytestmark = [
    pytest.mark.extra,
    pytest.mark.skipif(
        not all(map(importlib.util.find_spec, ("ribs", "pymoo"))),
        reason="without ribs or pymoo: pip install '.[test-all]'",
    ),
]


def values(table, *names):
    return np.stack([table.column(name).to_numpy() for name in names], axis=-1)


def numbers(out):
    """Everything that must be equal in two directories of one search."""
    table = read_table(out).drop_columns(["code"])
    best = json.loads((Path(out) / "best.json").read_text())
    return table.to_pydict(), best


def test_the_best_of_one_objective_is_found_among_falls(tmp_path):
    """The fastest gait that does not fall, where it stands by the closed form: just below the frequency of falls."""
    result = run_search(SPEED | {"budget": 300}, tmp_path / "out", simulator=FakeSimulator())
    best = result.best
    fastest = walk(FALLS, *BEST)[0]
    assert 0.99 * fastest < best["metrics"]["speed"] <= fastest
    assert best["objective"] == pytest.approx(-best["metrics"]["speed"])
    assert best["parameters"]["frequency"] <= FALLS
    assert best["failed"] > 0
    table = result.table
    assert best["evaluations"] == table.num_rows == sum(table.column("batch").to_numpy() >= 0)
    well = values(table, "speed")[np.array(table.column("status").to_pylist()) == "ok"]
    assert best["metrics"]["speed"] == well.max()


def test_the_first_point_is_the_published_gait(tmp_path):
    """Row 0 has the defaults, as far as the bounds have them, so that a search says what it has gained."""
    result = run_search(SPEED | {"budget": 12}, tmp_path / "out", simulator=FakeSimulator())
    row = result.table.slice(0, 1).to_pylist()[0]
    assert row["frequency"] == pytest.approx(0.67)
    assert row["spine.amplitude"] == pytest.approx(0.4)
    assert row["spine.phase"] == pytest.approx(0.0)


def test_constraints_hold_at_the_best_point(tmp_path):
    """The best point within a roll that the fastest one exceeds."""
    spec = SPEED | {"budget": 300, "subject_to": {"roll_std": {"max": 0.06}}}
    best = run_search(spec, tmp_path / "out", simulator=FakeSimulator()).best
    assert best["metrics"]["roll_std"] <= 0.06
    grid = np.meshgrid(
        np.linspace(0.4, FALLS, 101), np.linspace(0, 0.4, 101), [BEST[1]], indexing="ij"
    )
    speed, roll, _ = walk(*grid)
    assert best["metrics"]["speed"] > 0.985 * speed[roll <= 0.06].max()


@pytest.mark.parametrize(
    ("spec", "batches"),
    [
        (SPEED | {"budget": 12, "subject_to": {"roll_std": {"max": 0.001}}}, [12, 12]),
        (
            ATLAS | {"vary": WALK["vary"] | {"frequency": {"uniform": [1.41, 1.5]}}, "budget": 48},
            [16, 16, 16],
        ),
    ],
    ids=["constraints", "falls"],
)
def test_a_search_that_finds_nothing_says_so_at_its_end(spec, batches, tmp_path):
    """Where all of a first batch falls, an atlas keeps searching."""
    with pytest.raises(
        JobFailed, match="no point of this search walked to its end within its constraints"
    ):
        run_search(spec, tmp_path / "out", simulator=(fake := FakeSimulator()))
    assert fake.batches == batches


def test_a_front_has_no_point_that_another_one_beats(tmp_path):
    """Each point of the front against each point of the table."""
    result = run_search(FRONT, tmp_path / "out", simulator=FakeSimulator())
    table, front = result.table, result.best["front"]
    well = np.array(table.column("status").to_pylist()) == "ok"
    cost = (values(table, "speed", "cost_of_transport") * [-1, 1])[well]
    for point in front:
        objective = np.array(point["objective"])
        assert not ((cost <= objective).all(axis=1) & (cost < objective).any(axis=1)).any()
    beaten = [
        (np.all(cost <= candidate, axis=1) & np.any(cost < candidate, axis=1)).any()
        for candidate in cost
    ]
    assert len(front) == len(
        {tuple(candidate) for candidate, lost in zip(cost, beaten, strict=True) if not lost}
    )
    assert 0 < result.best["hypervolume"] < 1
    assert result.best["row"] in [point["row"] for point in front]


def test_an_atlas_has_the_best_of_each_cell(tmp_path):
    """Cells and their best from the table by hand, one row after the other."""
    result = run_search(ATLAS, tmp_path / "out", simulator=FakeSimulator())
    best = {}
    for row in result.table.to_pylist():
        i, j = int(row["speed"] / 0.16 * 8), int(row["roll_std"] / 0.1 * 6)
        if row["status"] == "ok" and i < 8 and j < 6:
            cell = 6 * i + j
            if cell not in best or row["cost_of_transport"] < best[cell]["cost_of_transport"]:
                best[cell] = row
    atlas = pq.read_table(tmp_path / "out/atlas.parquet")
    assert atlas.column("cell").to_pylist() == sorted(best)
    assert atlas.column("row").to_pylist() == [best[cell]["row"] for cell in sorted(best)]
    assert atlas.column("spine.phase").to_pylist() == [
        best[cell]["spine.phase"] for cell in sorted(best)
    ]
    atlas_metadata = json.loads(atlas.schema.metadata[b"atlas"])
    assert atlas_metadata["objective"] == {"metric": "cost_of_transport", "direction": "minimize"}
    assert atlas_metadata["measures"][0] == {
        "metric": "speed",
        "low": 0.0,
        "high": 0.16,
        "cells": 8,
    }
    roles = {field.name: field.metadata[b"role"].decode() for field in atlas.schema}
    assert roles["cell"] == "index"
    assert roles["frequency"] == "varied"
    assert roles["speed"] == "metric"
    assert result.best["filled"] == len(best)
    assert result.best["cells"] == 48


@pytest.mark.parametrize("spec", [SPEED, FRONT, ATLAS], ids=["cma", "nsga2", "cma_me"])
def test_the_same_search_gives_the_same_numbers_also_where_it_was_stopped(spec, tmp_path):
    """Stopped in its sixth batch, wherever NumPy's global generator stands: nothing that is stored is run again."""
    run_search(spec, tmp_path / "whole", simulator=(whole := FakeSimulator()))
    np.random.seed(5)  # noqa: NPY002
    with pytest.raises(Interrupted, match="nermo-mjx search"):
        run_search(spec, tmp_path / "out", simulator=FakeSimulator(stop_at=5))
    run_search(spec, tmp_path / "out", simulator=(rest := FakeSimulator()))
    assert rest.batches == whole.batches[5:]
    assert numbers(tmp_path / "out") == numbers(tmp_path / "whole")
    run_search(spec | {"seed": 1}, tmp_path / "other", simulator=FakeSimulator())
    assert numbers(tmp_path / "other")[0] != numbers(tmp_path / "whole")[0]


def test_a_larger_budget_prolongs_a_search(tmp_path):
    run_search(SPEED | {"budget": 60}, tmp_path / "out", simulator=FakeSimulator())
    run_search(SPEED, tmp_path / "out", simulator=(rest := FakeSimulator()))
    run_search(SPEED, tmp_path / "whole", simulator=FakeSimulator())
    assert sum(rest.batches) == 60
    assert numbers(tmp_path / "out") == numbers(tmp_path / "whole")


def test_a_budget_of_simulated_seconds(tmp_path):
    """Runs of two seconds: a hundred of them are fifty runs, and the batch that reaches it is the last."""
    best = run_search(
        SPEED | {"budget": {"simulated_seconds": 100}}, tmp_path / "o", simulator=FakeSimulator()
    ).best
    assert best["evaluations"] == 60
    assert best["simulated_seconds"] == pytest.approx(120)


def test_repeats_count_by_their_mean(tmp_path):
    """Rows of a point side by side, with draws of their own but for the first; the objective is that of the means."""
    spec = SPEED | {"randomize": {"repeats": 3}, "budget": 24}
    result = run_search(spec, tmp_path / "out", simulator=(fake := FakeSimulator()))
    table, best = result.table, result.best
    assert fake.batches == [36, 36]
    assert table.num_rows == 72
    assert table.column("repeat").to_pylist()[:4] == [0, 1, 2, 0]
    starts = np.reshape(table.column("start.x").to_pylist(), (24, 3))
    assert not starts[:, 0].any()
    assert len(set(starts[:, 1:].ravel())) == 48
    runs = table.slice(best["row"], 3)
    assert set(runs.column("variant").to_pylist()) == {best["row"] // 3}
    assert best["metrics"]["speed"] == pytest.approx(
        np.mean(runs.column("speed").to_pylist()), rel=1e-12
    )


def test_a_damaged_batch_is_run_again(tmp_path):
    """It is kept aside, and what follows from it is still right."""
    run_search(SPEED, tmp_path / "out", simulator=FakeSimulator())
    before = numbers(tmp_path / "out")
    (path,) = (
        part_path
        for part_path in part_files(tmp_path / "out")
        if pq.read_metadata(part_path).metadata[b"chunk"] == b"2"
    )
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    messages = []
    run_search(
        SPEED,
        tmp_path / "out",
        simulator=(fake := FakeSimulator()),
        watch=Watch(warn=messages.append),
    )
    assert fake.batches == [12]
    assert numbers(tmp_path / "out") == before
    assert messages == [
        f"{path} is damaged; it is kept in results.aside, and its runs are made again."
    ]
    assert [part_path.name for part_path in (tmp_path / "out/results.aside").iterdir()] == [
        f"{path.name}.aside-1"
    ]


def test_another_search_does_not_take_the_directory(tmp_path):
    run_search(SPEED | {"budget": 12}, tmp_path / "out", simulator=FakeSimulator())
    for change in (
        {"seed": 2},
        {"method": {"cma": {"sigma": 0.3}}},
        {"objective": {"maximize": "roll_std"}},
    ):
        with pytest.raises(
            DirectoryError, match=f"another search, with another {next(iter(change))}"
        ):
            run_search(SPEED | {"budget": 12} | change, tmp_path / "out", simulator=FakeSimulator())


def test_a_directory_keeps_the_size_of_its_batches(tmp_path):
    """Without a batch size in the file, another machine resumes with that of the first one."""
    spec = {key: value for key, value in SPEED.items() if key != "batch"}
    run_search(spec | {"batch": 10, "budget": 20}, tmp_path / "out", simulator=FakeSimulator())
    run_search(spec | {"budget": 40}, tmp_path / "out", simulator=(fake := FakeSimulator()))
    assert fake.batches == [10, 10]


def test_a_simulation_that_fails_keeps_what_is_done(tmp_path):
    with pytest.raises(
        JobFailed, match=r"batch 1 of .* failed: OSError: no luck\. What is finished is kept"
    ):
        run_search(
            SPEED, tmp_path / "out", simulator=FakeSimulator(fail_at=2, error=OSError("no luck."))
        )
    assert len(list((tmp_path / "out/results").iterdir())) == 1


def test_wrong_bounds_are_said_before_anything_is_written(tmp_path):
    with pytest.raises(
        SpecError, match=r"search: field 'spine.amplitude' is the list .*: a search moves between"
    ):
        run_search(SPEED | {"vary": {"spine.amplitude": [0.1, 0.2]}}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("spec", [SPEED, FRONT, ATLAS], ids=["cma", "nsga2", "cma_me"])
def test_the_same_search_gives_the_same_numbers(spec, tmp_path):
    """Also where NumPy's global generator stands elsewhere; another seed gives others."""
    run_search(spec, tmp_path / "a", simulator=FakeSimulator())
    np.random.seed(5)  # noqa: NPY002
    run_search(spec, tmp_path / "b", simulator=FakeSimulator())
    assert numbers(tmp_path / "a") == numbers(tmp_path / "b")
    run_search(spec | {"seed": 1}, tmp_path / "c", simulator=FakeSimulator())
    assert numbers(tmp_path / "a")[0] != numbers(tmp_path / "c")[0]


@pytest.mark.parametrize("spec", [SPEED, FRONT, ATLAS], ids=["cma", "nsga2", "cma_me"])
def test_a_search_that_is_stopped_goes_on_with_the_same_numbers(spec, tmp_path):
    """Stopped in its sixth batch; nothing that is stored is simulated again."""
    run_search(spec, tmp_path / "whole", simulator=(whole := FakeSimulator()))
    with pytest.raises(Interrupted, match="nermo-mjx search"):
        run_search(spec, tmp_path / "out", simulator=FakeSimulator(stop_at=5))
    run_search(spec, tmp_path / "out", simulator=(rest := FakeSimulator()))
    assert rest.batches == whole.batches[5:]
    assert numbers(tmp_path / "out") == numbers(tmp_path / "whole")


@pytest.mark.release
def test_a_kill_at_any_moment_loses_a_batch_at_most(tmp_path):
    """SIGKILL at two moments of one search; the last process ends with the numbers of a search without kills."""
    out, log = tmp_path / "out", tmp_path / "log"
    run_search(SPEED, tmp_path / "whole", simulator=FakeSimulator())
    fake, simulated = Path(__file__).parents[1] / "fakes" / "search_fake.py", 0
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    for kills in (1, 2):
        process = subprocess.Popen([sys.executable, str(fake), str(out), str(log)], env=environment)
        begun = time.monotonic()
        while time.monotonic() < begun + 120 and not (
            log.exists() and len(log.read_text().split()) > 2
        ):
            time.sleep(0.01)
        time.sleep(0.05 * kills)
        process.send_signal(signal.SIGKILL)
        process.wait()
        simulated += sum(map(int, log.read_text().split()))
        log.unlink()
        stored = read_table(out).num_rows
        assert simulated - stored <= 12 * kills
    run_search(SPEED, out, simulator=(rest := FakeSimulator()))
    assert sum(rest.batches) == 120 - stored
    assert numbers(out) == numbers(tmp_path / "whole")


@pytest.mark.parametrize(
    "aim",
    [
        {"objective": {"minimize": "turning_radius"}},
        {"pareto": [{"maximize": "speed"}, {"minimize": "turning_radius"}]},
    ],
)
def test_an_objective_that_is_nan_is_told_after_the_first_batch(tmp_path: Path, aim: Any) -> None:
    class Straight(FakeSimulator):
        def run(self, *arguments: Any, **named: Any) -> Any:
            result = super().run(*arguments, **named)
            result.metrics["turning_radius"] = np.full(len(result.status), np.nan)
            return result

    needs(*["pymoo"] * ("pareto" in aim))
    simulator = Straight()
    with pytest.raises(
        JobFailed, match=r"turning_radius has no number in all .* the first batch .*NaN if straight"
    ):
        run_search(WALK | aim | {"budget": 120, "batch": 12}, tmp_path, simulator=simulator)
    assert sum(simulator.batches) <= 24, "its first batch is twice as large"
