"""Compiled programs shared by all tests: each engine compiles once a session, and the persistent cache outlives it."""

from __future__ import annotations

import collections
import contextlib
import functools
import gc
import importlib
import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import chromium
import guard
import jax
import numpy as np
import pytest
import shapes
import tiers

# Without bytecode each of the processes that a run starts compiles the package anew, for 3 s of a core, and each of
# those that run tests compiles all tests, for 7 s.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    sys.dont_write_bytecode = False

from nermo_mjx import runtime
from nermo_mjx.physics import c_engine, resolve_engine
from nermo_mjx.plotting import files
from nermo_mjx.rollout import Run, RunResult, Setup, Simulator
from nermo_mjx.rollout.setup import without_presettings


def known_flags(flags: str) -> str:
    """The XLA flags of a list that this XLA knows: an unknown one would end the process.

    Another process for each flag finds out, in about 0.3 s. Call it before JAX starts.
    """
    code = "from jaxlib import _jax; _jax.CompileOptions().executable_build_options.debug_options"
    processes = {
        flag: subprocess.Popen(
            [sys.executable, "-c", code],
            env=os.environ | {"XLA_FLAGS": flag},
            stderr=subprocess.DEVNULL,
        )
        for flag in flags.split()
    }
    return " ".join(flag for flag, process in processes.items() if process.wait() == 0)


# Programs of a test run for seconds and compile for longer: XLA does not optimize machine code and leaves out LLVM's
# slow passes (a sixth of the time of derivatives of the step), takes its older emitter for all programs, not only for
# those of the package (`runtime.COMPILER_OPTIONS`: a Jacobian of the metrics takes 3.7 s of processor time instead of
# 9.3), and does not split them among threads, here and in processes that tests start, unless asked to (CI does, for
# what it runs of the wheel). A walk's loop takes three times as long.
QUICK_TO_COMPILE = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    " --xla_llvm_disable_expensive_passes=true"
)
if "xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = (
        f"{os.environ.get('XLA_FLAGS', '')} {known_flags(QUICK_TO_COMPILE)}".strip()
    )
files._FILE_DPI = 100  # figures are drawn at half their size
os.fsync = lambda _: (
    None
)  # no test cuts the power, and a process that is killed has written what it wrote
gc.disable()  # until all is imported and collected: a quarter of the time of both
gc.set_threshold(
    50_000, 20, 10
)  # tracing makes millions of small objects: with Python's own, a twentieth of the time
jax.config.update(
    "jax_traceback_in_locations_limit", 0
)  # nobody reads where in Python an operation comes from
runtime.start_jax()  # before a test does, with too few threads for large batches on two cores

c_engine.BLOCK_WORLDS = 8  # most tests simulate one to six worlds: with 32 lanes these have the same bits, and take longer

TESTS = Path(__file__).parent
# Tests of one room share what those of another define.
sys.path.extend(sorted({str(path.parent) for path in TESTS.rglob("test_*.py")} - {str(TESTS)}))

#: The longest files of the default run and of `-m release` begin first, so that no process ends long after the others.
FIRST = (
    "test_docs.py",
    "test_tune_walk.py",  # a notebook finds its program compiled
    "test_experiments.py",
    "test_wire.py",  # this file and the next two wait for clocks and browsers while others compute
    "test_explore_browser.py",
    "test_viewer_browser.py",
    "test_special_states.py",
    "test_notebooks.py",
    "test_walk_gradient.py",
    "test_ray_workers.py",
    "test_controller.py",
    "test_pushes.py",
    "test_own_task.py",
    "test_differentiable_step.py",
    "test_leg_kinematics.py",
    "test_tune_directory.py",
    "test_tune_run.py",
    "test_second_derivatives.py",
    "test_engines.py",
    "test_c_engine.py",
    "test_rollout_on_c.py",
    "test_training.py",
)
#: Seconds of each test marked `long` that has passed, setup included; in the process that collects reports.
_passed: collections.Counter[str] = collections.Counter()
LONG = pytest.StashKey[list[str]]()


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(guard)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """For `-n auto`: one process more than there are cores, which works while others wait, and memory for them."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None
    processes = runtime.cpu_count() + 1
    if hasattr(os, "sysconf"):  # not on Windows
        processes = min(
            processes, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // guard.MOST_BYTES
        )
    return max(1, processes)


def _mark_cases(item: pytest.Item) -> None:
    """Remove the mark `release(cases=...)` of a parametrized test from all cases but those that the mark lists."""
    for mark in [
        mark for mark in item.own_markers if mark.name == "release" and "cases" in mark.kwargs
    ]:
        if item.callspec.id not in mark.kwargs["cases"]:
            item.own_markers.remove(mark)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        _mark_cases(item)
    order = {name: rank for rank, name in enumerate(FIRST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))
    config.stash[LONG] = [item.nodeid for item in items if item.get_closest_marker("long")]


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, Any, Any]:
    """Of all tests each process compiles its share first, and finds the bytecode of the others' shares afterwards.

    Existing objects live until the end: the garbage collector need not traverse them repeatedly.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker and session.config.args == session.config.getini("testpaths"):
        names = sorted(path.stem for path in TESTS.rglob("test_*.py"))
        for name in names[int(worker["workerid"].removeprefix("gw")) :: worker["workercount"]]:
            with contextlib.suppress(
                Exception, pytest.skip.Exception
            ):  # which are reported when it is collected
                importlib.import_module(name)
    result = yield
    gc.freeze()
    gc.enable()
    return result


