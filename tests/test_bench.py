"""Selection of measurements, isolation of failures, and the page of results."""

from __future__ import annotations

import importlib
import json
import math
import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import mujoco
import pytest
from command import call, json_of

from nermo_mjx.bench import CASES, Benchmark, Option, apart, plan, run_bench
from nermo_mjx.bench.results import COLUMNS, RESULTS, append, draw_page
from nermo_mjx.cli.choices import BENCH_CASES
from nermo_mjx.runs import RunDirectory

pytestmark = pytest.mark.draws

HARDWARE = {"device": "1 x cpu", "cores": 2, "cpu": "some processor", "mujoco": "3", "jax": "0", "python": "3"}


def test_each_combination_is_measured_and_what_is_not_given_has_its_default() -> None:
    assert plan(["gradient"], {"mode": ("reverse",), "cycles": (1.0, 2.0), "worlds": ()}) == [
        ("gradient", {"mode": "reverse", "worlds": 16, "cycles": 1.0}),
        ("gradient", {"mode": "reverse", "worlds": 16, "cycles": 2.0}),
    ]
    both = plan(["throughput", "gradient"], {"engine": ("c",), "worlds": (8,), "mode": ("forward",)})
    gradient = ("gradient", {"mode": "forward", "worlds": 8, "cycles": 1.0})
    assert both == [("throughput", {"engine": "c", "worlds": 8}), gradient]


def test_every_case_can_be_imported_and_has_columns() -> None:
    assert tuple(CASES) == tuple(COLUMNS) == BENCH_CASES
    for case in CASES.values():
        module, _, name = case.place.partition(":")
        function = getattr(importlib.import_module(module), name)
        assert set(case.options) <= set(function.__code__.co_varnames[: function.__code__.co_argcount])


@pytest.mark.parametrize(
    ("place", "option", "message"),
    [("os:_exit", {"status": 3}, "ended without a result"), ("os:chdir", {"path": "/none"}, "FileNotFoundError: ")],
)
def test_a_measurement_that_fails_is_a_sentence(place: str, option: dict[str, Any], message: str) -> None:
    """The process may have died or raised."""
    case = Benchmark("", place, {name: Option((value,)) for name, value in option.items()})
    _, result = apart(case, option)
    assert message in result["error"]
    assert "\n" not in result["error"]


