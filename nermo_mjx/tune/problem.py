"""The simulation behind a tuning: a batch of walks in MJX, their objective, and its gradients."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nermo_mjx.rollout.derivative import choose_mode, cost, value_and_gradient
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import cpu_batch_limit
from nermo_mjx.tune.evaluation import Evaluation
from nermo_mjx.tune.objective import TRAJECTORY_ERROR
from nermo_mjx.tune.reference import Reference, load_reference
from nermo_mjx.tune.spec import Tuning


class WalkProblem:
    """Implements `evaluation.Problem` for a tuning file; one world a point."""

    def __init__(self, tuning: Tuning) -> None:
        """
        Raises:
            ParameterError: the tuning's recording cannot be compared with its walk.
        """
        self.tuning, self.names = tuning, tuning.names
        self.mode = choose_mode(len(self.names), tuning.mode)
        self.gradient_cost = cost(len(self.names), self.mode)
        lowest = dict(zip(self.names, map(float, tuning.bounds.low), strict=True))
        self.rollout = Rollout(tuning.setup, tuning.run, slowest=lowest.get("frequency"))
        self.simulated_seconds = self.rollout.seconds(tuning.constants | lowest)
        self.reference: Reference | None = None
        if tuning.recording is not None:
            self.reference = load_reference(tuning.recording, self.rollout, self.simulated_seconds)
        self._value = jax.jit(jax.vmap(self._walk))
        self._gradient = jax.jit(jax.vmap(value_and_gradient(self._walk, self.mode)))

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """See `evaluation.Problem.evaluate`."""
        limit = cpu_batch_limit() or len(points)
        parts = [self._part(points[first : first + limit], gradient) for first in range(0, len(points), limit)]
        return parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)

    def _part(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        if not gradient:
            value, metrics = self._value(points)
            return Evaluation(value, None, metrics, _walked(value, metrics))
        value, slope, metrics = self._gradient(points)
        return Evaluation(value, slope, metrics, _walked(value, metrics) & jnp.isfinite(slope).all(axis=-1))

    def _walk(self, point: Float[Array, " p"]) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Objective and metrics of one walk."""
        values: dict[str, Any] = dict(self.tuning.constants) | dict(zip(self.names, point, strict=True))
        metrics, path = self.rollout.record(values)
        if self.reference is not None:
            metrics = metrics | {TRAJECTORY_ERROR: self.reference.error(path.qpos)}
        return self.tuning.objective.value(metrics), metrics


def _walked(value: Array, metrics: dict[str, Array]) -> Array:
    """Whether each world walked to its end, with a finite objective."""
    return (metrics["fell"] == 0.0) & (metrics["diverged"] == 0.0) & jnp.isfinite(value)
