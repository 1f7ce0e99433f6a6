"""The simulations of a tuning: walks with their gradients, and the comparison with a recorded walk."""

from __future__ import annotations

import dataclasses
import functools
import math
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.optimize.objective import TRAJECTORY_ERROR, Evaluation, Problem
from nermo_mjx.optimize.tuning_spec import Differences, Tuning
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Simulator
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runs.code import CodeStamp, stamp
from nermo_mjx.runs.workers import TaskFailed, Workers
from nermo_mjx.runtime import compiler_options, cpu_batch_limit
from nermo_mjx.sweep.simulating import SimulatorLike

#: Smallest standard deviation that weights a coordinate: a millimetre, and a hundredth of a radian.
_LEAST_SPREAD: Final = (1e-3, 1e-2)


class WalkProblem:
    """An `objective.Problem` of walks on the engine `c`, with gradients by the method of the tuning."""

    def __init__(
        self,
        tuning: Tuning,
        reference: Reference | None = None,
        simulator: SimulatorLike | None = None,
    ) -> None:
        """
        Args:
            tuning: Tuning with the walk, the parameters and the method.
            reference: Replaces the tuning's recording, whose file may then be missing.
            simulator: Replaces `Simulator(tuning.setup, "c")`.

        Raises:
            ParameterError: The tuning's recording cannot be compared with its walk.
        """
        self.tuning = tuning
        self.names = tuning.names
        self.reference = reference
        self._given = simulator
        lowest, method = (
            {parameter.name: parameter.low for parameter in tuning.tuned},
            tuning.method,
        )
        self.simulated_seconds = tuning.seconds(lowest)
        self.gradient_cost = method.gradient_cost(len(self.names))
        self.rollout = Rollout(
            tuning.setup, tuning.run, tuning.engine, slowest=lowest.get("frequency")
        )
        if reference is None and tuning.recording is not None:
            self.reference = load_reference(tuning.recording, self.rollout, self.simulated_seconds)
        self._exact = jax.jit(
            jax.vmap(jax.value_and_grad(self._walk, has_aux=True)),
            compiler_options=compiler_options(),
        )

    def __reduce__(self) -> tuple[type[WalkProblem], tuple[Any, ...]]:
        """Pickle for another machine, which does not have the recording and rebuilds everything else."""
        return type(self), (self.tuning, self.reference)

    @functools.cached_property
    def simulator(self) -> Any:
        """The simulator of walks without derivatives, and of wide differences."""
        return self._given or Simulator(self.tuning.setup, "c")

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """See `objective.Problem.evaluate`.

        The differences are computed in NumPy in float64, so that the slopes are not rounded. A neighbour beyond a bound is
        moved onto the bound; if no distance is left, a forward neighbour is taken on the other side.
        """
        method = self.tuning.method
        if not gradient:
            value, metrics, ok = self.walk(np.asarray(points, float))
            return _evaluation(value, None, metrics, ok)
        if not isinstance(method, Differences):
            limit = cpu_batch_limit() or len(points)
            parts = [
                self._evaluate_gradients(points[first : first + limit])
                for first in range(0, len(points), limit)
            ]
            return (
                parts[0]
                if len(parts) == 1
                else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
            )
        point_array = np.asarray(points, float)
        (n, p), central = point_array.shape, method.scheme == "central"
        low, high = (
            np.array([getattr(parameter, end) for parameter in self.tuning.tuned])
            for end in ("low", "high")
        )
        periodic = np.array([parameter.periodic for parameter in self.tuning.tuned])
        # Each point and its neighbours (n, worlds, p), and their unwrapped values of each parameter.
        steps = np.diag(method.step * (high - low))
        worlds = point_array[:, None] + np.concatenate(
            [np.zeros((1, p)), steps, *([-steps] if central else [])]
        )
        if not central:
            worlds = np.where(~periodic & (worlds > high), 2.0 * worlds[:, :1] - worlds, worlds)
        reach = np.where(periodic, worlds, np.clip(worlds, low, high))
        worlds = np.where(periodic, low + np.mod(worlds - low, high - low), reach)
        value, metrics, ok = self.walk(worlds.reshape(-1, p))
        value, ok = value.reshape(n, -1), ok.reshape(n, -1)
        # For each parameter, two worlds with different values: both neighbours, or one neighbour and the point itself.
        above = 1 + np.arange(p)
        below = above + p if central else np.zeros(p, int)
        rise = value[:, above] - value[:, below]
        run = reach[:, above, np.arange(p)] - reach[:, below, np.arange(p)]
        metrics = {name: column.reshape(n, -1)[:, 0] for name, column in metrics.items()}
        return _evaluation(value[:, 0], rise / run, metrics, np.logical_and.reduce(ok, axis=1))

    def _evaluate_gradients(self, points: Float[Array, "n p"]) -> Evaluation:
        (value, metrics), slope = self._exact(points)
        ok = (metrics["fell"] == 0.0) & (metrics["diverged"] == 0.0) & jnp.isfinite(value)
        return Evaluation(value, slope, metrics, ok & jnp.isfinite(slope).all(axis=-1))

    def _walk(self, point: Float[Array, " p"]) -> tuple[Float[Array, ""], dict[str, Array]]:
        """The objective and metrics of one walk."""
        values: dict[str, Any] = dict(self.tuning.constants) | dict(
            zip(self.names, point, strict=True)
        )
        if self.reference is None:
            metrics = self.rollout(values)
        else:
            metrics, path = self.rollout.record(values)
            metrics = metrics | {TRAJECTORY_ERROR: self.reference.error(path.qpos)}
        return self.tuning.objective.value(metrics), metrics

    def walk(
        self, points: np.ndarray, others: Mapping[str, np.ndarray] | None = None
    ) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
        """The objective and metrics of walks at points (n, p), and whether each walk ended normally, (n,) each.

        Args:
            others: Values (n,) of parameters that are not tuned, by name.
        """
        values = {
            name: np.full(len(points), value) for name, value in self.tuning.constants.items()
        }
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
    """An evaluation with NumPy arrays, which do not match the annotations of JAX arrays."""
    return Evaluation(value, slope, metrics, ok)


