"""What a test needs is its mark; what needs nothing is `fast`; and the tests marked `long` say when they last ran."""

from __future__ import annotations

import datetime
import importlib.util
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pytest

from nermo_mjx.version import __version__

#: Mark -> what a test needs that has it. What has none of them is marked `fast`.
NEEDS: Final = {
    "compiles": "compiles programs of the controller or the robot, or simulates: seconds of a core",
    "process": "starts other processes, which import JAX anew or wait for each other",
    "cluster": "starts a Ray cluster",
    "draws": "draws figures, pictures or videos",
    "browser": "opens pages in a browser",
    "slow": "compiles MJX, or takes several seconds",
    "release": "builds the site, runs notebooks, examples, experiments, a cluster or a browser, or widens what a "
    "shorter test of the suite shows: with -m release only",
    "long": "takes a minute or more and resembles other tests, or needs the machine for itself: with -m long only",
}
#: Fixtures that bring what they need to whatever asks for them.
OF_FIXTURES: Final = {
    "simulator": "compiles",
    "walks": "compiles",
    "of_leg": "compiles",
    "of_spine": "compiles",
    "drawing": "draws",
    "program": "browser",
    "browser": "browser",
}
#: Marks and fixtures of the tests that are marked `release`, beside those that say so themselves.
RELEASED: Final = {"cluster", "browser", "site", "kernel"}
#: When each test marked `long` last passed, null if it has not yet: `pytest -m long` writes it.
LAST_RUN: Final = Path(__file__).with_name("long.json")


def needs(*packages: str) -> None:
    """Skip a test if one of these packages, which extras bring, is not installed; none of them is imported."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"without {' and '.join(missing)}: pip install '.[test-all]'")


def mark(items: Iterable[pytest.Item]) -> None:
    """Mark tests by the fixtures they ask for, and as `fast` where nothing is marked."""
    for item in items:
        for fixture in OF_FIXTURES.keys() & set(getattr(item, "fixturenames", ())):
            item.add_marker(OF_FIXTURES[fixture])
        needed = {name for name in NEEDS if item.get_closest_marker(name)} | set(getattr(item, "fixturenames", ()))
        if needed & RELEASED and "release" not in needed:
            item.add_marker("release")
        if not any(item.get_closest_marker(name) for name in NEEDS):
            item.add_marker("fast")


def sort(items: list[pytest.Item], first: Sequence[str]) -> None:
    """Files that take minutes come first, so that no process is left alone with one in the end."""
    order = {name: place for place, name in enumerate(first)}
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (order.get(item.path.name, len(order)), item.path not in slow))


def last_runs() -> dict[str, dict[str, Any] | None]:
    """Test -> day and version of its last run, and how long it took [s]."""
    found: dict[str, dict[str, Any] | None] = json.loads(LAST_RUN.read_text()) if LAST_RUN.exists() else {}
    return found


def note(seconds: Mapping[str, float]) -> None:
    """Write down that tests marked `long` have passed today, with the time that each took [s]."""
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    ran = {name: {"day": day, "version": __version__, "seconds": round(took)} for name, took in seconds.items()}
    if ran:
        LAST_RUN.write_text(json.dumps(dict(sorted((last_runs() | ran).items())), indent=1) + "\n")


def sentence() -> str:
    """When the tests marked `long` last passed."""
    runs = last_runs()
    days = sorted(run["day"] for run in runs.values() if run)
    never = sorted({test.partition("[")[0].partition("::")[2] or test for test, run in runs.items() if not run})
    told = f"{len(days)} last passed between {days[0]} and {days[-1]}" if days else ""
    return "; ".join(part for part in (told, f"not yet: {', '.join(never)}" if never else "") if part)
