"""A gait for rough ground: CMA-ES over the paths of the feet, on planks of several heights, then on more scenes, then
with the steering on all seven, at last with other bodies.

All gaits of a generation start alike, on the same ground, and each generation anew: no gait wins by an easy draw.
The result is the centre of the last distribution, which many gaits have shaped, not the best single gait.

    python search_gait.py free        # or stiff, or passive: the spine
    python search_gait.py free 100    # another search, whose random numbers begin elsewhere
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from typing import Any

import cma
import numpy as np

from nermo_mjx import ParameterError, Run, Setup, Simulator

Gait = dict[str, float]
#: Parameter -> where the search begins, and its bounds.
STANCE = {
    "frequency": (1.0, 0.4, 2.0),
    "stride": (0.6, 0.3, 0.9),
    "duty": (0.5, 0.3, 0.75),
    "stance.swing_amplitude": (0.018, 0.005, 0.03),
    "stance.stance_amplitude": (0.005, 0.0, 0.02),
    "stance.front_z": (-0.047, -0.053, -0.035),
    "stance.rear_z": (-0.046, -0.06, -0.035),
    "stance.front_y": (-0.005, -0.025, 0.025),
    "stance.rear_y": (-0.003, -0.025, 0.025),
}
SPINE = {"spine.amplitude": (0.1, 0.0, 0.5), "spine.phase": (0.0, -3.14, 3.14)} | {
    f"spine.harmonics.{name}": (0.0, -0.3, 0.3) for name in ("cos1", "sin1", "cos3", "sin3")
}
FEET = {
    "limb.phase.rear": (0.0, -0.4, 0.4),
    "limb.duty.front": (0.0, -0.2, 0.2),
    "limb.duty.rear": (0.0, -0.2, 0.2),
} | {f"foot.{limb}.{axis}{i}": (0.0, -0.02, 0.02) for limb in ("front", "rear") for axis in "yz" for i in range(1, 9)}
STEERING = {"turning.exponent": (2.0, 1.0, 5.0), "pilot.look_ahead": (0.4, 0.1, 1.0), "pilot.grip": (0.5, 0.1, 1.5)}
BENDING = {"turning.spine": (0.3, 0.0, 1.0)}


@dataclasses.dataclass(frozen=True, eq=False)
class Place:
    """A scene, the heights [m] that each gait walks over, its pilot, and how far from its path it may come [m]."""

    scene: str
    heights: tuple[float | None, ...] = (None,)
    pilot: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    corridor: float = 0.3


@dataclasses.dataclass(frozen=True)
class Stage:
    """A search.

    Attributes:
        places: where each gait walks.
        steers: whether the steering is searched for, too, and counts.
        bodies: what is drawn of the body for each walk, and its range.
        generations, population, sigma, seed: of CMA-ES; sigma as a share of the bounds.
        far: what is far enough in 8 s [m].
        fall: what a fall costs, and a way twice as wide as allowed [m].
        test: every how many generations the centre is tested, and how often.
    """

    places: tuple[Place, ...]
    generations: int
    population: int
    sigma: float
    seed: int
    far: float
    fall: float
    test: tuple[int, int]
    steers: bool = False
    bodies: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)


POLES = ((0, 0), (0, -0.1), (0.06, -0.35), (-0.06, -0.75), (0.06, -1.15), (-0.06, -1.55), (0.06, -1.95), (-0.06, -2.35))
HIGH = (0.008, 0.011)
SPIRAL = Place("spiral_stairs", HIGH, {"pilot": "arc"}, {"pilot.radius": 0.5, "pilot.direction": 1.0}, corridor=0.15)
SLALOM = Place("slalom", (None,), {"pilot": "waypoints", "waypoints": POLES}, corridor=0.1)
FIVE = (Place("planks", HIGH), Place("stairs", HIGH), SPIRAL, SLALOM, Place("logs", (0.011,)))
SEVEN = (*FIVE, SLALOM, Place("ramp"), Place("rough", HIGH))
#: The body of the gaits in the training files, docs/model.md's damped one.
DAMPED = {"damping.knee": 0.02531, "damping.ankle": 0.02531, "damping.spine": 0.09242}
#: Masses within 10 % of the model's, servos and spine within 20 %: the ranges of the training files.
BODIES = {
    "mass.front": (0.1525, 0.1865),
    "mass.rear": (0.0905, 0.1106),
    "servo.kp": (15.3, 22.9),
    "servo.kv": (0.0125, 0.0187),
    "stiffness.spine": (0.96, 1.44),
    "damping.spine": (0.074, 0.111),
}
FOUR = (0.008, 0.010, 0.011, 0.012)
#: Most walks where most fails.
ALL = (
    *(dataclasses.replace(SPIRAL, heights=FOUR) for _ in range(3)),
    *(dataclasses.replace(SLALOM, heights=(None,) * times) for times in (4, 2)),
    Place("rough", FOUR),
    Place("planks", (0.009, 0.012)),
    Place("stairs", HIGH),
    Place("logs", (0.011,)),
    Place("ramp"),
)
STAGES = (
    Stage(
        (Place("planks", (0.004, 0.006, 0.008, 0.010, 0.011, 0.012)),),
        generations=30,
        population=20,
        sigma=0.12,
        seed=1,
        far=1.2,
        fall=0.15,
        test=(5, 24),
    ),
    Stage(FIVE, generations=24, population=16, sigma=0.06, seed=2, far=0.9, fall=0.3, test=(10, 16)),
    Stage(SEVEN, generations=40, population=20, sigma=0.08, seed=3, far=0.8, fall=0.4, test=(10, 16), steers=True),
    Stage(
        (*SEVEN, Place("rough", HIGH), SPIRAL),
        generations=20,
        population=24,
        sigma=0.03,
        seed=4,
        far=0.55,
        fall=0.6,
        test=(10, 24),
        steers=True,
    ),
    Stage(
        ALL,
        generations=24,
        population=24,
        sigma=0.03,
        seed=5,
        far=0.55,
        fall=0.6,
        test=(4, 48),
        steers=True,
        bodies=BODIES,
    ),
)


class Ground:
    """Where gaits are compared."""

    def __init__(self, stage: Stage, spine: str) -> None:
        mode = "stride_extension+harmonics" if spine == "free" else "none"
        self.body = DAMPED | ({"build.spine_slack": 0.004} if spine == "passive" else {})
        self.random = np.random.default_rng(stage.seed)
        self.steers, self.bodies = stage.steers, stage.bodies
        self.simulators = {
            place: Simulator(
                Setup(scene=place.scene, gait="trot", trajectory="free", spine=mode, physics="fast", **place.pilot),
                engine="c",
            )
            for place in stage.places
        }

    def inside(self, gait: Gait) -> bool:
        """Whether the legs reach the feet's paths."""
        try:
            next(iter(self.simulators.values())).parameters({name: np.array([value]) for name, value in gait.items()})
        except ParameterError:
            return False
        return True

    def walk(self, place: Place, gaits: list[Gait], heights: tuple[Any, ...], seconds: float) -> Any:
        """Distance [m], distance from the path over what is allowed, and whether it lasted, of each gait and height."""
        n, draw = len(heights), self.random.uniform
        starts = {
            "start.phase": draw(0.0, 1.0, n),
            "start.yaw": draw(-0.1, 0.1, n),
            "contact.friction": draw(0.8, 1.6, n),
        }
        starts |= {name: draw(*ends, n) for name, ends in self.bodies.items()}
        if None not in heights:
            starts["terrain.height"] = np.array(heights)
            if not place.pilot:
                starts["terrain.shift"] = draw(-0.1, 0.1, n)
        given = {name: np.repeat([gait[name] for gait in gaits], n) for name in gaits[0]}
        given |= {name: np.tile(column, len(gaits)) for name, column in starts.items()}
        run = Run(duration=seconds, warmup=0.5)
        result = self.simulators[place].run(self.body | given | dict(place.values), run)
        shape = (len(gaits), n)
        lasted = (np.asarray(result.status) == "ok").reshape(shape)
        distance, peak = (
            np.nan_to_num(np.asarray(result.metrics[name])).reshape(shape) for name in ("distance", "cross_track_peak")
        )
        return distance, peak / place.corridor if self.steers else np.zeros(shape), lasted

    def tested(self, gait: Gait, times: int) -> str:
        """Share of walks over half a metre of each place at 10 mm, near enough to the path."""
        shares = []
        for place in self.simulators:
            heights = (None if None in place.heights else 0.01,) * times
            distance, aside, lasted = self.walk(place, [gait], heights, seconds=10.0)
            shares.append(f"{place.scene} {((distance >= 0.5) & (aside <= 1.0) & lasted).mean():.0%}")
        return ", ".join(shares)


