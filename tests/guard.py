"""The limits of the default run: programs that the tests of a file create, shared setups, and memory of a process.

A program is a function that JAX compiles or reads from its cache: the number of programs is the same on every machine.
The first test that uses a program creates it. Therefore the guard adds the programs of a file, and allows
`MOST_PROGRAMS` for each of its test functions: the sum does not depend on the order of the tests. The programs of a
fixture of a module or a session, and the programs of a shared simulator, count for this setup instead, and the default
run contains at most `MOST_SETUPS` setups. With `CI` in the environment a violation is a failure, and each file starts
without programs, so that the sum does not depend on other files. Otherwise the end of the run lists the violations. It
always lists the largest CPU times. Tests marked `release` or `long` do not count.
"""

from __future__ import annotations

import collections
import contextlib
import ctypes
import gc
import os
import re
import resource
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, Final

import jax
import pytest

ENFORCED: Final = bool(os.environ.get("CI"))
#: Programs for each test function of a file, on average.
MOST_PROGRAMS: Final = 24
MOST_SETUPS: Final = 12
#: CPU time of a test, and of a test function with all its cases, that the end of a run lists [s].
TEST_SECONDS: Final = 1.0
FUNCTION_SECONDS: Final = 4.0
GIB: Final = 1024**3
#: Memory of a process beyond which the end of a file frees all programs, and its limit [bytes].
FREED_BYTES: Final = 2 * GIB
MOST_BYTES: Final = 3 * GIB
#: The beginning of the name of a shared simulator: each is a shared setup, and of the fixtures those that create more
#: programs than `MOST_PROGRAMS`.
SIMULATOR: Final = "simulator "
#: The reason why a test is skipped without a package of `[test-all]`: from `importorskip` or from `tiers.needs`.
WITHOUT_EXTRA: Final = re.compile(r"could not import '|\[test-all\]")
COMPILED: Final = "/jax/core/compile/backend_compile_duration"
#: Most entries of a list at the end of a run.
ENTRIES: Final = 20
PEAK: Final = pytest.StashKey[int]()
#: Programs and CPU seconds of the running test, which is "", and of the shared setups that it creates.
_programs: collections.Counter[str] = collections.Counter()
_seconds: collections.Counter[str] = collections.Counter()
_owners, _last_reading = [""], [0.0]
#: The running file, and the programs of its tests so far.
_file, _of_file = [Path()], dict[str, int]()
#: In the process that collects reports: a value for each test, for each shared setup, and for each large process.
_tests: dict[str, dict[str, Any]] = {"programs": {}, "seconds": {}, "memory": {}}
_setups: collections.Counter[str] = collections.Counter()


def _count(event: str, _: float, **__: str | int) -> None:
    if event == COMPILED:
        _programs[_owners[-1]] += 1


jax.monitoring.register_event_duration_secs_listener(_count)


def _charge() -> None:
    """Assign the CPU time since the last call, of this process and of children that ended, to the current owner."""
    usages = [
        resource.getrusage(who_id) for who_id in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    ]
    now = sum(usage.ru_utime + usage.ru_stime for usage in usages)
    _seconds[_owners[-1]] += now - _last_reading[0]
    _last_reading[0] = now


@contextlib.contextmanager
def shared(name: str) -> Iterator[None]:
    """Within this context, programs and CPU time belong to the shared setup of this name."""
    _charge()
    _owners.append(name)
    try:
        yield
    finally:
        _charge()
        _owners.pop()


