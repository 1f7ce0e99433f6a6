"""Selection of measurements, isolation of failures, and the page of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import pytest
from click.testing import CliRunner

from nermo_mjx.bench import CASES, Benchmark, Option, apart, plan, run_bench
from nermo_mjx.bench.results import COLUMNS, RESULTS, append, draw_page
from nermo_mjx.cli import main
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
    import importlib

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


def add_run(folder: Path, run: dict[str, Any]) -> None:
    """Add a run and draw the page, as `bench --into` does."""
    append(folder / RESULTS, run)
    draw_page(folder)


def test_the_page_shows_the_newest_of_each_kind_by_machine(tmp_path) -> None:
    def run(device: str, date: str, *lines: dict[str, Any]) -> dict[str, Any]:
        return run_of(date, *lines, hardware=HARDWARE | {"device": device})

    walk = walk_of
    start = {"case": "startup", "engine": "c", "worlds": 64, "cold_s": 5.5, "warm_s": 3.5,
             "cold": {"import_s": 1.25, "training_s": 30.5}, "warm": {"import_s": 1.0, "training_s": 2.5}}  # fmt: skip
    add_run(tmp_path, run("1 x cpu", "2026-01-01", walk(11111.0), walk(22222.0, worlds=128)))
    add_run(tmp_path, run("1 x cpu", "2026-02-02", walk(33333.0), start))
    add_run(tmp_path, run("1 x gpu", "2026-03-03", {"case": "gradient", "mode": "reverse", "worlds": 16, "cycles": 1.0,
                                                    "error": "no memory"}))  # fmt: skip
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
        "case": "throughput", "engine": "c", "worlds": 64, "steps_per_second": rate, "ratio": 0.9,
        "plain_steps_per_second": rate, "peak_bytes": 1e9, "trace_s": 1.0, "compile_s": 1.0,
        "plain_trace_s": 0.0, "plain_compile_s": 0.0,
    } | more  # fmt: skip


FAILED = {"case": "throughput", "engine": "c", "worlds": 64, "error": "no memory"}


def test_a_failed_newest_run_stands_beside_the_last_good_figures_and_says_when(tmp_path) -> None:
    add_run(tmp_path, run_of("2026-01-01", walk_of(11111.0)))
    add_run(tmp_path, run_of("2026-02-02", FAILED))
    page = (tmp_path / "results.md").read_text()
    assert "| c | 64 | 11,111 |" in page
    assert (
        "- throughput (engine c, worlds 64) failed: no memory. That was on 2026-02-02, commit abc, mujoco 3, jax 0, "
        "python 3; the figures are of 2026-01-01.\n" in page
    )
    assert (tmp_path / "plots" / "throughput_1.png").exists()
    add_run(tmp_path, run_of("2026-03-03", walk_of(22222.0)))
    page = (tmp_path / "results.md").read_text()
    assert "22,222" in page
    assert "failed" not in page, "what went well again is no failure any more"


def test_a_run_that_ended_before_it_knew_its_machine_is_shown(tmp_path) -> None:
    add_run(tmp_path, run_of("2026-01-01", walk_of(11111.0)))
    add_run(tmp_path, run_of("2026-02-02", FAILED, hardware=None))
    page = (tmp_path / "results.md").read_text()
    assert "11,111" in page
    failed = page.index("failed: no memory. That was on 2026-02-02, commit abc.")
    assert page.index("11,111") < page.index("## Unknown machine") < failed


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
        result = CliRunner().invoke(main, ["bench", "--into", str(tmp_path / "a")])
    assert result.exit_code == 1
    assert f"another process works in {tmp_path / 'a'}" in result.stderr
    (tmp_path / "run.json").write_text('{"kind": "tuning"}')
    result = CliRunner().invoke(main, ["bench", "--into", str(tmp_path)])
    assert result.exit_code == 2
    assert "holds a tuning, and not benchmarks" in result.stderr
