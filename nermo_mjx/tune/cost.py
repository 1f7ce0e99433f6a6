"""Cost estimates of a tuning on this machine by each method, before it starts."""

from __future__ import annotations

import dataclasses
from typing import Final

import jax

from nermo_mjx.rollout import Simulator
from nermo_mjx.rollout.differentiable import choose_mode, cost
from nermo_mjx.sweep.simulating import pace
from nermo_mjx.tune.methods import Method
from nermo_mjx.tune.spec import Tuning

#: Worlds of the probe: enough to keep two cores busy.
_WORLDS: Final = 16
#: How much slower MJX runs on a CPU than MuJoCo C, with this many worlds or more, and with fewer in proportion
#: (docs/benchmarks: 14 simulated seconds per second, and 3.5 with one world, against 136).
MJX_SLOWER: Final = 10.0
MJX_WORLDS: Final = 4


@dataclasses.dataclass(frozen=True)
class MethodCost:
    """The cost of a tuning by one method.

    Attributes:
        method: its name.
        evaluations: walks; of the method `gradient` with their derivatives.
        simulated_seconds: of all walks, gradients at their cost in forward runs [s].
        wall_seconds: at this machine's speed, without compiling [s]; None if unknown, as for MJX on a GPU.
    """

    method: str
    evaluations: int
    simulated_seconds: float
    wall_seconds: float | None


def costs_of(tuning: Tuning) -> list[MethodCost]:
    """The cost of all iterations by each method, that of the tuning first; its estimator counts for the gradient."""
    found = pace_here(tuning)
    slowest = {each.name: each.low for each in tuning.tuned}
    timing = {name: value for name, value in (tuning.constants | slowest).items() if name in tuning.setup.timing}
    seconds = float(tuning.run.seconds(tuning.setup.cycle_rate(timing))[1])
    others = (Method(name) for name in ("gradient", "cma", "differences") if name != tuning.method.name)
    return [_cost(dataclasses.replace(tuning, method=each), seconds, found) for each in (tuning.method, *others)]


def pace_here(tuning: Tuning) -> float:
    """Simulated seconds per second on the engine `c`, measured now."""
    return pace(Simulator(tuning.setup, "c"), tuning.setup, _WORLDS)


def _cost(tuning: Tuning, seconds: float, found: float) -> MethodCost:
    method, estimator, parameters = tuning.method, tuning.estimator, len(tuning.names)
    rounds = tuning.iterations + 1
    if method.name == "cma":
        points = method.population * rounds
        return MethodCost(method.name, points, points * seconds, points * seconds / found)
    searches = tuning.optimizer.searches
    tried = tuning.starts * rounds * (1 + tuning.optimizer.line_search().points) if searches else 0
    if method.name == "differences":
        points = tried + tuning.starts * rounds * (1 + method.neighbours(parameters))
        return MethodCost(method.name, points, points * seconds, points * seconds / found)
    # A sampled estimator of a line search leaves the point itself out.
    batch = tuning.starts * (estimator.samples or 1 if searches else estimator.worlds)
    points, times, slower = batch * rounds, 1.0, MJX_SLOWER * max(1.0, MJX_WORLDS / batch)
    if estimator.needs_gradient:
        times = cost(parameters, choose_mode(parameters, tuning.mode))
    elif searches:
        slower = 1.0
    simulated = (points * times + tried) * seconds
    wall = (points * times * slower + tried) * seconds / found if jax.default_backend() == "cpu" else None
    return MethodCost(method.name, points + tried, simulated, wall)
