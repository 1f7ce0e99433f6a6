"""What is read of a program that was compiled for a GPU, and that every program can be compiled for one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from nermo_mjx.bench import registry
from nermo_mjx.bench.gpu_plan import LAUNCH_S, ROUNDS, WAIT_S, figures
from nermo_mjx.bench.gpu_programs import PROGRAMS, Program
from nermo_mjx.bench.gpu_targets import TARGETS
from nermo_mjx.bench.hlo import Module, Work
from nermo_mjx.bench.registry import CASES
from nermo_mjx.cli import choices, main

#: As XLA compiled it for an H100: a tick of five steps, repeated as often as the caller says, on four worlds of three
#: numbers. A step halves the state in a loop of unknown length (a kernel, and one for the condition), makes matrices
#: (a kernel) and factors them (a library call), adds the result (a kernel), and counts its round (a kernel). The tick
#: adds a row of a table of a thousand (a kernel).
LOOPS = (Path(__file__).parent / "data" / "gpu_loops.hlo").read_text()
STATE, MATRICES, FLAGS, COUNTER = 4 * 3 * 4, 4 * 3 * 3 * 4, 4 * 4, 4
HALVING = Work(kernels=2, waits=1, bytes=(STATE + STATE) + (STATE + 1))


def step(rounds: int) -> Work:
    """One physics step of `LOOPS`, counted by hand."""
    counting, making = 2 * COUNTER, STATE + MATRICES
    factoring = MATRICES + (MATRICES + FLAGS)
    adding = (STATE + MATRICES + FLAGS) + STATE
    return Work(kernels=3, libraries=1, bytes=counting + making + factoring + adding) + HALVING * rounds


def tick(rounds: int) -> Work:
    """One tick of `LOOPS`: of the table it reads one row, 12 bytes; its condition compares two numbers."""
    adding, counting, comparing = STATE + 3 * 4 + COUNTER + STATE, 2 * COUNTER, 2 * COUNTER + 1
    own = Work(kernels=3, copies=1, waits=1, bytes=adding + counting + comparing + 2 * COUNTER)
    return own + step(rounds) * 5


@pytest.mark.parametrize("rounds", [1, 3])
def test_launches_loops_and_bytes_are_those_of_the_text(rounds: int) -> None:
    module = Module(LOOPS, rounds)
    loops = list(module.loops(module.entry))
    assert [(loop.rounds, times) for loop, times in loops] == [(None, 1), (5, rounds), (None, 5 * rounds)]
    over_ticks, over_steps, halving = (loop for loop, _ in loops)
    assert module.round(halving) == HALVING
    assert module.round(over_steps) == step(rounds)
    assert module.round(over_ticks) == tick(rounds)
    assert module.work(module.entry) == tick(rounds) * rounds + Work(copies=1, bytes=2 * COUNTER)


def test_the_figures_of_a_step_leave_out_the_tick_and_the_bounds_do_not() -> None:
    """With as many rounds as are assumed; the loop over ticks is none of a tick."""
    program = Program(lambda: None, (), (), None, 5)
    gpu = TARGETS["t4"]
    found = figures(LOOPS, program, 4, gpu)
    assert found["kernels_per_step"] == 3 + 2 * ROUNDS
    assert (found["library_calls_per_step"], found["copies_per_step"]) == (1, 0)
    assert found["launches_per_step"] == 4 + 2 * ROUNDS
    assert found["launches_per_tick"] == 5 * (4 + 2 * ROUNDS) + 4
    assert found["unknown_loops"] == 1
    assert found["moved_bytes_per_step"] == round(step(ROUNDS).bytes / 4)
    seconds = found["launches_per_tick"] * LAUNCH_S + (5 * ROUNDS + 1) * WAIT_S
    assert found["estimated_launch_bound"] == pytest.approx(4 * 5 / seconds)
    assert found["estimated_bandwidth_bound"] == pytest.approx(4 * 5 * gpu.bandwidth / tick(ROUNDS).bytes)


#: Two ticks in a loop of known length, with two loops over the three steps in each, as reverse mode has them; a branch;
#: a call; and a result that is written into its row of what is kept.
BRANCHES = """HloModule jit_gradient

%keeping (param_0: f32[2,8], param_1: f32[8], param_2: s32[]) -> f32[2,8] {
  %param_0 = f32[2,8]{1,0} parameter(0)
  %param_1 = f32[8]{0} parameter(1)
  %param_2 = s32[] parameter(2)
  %zero = s32[] constant(0)
  %row = f32[1,8]{1,0} bitcast(%param_1)
  ROOT %kept = f32[2,8]{1,0} dynamic-update-slice(%param_0, %row, %param_2, %zero)
}

%short (x.1: f32[8]) -> f32[8] {
  %x.1 = f32[8]{0} parameter(0)
  ROOT %negated = f32[8]{0} negate(%x.1)
}

%long (x.2: f32[8]) -> f32[8] {
  %x.2 = f32[8]{0} parameter(0)
  %once = f32[8]{0} negate(%x.2)
  ROOT %twice = f32[8]{0} copy(%once)
}

