"""A program that one process traced is found by the next one, and by nobody for whom it would be wrong."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx import runtime
from nermo_mjx.control.controller import Controller
from nermo_mjx.control.pilot import tabulated
from nermo_mjx.physics import program_cache
from nermo_mjx.physics.program_cache import KeptProgram, is_ours, model_digest, source_digest
from nermo_mjx.rollout.loop import ClosedLoop


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Iterator[Path]:
    """Where this test's programs are."""
    monkeypatch.setenv("NERMO_MJX_CACHE", str(tmp_path))
    # JAX keeps its own beside them, which it does where the machine's user has not switched it off.
    if not jax.config.jax_compilation_cache_dir:
        pytest.skip("JAX's compilation cache is switched off on this machine")
    source_digest.cache_clear()
    monkeypatch.setattr(runtime, "STARTED", np.inf)  # files that are edited during a session of tests
    yield tmp_path / "programs"
    source_digest.cache_clear()


class Counted:
    """A function of pytrees that counts how often it is traced; `factor` is closed over."""

    def __init__(self, factor: float = 2.0) -> None:
        self.factor, self.traced = factor, 0

    def scale(self, tree, times, power=1):
        self.traced += 1
        root = jnp.linalg.cholesky(jnp.outer(tree["a"], tree["a"]) + jnp.eye(len(tree["a"])))
        return {"a": self.factor * times * tree["a"] ** power}, root


def tree(n: int = 3) -> dict[str, jax.Array]:
    return {"a": jnp.arange(n, dtype=jnp.float32)}


def call(closed_over: str | None = "two", factor: float = 2.0, argument=None, power: int = 1) -> tuple[np.ndarray, int]:
    """What a new process would get and how often it would trace."""
    counted = Counted(factor)
    program = KeptProgram(counted.scale, closed_over, static=(2,))
    result, root = program(argument or tree(), np.float32(1.0), power)
    program(argument or tree(), np.float32(3.0), power)
    assert root.shape == (len(result["a"]),) * 2
    return np.asarray(result["a"]), counted.traced


def test_the_next_process_does_not_trace(folder):
    """The first one traces once for all calls of a shape, the second not at all; results are those of the function."""
    expected = 2.0 * np.arange(3)
    first, traced = call()
    assert traced == 1
    assert len(list(folder.iterdir())) == 1
    second, traced_again = call()
    assert traced_again == 0
    np.testing.assert_array_equal(first, expected)
    np.testing.assert_array_equal(second, expected)


def test_whatever_differs_is_traced_anew(folder, monkeypatch):
    """Shapes, types, static arguments, what is closed over, settings of JAX, versions and sources."""
    assert call()[1] == 1
    assert call(argument=tree(4))[1] == 1
    assert call(argument={"a": jnp.arange(3)})[1] == 1
    assert call(power=2)[1] == 1
    result, traced = call("three", factor=3.0)
    assert (traced, result[1]) == (1, 3.0)
    with jax.default_matmul_precision("float32"):
        assert call()[1] == 1
    assert call()[1] == 0, "what is alike is still found"
    for name, value in (("source_digest", lambda: "other"), ("LIBRARIES", ("jax",))):
        with monkeypatch.context() as patch:
            patch.setattr(program_cache, name, value)
            program_cache._environment.cache_clear()
            assert call()[1] == 1
        program_cache._environment.cache_clear()
    assert call()[1] == 0


@pytest.mark.parametrize("content", ["cut", "flipped", b"", b"no program", b"\x80\x04."])
def test_a_damaged_or_foreign_file_is_made_anew(folder, content):
    """Silently, with right results, and whole afterwards."""
    call()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    middle = len(whole) // 2
    damaged = {"cut": whole[:middle], "flipped": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]}
    file.write_bytes(damaged.get(content, content))
    result, traced = call()
    assert traced == 1
    np.testing.assert_array_equal(result, 2.0 * np.arange(3))
    assert [file.name for file in folder.iterdir()] == [file.name]
    assert call()[1] == 0


