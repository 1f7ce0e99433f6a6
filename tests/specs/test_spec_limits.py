# Tests of specs/reading.py, specs/walk.py
"""Limits of spec files: bytes, values, depth, the worlds of a batch, and the length of a run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from command import refused
from fakes.search_fake import SPEED as SEARCH
from fakes.strangers import write_text
from fakes.sweep_fake import FakeSimulator
from fakes.tune_fake import SPEC as TUNE

from nermo_mjx.learn.spec import Training
from nermo_mjx.optimize import Search, Tuning
from nermo_mjx.specs import reading
from nermo_mjx.specs.reading import SpecError, read_file
from nermo_mjx.sweep import Sweep, run_sweep


@pytest.mark.parametrize(
    ("function", "spec", "message"),
    [
        (
            Sweep.from_dict,
            {"vary": {"frequency": [0.8]}, "run": {"cycles": 1e300}},
            "field 'run.cycles' is 1e+300",
        ),
        (
            Sweep.from_dict,
            {"vary": {"frequency": [0.8]}, "run": {"duration": 1e12}},
            "field 'run.duration'",
        ),
        (
            Search.from_dict,
            SEARCH | {"batch": 100_000},
            "field 'batch' is 100,000: 100,000 worlds at once take 5.0 GB",
        ),
        (
            Search.from_dict,
            SEARCH | {"batch": 700, "randomize": {"repeats": 100}},
            "70,000 worlds at once take 3.5 GB",
        ),
        (Tuning.from_dict, TUNE | {"starts": 100_000}, "500,000 worlds at once take 25.0 GB"),
        (
            Tuning.from_dict,
            TUNE | {"starts": 30_000},
            "each with 5 walks: 150,000 worlds at once take 7",
        ),
        (
            Training.from_dict,
            {"worlds": 500_000, "steps": 1_000_000},
            "500,000 worlds at once take 25.0 GB",
        ),
        *(
            (
                function,
                spec | {"pilot": {"waypoints": {"points": [[0.0, 0.0], [0.0, -0.5], [far, -1.0]]}}},
                message,
            )
            for function, spec in (
                (Sweep.from_dict, {"vary": {"frequency": [0.8]}}),
                (Search.from_dict, SEARCH),
                (Tuning.from_dict, TUNE),
                (Training.from_dict, {}),
            )
            for far, message in (
                (1e308, "field 'pilot.waypoints.points' is refused: Way point 2 is (1e+308, -1): "),
            )
        ),
    ],
)
def test_a_batch_that_does_not_fit_and_a_run_without_end_are_refused(
    function: Any, spec: Any, message: str
) -> None:
    with pytest.raises(SpecError, match=re.escape(message)):
        function(spec)


def test_the_ticks_of_a_sweep_have_a_limit(tmp_path: Path) -> None:
    spec = {
        "vary": {"frequency": {"linspace": [1e-3, 2e-3, 100]}},
        "run": {"cycles": 100},
        "randomize": {"repeats": 1000},
        "plots": False,
    }
    with pytest.raises(SpecError, match=r"simulates .* s in 100,000 runs: allowed are 1e\+09 s"):
        run_sweep(spec, tmp_path, chunk=1000, simulator=FakeSimulator())
    with pytest.raises(SpecError, match=r"chunk is 100,000: 100,000 worlds at once take 5\.0 GB"):
        run_sweep(
            spec | {"run": {"duration": 1.0}}, tmp_path, chunk=100_000, simulator=FakeSimulator()
        )


@pytest.mark.release
def test_yaml_has_a_limit_of_values_and_of_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(text: str, reason: str) -> None:
        with pytest.raises(SpecError, match=reason):
            read_file(write_text(tmp_path / "a.yaml", text))

    refused("# " + "x" * (1 << 23), "it has 8 MB: allowed are 8 MB")
    refused("vary: [" + "1," * 60_000 + "1]", "holds more than 50,000 values")
    monkeypatch.setattr(reading, "_MAX_YAML_VALUES", 100)
    refused("a: {" + "".join(f"b{i}: 1, " for i in range(60)) + "}", "holds more than 100 values")


PAIRS = ("ab", "bc", "cd", "de")


MERGED = (
    "a: &a {"
    + ", ".join(f"k{i}: 1" for i in range(300))
    + "}\n"
    + "".join(f"b{i}: {{<<: *a}}\n" for i in range(400))
)


@pytest.mark.release
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "a: &a [x]\n" + "".join(f"{b}: &{b} [{', '.join(['*' + a] * 60)}]\n" for a, b in PAIRS),
            "^x:1: aliases stand for more than 100,000 values",
        ),
        (MERGED, "aliases stand for more than"),
        ("run: {duration: 1}\nset: " + "[" * 900, "^x:2: .*too deep in one another"),
        ("set: " + "[" * 30_000, "^x:1: .*too deep"),
        ("set: " + "{a: " * 900, "^x:1: .*too deep"),
        ("\n".join(" " * i + "a:" for i in range(900)), "^x:900: .*too deep"),
        (
            "run: {duration: 1e30, warmup: 0.5}\nvary: {frequency: [0.6]}",
            r"^x:1: field 'run.duration' is 1e\+30: allowed is \(0, 100000\]",
        ),
        ("run: {cycles: 1e30}\nvary: {frequency: [0.6]}", "field 'run.cycles' is"),
        (
            "pilot: {straight: {distance: 1e30}}\nvary: {frequency: [0.6]}",
            "field 'pilot.straight.distance' is",
        ),
        ("vary: {frequency: [" + "1" * 400 + "]}", "field 'frequency' is the number 111"),
    ],
)
def test_files_without_end_are_refused(text: str, message: str) -> None:
    refused(Sweep.from_text, message, text, "x")