%step_forward (x.3: f32[8]) -> f32[8] {
  %x.3 = f32[8]{0} parameter(0)
  ROOT %called = f32[8]{0} call(%x.3), to_apply=%short
}

%step_backward (x.4: f32[8]) -> f32[8] {
  %x.4 = f32[8]{0} parameter(0)
  %which = pred[] constant(true)
  ROOT %chosen = f32[8]{0} conditional(%which, %x.4, %x.4), true_computation=%short, false_computation=%long
}

%more (x.5: f32[8]) -> pred[] {
  %x.5 = f32[8]{0} parameter(0)
  ROOT %yes = pred[] constant(true)
}

%tick (x.6: (s32[], f32[8], f32[2,8])) -> (s32[], f32[8], f32[2,8]) {
  %x.6 = (s32[], f32[8]{0}, /*index=2*/f32[2,8]{1,0}) parameter(0)
  %count = s32[] get-tuple-element(%x.6), index=0
  %state = f32[8]{0} get-tuple-element(%x.6), index=1
  %rows = f32[2,8]{1,0} get-tuple-element(%x.6), index=2
  %while.1 = f32[8]{0} while(%state), condition=%more, body=%step_forward, backend_config={"known_trip_count":{"n":"3"}}
  %while.2 = f32[8]{0} while(%while.1), condition=%more, body=%step_backward, backend_config={"known_trip_count":{"n":"3"}}
  %keep = f32[2,8]{1,0} fusion(%rows, %while.2, %count), kind=kLoop, calls=%keeping
  ROOT %next = (s32[], f32[8]{0}, f32[2,8]{1,0}) tuple(%count, %while.2, %keep)
}

%more_ticks (x.7: (s32[], f32[8], f32[2,8])) -> pred[] {
  %x.7 = (s32[], f32[8]{0}, f32[2,8]{1,0}) parameter(0)
  ROOT %go_on = pred[] constant(true)
}

ENTRY %main (x.8: (s32[], f32[8], f32[2,8])) -> (s32[], f32[8], f32[2,8]) {
  %x.8 = (s32[], f32[8]{0}, f32[2,8]{1,0}) parameter(0)
  ROOT %all = (s32[], f32[8]{0}, f32[2,8]{1,0}) while(%x.8), condition=%more_ticks, body=%tick, backend_config={"known_trip_count":{"n":"2"}}
}
"""  # noqa: E501


def test_forward_and_backward_steps_count_as_one_step_and_the_longer_branch_counts() -> None:
    program = Program(lambda: None, (), (), 2, 3)
    found = figures(BRANCHES, program, 1, TARGETS["h100"])
    assert (found["kernels_per_step"], found["copies_per_step"], found["unknown_loops"]) == (2, 1, 0)
    assert found["launches_per_tick"] == 3 * 3 + 1
    assert found["moved_bytes_per_step"] == 3 * 2 * 32
    # A row is written into what is kept; the rest of that is neither read nor written.
    kept = 2 * 32 + COUNTER
    tick_bytes = 3 * 3 * 2 * 32 + kept
    assert found["estimated_bandwidth_bound"] == pytest.approx(3 * TARGETS["h100"].bandwidth / tick_bytes)


def test_a_text_that_is_no_program_is_refused() -> None:
    with pytest.raises(ValueError, match="no ENTRY"):
        Module("HloModule nothing\n", 1)


def test_the_names_that_may_be_given_are_those_that_exist() -> None:
    options = CASES["gpu-plan"].options
    assert options["target"].allowed == choices.GPU_TARGETS == tuple(TARGETS)
    assert options["program"].allowed == choices.GPU_PROGRAMS == tuple(PROGRAMS)


@pytest.mark.parametrize("missing", ["jax_cuda12_plugin", "nvidia.cuda_nvcc"])
def test_without_the_extra_one_sentence_says_what_to_install(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before anything is compiled."""

    def find(name: str) -> Any:
        if name == missing and "." in name:  # Python raises where the package around it is missing, too
            raise ModuleNotFoundError
        return None if name == missing else object()

    monkeypatch.setattr(registry.importlib.util, "find_spec", find)
    result = CliRunner().invoke(main, ["bench", "gpu-plan", "--worlds", "8", "--json"])
    assert result.exit_code == 2
    assert f"gpu-plan needs {missing}, which is not installed: pip install 'nermo-mjx[gpu-plan]'." in result.stderr
    assert not result.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name == "walk" else pytest.param(name, marks=pytest.mark.long) for name in PROGRAMS]
)
def test_every_program_can_be_lowered_for_gpus_and_tpus(name: str) -> None:
    """For both at once, whatever is here: no operation of it is one that another platform lacks.

    Tracing a gradient takes half a minute: those of test_walk_gradient.py are lowered from a trace that is there.
    """
    program = PROGRAMS[name](2)
    text = program.jitted().trace(*program.arguments).lower(lowering_platforms=("cuda", "tpu")).as_text()
    assert "stablehlo.while" in text
    assert "cusolver" in text