def pytest_runtest_setup() -> None:
    shapes.calls.clear()


def pytest_unconfigure() -> None:
    gc.unfreeze()  # libraries complain of what is not collected at the end
    gc.callbacks.clear()  # xdist interrupts its processes, and hypothesis' callback would tell of it


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if "long" not in report.keywords:
        return
    if report.when == "setup":
        _passed[report.nodeid] = 0
    if report.passed and report.nodeid in _passed:
        _passed[report.nodeid] += report.duration
    else:
        _passed.pop(report.nodeid, None)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """In the process that collects reports: long tests are recorded and reported."""
    tiers.note(_passed)
    terminalreporter.write_line(f"tests marked long (pytest -m long): {tiers.sentence()}")


#: Modules that make simulators by this name.
MAKERS = (
    "rollout",
    "sweep.forecast",
    "sweep.replay",
    "sweep.simulating",
    "optimize.problems",
    "learn.evaluation",
    "experiments.walks",
    "live.driving",
    "live.wire",
)


def _name(setup: Setup, engine: str) -> str:
    plain = Setup().fields()
    return " ".join(
        [
            guard.SIMULATOR + engine,
            *(f"{n}={v}" for n, v in setup.fields().items() if v != plain.get(n)),
        ]
    )


class SharedSimulator(Simulator):
    """A simulator whose programs count for the simulator, not for the first test that uses them."""

    def run(self, *arguments: Any, **keywords: Any) -> RunResult:
        with guard.shared(_name(without_presettings(self.setup), self.engine.name)):
            return super().run(*arguments, **keywords)


@functools.cache
def _first_of(setup: Setup, engine: str) -> Simulator:
    with guard.shared(_name(setup, engine)):
        return SharedSimulator(setup, engine)


def shared_simulator(setup: Setup | None = None, engine: str = "auto", **options: Any) -> Simulator:
    """One for each setup and engine, with the programs it has compiled, which are the same for all gaits."""
    setup = setup or Setup()
    if options:
        return Simulator(setup, engine, **options)
    return _first_of(without_presettings(setup), resolve_engine(engine)).with_setup(setup)


@pytest.fixture(scope="module")
def shared_simulators() -> Iterator[None]:
    """What the tests of a file simulate by commands and functions shares simulators: one for each setup and engine."""
    with pytest.MonkeyPatch.context() as patch:
        for module in MAKERS:
            patch.setattr(f"nermo_mjx.{module}.Simulator", shared_simulator)
        yield


@pytest.fixture(scope="session")
def drawing():
    """Skips, with the remedy, where nothing can draw; in CI, which installs a library, that is a failure."""
    from nermo_mjx.view import offscreen

    try:
        offscreen.require_gl()
    except offscreen.RenderingUnavailable as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def program() -> str:
    """Path of a Chromium."""
    return chromium.require()


@pytest.fixture(scope="module")
def browser(program: str) -> Iterator[chromium.Browser]:
    with chromium.browser(program) as running:
        yield running


@pytest.fixture(scope="session")
def simulator():
    """`simulator(engine="c", **setup)`: one simulator for each combination, with the programs it has compiled."""

    def make(engine: str = "c", **choices: str) -> Simulator:
        return shared_simulator(Setup(**choices), engine)

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


@pytest.fixture
def canary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that is there when the stranger's code was run; it is also in the way of a careless import."""
    from fakes.strangers import CANARY

    from nermo_mjx.control import protocol

    log = tmp_path / "run by mistake"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    protocol._imported.cache_clear()
    (tmp_path / "own.py").write_text(CANARY.format(log=str(log)))
    return log


@pytest.fixture
def compilations():
    """Names of the programs XLA has compiled since the fixture began, cache hits included."""
    programs: list[str] = []

    def listen(event: str, duration: float, **details: str) -> None:
        if event == guard.COMPILED:
            programs.append(details.get("fun_name", "program"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield programs
    jax.monitoring.unregister_event_duration_listener(listen)