@dataclasses.dataclass(frozen=True)
class Reference:
    """Positions at the end of each control tick, and their weights.

    Attributes:
        qpos: Positions (ticks, nq).
        weight: Inverse of each coordinate's variance over the recording (nq,).
    """

    qpos: Float[np.ndarray, "ticks nq"]
    weight: Float[np.ndarray, " nq"]

    def error(self, qpos: Float[Array, "ticks nq"]) -> Float[Array, ""]:
        """Squared difference from the recording, divided by the recording's variance: mean over time and coordinates.

        Args:
            qpos: Positions of a walk at the end of each control tick; ticks after the end of the reference are ignored.
        """
        apart = (qpos[: len(self.qpos)] - jnp.asarray(self.qpos, qpos.dtype)) ** 2
        return jnp.mean(apart @ jnp.asarray(self.weight, qpos.dtype)) / self.qpos.shape[1]


def load_reference(path: Path, rollout: Rollout, seconds: float) -> Reference:
    """Read a recording as the reference of a walk of `seconds`.

    Raises:
        ParameterError: The file is not a recording, or a recording of another robot, or shorter than the walk.
    """
    try:
        recording = Recording.load(path)
        recording.check_model(rollout.robot.model)
    except RecordingError as error:
        raise ParameterError(f"recording is {path}: {error}") from None
    dt = rollout.controller.dt
    time = dt * (1.0 + np.arange(round(seconds / dt)))
    if recording.time[-1] < time[-1] - 0.5 * dt or recording.time[0] > 2.5 * dt:
        first, last = recording.time[0], recording.time[-1]
        raise ParameterError(
            f"recording is {path}, from {first:.3g} to {last:.3g} s: expected all of the run, from its start to "
            f"{time[-1]:.3g} s."
        )
    qpos = np.stack(
        [np.interp(time, recording.time, column) for column in recording.qpos.T], axis=-1
    )
    column_offset = np.arange(qpos.shape[1]) - rollout.robot.joints.root
    smallest_spread = np.where((column_offset >= 0) & (column_offset < 3), *_LEAST_SPREAD)
    return Reference(qpos, 1.0 / np.maximum(qpos.std(axis=0), smallest_spread) ** 2)


# ---
# The worlds of a tuning, distributed over workers. Each worker evaluates the worlds of some starts, and compiles once.


class Evaluator:
    """A `nermo_mjx.runs.workers.Computer` that evaluates points. The problem is pickled, and rebuilt on the worker."""

    def __init__(self, tuning: Tuning, problem: Problem) -> None:
        self._setup, self._engine = tuning.setup, tuning.engine
        self._problem: Problem | bytes = problem

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_problem": pickle.dumps(self._problem)}

    def warm(self) -> None:
        """Make the problem, which may raise `ParameterError`; the first points compile its program."""
        if isinstance(self._problem, bytes):
            self._problem = pickle.loads(self._problem)

    def stamp(self) -> CodeStamp:
        """Stamp of the code and the model that simulate here."""
        return stamp(self._setup.load().fingerprint, self._engine)

    def __call__(
        self, task: tuple[np.ndarray, bool], progress: Callable[[float], None] | None = None
    ) -> Evaluation:
        """Evaluate points (n, p), with gradients or without; the results are NumPy arrays."""
        points, gradient = task
        self.warm()
        assert not isinstance(self._problem, bytes)
        return jax.tree.map(np.asarray, self._problem.evaluate(jnp.asarray(points), gradient))


class SharedProblem:
    """An `objective.Problem` whose worlds are divided among workers.

    Each share contains the same number of whole starts during the whole tuning, so that a worker compiles once, and the
    numbers do not depend on the worker. A single share is the whole batch, with the same numbers as the problem. With
    several shares, MJX rounds the last digits differently, because XLA does so in batches of another size.

    Raises:
        ParameterError, WorkersLost: The problem cannot be evaluated.
    """

    def __init__(self, tuning: Tuning, problem: Problem, workers: Workers) -> None:
        self.names, self.simulated_seconds = problem.names, problem.simulated_seconds
        self.gradient_cost = problem.gradient_cost
        self._workers = workers
        self._starts, self._parts = tuning.starts, workers.parts
        workers.begin(Evaluator(tuning, problem))

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """See `objective.Problem.evaluate`; raises the errors of the problem, or `WorkersLost`."""
        point_array = np.asarray(points)
        size = math.ceil(self._starts / self._parts) * (len(point_array) // self._starts)
        shares = math.ceil(len(point_array) / size)
        # The last share is filled with points from the beginning.
        filled = np.resize(point_array, (shares * size, point_array.shape[1])).reshape(
            shares, size, -1
        )
        try:
            tasks = ((k, (share, gradient)) for k, share in enumerate(filled))
            results_by_task = dict(self._workers.results(tasks, lambda key, share: None))
        except TaskFailed as failed:
            raise failed.error from None
        parts = [results_by_task[k] for k in range(shares)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(point_array)], *parts)
