"""The cost of a gradient: value and gradient of a walk against the walk alone, over the length of the walk."""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from nermo_mjx.bench.hardware import peak_bytes
from nermo_mjx.bench.timing import compare, compile_cold
from nermo_mjx.rollout.derivative import Function, value_and_gradient
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.rollout.length import Run
from nermo_mjx.rollout.setup import Setup

#: The derivative: of the mean speed by the two parameters of the stride extension.
NAMES: Final = ("spine.amplitude", "spine.phase")
FREQUENCY: Final = 0.8  # [Hz]
ROUNDS: Final = 3


def differentiable_walk(cycles: float) -> tuple[Rollout, Function]:
    """A walk of a number of gait cycles, and its speed and metrics as a function of `NAMES`."""
    rollout = Rollout(Setup(spine="stride_extension"), Run(cycles=cycles, warmup_cycles=0))

    def walk(point: Array) -> tuple[Array, dict[str, Array]]:
        metrics = rollout({"frequency": FREQUENCY, **dict(zip(NAMES, point, strict=True))})
        return metrics["speed"], metrics

    return rollout, walk


def gradient_case(mode: str, worlds: int, cycles: float) -> dict[str, Any]:
    """Value and gradient in one mode against the value alone: same walk, same batch, alternating.

    Args:
        mode: `forward` or `reverse`.
        worlds: size of the batch.
        cycles: length of the walk in gait cycles.
    """
    rollout, walk = differentiable_walk(cycles)
    points = np.stack([np.linspace(0.05, 0.35, worlds), np.linspace(-1.0, 0.0, worlds)], axis=1)
    batch = jnp.asarray(points, float)
    plain = compile_cold(jax.jit(jax.vmap(walk)), batch)
    ours = compile_cold(jax.jit(jax.vmap(value_and_gradient(walk, mode))), batch)

    def run(program: Any) -> None:
        jax.block_until_ready(program(batch))

    run(plain.program)
    run(ours.program)
    ours_s, plain_s, ratio = compare(lambda: run(ours.program), lambda: run(plain.program), ROUNDS)
    steps = round(rollout.seconds({"frequency": FREQUENCY}) / rollout.robot.config.timestep)
    return {
        "engine": "mjx",
        "horizon_cycles": cycles,
        "forward_s": plain_s,
        "gradient_s": ours_s,
        "ratio": 1.0 / ratio,
        "steps_per_second": worlds * steps / ours_s,
        "plain_steps_per_second": worlds * steps / plain_s,
        "trace_s": ours.trace_s,
        "compile_s": ours.compile_s,
        "plain_trace_s": plain.trace_s,
        "plain_compile_s": plain.compile_s,
        "temporary_bytes_per_world": _temporary(ours.program) // worlds,
        "plain_temporary_bytes_per_world": _temporary(plain.program) // worlds,
        "peak_bytes": peak_bytes(),
    }


def _temporary(program: Any) -> int:
    """Bytes that a program needs in addition to its arguments and results, as planned by the compiler."""
    return int(program.memory_analysis().temp_size_in_bytes)
