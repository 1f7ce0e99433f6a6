# Tests of sweep/forecast.py
"""What a sweep would cost: counts that come true, nothing written, and where the rate is from."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from command import call, json_of
from fakes.sweep_fake import SPEC, FakeSimulator, contents

from nermo_mjx import Sweep, run_sweep
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.forecast import sweep_forecast


def rate(sweep: Sweep, engine: str) -> float:
    """A machine of 1,000 steps a second."""
    return 1000.0


def test_rows_chunks_and_steps_are_those_of_the_run(tmp_path: Path) -> None:
    """Steps in closed form: each chunk lasts as long as its longest run, four cycles at its lowest frequency."""
    sweep = Sweep.from_dict(SPEC)
    forecast = sweep_forecast(sweep, tmp_path / "out", engine="c", chunk=9, measure=rate)
    seconds = sum(9 * 4 / frequency for frequency in (0.5, 0.7, 0.9, 1.1))
    counts = {"rows": 36, "rows_left": 36, "chunks": 4, "batches": 4, "structures": 1}
    assert forecast.counts == counts | {"steps": round(seconds / 0.002)}
    assert forecast.simulated_seconds == pytest.approx(seconds)
    assert forecast.wall_seconds == pytest.approx(seconds / 0.002 / 1000)
    assert "measured now" in forecast.rate_from
    assert list(tmp_path.iterdir()) == []
    run_sweep(sweep, tmp_path / "out", chunk=9, simulator=FakeSimulator())
    written = sum(path.stat().st_size for path in (tmp_path / "out" / "results").iterdir())
    assert (
        0.3 * written < forecast.disk_bytes < 10 * written
    )  # the fake robot has three of the metrics


def test_what_is_there_is_subtracted_and_gives_the_rate(tmp_path: Path) -> None:
    """Of a directory with half of its chunks, and with --extend of one that is smaller."""
    run_sweep(
        SPEC, tmp_path, chunk=9, shard=(0, 2), simulator=FakeSimulator(engine="c", delay=0.05)
    )
    files = contents(tmp_path)
    forecast = sweep_forecast(
        Sweep.from_dict(SPEC), tmp_path, measure=lambda *_: pytest.fail("nothing is measured")
    )
    assert [forecast.counts[name] for name in ("rows", "rows_left", "batches")] == [36, 18, 2]
    assert forecast.engine == "c"
    assert forecast.rate_from.endswith(" steps/s, measured: 2 chunks of the directory")
    rate = forecast.counts["steps"] / forecast.wall_seconds
    assert rate == pytest.approx(9 * 100 / 0.05, rel=0.2)
    assert forecast.rate_from.startswith(f"{rate:,.0f} ")
    larger = Sweep.from_dict(SPEC | {"randomize": {"repeats": 2}})
    with pytest.raises(
        DirectoryError, match="repeats is 1 there and 2 here; --extend would extend it"
    ):
        sweep_forecast(larger, tmp_path)
    assert sweep_forecast(larger, tmp_path, extend=True).counts["rows_left"] == 72 - 18
    assert files == contents(tmp_path)


def test_an_unmeasured_gpu_engine_has_no_time(tmp_path: Path) -> None:
    """It says so, and what the batch takes of the device's memory."""
    forecast = sweep_forecast(Sweep.from_dict(SPEC), tmp_path, engine="mjx", chunk=36)
    assert math.isnan(forecast.wall_seconds)
    assert "not known: no chunk of the engine mjx" in forecast.rate_from
    assert "batch of 36 worlds" in forecast.notes[-1]


def test_the_command_prints_it_and_makes_no_directory(tmp_path: Path) -> None:
    """For people and as JSON; the arguments are checked as in a run."""
    (tmp_path / "sweep.yaml").write_text(json.dumps(SPEC))
    arguments = (
        "sweep",
        tmp_path / "sweep.yaml",
        "--dry-run",
        "--engine",
        "mjx",
        "--out",
        tmp_path / "out",
    )
    report = json_of(*arguments)
    assert (report["rows"], report["wall_seconds"]) == (36, None)
    output = call(*arguments)
    assert output.exit_code == 0
    assert output.stdout.startswith("36 rows, 36 rows left, 1 chunks, ")
    assert not (tmp_path / "out").exists()
    refused = call(*arguments, "--workers", "ray")
    assert refused.exit_code == 2
    assert "--dry-run estimates for this machine" in refused.stderr
