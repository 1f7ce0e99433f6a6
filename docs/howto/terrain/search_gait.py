"""Gaits for rough ground with the spine free, stiff and passive: CMA-ES with the steering, on seven scenes, with drawn
bodies. All have one frequency, so that what differs is the spine.

The stiff and the passive spine begin with their gaits `begin` in gaits.csv, the free one with the stiff one's and a
small bend, so that all that the stiff spine can do is within its reach. All gaits of a generation start alike, on the
same ground with the same bodies, and each generation anew: no gait wins by an easy draw. The result is the centre of
the last distribution, which many gaits have shaped, not the best single gait.

    python search_gait.py free begin 0 1 2 3 4    # the spine, or stiff, or passive; one search for each seed, and the
                                                  # walks of the gait `begin` at its own frequency
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
#: Of all gaits [Hz]: the cadence of the gaits with which the searches begin.
FREQUENCY = 1.25
POPULATION, GENERATIONS = 12, 4
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
BENDING = {
    "spine.amplitude": (0.0, 0.5),
    "spine.phase": (-3.14, 3.14),
    "turning.spine": (0.0, 1.0),
} | {f"spine.harmonics.{name}": (-0.3, 0.3) for name in ("cos1", "sin1", "cos3", "sin3")}
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
POLES = (
    (0, 0),
    (0, -0.1),
    (0.06, -0.35),
    (-0.06, -0.75),
    (0.06, -1.15),
    (-0.06, -1.55),
    (0.06, -1.95),
    (-0.06, -2.35),
)


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
                Setup(
                    scene=place.scene,
                    gait="trot",
                    trajectory="free",
                    spine=mode,
                    physics="fast",
                    **place.pilot,
                ),
                engine="c",
            )
            for place in places
        }

    def inside(self, gait: Gait) -> bool:
        """Whether the legs reach the feet's paths."""
        try:
            next(iter(self.simulators.values())).parameters(
                {name: np.array([value]) for name, value in gait.items()}
            )
        except ParameterError:
            return False
        return True

    def walk(
        self, place: Place, gaits: list[Gait], random: np.random.Generator, run: Run
    ) -> pd.DataFrame:
        """A walk of each gait over each height, a row for each: gait, status, metrics, and `aside`, the largest
        distance from the path over what is allowed. All gaits have the same starts and bodies."""
        n = len(place.heights)
        drawn = {
            "start.phase": (0.0, 1.0),
            "start.yaw": (-0.1, 0.1),
            "contact.friction": (0.8, 1.6),
        } | BODIES
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
        return walks.assign(
            gait=np.repeat(np.arange(len(gaits)), n),
            ok=np.asarray(result.status) == "ok",
            aside=aside,
        )


def gaits() -> pd.DataFrame:
    """Those of each spine: with which its searches begin, and what each seed found."""
    return pd.read_csv(HERE / "gaits.csv", dtype={"seed": str}).set_index(["spine", "seed"])


def scores_of(
    ground: Ground, tried: list[Gait], random: np.random.Generator
) -> tuple[np.ndarray, str]:
    """What each gait is worth [m], and how many walks of all of them passed each scene.

    Far enough is 0.55 m in 7 s; farther counts a fifth. A fall costs 0.6 m, and so does a way twice as wide as allowed;
    electrical energy costs 0.05 m for each 100 times weight and distance.
    """
    scores, passed = np.zeros(len(tried)), []
    for place in ground.places:
        walks = ground.walk(place, tried, random, Run(duration=7.0, warmup=0.5))
        distance, aside = walks.distance.fillna(0.0), walks.aside.fillna(2.0)
        energy = walks.electrical_cost_of_transport.fillna(400.0).clip(0.0, 400.0)
        score = (
            np.clip(distance, -0.2, 0.55)
            + 0.2 * np.clip(distance - 0.55, 0.0, None)
            - 0.0005 * energy
        )
        score -= 0.6 * (~walks.ok + np.clip(aside - 1.0, 0.0, 1.0))
        scores += score.groupby(walks.gait).mean() / len(ground.places)
        passed.append(
            f"{place.scene} {(walks.ok & (distance >= 0.35) & (aside <= 1.0)).mean():.0%}"
        )
    return np.asarray(scores), f"{scores.mean():.3f} m, {', '.join(passed)}"


