# Tests of rollout/differentiable.py
"""The derivatives of a whole gait cycle in float64: both modes against each other and against MuJoCo's C engine."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import compiler_options

pytestmark = pytest.mark.release

#: One number of each kind: spine, gait, a stiffness, a mass, friction, contact, servos. At 0.8 Hz a cycle ends with a
#: tick, and the measured way has a kink; at 0.81 Hz a step of the pilot has one, and C's differences hang on their
#: width.
POINT = {
    "spine.amplitude": 0.2,
    "spine.phase": -1.0,
    "frequency": 0.82,
    "stride": 0.9,
    "stiffness.ankle": 0.1,
    "mass.front": 0.165,
    "contact.friction": 1.3,
    "contact.width": 0.004,
    "servo.back_emf": 0.3,
    "servo.supply_voltage": 5.5,
    "servo.dead_band": 0.006,
    "servo.backlash": 0.02,
}
ONE_CYCLE = Run(cycles=1, warmup_cycles=0)
#: A loop, and NVIDIA's library of solvers.
HELD = ("stablehlo.while", "cusolver")
#: Half-width of the central differences, as a share of each value.
SHARE = 1e-6


class Walk:
    """One gait cycle: its speed and the slopes (n,) of that in each mode, and the C engine's; each computed when asked.

    `ahead` and `reverse` end with what their program holds of `HELD`, lowered for GPUs and TPUs.
    """

    def __init__(self, **choices: str) -> None:
        self.setup = Setup(spine="stride_extension", **choices)
        with jax.enable_x64(True):
            self.rollout = Rollout(self.setup, ONE_CYCLE, "mjx", slowest=0.8)
        self.first = np.array(list(POINT.values()))

    def speed(self, point):
        return self.rollout(dict(zip(POINT, point, strict=True)))["speed"]

    @functools.cached_property
    def ahead(self) -> tuple[float, np.ndarray, set[str]]:
        def with_slopes(point):
            """Value and slopes of one pass: `jacfwd` beside the speed would compile the walk twice."""
            return jax.vmap(lambda way: jax.jvp(self.speed, (point,), (way,)), out_axes=(None, 0))(
                jnp.eye(len(point))
            )

        (value, slopes), auxiliary = self._run(with_slopes)
        return float(value), np.asarray(slopes), auxiliary

    @functools.cached_property
    def reverse(self) -> tuple[np.ndarray, set[str]]:
        slopes, auxiliary = self._run(jax.grad(self.speed))
        return np.asarray(slopes), auxiliary

    def _run(self, function):
        with jax.enable_x64(True):
            program, point = (
                jax.jit(function, compiler_options=compiler_options()),
                jnp.asarray(self.first),
            )
            result = program(point)
            # From the trace that is there: tracing takes ten times as long as lowering.
            text = program.trace(point).lower(lowering_platforms=("cuda", "tpu")).as_text()
        return result, {word for word in HELD if word in text}

    @functools.cached_property
    def in_c(self) -> tuple[float, np.ndarray]:
        ways = np.eye(len(POINT))
        points = self.first + self.first * SHARE * np.concatenate(
            [np.zeros_like(ways[:1]), ways, -ways]
        )
        with jax.enable_x64(True):
            simulator = Simulator(self.setup, "c")
            # At the default of 1e-8 C stops early enough to move the speed by 2e-6 of itself, and slopes by up to 1e-3.
            simulator.engine.model.opt.tolerance = 0.0
            run = simulator.run(dict(zip(POINT, points.T, strict=True)), ONE_CYCLE)
        speed, *ends = run.metrics["speed"]
        high, low = np.split(np.array(ends), 2)
        return float(speed), (high - low) / (2 * SHARE * self.first)


#: The preset with larger steps every time; that of the default is compared with C in test_tune_walk.py, for a moment.
WALKS = {"fast": {"physics": "fast"}, "elliptic": {}, "pyramidal": {"cone": "pyramidal"}}


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.long] * (name != "fast")) for name in WALKS],
)
def walk(request):
    return Walk(**WALKS[request.param])


@pytest.mark.long  # test_protocol.py has reverse mode through a walk, test_differentiable_step.py both modes
def test_both_modes_agree(walk):
    """Forward and reverse mode differ by the rounding of two programs, which a walk amplifies."""
    np.testing.assert_allclose(walk.reverse[0], walk.ahead[1], rtol=1e-8)


@pytest.mark.long
def test_reverse_mode_can_be_lowered_for_gpus_and_tpus(walk):
    assert walk.reverse[-1] == set(HELD)


@pytest.mark.long
def test_the_speed_is_that_of_the_c_engine(walk):
    assert walk.ahead[0] == pytest.approx(walk.in_c[0], rel=1e-6)


def test_the_gradient_is_that_of_the_c_engine(walk):
    """Central differences of another implementation, which knows nothing of the rule for contacts."""
    np.testing.assert_allclose(walk.ahead[1], walk.in_c[1], rtol=1e-4)


def test_forward_mode_can_be_lowered_for_gpus_and_tpus(walk):
    """For both at once."""
    assert walk.ahead[-1] == set(HELD)
