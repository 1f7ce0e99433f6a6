"""The simulation behind a tuning without derivatives: walks in MuJoCo C, and slopes from their neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.rollout import Simulator
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.tune.evaluation import Evaluation
from nermo_mjx.tune.objective import TRAJECTORY_ERROR
from nermo_mjx.tune.problem import Reference, load_reference
from nermo_mjx.tune.spec import Tuning


class SimulatedProblem:
    """Implements `evaluation.Problem` on the engine `c`; a gradient costs the runs of a point's neighbours."""

    def __init__(
        self, tuning: Tuning, reference: Reference | None = None, simulator: SimulatorLike | None = None
    ) -> None:
        """
        Args:
            tuning: what is tuned.
            reference: replaces the tuning's recording, whose file need not be there then.
            simulator: replaces `Simulator(tuning.setup, "c")`.

        Raises:
            ParameterError: the tuning's recording cannot be compared with its walk.
        """
        self.tuning, self.names, self.reference = tuning, tuning.names, reference
        self.simulator: Any = simulator or Simulator(tuning.setup, tuning.method.engine)
        self.gradient_cost = 1.0 + tuning.method.neighbours(len(self.names))
        slowest = {each.name: each.low for each in tuning.tuned}
        timing = {name: value for name, value in (tuning.constants | slowest).items() if name in tuning.setup.timing}
        self.simulated_seconds = float(tuning.run.seconds(tuning.setup.cycle_rate(timing))[1])
        if reference is None and tuning.recording is not None:
            rollout = Rollout(tuning.setup, tuning.run, slowest=slowest.get("frequency"))
            self.reference = load_reference(tuning.recording, rollout, self.simulated_seconds)

    def __reduce__(self) -> tuple[type[SimulatedProblem], tuple[Any, ...]]:
        """For another machine, which lacks the recording and rebuilds everything else."""
        return SimulatedProblem, (self.tuning, self.reference)

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """See `evaluation.Problem.evaluate`."""
        at = np.asarray(points, float)
        if not gradient:
            value, metrics, ok = self.walk(at)
            return _evaluation(value, None, metrics, ok)
        n, p = at.shape
        apart = self._apart(p)
        worlds, reach = self._within(at[:, None] + apart)
        value, metrics, ok = self.walk(worlds.reshape(-1, p))
        value, ok = value.reshape(n, -1), ok.reshape(n, -1)
        # Of each parameter two worlds with different values of it: either neighbour, or one and the point itself.
        high = 1 + np.arange(p)
        low = high + p if self.tuning.method.scheme == "central" else np.zeros(p, int)
        rise = value[:, high] - value[:, low]
        run = reach[:, high, np.arange(p)] - reach[:, low, np.arange(p)]
        metrics = {name: column.reshape(n, -1)[:, 0] for name, column in metrics.items()}
        return _evaluation(value[:, 0], rise / run, metrics, np.logical_and.reduce(ok, axis=1))

    def _apart(self, p: int) -> np.ndarray:
        """From a point to itself and its neighbours (worlds, p)."""
        ranges = np.array([each.high - each.low for each in self.tuning.tuned])
        steps = np.diag(self.tuning.method.step * ranges)
        return np.concatenate([np.zeros((1, p)), steps, *([-steps] if self.tuning.method.scheme == "central" else [])])

    def _within(self, worlds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The worlds (n, worlds, p) within the bounds, and where they are along each parameter, unwrapped.

        A neighbour beyond a bound stands on it; a forward one turns to the other side where nothing would be left.
        """
        low, high = (np.array([getattr(each, end) for each in self.tuning.tuned]) for end in ("low", "high"))
        periodic = np.array([each.periodic for each in self.tuning.tuned])
        centre = worlds[:, :1]
        if self.tuning.method.scheme == "forward":
            worlds = np.where(~periodic & (worlds > high), 2.0 * centre - worlds, worlds)
        reach = np.where(periodic, worlds, np.clip(worlds, low, high))
        return np.where(periodic, low + np.mod(worlds - low, high - low), reach), reach

    def walk(
        self, points: np.ndarray, others: Mapping[str, np.ndarray] | None = None
    ) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
        """Objective, metrics and whether each of the points (n, p) walked to its end, (n,) each.

        Args:
            others: parameters beside the tuned ones, name -> (n,).
        """
        values = {name: np.full(len(points), value) for name, value in self.tuning.constants.items()}
        values |= {name: points[:, i] for i, name in enumerate(self.names)} | dict(others or {})
        how: dict[str, Any] = {"record": True} if self.reference is not None else {}
        result = self.simulator.run(values, self.tuning.run, **how)
        metrics = {name: np.asarray(column, float) for name, column in result.metrics.items()}
        if self.reference is not None:
            error = [float(self.reference.error(jnp.asarray(qpos))) for qpos in result.trace.qpos]
            metrics[TRAJECTORY_ERROR] = np.array(error)
        value = np.asarray(self.tuning.objective.value(metrics), float)
        return value, metrics, (np.asarray(result.status) == "ok") & np.isfinite(value)


def _evaluation(value: Any, slope: Any, metrics: dict[str, Any], ok: Any) -> Evaluation:
    """What was found, as NumPy arrays: differences of float64 are not rounded before they are slopes."""
    return Evaluation(value, slope, metrics, ok)