def test_a_folder_that_cannot_be_written_is_no_error(folder):
    folder.parent.mkdir(exist_ok=True)
    folder.write_text("")
    assert call()[1] == 1
    assert call()[1] == 1


def test_nothing_is_kept_where_the_key_would_be_incomplete(folder, monkeypatch):
    """Without a text for what is closed over; when a source is younger than this process; without JAX's cache."""
    assert call(None)[1] == 1
    with monkeypatch.context() as patch:
        patch.setattr(runtime, "STARTED", 0.0)
        source_digest.cache_clear()
        assert source_digest() is None
        assert call()[1] == 1
    source_digest.cache_clear()
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert call()[1] == 1
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    assert not folder.exists()


def test_old_programs_make_room(folder, monkeypatch):
    """The one used least recently goes first."""
    monkeypatch.setattr(program_cache, "MOST_FILES", 2)
    call()
    (oldest,) = folder.iterdir()
    call(argument=tree(4))
    (other,) = set(folder.iterdir()) - {oldest}
    for age, file in ((20.0, other), (10.0, oldest)):
        os.utime(file, (file.stat().st_atime, file.stat().st_mtime - age))
    call(argument=tree(5))
    assert oldest.exists()
    assert not other.exists()
    assert len(list(folder.iterdir())) == 2


def test_donated_arguments_give_their_memory():
    """As under `jax.jit`: the argument is gone, the others stay."""
    kept = KeptProgram(lambda a, b: (a[0] + b,), "sum", donated=(0,))
    a, b = jnp.ones(1000), jnp.ones(1000)
    (total,) = kept((a,), b)
    assert a.is_deleted()
    assert not b.is_deleted()
    assert total[0] == 2.0


def test_what_jax_cannot_write_runs_all_the_same(folder):
    """A call back into this process, for instance."""
    kept = KeptProgram(lambda a: jax.pure_callback(np.sin, jax.ShapeDtypeStruct(a.shape, a.dtype), a), "sine")
    for _ in range(2):
        np.testing.assert_allclose(kept(jnp.ones(3)), np.sin(1.0), rtol=1e-6)
    assert not folder.exists()


# --- what is closed over


def test_a_robots_loop_has_an_identity_unless_its_command_is_any_function(simulator):
    """A table of commands is told by its numbers; a function of the user's is not, nor a class of the user's."""
    robot = simulator().robot

    def identity(command, kind=ClosedLoop):
        return kind(robot, Controller(pilot="external", command=command)).identity

    tables = [tabulated([0.0, 1.0], 0.1, [0.0, turn]) for turn in (0.1, 0.2, 0.1)]
    first, second, third = map(identity, tables)
    assert first == third != second
    assert identity(lambda time: (0.1, 0.0)) is None
    assert identity(tables[0], type("Mine", (ClosedLoop,), {"__module__": "mine"})) is None
    assert not is_ours(robot, 3.0)


def test_models_are_told_apart_by_any_number(simulator):
    model = simulator().robot.model.__copy__()
    before = model_digest(model)
    assert model_digest(simulator().robot.model) == before
    model.opt.ls_iterations += 1
    assert model_digest(model) != before


def test_the_sources_are_all_of_the_packages(tmp_path, monkeypatch):
    """A changed, a new and a renamed file change the digest."""
    package = tmp_path / "package"
    (package / "sub").mkdir(parents=True)
    (package / "runtime.py").write_text("a = 1\n")
    (package / "sub" / "other.py").write_text("b = 1\n")
    monkeypatch.setattr(runtime, "__file__", str(package / "runtime.py"))
    seen = set()
    for change in (
        lambda: None,
        lambda: (package / "sub" / "other.py").write_text("b = 2\n"),
        lambda: (package / "new.py").write_text(""),
        lambda: (package / "new.py").rename(package / "newer.py"),
    ):
        change()
        source_digest.cache_clear()
        seen.add(source_digest())
    assert len(seen) == 4
    assert None not in seen