@pytest.mark.process
@pytest.mark.parametrize("engine", ["c", pytest.param("mjx", marks=pytest.mark.long)])
def test_a_walk_is_measured(engine: str) -> None:
    """A small batch: the figures that spec and page rely on are there, and are those of one walk and its physics."""
    result = run_bench(("throughput",), {"engine": (engine,), "worlds": (2,)})
    (line,) = result["cases"]
    assert (line["case"], line["engine"], line["worlds"]) == ("throughput", engine, 2)
    assert line["ratio"] == pytest.approx(line["steps_per_second"] / line["plain_steps_per_second"], rel=0.5)
    assert line["seconds_simulated_per_second"] == pytest.approx(0.002 * line["steps_per_second"])
    assert result["hardware"]["mujoco"] == mujoco.__version__
    assert result["date"] < "3"


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Instead of measuring, keeps one run, with what went well and what failed."""
    run = run_of("2026-11-21", walk_of(10_000.0, plain_steps_per_second=math.nan), FAILED | {"engine": "mjx"})
    made = Mock(side_effect=lambda *_, keep: keep(run) or run)
    monkeypatch.setattr("nermo_mjx.bench.run_bench", made)
    return made


def test_bench_passes_its_options_on_and_keeps_the_run(measured: Mock, tmp_path: Path) -> None:
    """A failed measurement is reported with the others; DIR gets a line per run, and their page."""
    result = json_of("bench", "--engine", "c", "--worlds", "4", "--worlds", "8", "--into", tmp_path)
    assert result["cases"][0]["plain_steps_per_second"] is None
    cases, given, _ = measured.call_args[0]
    assert (cases, given["engine"], given["worlds"]) == (("throughput",), ("c",), (4, 8))
    assert not any((given["mode"], given["cycles"]))
    shown = call("bench", "throughput", "--into", tmp_path).stdout
    assert "10,000" in shown
    assert "throughput (engine mjx, worlds 64) failed: no memory" in shown
    runs = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert [run["cases"] for run in runs] == [result["cases"]] * 2
    page = (tmp_path / "results.md").read_text()
    assert page.count("10,000") == 1
    for figure in re.findall(r"\]\((plots/.*?)\)", page):
        assert (tmp_path / figure).stat().st_size > 1000
    (tmp_path / "results.md").write_text("a user's remarks")
    assert f"moved aside in {tmp_path}, to results.md.aside-1." in call("bench", "--into", tmp_path).stderr
    assert (tmp_path / "results.md.aside-1").read_text() == "a user's remarks"


def test_a_benchmark_that_is_stopped_says_what_it_has_kept(measured: Mock, tmp_path: Path) -> None:
    def stopped(*_: Any, keep: Any) -> None:
        keep(run_of("2026-11-21"))
        raise KeyboardInterrupt

    measured.side_effect = stopped
    result = call("bench", "--into", tmp_path)
    assert result.exit_code == 1
    assert result.stderr.endswith(f"nermo-mjx: stopped; 1 measurement is kept in {tmp_path / 'results.jsonl'}.\n")
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 1


def add_run(folder: Path, run: dict[str, Any]) -> None:
    """Add a run and draw the page, as `bench --into` does."""
    append(folder / RESULTS, run)
    draw_page(folder)


def test_the_page_shows_the_newest_of_each_kind_by_machine(tmp_path) -> None:
    gpu, walk = HARDWARE | {"device": "1 x gpu"}, walk_of
    start = {
        "case": "startup",
        "engine": "c",
        "worlds": 64,
        "cold_s": 5.5,
        "warm_s": 3.5,
        "cold": {"import_s": 1.25, "training_s": 30.5},
        "warm": {"import_s": 1.0, "training_s": 2.5},
    }
    gradient = {"case": "gradient", "mode": "reverse", "worlds": 16, "cycles": 1.0, "error": "no memory"}
    add_run(tmp_path, run_of("2026-01-01", walk(11111.0), walk(22222.0, worlds=128)))
    add_run(tmp_path, run_of("2026-02-02", walk(33333.0), start))
    add_run(tmp_path, run_of("2026-03-03", gradient, hardware=gpu))
    page = (tmp_path / "results.md").read_text()
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 3
    assert "11,111" not in page
    assert page.index("33,333") < page.index("22,222") < page.index("1 x gpu") < page.index("failed: no memory")
    assert "| c | 64 | cold | 5.5 | 1.2 | 30.5 |" in page
    assert "2026-02-02" in page
    assert sorted(path.name for path in (tmp_path / "plots").glob("*.png")) == ["compile_1.png", "throughput_1.png"]


def run_of(date: str, *lines: dict[str, Any], hardware: dict[str, Any] | None = HARDWARE) -> dict[str, Any]:
    """A run as it stands in results.jsonl."""
    return {"date": date, "commit": "abc", "hardware": hardware, "cases": list(lines)}


def walk_of(rate: float, **more: Any) -> dict[str, Any]:
    """A successful measurement of the throughput."""
    return {
        "case": "throughput",
        "engine": "c",
        "worlds": 64,
        "steps_per_second": rate,
        "ratio": 0.9,
        "plain_steps_per_second": rate,
        "peak_bytes": 1e9,
        "trace_s": 1.0,
        "compile_s": 1.0,
        "plain_trace_s": 0.0,
        "plain_compile_s": 0.0,
    } | more


FAILED = {"case": "throughput", "engine": "c", "worlds": 64, "error": "no memory"}


def test_a_failed_newest_run_stands_beside_the_last_good_figures_and_says_when(tmp_path: Path) -> None:
    """Also one that ended before it knew its machine; what goes well again is no failure any more."""
    failure, when = (
        "- throughput (engine c, worlds 64) failed: no memory. That was on 2026-02-02, commit abc",
        "2026-02-02",
    )
    add_run(tmp_path, run_of("2026-01-01", walk_of(11111.0)))
    add_run(tmp_path, run_of(when, FAILED))
    add_run(tmp_path, run_of(when, FAILED, hardware=None))
    page = (tmp_path / "results.md").read_text()
    assert f"{failure}, mujoco 3, jax 0, python 3; the figures are of 2026-01-01.\n" in page
    places = [page.index(text) for text in ("| c | 64 | 11,111 |", "## Unknown machine", f"{failure}.\n")]
    assert places == sorted(places)
    assert (tmp_path / "plots" / "throughput_1.png").exists()
    add_run(tmp_path, run_of("2026-03-03", walk_of(22222.0)))
    page = (tmp_path / "results.md").read_text()
    assert "22,222" in page
    assert page.count("failed") == 1, "of the unknown machine"


def test_lines_that_cannot_be_read_are_kept_and_mentioned(tmp_path) -> None:
    unreadable = b'{"cut off\n\xff\xfe\n{}\n'
    later = {"case": "taste", "engine": "c", "sweetness": 3}
    add_run(tmp_path, run_of("2026-01-01", walk_of(11111.0), later))
    path = tmp_path / "results.jsonl"
    path.write_bytes(path.read_bytes() + unreadable.rstrip(b"\n"))
    add_run(tmp_path, run_of("2026-02-02", walk_of(22222.0, worlds=128)))
    assert unreadable in path.read_bytes(), "byte for byte, and what comes next has a line of its own"
    page = (tmp_path / "results.md").read_text()
    assert "11,111" in page
    assert "22,222" in page
    assert "Lines 2, 3 and 4 of results.jsonl cannot be read, and are not shown." in page
    assert "Line 1 of results.jsonl has a case 'taste' that this version does not know; it is not shown." in page


def test_a_good_line_without_a_figure_costs_only_that_figure(tmp_path) -> None:
    bare = {"case": "throughput", "engine": "abacus", "worlds": 1, "steps_per_second": 3.0}
    start = {"case": "startup", "engine": "c", "worlds": 64}
    add_run(tmp_path, run_of("2026-01-01", walk_of(11111.0), bare, start))
    page = (tmp_path / "results.md").read_text()
    assert "| abacus | 1 | 3 | - |" in page
    assert "Line 1 of results.jsonl has a case 'startup' that cannot be read; it is not shown." in page


def test_two_runs_into_one_directory_do_not_meet(tmp_path) -> None:
    """The second is refused before it measures anything, as is a directory of another kind."""
    with RunDirectory(tmp_path / "a", "benchmarks"):
        result = call("bench", "--into", tmp_path / "a")
    assert result.exit_code == 1
    assert f"another process works in {tmp_path / 'a'}" in result.stderr
    (tmp_path / "run.json").write_text('{"kind": "tuning"}')
    result = call("bench", "--into", tmp_path)
    assert result.exit_code == 2
    assert "holds a tuning, and not benchmarks" in result.stderr
