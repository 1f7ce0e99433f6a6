"""Estimates for the programs on a GPU, from XLA's compiler on a machine without one.

The program is compiled to machine code for the target and never run. Launches, loops and bytes are read from the
optimized HLO, memory from the compiler's plan of it. The two bounds on throughput are estimates: of a device that
launches as slowly as `LAUNCH_S` and `WAIT_S` say and computes in no time, and of one that only moves bytes.
"""

from __future__ import annotations

from typing import Any, Final

import jax
from jax.sharding import SingleDeviceSharding

from nermo_mjx.bench.gpu_programs import PROGRAMS, Program
from nermo_mjx.bench.gpu_targets import TARGETS, GpuTarget
from nermo_mjx.bench.hardware import peak_bytes
from nermo_mjx.bench.hlo import Loop, Module, Work
from nermo_mjx.bench.timing import compile_cold

#: Assumed number of iterations of a loop of unknown length. The constraint solver makes as many as the slowest world
#: needs: 2.3 on average for 64 walks, 7 at most.
ROUNDS: Final = 5
#: Assumed, not measured: from the launch of a small kernel to that of the next [s], and how long the host waits to
#: learn whether a loop continues [s].
LAUNCH_S: Final = 2.5e-6
WAIT_S: Final = 15e-6


def gpu_plan_case(target: str, program: str, worlds: int) -> dict[str, Any]:
    """Compile a program for a GPU that need not be present, and analyse the result.

    Args:
        target: name from `TARGETS`.
        program: name from `PROGRAMS`.
        worlds: size of the batch.
    """
    jax.config.update("jax_platforms", "cpu")  # an accelerator in this machine is not used
    gpu = TARGETS[target]
    where = SingleDeviceSharding(gpu.device())
    made = PROGRAMS[program](worlds)
    compiled = compile_cold(made.jitted(where), *made.arguments)
    memory = compiled.program.memory_analysis()
    kept = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    needed = kept + memory.temp_size_in_bytes
    return {
        "trace_s": compiled.trace_s,
        "compile_s": compiled.compile_s,
        "bytes_per_world": needed // worlds,
        "temporary_bytes_per_world": memory.temp_size_in_bytes // worlds,
        "fits": "yes" if needed <= gpu.memory else "no",
        **figures(compiled.program.as_text(), made, worlds, gpu),
        "peak_bytes": peak_bytes(),
    }


def figures(text: str, program: Program, worlds: int, gpu: GpuTarget) -> dict[str, Any]:
    """Launches, loops, bytes and bounds of a compiled program.

    Args:
        text: its optimized HLO.
        program: what was compiled.
        worlds: size of its batch.
        gpu: that it was compiled for, which has the bandwidth.

    Returns:
        Figures `_per_step` are for a physics step without the rest of a control tick, which `launches_per_tick`
        includes. The bounds are for the whole tick, in physics steps of all worlds per second.
    """
    module = Module(text, ROUNDS)
    tick, loops, ticks = _tick(module, program)
    step = _step(module, loops, program.steps_per_tick) * (1.0 / (ticks * program.steps_per_tick))
    tick = tick * (1.0 / ticks)
    steps = worlds * program.steps_per_tick
    return {
        "kernels_per_step": round(step.kernels, 1),
        "library_calls_per_step": round(step.libraries, 1),
        "copies_per_step": round(step.copies, 1),
        "launches_per_step": round(step.launches, 1),
        "launches_per_tick": round(tick.launches, 1),
        "unknown_loops": sum(loop.rounds is None for loop, _ in loops),
        "moved_bytes_per_step": round(step.bytes / worlds),
        "estimated_launch_bound": steps / (tick.launches * LAUNCH_S + tick.waits * WAIT_S),
        "estimated_bandwidth_bound": steps * gpu.bandwidth / tick.bytes,
        "estimated_with": {"rounds": ROUNDS, "launch_s": LAUNCH_S, "wait_s": WAIT_S},
    }


def _tick(module: Module, program: Program) -> tuple[Work, list[tuple[Loop, float]], int]:
    """The work of a run over a number of ticks, its loops, and the ticks.

    If the caller sets the number of ticks, the single loop over them is the outermost one, and one of its iterations is
    a tick.
    """
    if program.ticks is not None:
        return module.work(module.entry), list(module.loops(module.entry)), program.ticks
    over_ticks = max((loop for loop, _ in module.loops(module.entry)), key=lambda loop: module.round(loop).launches)
    return module.round(over_ticks), list(module.loops(over_ticks.body)), 1


def _step(module: Module, loops: list[tuple[Loop, float]], steps: int) -> Work:
    """The work of the loops over a tick's physics steps, in all iterations."""
    over_steps = [(loop, times) for loop, times in loops if loop.rounds == steps]
    within = {inner.body for loop, _ in over_steps for inner, _ in module.loops(loop.body)}
    chosen = [(loop, times) for loop, times in over_steps if loop.body not in within]
    return sum((module.round(loop) * (steps * times) for loop, times in chosen), Work())
