"""The simulation behind a tuning by line search: derivatives by MJX, walks without derivatives in MuJoCo C."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from nermo_mjx.rollout import Simulator
from nermo_mjx.tune.evaluation import Evaluation
from nermo_mjx.tune.problem import Reference, WalkProblem
from nermo_mjx.tune.simulated import SimulatedProblem
from nermo_mjx.tune.spec import Tuning


class GuidedProblem:
    """Implements `evaluation.Problem` on both engines; a walk on `c` costs a tenth of one in MJX on a CPU."""

    def __init__(self, tuning: Tuning, reference: Reference | None = None) -> None:
        """See `problem.WalkProblem`."""
        self._tuning, self._derived = tuning, WalkProblem(tuning, reference)
        self._walked = SimulatedProblem(tuning, self._derived.reference, Simulator(tuning.setup, "c"))
        self.names, self.gradient_cost = self._derived.names, self._derived.gradient_cost
        self.simulated_seconds = self._derived.simulated_seconds

    def __reduce__(self) -> tuple[type[GuidedProblem], tuple[Any, ...]]:
        """For another machine, which lacks the recording and rebuilds everything else."""
        return GuidedProblem, (self._tuning, self._derived.reference)

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """See `evaluation.Problem.evaluate`."""
        return (self._derived if gradient else self._walked).evaluate(points, gradient)
