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

def test_few(setup):
    programs(8)

def test_many():
    programs(9)

@pytest.mark.release
def test_released():
    programs(9)

def test_first():
    programs(2)
    [each(1.0) for each in lazy]
"""


@pytest.mark.release
@pytest.mark.parametrize("setups", [1, 2])
def test_ci_fails_for_many_programs_and_for_many_setups(setups: int, tmp_path: Path) -> None:
    """Of two files with the same tests, each starts without programs: the order of the files changes nothing."""
    (tmp_path / "conftest.py").write_text(f"import guard; guard.MOST_SETUPS = {2 * setups - 1}\n")
    for name in ("a", "b")[:setups]:
        (tmp_path / f"test_{name}.py").write_text(TESTS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "guard", "-p", "no:cacheprovider", "-rf", tmp_path],
        env=os.environ | {"CI": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    failed = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("FAILED")]
    assert failed == [f"test_{name}.py::test_many" for name in ("a", "b")[:setups]], done.stdout
    assert "The test creates 9 programs, more than 8" in done.stdout
    assert f"more than {2 * setups - 1} shared setups, with their programs: {2 * setups}" in done.stdout
    assert "  20 test_a.py::setup[1]" in done.stdout


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


def test_programs_of_a_shared_setup_do_not_count_for_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "_programs", collections.Counter())
    jax.jit(lambda x: x + 0.25)(1.0)
    with guard.shared("a"):
        for more in range(3):
            jax.jit(lambda x: x + more)(1.0)  # noqa: B023
        with guard.shared("b"):
            jax.jit(lambda x: x - 0.25)(1.0)
    assert guard._programs == {"": 1, "a": 3, "b": 1}


def test_a_process_that_becomes_too_large_fails_the_test_once(monkeypatch: pytest.MonkeyPatch) -> None:
    class Item:
        def __init__(self) -> None:
            self.stash, self.user_properties = {guard.PEAK: before}, list[Any]()

        def get_closest_marker(self, _: str) -> None: ...

    def torn_down() -> Item:
        item: Any = Item()
        generator = guard.pytest_runtest_teardown(item)
        next(generator)
        with pytest.raises(StopIteration):
            generator.send(None)
        return item

    monkeypatch.setattr(guard, "ENFORCED", True)
    before, peak = 2 * guard.GIB, 3 * guard.GIB
    monkeypatch.setattr(guard, "peak_bytes", lambda: peak)
    torn_down()
    peak += guard.GIB
    with pytest.raises(pytest.fail.Exception, match=r"takes 4\.0 GiB, more than 3 GiB"):
        torn_down()
    before = peak
    torn_down()


def test_the_end_of_a_file_frees_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    class Item:
        def __init__(self, path: str) -> None:
            self.path, self.stash = Path(path), dict[Any, int]()

    freed: list[bool] = []
    monkeypatch.setattr(guard, "free", lambda: freed.append(True))
    monkeypatch.setattr(guard, "_file", [Path("a")])
    for used in (guard.FREED_BYTES, guard.FREED_BYTES + 1):
        monkeypatch.setattr(guard, "resident_bytes", lambda used=used: used)
        for following in ("a", "b"):
            item, after = Item("a"), Item(following)
            generator = guard.pytest_runtest_protocol(item, after)  # type: ignore[arg-type]
            next(generator)
            with pytest.raises(StopIteration):
                generator.send(True)
    assert freed == [True], "only at the end of the file, and only beyond the limit"
