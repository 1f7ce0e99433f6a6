"""Gaits for rough ground with the spine free, stiff and passive: CMA-ES with the steering, on seven scenes, with drawn
bodies. All have one frequency, so that what differs is the spine.

A first search brings the spine's gait `begin` in gaits.csv to this frequency, and each seed goes on from there. All
gaits of a generation start alike, on the same ground with the same bodies, and each generation anew: no gait wins by an
easy draw. The result is the centre of the last distribution, which many gaits have shaped, not the best single gait.

    python search_gait.py free first 0 1 2 3 4    # the spine, or stiff, or passive; one search for each seed
    python search_gait.py free begin                # the walks of the gait that it begins with, at its own frequency
    python search_gait.py compare
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cma
import numpy as np
import pandas as pd
from scipy import stats

from nermo_mjx import ParameterError, Run, Setup, Simulator

Gait = dict[str, float]
HERE = Path(__file__).parent
#: Of all gaits [Hz]: between the 1.89 Hz with which the free spine's search begins and the 1.25 Hz of the others.
FREQUENCY = 1.5
#: Parameter -> its bounds. What is not here, the paths of the feet, stays as in the gait that the search begins with.
GAIT = {
    "stride": (0.3, 0.9),
    "duty": (0.3, 0.75),
    "stance.swing_amplitude": (0.005, 0.03),
    "stance.stance_amplitude": (0.0, 0.02),
    "stance.front_z": (-0.053, -0.035),
    "stance.rear_z": (-0.06, -0.035),
    "stance.front_y": (-0.025, 0.025),
    "stance.rear_y": (-0.025, 0.025),
    "limb.phase.rear": (-0.4, 0.4),
    "limb.duty.front": (-0.2, 0.2),
    "limb.duty.rear": (-0.2, 0.2),
    "turning.exponent": (1.0, 5.0),
    "pilot.look_ahead": (0.1, 1.0),
    "pilot.grip": (0.1, 1.5),
}
#: The same of a spine that bends.
BENDING = {"spine.amplitude": (0.0, 0.5), "spine.phase": (-3.14, 3.14), "turning.spine": (0.0, 1.0)} | {
    f"spine.harmonics.{name}": (-0.3, 0.3) for name in ("cos1", "sin1", "cos3", "sin3")
}
#: Masses within 10 % of the model's, servos and spine within 20 %: the ranges of the training files.
BODIES = {
    "mass.front": (0.1525, 0.1865),
    "mass.rear": (0.0905, 0.1106),
    "servo.kp": (15.3, 22.9),
    "servo.kv": (0.0125, 0.0187),
    "stiffness.spine": (0.96, 1.44),
    "damping.spine": (0.008, 0.012),
}
#: What is told of the walks, beside success.
MEASURED = ["speed", "cost_of_transport", "electrical_cost_of_transport", "cross_track_peak"]
UNSEEN = 1  # marks the walks that choose nothing
SLACK = {"build.spine_slack": 0.004}
POLES = ((0, 0), (0, -0.1), (0.06, -0.35), (-0.06, -0.75), (0.06, -1.15), (-0.06, -1.55), (0.06, -1.95), (-0.06, -2.35))


@dataclasses.dataclass(frozen=True)
class Place:
    """A scene, the heights [m] that each gait walks over, its pilot, and how far from its path it may come [m]."""

    scene: str
    heights: tuple[float | None, ...]
    pilot: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    corridor: float = 0.3


#: Most walks where most fails.
PLACES = (
    Place("planks", (0.010, 0.012)),
    Place("ramp", (None,)),
    Place("logs", (0.011,)),
    Place("stairs", (0.009, 0.011)),
    Place(
        "spiral_stairs",
        (0.008, 0.010, 0.011, 0.012),
        {"pilot": "arc"},
        {"pilot.radius": 0.5, "pilot.direction": 1.0},
        corridor=0.15,
    ),
    Place("rough", (0.011,)),
    Place("slalom", (None,) * 3, {"pilot": "waypoints", "waypoints": POLES}, corridor=0.1),
)


class Ground:
    """Where gaits of a spine walk."""

    def __init__(self, spine: str, places: tuple[Place, ...] = PLACES) -> None:
        mode = "stride_extension+harmonics" if spine == "free" else "none"
        self.body = SLACK if spine == "passive" else {}
        self.places = places
        self.simulators = {
            place.scene: Simulator(
                Setup(scene=place.scene, gait="trot", trajectory="free", spine=mode, physics="fast", **place.pilot),
                engine="c",
            )
            for place in places
        }

    def inside(self, gait: Gait) -> bool:
        """Whether the legs reach the feet's paths."""
        try:
            next(iter(self.simulators.values())).parameters({name: np.array([value]) for name, value in gait.items()})
        except ParameterError:
            return False
        return True

    def walk(self, place: Place, gaits: list[Gait], random: np.random.Generator, run: Run) -> pd.DataFrame:
        """A walk of each gait over each height, a row for each: gait, status, metrics, and `aside`, the largest
        distance from the path over what is allowed. All gaits have the same starts and bodies."""
        n = len(place.heights)
        drawn = {"start.phase": (0.0, 1.0), "start.yaw": (-0.1, 0.1), "contact.friction": (0.8, 1.6)} | BODIES
        starts = {name: random.uniform(*ends, n) for name, ends in drawn.items()}
        if None not in place.heights:
            starts["terrain.height"] = np.array(place.heights)
            if not place.pilot:
                starts["terrain.shift"] = random.uniform(-0.1, 0.1, n)
        given = {name: np.repeat([gait[name] for gait in gaits], n) for name in gaits[0]}
        given |= {name: np.tile(column, len(gaits)) for name, column in starts.items()}
        result = self.simulators[place.scene].run({**self.body, **given, **place.values}, run)
        walks = pd.DataFrame({name: np.asarray(column) for name, column in result.metrics.items()})
        aside = walks.cross_track_peak / place.corridor
        return walks.assign(gait=np.repeat(np.arange(len(gaits)), n), ok=np.asarray(result.status) == "ok", aside=aside)


