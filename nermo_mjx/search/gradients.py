"""Gradients of quality and measures, through MJX: what CMA-MEGA steps along."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.rollout.derivative import cost
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import compiler_options, cpu_batch_limit
from nermo_mjx.search.spec import Search
from nermo_mjx.sweep.axes import Axis


class Gradients(Protocol):
    """Jacobians of a batch of runs."""

    def __call__(self, values: Mapping[str, np.ndarray], shares: np.ndarray) -> np.ndarray:
        """d (quality, *measures) / d fraction of the bounds, (runs, 1 + m, p).

        Args:
            values: every parameter that the search names, name -> (runs,).
            shares: of the points (points, p), which may have several runs each.
        """
        ...


class WalkGradients:
    """Implements `Gradients` by tangents, one a searched parameter: there are more outputs than cotangents pay for."""

    def __init__(self, search: Search) -> None:
        """Nothing is compiled before the first call."""
        self._search = search
        lowest = {each.name: float(each.tried(grid=False).min()) for each in search.sweep.axes}
        lowest |= {each.name: float(each.at(np.zeros(1))[0]) for each in search.sweep.draws}
        self._rollout = Rollout(search.setup, search.run, slowest=lowest.get("frequency"))
        self._function = jax.jit(jax.vmap(self._jacobian), compiler_options=compiler_options())

    @staticmethod
    def cost_of(search: Search) -> float:
        """Cost of a run's gradients, in forward runs."""
        return cost(len(search.names), "forward")

    def __call__(self, values: Mapping[str, np.ndarray], shares: np.ndarray) -> np.ndarray:
        """See `Gradients`."""
        runs = len(next(iter(values.values())))
        # What is the same in all runs is no argument: the length of a run in cycles has to be known.
        known = {*self._search.names, *self._search.sweep.constants}
        given = {name: np.asarray(column, float) for name, column in values.items() if name not in known}
        points = np.repeat(shares, runs // len(shares), axis=0)
        limit = cpu_batch_limit() or runs
        parts = []
        for first in range(0, runs, limit):
            part = slice(first, first + limit)
            parts.append(np.asarray(self._function(jnp.asarray(points[part]), {k: v[part] for k, v in given.items()})))
        return np.concatenate(parts).astype(float)

    def _jacobian(self, shares: Float[Array, " p"], others: Mapping[str, Array]) -> Float[Array, "k p"]:
        return jax.jacfwd(lambda at: self._outputs(at, others))(shares)

    def _outputs(self, shares: Float[Array, " p"], others: Mapping[str, Array]) -> Float[Array, " k"]:
        aim, axes = self._search.aim, self._search.sweep.axes
        values: dict[str, Any] = dict(self._search.sweep.constants) | dict(others)
        metrics = self._rollout(values | {axis.name: _at(axis, at) for axis, at in zip(axes, shares, strict=True)})
        return jnp.stack([-aim.objective.value(metrics), *(metrics[each.metric] for each in aim.measures)])


def _at(axis: Axis, share: Float[Array, ""]) -> Float[Array, ""]:
    """`Axis.at` of a traced share, within the bounds."""
    low, high = axis.numbers[:2]
    return low * (high / low) ** share if axis.form.startswith("log") else low + (high - low) * share
