"""The derivatives of a whole gait cycle in float64: both modes against each other and against MuJoCo's C engine."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import compiler_options

pytestmark = pytest.mark.slow

#: One number of each kind: spine, gait, a stiffness, a mass, friction, contact. At 0.8 Hz a cycle ends with a tick, and
#: the measured way has a kink; at 0.81 Hz a step of the pilot has one, and C's differences hang on their width.
POINT = {
    "spine.amplitude": 0.2, "spine.phase": -1.0, "frequency": 0.82, "stride": 0.9, "stiffness.ankle": 0.1,
    "mass.front": 0.165, "contact.friction": 1.3, "contact.width": 0.001,
}  # fmt: skip
ONE_CYCLE = Run(cycles=1, warmup_cycles=0)
#: A loop, and NVIDIA's library of solvers.
HELD = ("stablehlo.while", "cusolver")
#: Half-width of the central differences, as a share of each value.
SHARE = 1e-6


@dataclasses.dataclass(frozen=True)
class Walked:
    """Mean speed of one gait cycle and its slopes (8,) in both modes; the C engine's speed and slopes (8,).

    `lowered` is what the programs of both modes hold of `HELD`, lowered for GPUs and TPUs.
    """

    value: float
    ahead: np.ndarray
    reverse: np.ndarray
    in_c: float
    differences: np.ndarray
    lowered: dict[str, set[str]]


def lowered_for_all(program, point):
    """What the program holds of `HELD`; JAX refuses an operation that GPUs or TPUs lack."""
    text = program.trace(point).lower(lowering_platforms=("cuda", "tpu")).as_text()
    return {word for word in HELD if word in text}


@pytest.fixture(scope="module", params=["elliptic", pytest.param("pyramidal", marks=pytest.mark.long)])
def walked(request):
    setup = Setup(spine="stride_extension", cone=request.param)
    first = np.array(list(POINT.values()))
    with jax.enable_x64(True):
        rollout = Rollout(setup, ONE_CYCLE, slowest=0.8)

        def speed(point):
            return rollout(dict(zip(POINT, point, strict=True)))["speed"]

        def with_slopes(point):
            """Value and slopes of one pass: `jacfwd` beside the speed would compile the walk twice."""
            return jax.vmap(lambda way: jax.jvp(speed, (point,), (way,)), out_axes=(None, 0))(jnp.eye(len(first)))

        functions, options = {"forward": with_slopes, "reverse": jax.grad(speed)}, compiler_options()
        programs = {mode: jax.jit(function, compiler_options=options) for mode, function in functions.items()}
        value, ahead = programs["forward"](jnp.asarray(first))
        reverse = programs["reverse"](jnp.asarray(first))
        # From the traces that are there: tracing takes ten times as long as lowering.
        lowered = {mode: lowered_for_all(program, jnp.asarray(first)) for mode, program in programs.items()}
        points = first + first * SHARE * np.concatenate([np.zeros((1, 8)), np.eye(8), -np.eye(8)])
        simulator = Simulator(setup, "c")
        # At the default of 1e-8 C stops early enough to move the speed by 2e-6 of itself, and slopes by up to 1e-3.
        simulator.robot.physical.opt.tolerance = 0.0
        run = simulator.run(dict(zip(POINT, points.T, strict=True)), ONE_CYCLE)
    in_c, *ends = run.metrics["speed"]
    high, low = np.split(np.array(ends), 2)
    differences = (high - low) / (2 * SHARE * first)
    return Walked(float(value), np.asarray(ahead), np.asarray(reverse), float(in_c), differences, lowered)


def test_both_modes_agree(walked):
    """Forward and reverse mode differ by the rounding of two programs, which a walk amplifies."""
    np.testing.assert_allclose(walked.reverse, walked.ahead, rtol=1e-8)


def test_the_speed_is_that_of_the_c_engine(walked):
    assert walked.value == pytest.approx(walked.in_c, rel=1e-6)


def test_the_gradient_is_that_of_the_c_engine(walked):
    """Central differences of another implementation, which knows nothing of the rule for contacts."""
    np.testing.assert_allclose(walked.ahead, walked.differences, rtol=1e-4)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_gradient_can_be_lowered_for_gpus_and_tpus(walked, mode):
    """For both at once; in float32, and as `bench gpu-plan` has it, with `pytest -m long` (test_gpu_plan.py)."""
    assert walked.lowered[mode] == set(HELD)
