"""Cost estimates of a tuning on this machine by each method, before it starts."""

from __future__ import annotations

import dataclasses
from typing import Final

import jax

from nermo_mjx.rollout import Simulator
from nermo_mjx.rollout.derivative import choose_mode, cost
from nermo_mjx.sweep.pace import pace
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
    method, parameters = tuning.method, len(tuning.names)
    if method.name == "cma":
        points = method.population * (tuning.iterations + 1)
        return MethodCost(method.name, points, points * seconds, points * seconds / found)
    if method.name == "differences":
        points = tuning.starts * (tuning.iterations + 1) * (1 + method.neighbours(parameters))
        return MethodCost(method.name, points, points * seconds, points * seconds / found)
    batch = tuning.starts * tuning.estimator.worlds
    points = batch * (tuning.iterations + 1)
    times = cost(parameters, choose_mode(parameters, tuning.mode)) if tuning.estimator.needs_gradient else 1.0
    slower = MJX_SLOWER * max(1.0, MJX_WORLDS / batch)
    wall = points * seconds * times * slower / found if jax.default_backend() == "cpu" else None
    return MethodCost(method.name, points, points * seconds * times, wall)