def gaits() -> pd.DataFrame:
    """Those of each spine: with which its searches begin, and what each seed found."""
    return pd.read_csv(HERE / "gaits.csv", dtype={"seed": str}).set_index(["spine", "seed"])


def search(spine: str, ground: Ground, seed: str, generations: int | None = None, population: int = 14) -> Gait:
    """The gait that is found, parameter -> value."""
    first = seed == "first"
    begin = gaits().loc[spine, "begin" if first else "first"].dropna().to_dict() | {"frequency": FREQUENCY}
    number = 0 if first else 1 + int(seed)
    space = GAIT | (BENDING if spine == "free" else {})
    low, high = np.array(list(space.values())).T
    start = (np.array([begin[name] for name in space]) - low) / (high - low)
    options = {"popsize": population, "bounds": [0, 1], "seed": number + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.02, 0.98), 0.06 if first else 0.04, options)
    random = np.random.default_rng(number)

    def gait_of(point: Any) -> Gait:
        return begin | dict(zip(space, (low + np.asarray(point) * (high - low)).tolist(), strict=True))

    for generation in range(generations or (10 if first else 8)):
        points: list[np.ndarray] = []
        while len(points) < population:
            (point,) = strategy.ask(1)
            points += [point] if ground.inside(gait_of(point)) else []
        scores, passed = np.zeros(population), []
        for place in ground.places:
            walks = ground.walk(place, [gait_of(point) for point in points], random, Run(duration=7.0, warmup=0.5))
            distance, aside = walks.distance.fillna(0.0), walks.aside.fillna(2.0)
            # Far enough is 0.55 m; a fall costs 0.6 m, and so does a way twice as wide as allowed.
            score = np.clip(distance, -0.2, 0.55) - 0.6 * (~walks.ok + np.clip(aside - 1.0, 0.0, 1.0))
            scores += score.groupby(walks.gait).mean() / len(ground.places)
            passed.append(f"{place.scene} {(walks.ok & (distance >= 0.35) & (aside <= 1.0)).mean():.0%}")
        strategy.tell(points, (-scores).tolist())
        print(f"{spine} {seed}, generation {generation}: {scores.mean():.3f} m, {', '.join(passed)}", flush=True)
    return {name: round(value, 5) for name, value in gait_of(strategy.result.xfavorite).items()}


def measured(ground: Ground, gait: Gait, seed: int, times: int = 40) -> pd.DataFrame:
    """What a gait does in walks of 10 s at 10 mm, a row for each place; seeds of each spine have the same bodies."""
    rows = []
    for i, place in enumerate(ground.places):
        same = dataclasses.replace(place, heights=(None if None in place.heights else 0.01,) * times)
        random = np.random.default_rng([seed, i, UNSEEN])
        walks = ground.walk(same, [gait], random, Run(duration=10.0, warmup=1.0))
        passed = walks.ok & (walks.distance >= 0.5) & (walks.aside <= 1.0)
        counts = {"walks": times, "successes": passed.sum(), "falls": (~walks.ok).sum()}
        rows.append({"scene": place.scene} | counts | walks[MEASURED].median().to_dict())
    return pd.DataFrame(rows)


def appended(name: str, rows: pd.DataFrame) -> None:
    """Rows at the end of a table beside this file."""
    path = HERE / name
    table = pd.concat([pd.read_csv(path, dtype={"seed": str}), rows]) if path.exists() else rows
    table.to_csv(path, index=False, float_format="%.5g")


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """Means over the seeds for each scene and for all, of success as a share, and how far those of the free spine lie
    above the others, with half of the 95 % interval: Student's t over the seeds, whose walks have the same bodies."""
    table = table[table.seed != "begin"].assign(success=table.successes / table.walks)
    table = table.drop(columns=["walks", "successes"])
    every = table.groupby(["spine", "seed"], as_index=False).mean(numeric_only=True).assign(scene="all")
    seeds = pd.concat([table, every]).set_index(["scene", "seed", "spine"]).unstack("spine")
    rows = {}
    for name in ("success", *MEASURED):
        for scene, each in seeds[name].groupby("scene", sort=False):
            row = each.mean().to_dict()
            for other in ("stiff", "passive"):
                apart = each.free - each[other]
                half = apart.sem() * stats.t.ppf(0.975, len(apart) - 1)
                row |= {f"free - {other}": apart.mean(), f"+- {other}": half}
            rows[name, scene] = row
    return pd.DataFrame(rows).T


if __name__ == "__main__":
    if sys.argv[1] == "compare":
        print(compared(pd.read_csv(HERE / "seeds.csv")).round(4).to_string())
        sys.exit()
    spine, seeds = sys.argv[1], sys.argv[2:]
    ground = Ground(spine)
    for seed in seeds:
        if seed == "begin":  # at its own frequency, as it is
            walks = measured(ground, gaits().loc[spine, seed].dropna().to_dict(), 0, times=100)
        else:
            gait = search(spine, ground, seed)
            appended("gaits.csv", pd.DataFrame([{"spine": spine, "seed": seed} | gait]))
            walks = pd.DataFrame() if seed == "first" else measured(ground, gait, int(seed))
        appended("seeds.csv", walks.assign(spine=spine, seed=seed))
