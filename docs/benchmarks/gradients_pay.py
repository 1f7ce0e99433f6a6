"""Where gradients pay off: one search for a gait by one method, on a budget of processor time."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from measuring import append, run_of

from nermo_mjx.optimize import Tuning
from nermo_mjx.optimize.methods import initial_state
from nermo_mjx.optimize.objective import Evaluation, Problem, from_unconstrained
from nermo_mjx.optimize.run import simulation_of, tuner_of, verified
from nermo_mjx.rollout.simulator import Simulator

#: The objectives. For the cost of transport, the speed given with the gait is held.
TASKS: Final = ("speed", "transport")
METHODS: Final = ("exact", "mixture", "line_search", "cma")
HELD: Final = {"trt": 0.08, "trt1": 0.06, "lat": 0.06}  # [m/s]
FREQUENCY: Final = 0.8  # [Hz]
#: Each seed starts at another point: distance from the published gait, as a fraction of the bounds on either side.
ASIDE: Final = 0.1
#: CMA-ES: initial standard deviation in the coordinates of tunings, where a range is about 4 wide, and population size.
SIGMA: Final = 0.5
POPULATION: Final = 16

_POINTS: Final = ("2", "3", "4", "7")
_OTHERS: Final = ("1", "5", "6", "8")


def _feet(groups: tuple[str, ...], points: tuple[str, ...], axes: str = "yz") -> dict[str, float]:
    return {f"foot.{group}.{axis}{point}": 0.008 for group in groups for axis in axes for point in points}


#: Parameters in the order in which they are added, with each one's range on either side of the published gait: spine as
#: a Fourier series, lift and trim of the pairs of limbs, their strides and duties, the points of their foot paths, and
#: of each foot's. `SIZES` of them are searched at a time.
REACH: Final[dict[str, float]] = {
    "spine.harmonics.cos1": 0.4,
    "spine.harmonics.sin1": 0.4,
    "limb.lift.front": 0.01,
    "limb.lift.rear": 0.01,
    "trim.hip.front": 0.15,
    "trim.hip.rear": 0.15,
    "trim.knee.front": 0.15,
    "trim.knee.rear": 0.15,
    "spine.harmonics.cos2": 0.15,
    "spine.harmonics.sin2": 0.15,
    "spine.harmonics.cos3": 0.15,
    "spine.harmonics.sin3": 0.15,
    "limb.stride.front": 0.2,
    "limb.stride.rear": 0.2,
    "limb.duty.front": 0.1,
    "limb.duty.rear": 0.1,
    **_feet(("front", "rear"), _POINTS),
    **_feet(("front", "rear"), _OTHERS),
    **_feet(("front_left", "front_right", "rear_left", "rear_right"), ("3", "7")),
}
SIZES: Final = (2, 8, 16, 32, 64)


def paying_case(task: str, gait: str, parameters: int, method: str, seed: int, cpu_s: float) -> dict[str, Any]:
    """One search, in a process of its own, until it has used its processor time.

    Time counts from the start of the process and includes everything: imports, reading the traced program or tracing
    it, compiling it or loading it from the cache. On shared cores wall time is meaningless, so the budget is processor
    time; CMA-ES keeps two cores busy, and a gradient of one walk less than one and a half.

    Args:
        task: of `TASKS`.
        gait: centre of the searched range.
        parameters: their number, one of `SIZES`.
        method: of `METHODS`; the gradient is exact, or a mixture of 5 walks, or the mean direction at 4 points, with a
            line search on the engine `c`; CMA-ES runs on the engine `c`.
        seed: of the start, which is the same for all methods, and of the method.
        cpu_s: the budget [s].
    """
    tuning = tuning_of(task, gait, parameters, method, seed)
    problem = Counted(simulation_of(tuning))
    tuner = tuner_of(tuning, problem)
    state, curve = initial_state(tuning), list[list[float]]()
    while not curve or _cpu() < cpu_s:
        after, _ = tuner.step(state)
        # A step that ends after the budget does not count, unless it is the only one.
        state = after if not curve or _cpu() <= cpu_s else state
        best = int(np.argmin(state.best_value))
        curve.append([round(_wall(), 2), round(_cpu(), 2), round(problem.simulated, 2), float(state.best_value[best])])
    at = np.asarray(from_unconstrained(tuning.bounds, state.best_u[best]))
    points = {"began": tuning.start_points()[0], "found": at}
    named = {name: dict(zip(tuning.names, map(float, point), strict=True)) for name, point in points.items()}
    again = verified(tuning, named, Simulator(tuning.setup, "c"))
    return {
        "ready_wall_s": curve[0][0],
        "ready_cpu_s": curve[0][1],
        "evaluations": len(curve),
        "curve": curve,
        "began": again["began"],
        "found": again["found"],
        "parameters_found": named["found"],
    }


def tuning_of(task: str, gait: str, parameters: int, method: str, seed: int) -> Tuning:
    """The tuning of one cell, from a seed's start."""
    names = list(REACH)[:parameters]
    rng = np.random.default_rng([seed, 20])
    probe = Tuning.from_dict({**_walk(gait), "tune": {"stride": None}, "objective": [{"maximize": "speed"}]})
    aside = rng.uniform(-ASIDE, ASIDE, len(REACH))
    tuned = {}
    for name, away in zip(names, aside, strict=False):
        about = probe.parameters[name]
        published: Any = about.default
        low, high = max(about.low, published - REACH[name]), min(about.high, published + REACH[name])
        middle = 0.2 if name == "spine.harmonics.cos1" else published
        tuned[name] = {"bounds": [low, high], "start": float(np.clip(middle + away * (high - low), low, high))}
    objective: list[dict[str, Any]] = [{"maximize": "speed", "scale": 0.1}]
    if task == "transport":
        held = {"hold": "speed", "at": HELD[gait], "scale": 0.01, "weight": 2}
        objective = [{"minimize": "cost_of_transport"}, held]
    methods: dict[str, dict[str, Any]] = {
        "exact": {},
        "mixture": {"estimator": {"mixture": {"samples": 4, "sigma": 0.05}}},
        "line_search": {
            "estimator": {"smoothed": {"samples": 4, "sigma": 0.1, "normalized": True}},
            "optimizer": "line_search",
        },
        "cma": {"method": {"cma": {"sigma": SIGMA, "population": POPULATION}}},
    }
    return Tuning.from_dict({**_walk(gait), **methods[method], "tune": tuned, "objective": objective, "seed": seed})


