"""A cached traced program is reused by other processes, and never confused with another one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx import programs
from nermo_mjx.programs import Program
from nermo_mjx.rollout import Run, Setup, metric
from nermo_mjx.rollout.differentiable import Rollout

pytestmark = pytest.mark.compiles


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NERMO_MJX_CACHE", str(tmp_path))
    return tmp_path / "traced"


class Traced:
    """Counts how often a function is traced: x -> (factor x, {"sum": sum of x})."""

    def __init__(self, factor=2.0):
        self.factor, self.times = factor, 0

    def __call__(self, x):
        self.times += 1
        return self.factor * x, {"sum": x.sum()}


def run(identity, function, n=3):
    """By a program that is made as in a new process."""
    y, rest = Program(function, identity)(jnp.arange(float(n)))
    return np.asarray(y).tolist(), float(rest["sum"])


def test_a_program_is_traced_once_for_all_processes(folder):
    """The next one reads it, with the same results; each shape is a program of its own."""
    function = Traced()
    assert run("a", function) == run("a", function) == ([0.0, 2.0, 4.0], 3.0)
    assert (function.times, len(list(folder.iterdir()))) == (1, 1)
    assert run("a", function, 4) == ([0.0, 2.0, 4.0, 6.0], 6.0)
    assert (function.times, len(list(folder.iterdir()))) == (2, 2)


def test_what_it_gave_may_be_given_to_it_without_compiling_again(folder):
    """A tuner's next points come out of what the program gave for the last ones."""
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **about: compiled.append(event) if "backend_compile" in event else None
    )
    program = Program(Traced(), "a")
    y, _ = program(jnp.arange(3.0))
    before = len(compiled)
    program(y)
    assert (before > 0, len(compiled)) == (True, before)


@pytest.mark.parametrize("change", ["identity", "source", "version", "setting"])
def test_another_program_is_not_found(folder, monkeypatch, change):
    """What decides a program is in its name: here the same shapes give three times the argument."""
    run("a", Traced())
    if change == "source":
        monkeypatch.setattr(programs, "_sources", lambda: "other")
    if change == "version":
        monkeypatch.setattr(programs, "_versions", lambda: ("other",))
    if change == "setting":
        monkeypatch.setattr(programs, "_SETTINGS", ())
    assert run("b" if change == "identity" else "a", Traced(3.0))[0] == [0.0, 3.0, 6.0]


@pytest.mark.parametrize("content", [b"", b"nermo-mjx program 1\n", b"half", b"flipped", b"unknown"])
def test_a_damaged_file_is_traced_again(folder, content):
    """Cut, overwritten, a bit turned, or whole and of something else: never used, never an error, and mended."""
    run("a", Traced())
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    damaged = {b"half": whole[: len(whole) // 2], b"flipped": whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:]}
    if content == b"unknown":
        programs._write(path, b"no program")
    else:
        path.write_bytes(damaged.get(content, content))
    function = Traced()
    assert run("a", function)[0] == [0.0, 2.0, 4.0]
    assert function.times == 1
    assert run("a", function)[0] == [0.0, 2.0, 4.0]
    assert function.times == 1


def test_what_was_longest_not_used_goes_first(folder, monkeypatch):
    """Together the files keep to their limit."""
    sizes = []
    for name in "abc":
        run(name, Traced())
        sizes.append(max(path.stat().st_size for path in folder.iterdir()))
    run("a", Traced())  # used now, so that b is the oldest
    monkeypatch.setattr(programs, "MOST_BYTES", int(3.5 * max(sizes)))
    run("d", Traced())
    function = Traced()
    for name in "acd":
        run(name, function)
    assert function.times == 0
    run("b", function)
    assert function.times == 1


@pytest.mark.parametrize("why", ["no identity", "no cache", "not writable"])
def test_nothing_is_kept_where_nothing_may_be(folder, monkeypatch, why):
    """Code of the user's, a user who wants no cache, a place that is a file: it runs, and leaves nothing."""
    if why == "no cache":
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    if why == "not writable":
        folder.write_text("")
    assert run(None if why == "no identity" else "a", Traced())[0] == [0.0, 2.0, 4.0]
    assert not folder.is_dir()


def test_a_walk_is_told_apart_by_all_that_it_is_made_of():
    """By setup, length and robot; one with a metric of the user's has no identity that could be known."""
    given = [
        Rollout(Setup(), Run(duration=0.1, warmup=0.0)),
        Rollout(Setup(gait="lat"), Run(duration=0.1, warmup=0.0)),
        Rollout(Setup(), Run(duration=0.2, warmup=0.0)),
        Rollout(Setup(tail="articulated"), Run(duration=0.1, warmup=0.0)),
        Rollout(Setup(), Run(duration=0.1, warmup=0.0), slowest=0.4),
    ]
    assert len({each.identity for each in given}) == len(given)
    assert given[0].identity == Rollout(Setup(), Run(duration=0.1, warmup=0.0)).identity

    @metric(unit="m")
    def behind(sensors):
        """How far behind the origin."""
        return sensors.position[1]

    assert Rollout(Setup(metrics=(behind,)), Run(duration=0.1, warmup=0.0)).identity is None