def begun(spine: str, ground: Ground, random: np.random.Generator) -> Gait:
    """The gait that a search begins with; that of the free spine bends at the phase that serves it best."""
    known = gaits().loc["stiff" if spine == "free" else spine, "begin"].dropna().to_dict() | {
        "frequency": FREQUENCY
    }
    if spine != "free":
        return known
    bend = dict.fromkeys(BENDING, 0.0) | {"spine.amplitude": 0.1, "turning.spine": 0.3}
    phases = np.linspace(-np.pi, np.pi, POPULATION, endpoint=False)
    tried = [known | bend | {"spine.phase": float(phase)} for phase in phases]
    scores, passed = scores_of(ground, tried, random)
    print(f"phases {np.round(phases, 2)}: {np.round(scores, 3)} m; {passed}", flush=True)
    return tried[int(np.argmax(scores))]


def search(
    spine: str,
    ground: Ground,
    seed: int,
    generations: int = GENERATIONS,
    population: int = POPULATION,
) -> Gait:
    """The gait that is found, parameter -> value."""
    random = np.random.default_rng(seed)
    begin = begun(spine, ground, random)
    space = GAIT | (BENDING if spine == "free" else {})
    low, high = np.array(list(space.values())).T
    start = (np.array([begin[name] for name in space]) - low) / (high - low)
    options = {"popsize": population, "bounds": [0, 1], "seed": seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.02, 0.98), 0.03, options)

    def gait_of(point: Any) -> Gait:
        return begin | dict(
            zip(space, (low + np.asarray(point) * (high - low)).tolist(), strict=True)
        )

    for generation in range(generations):
        points: list[np.ndarray] = []
        while len(points) < population:
            (point,) = strategy.ask(1)
            points += [point] if ground.inside(gait_of(point)) else []
        scores, passed = scores_of(ground, [gait_of(point) for point in points], random)
        strategy.tell(points, (-scores).tolist())
        print(f"{spine} {seed}, generation {generation}: {passed}", flush=True)
    return {name: round(value, 5) for name, value in gait_of(strategy.result.xfavorite).items()}


def measured(ground: Ground, gait: Gait, seed: int) -> pd.DataFrame:
    """What a gait does in walks of 10 s at 10 mm, most where most fails; seeds of each spine have the same bodies."""
    rows = []
    for i, place in enumerate(ground.places):
        heights = (None if None in place.heights else 0.01,) * len(place.heights) * POPULATION
        random = np.random.default_rng([seed, i, UNSEEN])
        walks = ground.walk(
            dataclasses.replace(place, heights=heights),
            [gait],
            random,
            Run(duration=10.0, warmup=1.0),
        )
        passed = walks.ok & (walks.distance >= 0.5) & (walks.aside <= 1.0)
        counts = {"walks": len(walks), "successes": passed.sum(), "falls": (~walks.ok).sum()}
        rows.append({"scene": place.scene} | counts | walks[MEASURED].median().to_dict())
    return pd.DataFrame(rows)


def put(name: str, rows: pd.DataFrame) -> None:
    """Rows of a spine and a seed at the end of a table beside this file, in place of those it has of them."""
    path = HERE / name
    if path.exists():
        table = pd.read_csv(path, dtype={"seed": str})
        others = (table.spine != rows.spine.iloc[0]) | (table.seed != rows.seed.iloc[0])
        rows = pd.concat([table[others], rows])
    rows.to_csv(path, index=False, float_format="%.5g")


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """Means over the seeds for each scene and for all, of success as a share, and how far those of the free spine lie
    above the others, with half of the 95 % interval: Student's t over the seeds, whose walks have the same bodies."""
    table = table[table.seed.str.isdigit()].assign(success=table.successes / table.walks)
    table = table.drop(columns=["walks", "successes"])
    every = (
        table.groupby(["spine", "seed"], as_index=False).mean(numeric_only=True).assign(scene="all")
    )
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
        print(compared(pd.read_csv(HERE / "seeds.csv", dtype={"seed": str})).round(4).to_string())
        sys.exit()
    spine, seeds = sys.argv[1], sys.argv[2:]
    ground = Ground(spine)
    for seed in seeds:
        if seed == "begin":
            walks = measured(ground, gaits().loc[spine, seed].dropna().to_dict(), 5)
        else:
            gait = search(spine, ground, int(seed))
            put("gaits.csv", pd.DataFrame([{"spine": spine, "seed": seed} | gait]))
            walks = measured(ground, gait, int(seed))
        put("seeds.csv", walks.assign(spine=spine, seed=seed))
