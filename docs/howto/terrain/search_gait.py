"""A gait for rough ground: CMA-ES over the paths of the feet, first on planks of several heights, then on five scenes.

All gaits of a generation start alike, on the same ground, and each generation anew: no gait wins by an easy draw.
The result is the centre of the last distribution, which many gaits have shaped, not the best single gait.

    python search_gait.py free        # or stiff, or passive: the spine
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
    "frequency": (1.0, 0.4, 2.0), "stride": (0.6, 0.3, 0.9), "duty": (0.5, 0.3, 0.75),
    "stance.swing_amplitude": (0.018, 0.005, 0.03), "stance.stance_amplitude": (0.005, 0.0, 0.02),
    "stance.front_z": (-0.047, -0.053, -0.035), "stance.rear_z": (-0.046, -0.06, -0.035),
    "stance.front_y": (-0.005, -0.025, 0.025), "stance.rear_y": (-0.003, -0.025, 0.025),
}  # fmt: skip
SPINE = {"spine.amplitude": (0.1, 0.0, 0.5), "spine.phase": (0.0, -3.14, 3.14)} | {
    f"spine.harmonics.{name}": (0.0, -0.3, 0.3) for name in ("cos1", "sin1", "cos3", "sin3")
}
FEET = {
    "limb.phase.rear": (0.0, -0.4, 0.4),
    "limb.duty.front": (0.0, -0.2, 0.2),
    "limb.duty.rear": (0.0, -0.2, 0.2),
} | {f"foot.{limb}.{axis}{i}": (0.0, -0.02, 0.02) for limb in ("front", "rear") for axis in "yz" for i in range(1, 9)}


@dataclasses.dataclass(frozen=True, eq=False)
class Place:
    """A scene, the heights [m] that each gait walks over there, and its pilot."""

    scene: str
    heights: tuple[float, ...] = ()
    pilot: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Stage:
    """A search: how far is far enough, what a fall costs [m], and every how many generations it is tested how often."""

    places: tuple[Place, ...]
    generations: int
    population: int
    sigma: float
    seed: int
    far: float
    fall: float
    test: tuple[int, int]


POLES = ((0, 0), (0, -0.1), (0.06, -0.35), (-0.06, -0.75), (0.06, -1.15), (-0.06, -1.55), (0.06, -1.95), (-0.06, -2.35))
HIGH = (0.008, 0.011)
STAGES = (
    Stage((Place("planks", (0.004, 0.006, 0.008, 0.010, 0.011, 0.012)),), generations=30, population=20, sigma=0.12,
          seed=1, far=1.2, fall=0.15, test=(5, 24)),
    Stage((Place("planks", HIGH), Place("stairs", HIGH),
           Place("spiral_stairs", HIGH, {"pilot": "arc"}, {"pilot.radius": 0.5, "pilot.direction": 1.0}),
           Place("slalom", (), {"pilot": "waypoints", "waypoints": POLES}), Place("logs", (0.011,))),
          generations=24, population=16, sigma=0.06, seed=2, far=0.9, fall=0.3, test=(10, 16)),
)  # fmt: skip


class Ground:
    """Where gaits are compared."""

    def __init__(self, stage: Stage, spine: str) -> None:
        mode = "stride_extension+harmonics" if spine == "free" else "none"
        self.slack = {"build.spine_slack": 0.004} if spine == "passive" else {}
        self.random = np.random.default_rng(stage.seed)
        self.simulators = {
            place: Simulator(Setup(scene=place.scene, gait="trt", trajectory="free", spine=mode, physics="fast",
                                   **place.pilot), engine="c")
            for place in stage.places
        }  # fmt: skip

    def inside(self, gait: Gait) -> bool:
        """Whether the legs reach the feet's paths."""
        try:
            next(iter(self.simulators.values())).parameters({name: np.array([value]) for name, value in gait.items()})
        except ParameterError:
            return False
        return True

    def walk(self, place: Place, gaits: list[Gait], heights: tuple[Any, ...], seconds: float) -> Any:
        """Distance [m], and whether the walk lasted, of each gait on each height."""
        n, draw = len(heights), self.random.uniform
        starts = {"start.phase": draw(0.0, 1.0, n), "start.yaw": draw(-0.1, 0.1, n),
                  "contact.friction": draw(0.8, 1.6, n)}  # fmt: skip
        if place.heights:
            starts["terrain.height"] = np.array(heights)
            if not place.pilot:
                starts["terrain.shift"] = draw(-0.1, 0.1, n)
        given = {name: np.repeat([gait[name] for gait in gaits], n) for name in gaits[0]}
        given |= {name: np.tile(column, len(gaits)) for name, column in starts.items()}
        run = Run(duration=seconds, warmup=0.5)
        result = self.simulators[place].run(given | dict(place.values) | self.slack, run)
        lasted = (np.asarray(result.status) == "ok").reshape(len(gaits), n)
        return np.nan_to_num(np.asarray(result.metrics["distance"])).reshape(len(gaits), n), lasted

    def tested(self, gait: Gait, times: int) -> str:
        """Share of walks over half a metre of each place at 10 mm."""
        shares = []
        for place in self.simulators:
            distance, lasted = self.walk(place, [gait], (0.01,) * times, seconds=10.0)
            shares.append(f"{place.scene} {((distance >= 0.5) & lasted).mean():.0%}")
        return ", ".join(shares)


def searched(stage: Stage, spine: str, begin: Gait) -> Gait:
    """The gait that a stage leads to from another."""
    ground, space = Ground(stage, spine), STANCE | (SPINE if spine == "free" else {}) | FEET
    _, low, high = np.array(list(space.values())).T
    start = (np.array([begin[name] for name in space]) - low) / (high - low)
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
            distance, lasted = ground.walk(place, gaits, place.heights or (None,), seconds=8.0)
            scores += (np.clip(distance, -0.2, stage.far) - stage.fall * ~lasted).mean(axis=1) / len(stage.places)
        strategy.tell(points, (-scores).tolist())
        every, times = stage.test
        if generation % every == every - 1:
            print(f"generation {generation}: {ground.tested(gait_of(strategy.result.xfavorite), times)}", flush=True)
    return {name: round(value, 5) for name, value in gait_of(strategy.result.xfavorite).items()}


def search(spine: str, stages: tuple[Stage, ...] = STAGES) -> Gait:
    """The gait that is found, parameter -> value."""
    gait = {name: start for name, (start, _, _) in (STANCE | SPINE | FEET).items()}
    for stage in stages:
        gait = searched(stage, spine, gait)
    return gait


if __name__ == "__main__":
    for parameter, value in search(sys.argv[1]).items():
        print(f"  {parameter}: {value:g}")
