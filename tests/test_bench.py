# Tests of bench.py, docs/benchmarks
"""Measurements of this machine, their failures, and the page of results in docs/benchmarks."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import mujoco
import pytest
from command import call, json_of

from nermo_mjx.bench import BENCHMARKS, STARTUP_PROGRAM, apart, run_bench
from nermo_mjx.cli.choices import BENCH_CASES

STUDIES = Path(__file__).parents[1] / "docs" / "benchmarks"
sys.path.insert(0, str(STUDIES))
engines = importlib.import_module("engines")

FAILED = {"case": "throughput", "engine": "mjx", "worlds": 64, "error": "no memory"}


def test_each_combination_is_measured_in_order_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "nermo_mjx.bench.apart", lambda measure, *options: {"measured": measure.__name__}
    )
    progress = Mock()
    result = run_bench(BENCH_CASES, ["c", "mjx"], [4, 8], progress)
    options = [(engine, size) for engine in ("c", "mjx") for size in (4, 8)]
    assert [tuple(line.values()) for line in result["cases"]] == [
        (case, engine, size, case) for case in ("throughput", "startup") for engine, size in options
    ]
    assert [call.args for call in progress.call_args_list] == [(count, 8) for count in range(9)]
    assert tuple(BENCHMARKS) == BENCH_CASES


@pytest.mark.parametrize(
    ("measure", "option", "message"),
    [(os._exit, 3, "ended without a result"), (os.chdir, "/none", "FileNotFoundError: ")],
)
def test_a_measurement_that_fails_is_a_sentence(measure: Any, option: Any, message: str) -> None:
    """The process may have died or raised."""
    (sentence,) = apart(measure, option).values()
    assert message in sentence
    assert "\n" not in sentence


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("engine", ["c", pytest.param("mjx", marks=pytest.mark.long)])
def test_a_walk_is_measured(engine: str) -> None:
    """A small batch: the command's figures, and those of the page, are of one walk of one model."""
    result = run_bench(["throughput"], [engine], [2])
    (line,) = result["cases"]
    assert (line["case"], line["engine"], line["worlds"]) == ("throughput", engine, 2)
    assert line["simulated_seconds_per_second"] == pytest.approx(0.002 * line["steps_per_second"])
    assert result["hardware"]["mujoco"] == mujoco.__version__
    comparison = engines.throughput_case(engine, 2)
    assert comparison["ratio"] == pytest.approx(
        comparison["steps_per_second"] / comparison["plain_steps_per_second"], rel=0.5
    )
    assert set(comparison) >= {"steps_per_second", "compile_s", "peak_bytes"}


def test_bench_shows_what_went_well_and_what_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    line = {
        "case": "throughput",
        "engine": "c",
        "worlds": 64,
        "steps_per_second": 10_000.4,
        "peak_bytes": 6e8,
    }
    stages = {"import_s": 1.25, "training_s": 30.5}
    start = {
        "case": "startup",
        "engine": "c",
        "worlds": 64,
        "cold_s": 5.5,
        "warm_s": 3.5,
        "cold": stages,
        "warm": stages,
    }
    run = {"hardware": {"cpu": "some processor", "cores": 2}, "cases": [line, FAILED, start]}
    measured = Mock(return_value=run)
    monkeypatch.setattr("nermo_mjx.bench.run_bench", measured)
    assert (
        json_of("bench", "startup", "--engine", "c", "--worlds", "4", "--worlds", "8")["cases"]
        == run["cases"]
    )
    assert measured.call_args[0][:3] == (("startup",), ("c",), (4, 8))
    output = call("bench").stdout
    assert measured.call_args[0][:3] == (("throughput",), ("c", "mjx"), (64,))
    assert "hardware: cpu some processor, cores 2" in output
    assert "throughput (engine mjx, worlds 64) failed: no memory" in output
    rows = [line.split() for line in output.splitlines()]
    assert ["c", "64", "10,000", "600"] in rows
    assert ["c", "64", "cold", "5.50", "1.25", "30.50"] in rows


def run_of(date: str, *lines: dict[str, Any], device: str = "1 x cpu") -> str:
    """A line of results.jsonl."""
    hardware = {
        "device": device,
        "cores": 2,
        "cpu": "some processor",
        "mujoco": "3",
        "jax": "0",
        "python": "3",
    }
    return (
        json.dumps({"date": date, "commit": "abc", "hardware": hardware, "cases": list(lines)})
        + "\n"
    )


def walk_of(rate: float, **fields: Any) -> dict[str, Any]:
    """A measurement of the throughput."""
    times = dict.fromkeys(("trace_s", "compile_s", "plain_trace_s", "plain_compile_s"), 1.0)
    rates = {
        "steps_per_second": rate,
        "ratio": 0.9,
        "plain_steps_per_second": rate,
        "peak_bytes": 1e9,
    }
    return {"case": "throughput", "engine": "c", "worlds": 64, **rates, **times} | fields


def test_the_page_shows_the_newest_of_each_kind_by_machine(tmp_path: Path) -> None:
    cold, warm = {"import_s": 1.25, "training_s": 30.5}, {"import_s": 1.0, "training_s": 2.5}
    start = {
        "case": "startup",
        "engine": "c",
        "worlds": 64,
        "cold_s": 5.5,
        "warm_s": 3.5,
        "cold": cold,
        "warm": warm,
    }
    lines = [
        run_of("2026-01-01", walk_of(11111.0), walk_of(22222.0, worlds=128)),
        run_of("2026-02-02", walk_of(33333.0), start),
        run_of("2026-03-03", walk_of(44444.0), device="1 x gpu"),
    ]
    (tmp_path / "results.jsonl").write_text("".join(lines))
    engines.draw_page(tmp_path / "results.jsonl", tmp_path)
    page = (tmp_path / "results.md").read_text()
    assert "11,111" not in page
    assert (
        page.index("33,333") < page.index("22,222") < page.index("1 x gpu") < page.index("44,444")
    )
    assert "| c | 64 | cold | 5.5 | 1.2 | 30.5 |" in page
    assert "2026-02-02, commit abc, mujoco 3, jax 0, python 3" in page
    for figure in (figures := re.findall(r"\]\((plots/.*?)\)", page)):
        assert (tmp_path / figure).stat().st_size > 1000
    assert figures == [
        f"plots/{name}_{machine}.svg" for machine in (1, 2) for name in ("throughput", "compile")
    ]


def test_the_page_of_this_repository_is_that_of_its_results(tmp_path: Path) -> None:
    engines.draw_page(STUDIES / "results.jsonl", tmp_path)
    assert (tmp_path / "results.md").read_text() == (STUDIES / "results.md").read_text()


def test_the_startup_program_imports_names_that_exist():
    """The program is a string, which neither mypy nor the other tests read."""
    statements = [
        node for node in ast.walk(ast.parse(STARTUP_PROGRAM)) if isinstance(node, ast.ImportFrom)
    ]
    assert statements
    for statement in statements:
        module = importlib.import_module(statement.module)
        assert [name.name for name in statement.names if not hasattr(module, name.name)] == []
