"""Compiled programs shared by all tests: each engine compiles once a session, and the persistent cache outlives it."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator

import chromium
import numpy as np
import pytest

from nermo_mjx import runtime
from nermo_mjx.rollout import Run, RunResult, Setup, Simulator

runtime.start_jax()  # before a test does, with too few threads for large batches on two cores


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that compile for minutes come first, so that no process is left alone with one in the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, item.path.name != "test_walk_gradient.py"))


@functools.cache
def _simulator(setup: Setup, engine: str) -> Simulator:
    return Simulator(setup, engine)


@pytest.fixture(scope="session")
def drawing():
    """Skips, with the remedy, where nothing can draw; in CI, which installs a library, that is a failure."""
    try:
        runtime.require_gl()
    except runtime.RenderingUnavailable as missing:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(missing))


@pytest.fixture(scope="module")
def program() -> str:
    """Path of a browser; skips, with the remedy, where there is none. In CI, which installs one, that is a failure."""
    path = chromium.find()
    if path is None:
        remedy = "no Chromium to test pages in: `apt-get install chromium`, or set CHROMIUM to the path of one"
        if os.environ.get("CI"):
            pytest.fail(remedy)
        pytest.skip(remedy)
    return path


@pytest.fixture(scope="module")
def browser(program: str) -> Iterator[chromium.Browser]:
    with chromium.browser(program) as running:
        yield running


@pytest.fixture(scope="session")
def simulator():
    """`simulator(engine="c", **setup)`: one simulator for each combination, with the programs it has compiled."""

    def make(engine: str = "c", **choices: str) -> Simulator:
        return _simulator(Setup(**choices), engine)

    return make


#: Eight different walks, the same in all engines: without spine, and with several amplitudes and phases.
WALKS = {
    "frequency": np.full(8, 0.8),
    "spine.amplitude": np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4]),
    "spine.phase": np.array([0.0, 0.0, -0.5, -0.5, -0.5, 0.0, np.pi / 2, np.pi]),
}
WALK_RUN = Run(cycles=5, warmup_cycles=1)


@pytest.fixture(scope="session")
def walks(simulator):
    """`walks(engine)`: `WALKS` recorded on an engine, once a session (in MJX this is the session's one compilation)."""

    @functools.cache
    def run(engine: str) -> RunResult:
        return simulator(engine, spine="stride_extension").run(WALKS, WALK_RUN, record=True)

    return run