def peak_bytes() -> int:
    """The largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def resident_bytes() -> int:
    """The resident memory of this process; its largest so far on a system without /proc."""
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    return peak_bytes()


def free() -> None:
    """Free all programs of JAX, and return the memory to the system."""
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):  # a function of glibc
        ctypes.CDLL(None).malloc_trim(0)


def by_default(item: pytest.Item) -> bool:
    return not (item.get_closest_marker("release") or item.get_closest_marker("long"))


def ends_file(item: pytest.Item, following: pytest.Item | None) -> bool:
    return following is None or following.path != item.path


def too_many(programs: dict[str, int]) -> str:
    """A sentence if these programs of the tests of a file are too many; else nothing."""
    functions, created = {test.partition("[")[0] for test in programs}, sum(programs.values())
    largest = sorted(programs, key=lambda test: -programs[test])[:3]
    return (
        f"its default tests create {created} programs, more than {MOST_PROGRAMS} for each of {len(functions)} "
        f"functions; most of them: {', '.join(f'{test} {programs[test]}' for test in largest)}"
        if created > MOST_PROGRAMS * len(functions)
        else ""
    )


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, Any, Any]:
    if _file[0] != item.path:
        _file[0] = item.path
        _of_file.clear()
        if ENFORCED:
            jax.clear_caches()
    item.stash[PEAK] = peak_bytes()
    _charge()
    _programs.clear()
    _seconds.clear()
    result = yield
    if ends_file(item, nextitem) and resident_bytes() > FREED_BYTES:
        free()
    return result


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any, request: Any) -> Generator[None, Any, Any]:
    if fixturedef.scope == "function":
        return (yield)
    with shared(f"{fixturedef.baseid}::{fixturedef.argname}[{getattr(request, 'param_index', 0)}]"):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, Any, Any]:
    _charge()
    if by_default(item):
        _of_file[item.name] = _programs[""]
        item.user_properties.append(("limits", [dict(_programs), _seconds[""]]))
    result = yield
    wrong = []
    if ends_file(item, nextitem) and (message := too_many(_of_file)):
        wrong.append(
            f"{item.path.name}: {message}. Compile whole functions with jax.jit, share programs through a fixture of the "
            "module or the session, or mark tests `release`."
        )
    if (peak := peak_bytes()) > max(MOST_BYTES, item.stash[PEAK]):
        item.user_properties.append(("memory", peak / GIB))
        wrong.append(f"The process takes {peak / GIB:.1f} GiB, more than {MOST_BYTES / GIB:g} GiB.")
    if ENFORCED and wrong:
        pytest.fail("\n".join(wrong), pytrace=False)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, Any]:
    """In CI, a test that is skipped without a package has the mark `extra`, by which `.ci/run release` selects it."""
    report = yield
    is_unmarked = by_default(item) and not item.get_closest_marker("extra")
    if ENFORCED and report.skipped and is_unmarked and WITHOUT_EXTRA.search(str(report.longrepr)):
        report.outcome, report.longrepr = "failed", f"Mark it `extra`. {report.longrepr[2]}"
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    properties: dict[str, Any] = dict(report.user_properties) if report.when == "teardown" else {}
    if "limits" in properties:
        programs, seconds = properties["limits"]
        _tests["programs"][report.nodeid], _tests["seconds"][report.nodeid] = (
            programs.get("", 0),
            seconds,
        )
        dear = {
            name: count
            for name, count in programs.items()
            if count > MOST_PROGRAMS or name.startswith(SIMULATOR)
        }
        _setups.update({name: count for name, count in dear.items() if name})
    if "memory" in properties:
        _tests["memory"][report.nodeid] = properties["memory"]


def _lists() -> Iterator[str]:
    """What exceeds its limit, the largest first."""
    functions, files = (
        collections.Counter[str](),
        collections.defaultdict[str, dict[str, int]](dict),
    )
    for test, seconds in _tests["seconds"].items():
        functions[test.partition("[")[0]] += seconds
        file, _, name = test.partition("::")
        files[file][name] = _tests["programs"][test]
    yield from (
        f"{file}: {message}" for file, programs in files.items() if (message := too_many(programs))
    )
    setups = _setups if len(_setups) > MOST_SETUPS else {}
    kinds: list[tuple[str, Any, float]] = [
        (f"more than {MOST_SETUPS} shared setups, with their programs", setups, 0),
        (
            f"tests after which a process took more than {MOST_BYTES / GIB:g} GiB",
            _tests["memory"],
            0,
        ),
        (f"tests of more than {TEST_SECONDS:g} s of CPU time", _tests["seconds"], TEST_SECONDS),
        (
            f"test functions of more than {FUNCTION_SECONDS:g} s of CPU time",
            functions,
            FUNCTION_SECONDS,
        ),
    ]
    for title, values, limit in kinds:
        beyond = sorted(
            ((value, name) for name, value in values.items() if value > limit), reverse=True
        )
        yield from [f"{title}: {len(beyond)}"] * bool(beyond)
        yield from (f"  {value:.3g} {name}" for value, name in beyond[:ENTRIES])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for line in _lists():
        terminalreporter.write_line(line)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    if ENFORCED and len(_setups) > MOST_SETUPS:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
