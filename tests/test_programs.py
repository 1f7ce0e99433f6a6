# Tests of runtime.py
"""What runs is the code that is in force: no process finds a program of other code, and few are compiled to start."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nermo_mjx import runtime
from nermo_mjx.rollout import Run, Setup, Simulator, run

HEIGHT = """
import nermo_mjx, numpy as np
from nermo_mjx import runtime
from nermo_mjx.rollout import Run, Setup, Simulator, run
{change}
print(float(Simulator(Setup(), "c").prepare({{"frequency": np.array([0.8])}}, Run(cycles=1)).qpos[0, 2]))
"""
COMPILED = """
import nermo_mjx, jax, numpy as np
from nermo_mjx import runtime
from nermo_mjx.rollout import Run, Setup, Simulator
names = []
def listen(event, duration, **about):
    if event == "/jax/core/compile/backend_compile_duration":
        names.append(about.get("fun_name", "program"))
jax.monitoring.register_event_duration_secs_listener(listen)
simulator = Simulator(Setup(), "c")
batch = simulator.prepare({"frequency": np.array([0.8])}, Run(cycles=1))
simulator.engine.open(batch.params, batch.qpos, batch.fields)
print(*names)
"""


def said(script: str, **settings: str) -> str:
    """Output of a new process."""
    environment = os.environ | {"PYTHONPATH": str(Path(run.__file__).parents[2])} | settings
    words = [sys.executable, "-c", script]
    process = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


@pytest.mark.release
def test_a_constant_that_is_changed_at_run_time_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """As does an edit that is loaded again: a new simulator does not run a program of the old code."""

    def height() -> float:
        simulator = Simulator(Setup(), "c")
        return float(simulator.prepare({"frequency": np.array([0.8])}, Run(cycles=1)).qpos[0, 2])

    former_height = height()
    monkeypatch.setattr(run, "DEPTH", run.DEPTH + 1e-3)
    assert height() == pytest.approx(former_height - 1e-3, abs=1e-7)


@pytest.mark.release
def test_a_process_does_not_find_a_program_of_other_code(tmp_path: Path) -> None:
    """The first one keeps what it compiled of a changed constant; the second has the constant of the sources."""
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    cache["NERMO_MJX_CACHE"] = str(tmp_path)
    changed, plain = (
        float(said(HEIGHT.format(change=change), **cache)) for change in ("run.DEPTH += 1e-3", "")
    )
    assert list((tmp_path / "jax").iterdir())
    assert changed == pytest.approx(plain - 1e-3, abs=1e-7)


@pytest.mark.release
def test_a_handful_of_programs_are_compiled_to_start_the_c_engine() -> None:
    """Operations on single arrays, each compiled by itself, took longer than what a walk needs.

    Whether XLA knows an option is found by compiling with it, unless XLA_FLAGS has it: of JAX 0.12 it does not.
    """
    names = said(COMPILED).split()
    assert "step_once" in " ".join(names)
    options = [name for name in runtime.COMPILER_OPTIONS if name not in os.environ["XLA_FLAGS"]]
    assert len(names) - len(options) <= 6, names