def _walk(gait: str) -> dict[str, Any]:
    return {
        "gait": gait,
        "spine": "harmonics",
        "trajectory": "free",
        "run": {"cycles": 3, "warmup_cycles": 1},
        "set": {"frequency": FREQUENCY},
    }


class Counted:
    """A problem that counts its simulated time [s], with gradients at their cost in forward runs."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self.simulated = problem, 0.0
        self.names, self.gradient_cost = problem.names, problem.gradient_cost
        self.simulated_seconds = problem.simulated_seconds

    def evaluate(self, points: Any, gradient: bool) -> Evaluation:
        """See `evaluation.Problem.evaluate`."""
        self.simulated += len(points) * self.simulated_seconds * (self.gradient_cost if gradient else 1.0)
        return self._problem.evaluate(points, gradient)


def _cpu() -> float:
    """Processor time of this process so far, all threads [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


_BEGAN: Final = time.perf_counter()


def _wall() -> float:
    """Wall time since this module was imported, to within the second that JAX takes before [s]."""
    return time.perf_counter() - _BEGAN


@click.command(help=__doc__)
@click.option("--task", type=click.Choice(TASKS), default="speed")
@click.option("--gait", type=click.Choice(list(HELD)), default="trt")
@click.option("--parameters", type=click.Choice(SIZES), default=32)
@click.option("--method", type=click.Choice(METHODS), default="cma")
@click.option("--seed", type=click.IntRange(1), default=1)
@click.option("--cpu", "cpu_s", type=float, default=60.0, help="Budget [CPU s].")
@click.option("--into", type=click.Path(path_type=Path), default=Path(__file__).with_suffix(".jsonl"))
def main(into: Path, **chosen: Any) -> None:
    append(into, run_of([{"case": "gradients-pay", **chosen, **paying_case(**chosen)}]))


if __name__ == "__main__":
    main()
