"""The simulation behind a tuning: a batch of walks in MJX, their objective and its gradients, and a recorded walk that
they may be compared with."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.programs import Program
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout.derivative import choose_mode, cost, value_and_gradient
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import cpu_batch_limit
from nermo_mjx.tune.evaluation import Evaluation
from nermo_mjx.tune.objective import TRAJECTORY_ERROR
from nermo_mjx.tune.spec import Tuning

#: Spread of a coordinate below which it counts as this large: a millimetre, and a hundredth of a radian.
_LEAST_SPREAD: Final = (1e-3, 1e-2)


class WalkProblem:
    """Implements `evaluation.Problem` for a tuning file; one world per point."""

    def __init__(self, tuning: Tuning, reference: Reference | None = None) -> None:
        """
        Args:
            tuning: what is tuned.
            reference: replaces the tuning's recording, whose file need not be there then.

        Raises:
            ParameterError: the tuning's recording cannot be compared with its walk.
        """
        self.tuning, self.names = tuning, tuning.names
        self.mode = choose_mode(len(self.names), tuning.mode)
        self.gradient_cost = cost(len(self.names), self.mode)
        lowest = dict(zip(self.names, map(float, tuning.bounds.low), strict=True))
        self.rollout = Rollout(tuning.setup, tuning.run, slowest=lowest.get("frequency"))
        self.simulated_seconds = self.rollout.seconds(tuning.constants | lowest)
        self.reference = reference
        if reference is None and tuning.recording is not None:
            self.reference = load_reference(tuning.recording, self.rollout, self.simulated_seconds)
        identity = self._identity()
        self._value = Program(jax.vmap(self._walk), identity and f"value {identity}")
        gradient = jax.vmap(value_and_gradient(self._walk, self.mode))
        self._gradient = Program(gradient, identity and f"{self.mode} {identity}")

    def __reduce__(self) -> tuple[type[WalkProblem], tuple[Any, ...]]:
        """For another machine, which lacks the recording and rebuilds everything else."""
        return WalkProblem, (self.tuning, self.reference)

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

    def _identity(self) -> str | None:
        """All that decides a walk, see `Rollout.identity`, its objective and what it is compared with."""
        walk, against = self.rollout.identity, self.reference
        if walk is None:
            return None
        recorded = against and [hashlib.sha256(each.tobytes()).hexdigest() for each in (against.qpos, against.weight)]
        lowest = self.simulated_seconds
        return repr((walk, dict(self.tuning.constants), self.names, self.tuning.objective, lowest, recorded))

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


@dataclasses.dataclass(frozen=True)
class Reference:
    """Positions at the end of each control tick, and how much each of them counts.

    Attributes:
        qpos: (ticks, nq).
        weight: inverse of each coordinate's variance over the recording, (nq,).
    """

    qpos: Float[np.ndarray, "ticks nq"]
    weight: Float[np.ndarray, " nq"]

    def error(self, qpos: Float[Array, "ticks nq"]) -> Float[Array, ""]:
        """Mean over time and coordinates of the squared difference from the recording, over the recording's variance.

        Args:
            qpos: of a walk, at the end of each control tick; what is longer than the reference does not count.
        """
        apart = (qpos[: len(self.qpos)] - jnp.asarray(self.qpos, qpos.dtype)) ** 2
        return jnp.mean(apart @ jnp.asarray(self.weight, qpos.dtype)) / self.qpos.shape[1]


def load_reference(path: Path, rollout: Rollout, seconds: float) -> Reference:
    """Read a recording as the reference of a walk of `seconds`.

    Raises:
        ParameterError: it is not a recording, of another robot, or shorter than the walk; one sentence.
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
    qpos = np.stack([np.interp(time, recording.time, column) for column in recording.qpos.T], axis=-1)
    place = np.arange(qpos.shape[1]) - rollout.robot.joints.root
    least = np.where((place >= 0) & (place < 3), *_LEAST_SPREAD)
    return Reference(qpos, 1.0 / np.maximum(qpos.std(axis=0), least) ** 2)
