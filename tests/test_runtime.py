# Tests of runtime.py, __main__.py
"""Settings made when JAX is first needed: no hang on small machines, a compilation cache, and no overrides."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from conftest import known_flags

from nermo_mjx import runtime
from nermo_mjx.cli import options
from nermo_mjx.view import offscreen

SETTINGS = (
    "PJRT_NPROC",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "NERMO_MJX_CACHE",
    "XLA_FLAGS",
    "MUJOCO_GL",
    "NERMO_MJX_THREADS",
)


def run(script: str, **environment: str) -> list[str]:
    """Lines printed by a script in a fresh interpreter, without the settings of this one."""
    clean = {key: value for key, value in os.environ.items() if key not in SETTINGS}
    process = subprocess.run(
        [sys.executable, "-c", script], env=clean | environment, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.splitlines()


IMPORT = """
import importlib, os, pkgutil
plain = dict(os.environ)
import nermo_mjx
print(dict(os.environ) == plain)
import jax
from jax._src import xla_bridge
before = dict(os.environ), dict(jax.config.values)
for module in pkgutil.walk_packages(nermo_mjx.__path__, "nermo_mjx."):
    if not module.name.endswith(("__main__", "_door")):  # what a door leads to is an extra, and does as it likes
        importlib.import_module(module.name)
print((dict(os.environ), dict(jax.config.values)) == before, xla_bridge.backends_are_initialized())
"""


@pytest.mark.release
def test_importing_changes_nothing_in_the_process() -> None:
    """Neither the package nor any of its modules sets a variable or an option of JAX, or starts JAX."""
    lines = run(IMPORT)
    assert (lines[0], lines[-1]) == ("True", "True False")


SHOW = (
    "import os\nfrom nermo_mjx import runtime\nruntime.cpu_count = lambda: {cores}\n{before}\nseen = []\n"
    "find = runtime._find_devices\n"
    "runtime._find_devices = lambda jax: (seen.append(os.environ.get('PJRT_NPROC')), find(jax))\n"
    "given = dict(os.environ)\nruntime.start_jax()\nprint(*seen, runtime.cpu_batch_limit(), given == dict(os.environ))"
)


@pytest.mark.release
def test_a_small_machine_gets_threads_enough_and_a_large_one_is_left_alone() -> None:
    """While JAX starts; the environment is as before afterwards."""
    assert run(SHOW.format(cores=2, before="")) == ["8 None True"]
    assert run(SHOW.format(cores=16, before="")) == ["None None True"]


@pytest.mark.release
def test_a_choice_of_the_user_is_kept_and_guarded_where_it_would_hang() -> None:
    assert run(SHOW.format(cores=2, before="os.environ['PJRT_NPROC'] = '1'")) == ["1 None True"]
    assert run(SHOW.format(cores=2, before="os.environ['PJRT_NPROC'] = '2'")) == [
        f"2 {runtime.GUARDED_BATCH} True"
    ]


@pytest.mark.release
def test_batches_are_limited_where_jax_started_before_us() -> None:
    assert run(SHOW.format(cores=2, before="import jax; jax.devices()")) == [
        f"{runtime.GUARDED_BATCH} True"
    ]
    assert run(SHOW.format(cores=2, before="import jax")) == ["8 None True"], (
        "imported is not started"
    )


TOMORROW = """
from nermo_mjx import runtime
runtime.COMPILER_OPTIONS = {'xla_of_tomorrow': True}
print(runtime.compiler_options())
from nermo_mjx import Run, Setup, Simulator
print(Simulator(Setup(), "c").run({}, Run(duration=0.05, warmup=0.0)).status[0])
"""


@pytest.mark.release
def test_a_robot_walks_with_an_xla_that_knows_none_of_our_options() -> None:
    """They go with each program, and what XLA does not know is left out; as a flag it would end the process."""
    assert known_flags("--xla_of_tomorrow=1 --xla_nor_this") == ""
    assert run(TOMORROW, XLA_FLAGS=os.environ["XLA_FLAGS"]) == ["{}", "ok"]


OPTIONS = """
from nermo_mjx import runtime
import jax
known = {}
for name, value in runtime.COMPILER_OPTIONS.items():
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        known[name] = value
    except RuntimeError:
        pass