def searched(stage: Stage, spine: str, begin: Gait) -> Gait:
    """The gait that a stage leads to from another."""
    ground, space = Ground(stage, spine), STANCE | (SPINE if spine == "free" else {}) | FEET
    if stage.steers:
        space |= STEERING | (BENDING if spine == "free" else {})
    start, low, high = np.array(list(space.values())).T
    start = (np.array([begin.get(name, at) for name, at in zip(space, start, strict=True)]) - low) / (high - low)
    options = {"popsize": stage.population, "bounds": [0, 1], "seed": stage.seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.02, 0.98), stage.sigma, options)

    def gait_of(point: Any) -> Gait:
        return dict(zip(space, (low + np.asarray(point) * (high - low)).tolist(), strict=True))

    for generation in range(stage.generations):
        points: list[np.ndarray] = []
        while len(points) < stage.population:
            (point,) = strategy.ask(1)
            points += [point] if ground.inside(gait_of(point)) else []
        gaits, scores = [gait_of(point) for point in points], np.zeros(len(points))
        for place in stage.places:
            distance, aside, lasted = ground.walk(place, gaits, place.heights, seconds=8.0)
            cost = stage.fall * (~lasted + np.clip(aside - 1.0, 0.0, 1.0))
            scores += (np.clip(distance, -0.2, stage.far) - cost).mean(axis=1) / len(stage.places)
        strategy.tell(points, (-scores).tolist())
        every, times = stage.test
        if generation % every == every - 1:
            print(f"generation {generation}: {ground.tested(gait_of(strategy.result.xfavorite), times)}", flush=True)
    return {name: round(value, 5) for name, value in gait_of(strategy.result.xfavorite).items()}


def search(spine: str, stages: tuple[Stage, ...] = STAGES, seed: int = 0) -> Gait:
    """The gait that is found, parameter -> value; `seed` is added to those of the stages."""
    gait = {name: start for name, (start, _, _) in (STANCE | SPINE | FEET).items()}
    for stage in stages:
        gait = searched(dataclasses.replace(stage, seed=stage.seed + seed), spine, gait)
    return gait


if __name__ == "__main__":
    for parameter, value in search(sys.argv[1], seed=int(sys.argv[2]) if len(sys.argv) > 2 else 0).items():
        print(f"  {parameter}: {value:g}")
