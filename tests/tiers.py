"""The record of the last run of each test marked `long`."""

from __future__ import annotations

import datetime
import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pytest

from nermo_mjx.version import __version__

#: When each test marked `long` last passed, null if it has not yet: `pytest -m long` writes it.
LAST_RUN: Final = Path(__file__).with_name("long.json")


def needs(*packages: str) -> None:
    """Skip a test if one of these packages, which extras bring, is not installed; none of them is imported."""
    missing_packages = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing_packages:
        pytest.skip(f"without {' and '.join(missing_packages)}: pip install '.[test-all]'")


def last_runs() -> dict[str, dict[str, Any] | None]:
    """Test -> day and version of its last run, and how long it took [s]."""
    runs: dict[str, dict[str, Any] | None] = (
        json.loads(LAST_RUN.read_text()) if LAST_RUN.exists() else {}
    )
    return runs


def note(seconds: Mapping[str, float]) -> None:
    """Write down that tests marked `long` have passed today, with the time that each took [s]."""
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    ran = {
        name: {"day": day, "version": __version__, "seconds": round(took)}
        for name, took in seconds.items()
    }
    if ran:
        LAST_RUN.write_text(json.dumps(dict(sorted((last_runs() | ran).items())), indent=1) + "\n")


def sentence() -> str:
    """When the tests marked `long` last passed."""
    runs = last_runs()
    days = sorted(run["day"] for run in runs.values() if run)
    never = sorted(
        {test.partition("[")[0].partition("::")[2] or test for test, run in runs.items() if not run}
    )
    interval = f"{len(days)} last passed between {days[0]} and {days[-1]}" if days else ""
    return "; ".join(
        part for part in (interval, f"not yet: {', '.join(never)}" if never else "") if part
    )
