# Tests of tests/guard.py
"""The guard of the default run: which programs count for a test, and what fails in CI."""

from __future__ import annotations

import collections
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import guard
import jax
import pytest

TESTS = """
import jax, pytest

def programs(count):
    for i in range(count):
        jax.jit(lambda x: x + 0.5 + i)(1.0)

lazy = [jax.jit(lambda x: x - 0.5 - i) for i in range(6)]

@pytest.fixture(scope="module", params=range(2))
def setup(request):
    programs(20)

@pytest.fixture(scope="module")
def small():
    programs(8)

def test_few(setup, small):
    programs(2)

def test_shared():
    programs(FEW)
    [each(1.0) for each in lazy]

@pytest.mark.release
def test_released():
    programs(90)

@pytest.mark.parametrize("case", range(3))
def test_shared_again(case):
    [each(1.0) for each in lazy]
"""


@pytest.mark.release
def test_ci_fails_for_many_programs_and_for_many_setups(tmp_path: Path) -> None:
    """Of two files with the same programs, each has its own, and a third one has as many as are allowed; the cases of
    a fixture are two setups."""
    (tmp_path / "conftest.py").write_text(
        "import guard; guard.MOST_SETUPS, guard.MOST_PROGRAMS = 5, 8\n"
    )
    for name, program_count in (("a", 15), ("b", 15), ("c", 14)):
        (tmp_path / f"test_{name}.py").write_text(TESTS.replace("FEW", str(program_count)))
    process = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "guard",
            "-p",
            "no:cacheprovider",
            "-rE",
            "-n",
            "1",
            tmp_path,
        ],
        env=os.environ | {"CI": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 1
    message = "its default tests create 25 programs, more than 8 for each of 3 functions; most of them: test_shared 21, "
    counts = [
        process.stdout.count(f"\ntest_{name}.py: {message}") for name in ("a", "b")
    ]  # by the test and at the end
    assert counts == [2, 2], process.stdout
    assert "\ntest_c.py: " not in process.stdout
    assert "2 errors" in process.stdout
    assert "more than 5 shared setups, with their programs: 6" in process.stdout
    assert "  20 test_a.py::setup[1]" in process.stdout


def test_the_programs_of_a_file_count_in_any_order() -> None:
    limit = 3 * guard.MOST_PROGRAMS  # of three functions
    counts = {"test_a": limit - 4, "test_b[0]": 2, "test_b[1]": 2, "test_c": 0}
    assert guard.too_many(counts) == ""
    message = guard.too_many(counts | {"test_b[1]": 3})
    assert f"{limit + 1} programs" in message
    assert message == guard.too_many({"test_c": 0, "test_b[1]": 3} | counts | {"test_b[1]": 3})


@pytest.mark.parametrize(
    ("marks", "reason", "outcome"),
    [
        ((), "Skipped: could not import 'duckdb'", "failed"),
        ((), "Skipped: without ribs: pip install '.[test-all]'", "failed"),
        (("extra",), "Skipped: could not import 'duckdb'", "skipped"),
        (("release",), "Skipped: could not import 'duckdb'", "skipped"),
        ((), "Skipped: no /dev/full", "skipped"),
    ],
)
def test_a_default_test_that_is_skipped_without_an_extra_has_its_mark(
    marks: tuple[str, ...], reason: str, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Item:
        def get_closest_marker(self, name: str) -> bool:
            return name in marks

    class Report:
        skipped, outcome, longrepr = True, "skipped", ("test_a.py", 1, reason)

    monkeypatch.setattr(guard, "ENFORCED", True)
    item: Any = Item()
    generator, report = guard.pytest_runtest_makereport(item), Report()
    next(generator)
    with pytest.raises(StopIteration):
        generator.send(report)
    assert report.outcome == outcome


def test_too_many_setups_fail_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    class Session:
        exitstatus = 0

    session: Any = Session()
    monkeypatch.setattr(guard, "ENFORCED", True)
    monkeypatch.setattr(guard, "_setups", collections.Counter(map(str, range(guard.MOST_SETUPS))))
    guard.pytest_sessionfinish(session)
    assert session.exitstatus == 0
    guard._setups["one more"] = 1
    guard.pytest_sessionfinish(session)
    assert session.exitstatus == 1


def test_programs_of_a_shared_setup_do_not_count_for_the_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(guard, "_programs", collections.Counter())
    jax.jit(lambda x: x + 0.25)(1.0)
    with guard.shared("a"):
        for number in range(3):
            jax.jit(lambda x: x + number)(1.0)  # noqa: B023
        with guard.shared("b"):
            jax.jit(lambda x: x - 0.25)(1.0)
    assert guard._programs == {"": 1, "a": 3, "b": 1}


def test_a_process_that_becomes_too_large_fails_the_test_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Item:
        def __init__(self) -> None:
            self.stash, self.user_properties, self.name = (
                {guard.PEAK: previous_peak},
                list[Any](),
                "test",
            )
            self.path = Path("a")

        def get_closest_marker(self, _: str) -> None: ...

    def torn_down() -> Item:
        item: Any = Item()
        generator = guard.pytest_runtest_teardown(item, item)
        next(generator)
        with pytest.raises(StopIteration):
            generator.send(None)
        return item

    monkeypatch.setattr(guard, "ENFORCED", True)
    previous_peak, peak = 2 * guard.GIB, 3 * guard.GIB
    monkeypatch.setattr(guard, "peak_bytes", lambda: peak)
    torn_down()
    peak += guard.GIB
    with pytest.raises(pytest.fail.Exception, match=r"takes 4\.0 GiB, more than 3 GiB"):
        torn_down()
    previous_peak = peak
    torn_down()


def test_the_end_of_a_file_frees_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    class Item:
        def __init__(self, path: str) -> None:
            self.path, self.stash = Path(path), dict[Any, int]()

    freed: list[bool] = []
    monkeypatch.setattr(guard, "free", lambda: freed.append(True))
    monkeypatch.setattr(guard, "_file", [Path("a")])
    for used_bytes in (guard.FREED_BYTES, guard.FREED_BYTES + 1):
        monkeypatch.setattr(guard, "resident_bytes", lambda used_bytes=used_bytes: used_bytes)
        for following in ("a", "b"):
            item, next_item = Item("a"), Item(following)
            generator = guard.pytest_runtest_protocol(item, next_item)  # type: ignore[arg-type]
            next(generator)
            with pytest.raises(StopIteration):
                generator.send(True)
    assert freed == [True], "only at the end of the file, and only beyond the limit"
