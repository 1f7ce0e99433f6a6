"""A tuning's worlds, distributed over workers: each evaluates those of some starts, with a program that stays warm."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.runs.code import CodeStamp, stamp
from nermo_mjx.runs.workers import TaskFailed, Workers
from nermo_mjx.tune.evaluation import Evaluation, Problem
from nermo_mjx.tune.spec import Tuning


class Evaluator:
    """Evaluates points; a `nermo_mjx.runs.workers.Computer`. The problem is sent pickled, and rebuilt there."""

    def __init__(self, tuning: Tuning, problem: Problem) -> None:
        self._setup, self._engine = tuning.setup, tuning.method.engine
        self._problem: Problem | bytes = problem

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_problem": pickle.dumps(self._problem)}

    def warm(self) -> None:
        """Make the problem, which may raise `ParameterError`; it compiles with the first points."""
        if isinstance(self._problem, bytes):
            self._problem = pickle.loads(self._problem)

    def stamp(self) -> CodeStamp:
        """Stamp of the code and the model that simulate here."""
        return stamp(self._setup.load().fingerprint, self._engine)

    def __call__(self, task: tuple[np.ndarray, bool], progress: Callable[[float], None] | None = None) -> Evaluation:
        """Points (n, p), with gradients or without; the same as NumPy arrays."""
        points, gradient = task
        self.warm()
        assert not isinstance(self._problem, bytes)
        return jax.tree.map(np.asarray, self._problem.evaluate(jnp.asarray(points), gradient))


class SharedProblem:
    """A problem whose worlds are shared among workers; an `evaluation.Problem` itself.

    Shares are whole starts, as many in each, which stays while the tuning runs: a worker compiles once, and numbers do
    not depend on who computes them. One share is the whole batch, and its numbers are the problem's own. With several,
    MJX rounds the last digits differently, as XLA does in batches of another size.

    Raises:
        ParameterError, WorkersLost: the problem cannot be evaluated.
    """

    def __init__(self, tuning: Tuning, problem: Problem, workers: Workers) -> None:
        self.names, self.simulated_seconds = problem.names, problem.simulated_seconds
        self.gradient_cost = problem.gradient_cost
        self._workers = workers
        self._starts, self._parts = tuning.starts, workers.parts
        workers.begin(Evaluator(tuning, problem))

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """See `evaluation.Problem.evaluate`; raises what the problem raises, or `WorkersLost`."""
        given = np.asarray(points)
        size = math.ceil(self._starts / self._parts) * (len(given) // self._starts)
        shares = math.ceil(len(given) / size)
        # The last share is filled up with points from the beginning.
        filled = np.resize(given, (shares * size, given.shape[1])).reshape(shares, size, -1)
        try:
            found = dict(self._workers.results(((k, (share, gradient)) for k, share in enumerate(filled)), _untold))
        except TaskFailed as failed:
            raise failed.error from None
        parts = [found[k] for k in range(shares)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(given)], *parts)


def _untold(key: int, share: float) -> None:
    """How far a fraction of the worlds is does not matter: an iteration ends with the last of them."""
