"""Derivatives of a walk on MJX along slope, gravity and friction, in a scene of one's own: against walks in C."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import compiler_options

#: A floor half a metre up.
SETUP = Setup(
    scene="<mujoco><worldbody><geom name='floor' type='plane' size='0 0 0.1' pos='0 0 0.5'/></worldbody></mujoco>",
    physics="fast",
)
#: Before the first foot is lifted high; later, differences of walks in C are no longer straight to a percent.
RUN = Run(duration=0.3)
#: A point where soles slip a little, and half the width of the differences.
POINT = {"ground.slope": (0.1, 0.01), "ground.gravity": (9.0, 0.1), "contact.friction": (0.4, 0.01)}
METRICS = ("distance", "load_rear_left")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def derivatives() -> tuple[np.ndarray, np.ndarray]:
    """The first metric's value, and the derivatives of all, (metrics, parameters): one program."""
    rollout = Rollout(SETUP, RUN)

    def measured(at: Any) -> tuple[Any, Any]:
        metrics = rollout({"frequency": 0.8, **dict(zip(POINT, at, strict=True))})
        values = jnp.stack([metrics[name] for name in METRICS])
        return values, values[0]

    point = jnp.array([centre for centre, _ in POINT.values()])
    slopes, value = jax.jit(jax.jacfwd(measured, has_aux=True), compiler_options=compiler_options())(point)
    return np.asarray(value), np.asarray(slopes)


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(SETUP, "c")


def test_the_walk_is_that_of_c(derivatives, simulator):
    """On the raised floor and the slope."""
    values = {"frequency": 0.8, **{name: centre for name, (centre, _) in POINT.items()}}
    assert derivatives[0] == pytest.approx(simulator.run(values, RUN).metrics[METRICS[0]][0], rel=0.01)


@pytest.mark.parametrize("parameter", POINT)
def test_derivatives_are_those_of_differences_of_walks_in_c(derivatives, simulator, parameter):
    """Of the way, and of the load on a foot."""
    values = {"frequency": 0.8, **{name: centre for name, (centre, _) in POINT.items()}}
    centre, width = POINT[parameter]
    result = simulator.run(values | {parameter: np.array([centre - width, centre + width])}, RUN).metrics
    slopes = [float(np.diff(result[name])[0]) / (2 * width) for name in METRICS]
    np.testing.assert_allclose(derivatives[1][:, list(POINT).index(parameter)], slopes, rtol=0.05)
