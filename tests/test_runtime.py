"""What is settled before JAX starts: no hang on small machines, a compilation cache, and nothing overridden."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nermo_mjx import runtime

SETTINGS = ("PJRT_NPROC", "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "NERMO_MJX_CACHE")


def run(script: str, **environment: str) -> list[str]:
    """Lines printed by a script in a fresh interpreter, without the settings of this one."""
    clean = {key: value for key, value in os.environ.items() if key not in SETTINGS}
    done = subprocess.run([sys.executable, "-c", script], env=clean | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


SHOW = (
    "import os\nfrom nermo_mjx import runtime\nruntime.cpu_count = lambda: {cores}\nos.environ.pop('PJRT_NPROC', 0)\n"
    "{before}\nruntime.configure_threads()\nprint(os.environ.get('PJRT_NPROC'), runtime.cpu_batch_limit())"
)


def test_a_small_machine_gets_threads_enough_and_a_large_one_is_left_alone() -> None:
    assert run(SHOW.format(cores=2, before="")) == ["8 None"]
    assert run(SHOW.format(cores=16, before="")) == ["None None"]


def test_a_choice_of_the_user_is_kept_and_guarded_where_it_would_hang() -> None:
    assert run(SHOW.format(cores=2, before="os.environ['PJRT_NPROC'] = '1'")) == ["1 None"]
    assert run(SHOW.format(cores=2, before="os.environ['PJRT_NPROC'] = '2'")) == [f"2 {runtime.GUARDED_BATCH}"]


def test_batches_are_limited_where_jax_started_before_us() -> None:
    started = "import jax; jax.devices()"
    assert run(SHOW.format(cores=2, before=started)) == [f"None {runtime.GUARDED_BATCH}"]
    assert run(SHOW.format(cores=2, before="import jax")) == ["8 None"], "imported is not started"


FLAGS = (
    "import os\nfrom nermo_mjx import runtime\n{before}\nruntime.configure_compiler()\n"
    "print(os.environ.get('XLA_FLAGS'))\nimport jax; print(jax.jit(lambda x: x + 1)(1.0))"
)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", " ".join(runtime.COMPILER_FLAGS)),
        (
            "--xla_force_host_platform_device_count=2",
            " ".join(("--xla_force_host_platform_device_count=2", *runtime.COMPILER_FLAGS)),
        ),
        (
            "--xla_cpu_use_fusion_emitters=true",
            f"--xla_cpu_use_fusion_emitters=true {runtime.COMPILER_FLAGS[1]}",
        ),
    ],
)
def test_the_compilers_flags_stand_beside_the_users_and_are_known_to_xla(flags: str, expected: str) -> None:
    assert run(FLAGS.format(before=""), XLA_FLAGS=flags) == [expected, "2.0"]


def test_the_compilers_flags_are_not_set_where_jax_started_before_us() -> None:
    started = "os.environ.pop('XLA_FLAGS', 0); import jax; jax.devices()"
    assert run(FLAGS.format(before=started))[0] == "None"


CACHE = (
    "{first}import nermo_mjx.runtime as r; r.configure_cache(); import jax; print(jax.config.jax_compilation_cache_dir)"
)


@pytest.mark.parametrize("first", ["", "import jax; "])
def test_the_cache_is_on_by_default_whenever_jax_is_imported(tmp_path: Path, first: str) -> None:
    (directory,) = run(CACHE.format(first=first), NERMO_MJX_CACHE=str(tmp_path / "cache"))
    assert directory.startswith(str(tmp_path / "cache"))
    assert Path(directory).is_dir()


def test_the_users_cache_is_kept_and_a_directory_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    script = CACHE.format(first="")
    assert run(script, JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == [str(tmp_path)]
    (tmp_path / "file").write_text("")
    assert run(script, NERMO_MJX_CACHE=str(tmp_path / "file" / "below")) == ["None"]


def test_the_choice_of_the_user_for_gl_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert runtime.choose_gl() == "glfw"


def test_without_any_library_nothing_is_raised_until_something_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(runtime, "_headless_backend", lambda: None)
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    monkeypatch.setattr(runtime, "_gl_problem", None)
    assert runtime.choose_gl() is None
    with pytest.raises(runtime.RenderingUnavailable, match="apt-get install libosmesa6"):
        runtime.require_gl()
