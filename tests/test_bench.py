"""Which measurements a user asks for, that one that fails costs no other, and the page that runs leave."""

from __future__ import annotations

import json
from typing import Any

import pytest

from nermo_mjx.bench import CASES, apart, run_bench
from nermo_mjx.bench.columns import COLUMNS, rows
from nermo_mjx.bench.page import add_run
from nermo_mjx.bench.registry import Case, Option, plan
from nermo_mjx.cli.choices import BENCH_CASES
from nermo_mjx.robot import ParameterError

HARDWARE = {"device": "1 x cpu", "cores": 2, "cpu": "some processor", "mujoco": "3", "jax": "0", "python": "3"}


def test_each_combination_is_measured_and_what_is_not_given_has_its_default() -> None:
    assert plan(["gradient"], {"mode": ("reverse",), "cycles": (1.0, 2.0), "worlds": ()}) == [
        ("gradient", {"mode": "reverse", "worlds": 16, "cycles": 1.0}),
        ("gradient", {"mode": "reverse", "worlds": 16, "cycles": 2.0}),
    ]
    both = plan(["throughput", "tuning"], {"engine": ("c",), "worlds": (8,), "frequency": (0.6,)})
    assert both == [("throughput", {"engine": "c", "worlds": 8}), ("tuning", {"frequency": 0.6})]


@pytest.mark.parametrize(
    ("cases", "options", "message"),
    [
        (["speed"], {}, "case is 'speed': allowed is one of throughput, "),
        (["throughput"], {"engine": ("cpu",)}, "engine is 'cpu': allowed is one of c, mjx, warp."),
        (["throughput"], {"worlds": (0,)}, "worlds is 0: allowed is a whole number from 1."),
        (["gradient"], {"cycles": (float("nan"),)}, r"cycles is nan: allowed is \(0, inf\)."),
        (["throughput"], {"cycles": (1.0,)}, "cycles is given, but not measured: it is an option of gradient."),
    ],
)
def test_wrong_use_is_refused_before_anything_is_measured(cases: Any, options: Any, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        run_bench(cases, options)


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
    """The process may be gone, or have raised."""
    case = Case("", place, {name: Option((value,)) for name, value in option.items()})
    _, figures = apart(case, option)
    assert message in figures["error"]
    assert "\n" not in figures["error"]


def test_a_walk_is_measured_on_the_c_engine() -> None:
    """A small batch: the figures that spec and page rely on are there, and are those of one walk and its physics."""
    result = run_bench(("throughput",), {"engine": ("c",), "worlds": (2,)})
    (line,) = result["cases"]
    assert (line["case"], line["engine"], line["worlds"]) == ("throughput", "c", 2)
    assert line["ratio"] == pytest.approx(line["steps_per_second"] / line["plain_steps_per_second"], rel=0.5)
    assert line["seconds_simulated_per_second"] == pytest.approx(0.002 * line["steps_per_second"])
    assert result["hardware"]["mujoco"] == "3.17.0"
    assert result["date"] < "3"


def test_the_page_shows_the_newest_of_each_kind_by_machine(tmp_path) -> None:
    def run(device: str, date: str, *lines: dict[str, Any]) -> dict[str, Any]:
        return {"date": date, "commit": "abc", "hardware": HARDWARE | {"device": device}, "cases": list(lines)}

    def walk(rate: float, worlds: int = 64) -> dict[str, Any]:
        return {
            "case": "throughput", "engine": "c", "worlds": worlds, "steps_per_second": rate, "ratio": 0.9,
            "plain_steps_per_second": rate, "peak_bytes": 1e9, "trace_s": 1.0, "compile_s": 1.0,
            "plain_trace_s": 0.0, "plain_compile_s": 0.0,
        }  # fmt: skip

    start = {"case": "startup", "engine": "c", "worlds": 64, "cold_s": 5.5, "warm_s": 3.5,
             "cold": {"import_s": 1.25}, "warm": {"import_s": 1.0}}  # fmt: skip
    add_run(tmp_path, run("1 x cpu", "2026-01-01", walk(11111.0), walk(22222.0, 128)))
    add_run(tmp_path, run("1 x cpu", "2026-02-02", walk(33333.0), start))
    add_run(tmp_path, run("1 x gpu", "2026-03-03", {"case": "gradient", "mode": "reverse", "worlds": 16, "cycles": 1.0,
                                                    "error": "no memory"}))  # fmt: skip
    page = (tmp_path / "results.md").read_text()
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 3
    assert "11,111" not in page
    assert page.index("33,333") < page.index("22,222") < page.index("1 x gpu") < page.index("failed: no memory")
    assert "| c | 64 | cold | 5.5 | 1.2 |" in page
    assert "2026-02-02" in page
    assert sorted(path.name for path in (tmp_path / "plots").glob("*.png")) == ["compile_1.png", "throughput_1.png"]


def test_rows_of_a_case_with_parts() -> None:
    """A profile has a row a stage, a tuning one a search."""
    stages = [{"stage": "solver", "us": 2.0}, {"stage": "tendons", "us": 1.0}]
    found = list(rows({"case": "profile", "engine": "c", "worlds": 1, "step_us": 3.0, "stages": stages}))
    assert [(row["engine"], row["stage"], row["us"]) for row in found] == [("c", "solver", 2.0), ("c", "tendons", 1.0)]
    assert json.dumps(found)
