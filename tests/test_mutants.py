# Tests of tests/mutants.py
"""The list of mutants: each mutant fits the package, and a run finds the test that kills it."""

from __future__ import annotations

import shutil
from pathlib import Path

import mutants
import pytest
from mutants import DEFAULT, MUTANTS, Mutant


def test_every_mutant_still_fits_the_package() -> None:
    """The old text is found exactly once, and the mutated module is Python; every subpackage has a mutant."""
    assert mutants.check() == []
    package = mutants.ROOT / "nermo_mjx"
    subpackages = {path.parent.name for path in package.glob("*/__init__.py")}
    assert {mutant.subpackage for mutant in MUTANTS.values()} == subpackages | {"nermo_mjx"}
    assert len(MUTANTS) == 60


def test_the_tests_of_a_module_come_first() -> None:
    """Those that name or import it, then those of its folder, then all others."""
    first, second, third = mutants.selections(MUTANTS["newton_early"], mutants.ROOT, nearest=False)
    assert "tests/dynamics/test_solver.py" in first
    assert "tests/sweep/test_counting.py" not in first
    assert second[0] == "tests/dynamics"
    assert {f"--ignore={path}" for path in first} <= set(second)
    assert third[0] == "tests"
    assert len(list(mutants.selections(MUTANTS["newton_early"], mutants.ROOT, nearest=True))) == 2


@pytest.mark.release
def test_a_run_names_the_test_that_kills_a_mutant_and_ignores_tests_that_always_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a small repository: one mutant is killed, and nothing finds the other."""
    (tmp_path / "nermo_mjx").mkdir()
    (tmp_path / "nermo_mjx" / "__init__.py").touch()
    (tmp_path / "nermo_mjx" / "sums.py").write_text(
        "def total(a, b):\n    return a + b\n\n\ndef less(a):\n    return a - 1\n"
    )
    (tmp_path / "tests").mkdir()
    shutil.copy(mutants.__file__, tmp_path / "tests")
    (tmp_path / "tests" / "test_sums.py").write_text(
        "from nermo_mjx.sums import total\n\n\ndef test_that_fails():\n    assert total(1, 2) == 4\n\n\n"
        "def test_of_a_total():\n    assert total(1, 2) == 3\n"
    )
    small = {
        "minus": Mutant("sums.py", "a + b", "a - b", "A sum is a difference."),
        "more": Mutant("sums.py", "a - 1", "a + 1", "Less is more."),
    }
    monkeypatch.setattr(mutants, "MUTANTS", small)
    rows = [mutants.kill(name, [DEFAULT], nearest=False, root=tmp_path) for name in small]
    assert [row["test"] for row in rows] == ["tests/test_sums.py::test_of_a_total", ""]
    assert float(rows[0]["test_seconds"]) < 1.0
    assert "a + b" in (tmp_path / "nermo_mjx" / "sums.py").read_text()
    assert mutants.table(rows, [DEFAULT]).endswith("1 of 2 (50 %).")
