"""Local gradients, wide differences and CMA-ES with equal processor time: `python rematch.py OUT.jsonl`.

Adds a line to the file for each search that it does not hold yet. Speed of a trot, or its cost of transport at a held
speed, by 2, 16 and 64 parameters, from starts beside the published gait, on the default body; each best point is walked
from eight unseen starts.
"""

import contextlib
import json
import resource
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from nermo_mjx import Rollout, Simulator, Tuning
from nermo_mjx.optimize.objective import from_unconstrained, slope, to_unconstrained
from nermo_mjx.optimize.problems import WalkProblem
from nermo_mjx.optimize.search_methods import make_strategy
from nermo_mjx.optimize.tuner import Tuner, initial_state
from nermo_mjx.optimize.tuning_run import verify_points

SECONDS = 40.0
SECANTS = {"wide_differences": {"scheme": "forward", "step": 0.02}}
METHODS = {
    "exact": "local_gradient",
    "secants": SECANTS,
    "secants, L-BFGS": SECANTS,
    "CMA-ES": SECANTS,
}
#: Initial standard deviation of CMA-ES, in unbounded coordinates, and points of a generation.
SIGMA, POPULATION = 0.5, 16
FEET = (
    "foot.front",
    "foot.rear",
    "foot.front_left",
    "foot.front_right",
    "foot.rear_left",
    "foot.rear_right",
)
#: Parameters in the order in which they are added, and how far each is searched on either side of the published gait.
REACH = {"spine.harmonics.cos1": 0.4, "spine.harmonics.sin1": 0.4}
REACH |= {f"limb.lift.{pair}": 0.01 for pair in ("front", "rear")}
REACH |= {f"trim.{joint}.{pair}": 0.15 for joint in ("hip", "knee") for pair in ("front", "rear")}
REACH |= {f"spine.harmonics.{part}{i}": 0.15 for i in (2, 3) for part in ("cos", "sin")}
REACH |= {f"limb.stride.{pair}": 0.2 for pair in ("front", "rear")}
REACH |= {f"limb.duty.{pair}": 0.1 for pair in ("front", "rear")}
REACH |= {f"{foot}.{axis}{i}": 0.008 for i in range(1, 9) for axis in "yz" for foot in FEET[:2]}
REACH |= {f"{foot}.{axis}{i}": 0.008 for i in (3, 7) for axis in "yz" for foot in FEET[2:]}
OBJECTIVES = {
    "speed": [{"maximize": "speed", "scale": 0.1}],
    "transport": [
        {"minimize": "cost_of_transport"},
        {"hold": "speed", "at": 0.08, "scale": 0.01, "weight": 2},
    ],
}


def spent():
    """Processor time of this process [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def tuning_of(aim, parameters, method, seed):
    """A tuning from a seed's start."""
    walk = {
        "spine": "harmonics",
        "trajectory": "free",
        "run": {"cycles": 3, "warmup_cycles": 1},
        "seed": seed,
    }
    walk |= {"set": {"frequency": 0.8}, "objective": OBJECTIVES[aim], "method": METHODS[method]}
    about = Tuning.from_dict(walk | {"tune": {"stride": None}}).parameters
    aside, tuned = np.random.default_rng([seed, 20]).uniform(-0.1, 0.1, len(REACH)), {}
    for (name, reach), away in zip(list(REACH.items())[:parameters], aside, strict=False):
        low, high = (
            max(about[name].low, about[name].default - reach),
            min(about[name].high, about[name].default + reach),
        )
        middle = 0.2 if name == "spine.harmonics.cos1" else about[name].default
        tuned[name] = {
            "bounds": [low, high],
            "start": float(np.clip(middle + away * (high - low), low, high)),
        }
    return Tuning.from_dict(walk | {"tune": tuned})


def search(tuning, method):
    """The best point (p,), and how many walks were made; the first evaluation compiles and does not count."""
    problem, walks, best = WalkProblem(tuning), [0], [np.inf, tuning.start_points()[0]]
    if method == "exact":  # also by more parameters than `auto` leaves to this engine
        problem.rollout = Rollout(tuning.setup, tuning.run, "c")
        problem.gradient_cost = 1.0 + 2.0 * len(tuning.names)
    evaluate, cost = problem.evaluate, problem.gradient_cost

    def counted(points, gradient):
        found = evaluate(points, gradient)
        walks[0] += len(points) * (cost if gradient else 1)
        value = np.where(found.ok, found.value, np.inf)
        if spent() <= limit and value.min() < best[0]:
            best[:] = value.min(), np.asarray(points, float)[value.argmin()]
        return found

    def generations():
        """CMA-ES, whose first point is the given one. A fallen point counts as worse than all others."""
        start = np.asarray(to_unconstrained(tuning.bounds, tuning.start_points()[0]), float)
        found = make_strategy(start, SIGMA, POPULATION, np.random.default_rng(tuning.seed))
        points = np.array([start, *found.ask()[1:]])
        while True:
            at = problem.evaluate(from_unconstrained(tuning.bounds, points), False)
            known = np.asarray(at.value, float)[np.asarray(at.ok)]
            worst = known.max() + max(np.ptp(known), 1.0) if len(known) else 0.0
            found.tell(points.tolist(), np.where(at.ok, at.value, worst).tolist())
            yield
            points = np.array(found.ask())

    def steps():
        """Steps of the tuning."""
        state, tuner = initial_state(tuning), Tuner(tuning, problem)
        while True:
            state, _ = tuner.step(state)
            yield

    begun = generations if method == "CMA-ES" else steps
    next(begun())
    limit, problem.evaluate = spent() + SECONDS, counted

    def loss(u):
        if spent() > limit:
            raise StopIteration
        at = np.asarray(from_unconstrained(tuning.bounds, u[None]))
        found = counted(at, True)
        return float(found.value[0]), np.asarray(found.gradient[0] * slope(tuning.bounds, u), float)

    if method.endswith("L-BFGS"):
        with contextlib.suppress(StopIteration):
            minimize(
                loss,
                to_unconstrained(tuning.bounds, tuning.start_points()[0]),
                jac=True,
                method="L-BFGS-B",
            )
    else:
        for _ in begun():
            if spent() >= limit:
                break
    return best[1], walks[0]


if __name__ == "__main__":
    file, SECONDS = Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else SECONDS
    kept = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    known = [line["of"] for line in kept if line["cpu_s"] == SECONDS]
    cases = [
        [aim, p, method, seed]
        for p in (2, 16, 64)
        for seed in (1, 2, 3)
        for aim in OBJECTIVES
        for method in METHODS
    ]
    for of in (each for each in cases if each not in known):
        tuning = tuning_of(*of)
        found, walks = search(tuning, of[2])
        points = {"began": dict(zip(tuning.names, tuning.start_points()[0].tolist(), strict=True))}
        points["found"] = dict(zip(tuning.names, found.tolist(), strict=True))
        again = verify_points(tuning, points, Simulator(tuning.setup, "c"))
        values = {name: again[name] and again[name]["objective"] for name in points}
        with file.open("a") as lines:
            lines.write(json.dumps({"of": of, "cpu_s": SECONDS, "walks": walks, **values}) + "\n")
