# Tests of tests/tiers.py, tests/conftest.py
"""The tests themselves: their names, the order of their files, and the record of the tests that take minutes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import tiers
from conftest import FIRST, LONG, TESTS, pytest_xdist_auto_num_workers

from nermo_mjx import runtime


def test_the_files_that_begin_first_are_files() -> None:
    assert set(FIRST) <= {path.name for path in TESTS.rglob("test_*.py")}


#: Modules whose tests are in another folder, because they show in the results of that folder only.
ELSEWHERE = {
    "dynamics/checkpointing.py": "rollout",  # the backward pass of a rollout
    "hardware/twin.py": "cli",  # the comparison that `log` and `replay` print
    "rollout/eye_metrics.py": "control",  # head control
    "rollout/saving.py": "sweep",  # the series that a sweep stores
    "rollout/transitions.py": "control",  # a schedule's switches
    "runs/work.py": "sweep",  # a sweep asks for rows
    "sweep/scalars.py": "runs",  # the writer of TensorBoard
    "runs/status.py": "cli",  # the command `status`
    "view/trained.py": "learn",  # the page of a training
}


def test_the_first_line_of_each_file_names_the_modules_that_it_tests() -> None:
    """Each module is named in the folder of its room, so that its tests are easy to find."""
    folder, form = Path(__file__).parent, re.compile("# Tests of (.+)")
    package, module_rooms = folder.parent / "nermo_mjx", set[tuple[str, str]]()
    for path in sorted(folder.rglob("test_*.py")):
        line = form.fullmatch(path.read_text().partition("\n")[0])
        assert line is not None, path
        for name in line[1].split(", "):
            assert (package / name).exists() or (folder.parent / name).exists(), (path, name)
            module_rooms.add(
                (name, path.relative_to(folder).parts[0] if path.parent != folder else "")
            )
    modules = [
        path.relative_to(package) for path in package.rglob("*.py") if path.name != "__init__.py"
    ]
    rooms = {
        path.as_posix(): path.parts[0] if path.parent.parts else "" for path in modules
    } | ELSEWHERE
    assert set(rooms.items()) - module_rooms == set()


def test_the_record_lists_the_tests_marked_long_and_no_others(
    request: pytest.FixtureRequest,
) -> None:
    """A file whose package is missing is not collected: there, the code shows that a recorded test exists."""
    collected, recorded = set(request.config.stash[LONG]), set(tiers.last_runs())
    assert collected <= recorded
    functions = {name.partition("[")[0] for name in collected}
    if not any("::" in argument for argument in request.config.args):
        assert {name for name in recorded if name.partition("[")[0] in functions} <= collected
    for file, name in {tuple(test.partition("[")[0].split("::")) for test in recorded}:
        assert f"\ndef {name}(" in (TESTS.parent / file).read_text(encoding="utf-8"), file


def test_a_day_is_written_down_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiers, "LAST_RUN", tmp_path / "long.json")
    tiers.note({})
    assert not tiers.LAST_RUN.exists()
    tiers.LAST_RUN.write_text('{"a": null, "b": null}')
    assert tiers.sentence() == "not yet: a, b"
    tiers.note({"a": 61.4})
    last_run = tiers.last_runs()["a"]
    assert last_run is not None
    assert last_run["seconds"] == 61
    assert (
        tiers.sentence()
        == f"1 last passed between {last_run['day']} and {last_run['day']}; not yet: b"
    )


def test_workers_follow_the_cores_and_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTEST_XDIST_AUTO_NUM_WORKERS", raising=False)
    monkeypatch.setattr(runtime, "cpu_count", lambda: 2)
    monkeypatch.setattr(
        "os.sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 64 * 2**18}.__getitem__
    )
    assert pytest_xdist_auto_num_workers() == 3, "one more than the cores"
    monkeypatch.setattr(runtime, "cpu_count", lambda: 100)
    assert pytest_xdist_auto_num_workers() == 21, "of 64 GiB"
    monkeypatch.setenv("PYTEST_XDIST_AUTO_NUM_WORKERS", "5")
    assert pytest_xdist_auto_num_workers() is None, "what the user says"