print(runtime.compiler_options() == known)
"""


@pytest.mark.release
def test_the_compilers_options_are_those_that_xla_knows_and_give_way_to_the_users() -> None:
    assert run(OPTIONS, JAX_PLATFORMS="cpu") == ["True"]
    users = "--xla_cpu_use_fusion_emitters=true"
    if known_flags(users):
        assert run(
            "from nermo_mjx import runtime; print(runtime.compiler_options())", XLA_FLAGS=users
        ) == ["{}"]


def test_dispatch_is_set_as_before_once_jax_has_started() -> None:
    """It was off while JAX's CPU client was made, which keeps to that; the option is the user's again."""
    script = (
        "import jax; from nermo_mjx import runtime; name = 'jax_cpu_enable_async_dispatch'\n"
        "before = jax.config.read(name); runtime.start_jax(); print(jax.config.read(name) == before)"
    )
    assert run(script) == ["True"]


def test_the_number_of_threads_is_the_callers_or_the_users_or_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert runtime.thread_count(3) == 3
    monkeypatch.setenv(runtime.THREADS_VARIABLE, "5")
    assert runtime.thread_count() == 5
    monkeypatch.delenv(runtime.THREADS_VARIABLE)
    assert runtime.thread_count() == runtime.cpu_count()
    with pytest.raises(ValueError, match=r"^threads is 0: allowed is a whole number from 1 on\.$"):
        runtime.thread_count(0)


CACHE = (
    "{first}import nermo_mjx.runtime as r; r.start_jax(); import jax; "
    "print(jax.config.jax_compilation_cache_dir, jax.config.jax_compilation_cache_max_size)"
)


@pytest.mark.parametrize("first", ["", "import jax; ", "import jax; jax.numpy.ones(3); "])
def test_the_cache_is_on_where_we_compile_and_has_a_size(tmp_path: Path, first: str) -> None:
    (line,) = run(CACHE.format(first=first), NERMO_MJX_CACHE=str(tmp_path / "cache"))
    directory, size = line.split()
    assert directory.startswith(str(tmp_path / "cache"))
    assert Path(directory).is_dir()
    assert int(size) == runtime.MAX_CACHE_BYTES


@pytest.mark.release
def test_the_users_cache_is_kept_and_a_directory_that_cannot_be_written_is_no_error(
    tmp_path: Path,
) -> None:
    script = CACHE.format(first="")
    assert run(script, JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == [f"{tmp_path} -1"]
    (tmp_path / "file").write_text("")
    assert run(script, NERMO_MJX_CACHE=str(tmp_path / "file" / "below")) == ["None -1"]
    ours, _ = run(script, NERMO_MJX_CACHE=str(tmp_path / "ours"))[0].split()
    Path(ours, ".lockfile").touch()
    theirs = "import os; os.access = lambda path, mode: not str(path).endswith('.lockfile')\n"
    assert run(theirs + script, NERMO_MJX_CACHE=str(tmp_path / "ours")) == ["None -1"], (
        "the lock is another user's"
    )


def test_the_choice_of_the_user_for_gl_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is looked for where MuJoCo has been told what to take."""
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(offscreen, "_headless_backend", lambda: pytest.fail("looked for a library"))
    offscreen.require_gl()


def test_commands_take_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """`--threads` stands beside `--engine`, and holds for the processes that a command starts, too."""
    monkeypatch.setenv(runtime.THREADS_VARIABLE, "1")
    command = click.command()(options.engine(lambda engine: click.echo(runtime.thread_count())))
    assert CliRunner().invoke(command, ["--threads", "3"]).output == "3\n"
    result = CliRunner().invoke(command, ["--threads", "0"])
    assert result.exit_code == 2
    assert "--threads" in result.output
