"""Robot instances that walk as fast as published: how an ensemble such as `nermo_mjx/robot/identified.csv` is made.

    python docs/benchmarks/published_speeds.py DIR --profile as_published --samples 64 --generations 3

CMA-ES searches servo gain and damping for the ratios of speeds in section 6.2.1 of the publication. Then the script
samples robot instances evenly within the bounds, frictions included, and keeps those with an objective of at most
`--tolerance`. DIR/ensemble.csv works with `--body DIR` and `randomize: {from: DIR}`; DIR/ensemble.png shows it.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import click
import numpy as np

from nermo_mjx import Run, Setup, Simulator, all_parameters
from nermo_mjx.control.parameters import body_values, robot_choices
from nermo_mjx.experiments.cases import AMPLITUDE, Case, Settings, worlds
from nermo_mjx.identify.estimation import Estimation, LoggedSamples, Parameter, ParameterSpace
from nermo_mjx.identify.report import ensemble_text
from nermo_mjx.plotting.charts import pair_scatters
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.shown import shown

#: Parameter -> lowest and highest value, which have physical reasons: stall torque at an error of 2 to 0.45 degrees (in
#: `as_published` up to the gain at which the author's servos tremble), stall torque at 16 to 0.5 rad/s, printed hinges
#: that creep back within a tenth of a second. The ankles have the damping of the knees.
SERVO = {"servo.kp": (4.5, 20.0), "servo.kv": (0.01, 0.3)}
SEARCHED = SERVO | {"damping.knee": (0.002, 0.03), "damping.spine": (0.003, 0.1)}
#: Sampled, but not searched: rubber and printed plastic on a mat.
UNCERTAIN = {"contact.friction": (1.0, 1.8), "contact.tail_friction": (0.2, 1.0)}
#: Walks by name: gait, whether the spine extends the strides, frequency [Hz].
GAITS = {
    "trot": ("trot", 0),
    "trot+": ("trot", 1),
    "walking": ("walking_trot", 0),
    "walking+": ("walking_trot", 1),
}
WALKS = {
    f"{n} {f}": (*of, f)
    for f in (0.5, 0.8)
    for n, of in (GAITS | {"lateral": ("lateral_walk", 0)}).items()
}
#: Lowest and highest published ratio of two speeds, tolerance of the ratio's logarithm, and both walks.
TARGETS = [(0.9, 0.9, 0.1, "trot 0.8", "theory"), (1.22, 1.22, 0.1, "trot+ 0.8", "trot 0.8")]
TARGETS += [
    (1.05, 1.22, 0.1, "trot+ 0.5", "trot 0.5"),
    (1.27, 1.27, 0.1, "trot 0.8", "lateral 0.8"),
]
TARGETS += [(1.48, 1.48, 0.1, "trot+ 0.8", "lateral 0.8")]
#: An order of two speeds is a ratio of at least 1.
ORDERS = [("walking+", "walking"), ("trot", "walking"), ("walking", "lateral")]
TARGETS += [
    (1.0, math.inf, 0.02, f"{one} {f}", f"{other} {f}") for one, other in ORDERS for f in (0.8, 0.5)
]
#: Speed of the trot at 0.8 Hz without slip (5.22) [m/s], and the robot instances that are simulated together.
THEORY, BATCH = 0.096, 12


class PublishedSpeeds:
    """A problem of `Estimation`: deviations of simulated ratios of speeds from the published ones, in tolerances."""

    def __init__(self, defaults: dict[str, float], profile: str) -> None:
        n = len(TARGETS)
        self.measured = LoggedSamples(
            np.zeros(n), np.zeros(n, int), np.arange(n, dtype=float), np.zeros(1)
        )
        self.defaults = defaults
        choices = {name: str(chosen) for name, chosen in robot_choices(profile).items()}
        setup = Setup(pilot="straight", spine="stride_extension", **choices)
        no_pilot = {"pilot.error_gain": 0.0, "pilot.change_gain": 0.0}
        cases = [
            Case(
                {"walk": name},
                gait,
                values={"frequency": f, "spine.amplitude": AMPLITUDE * spine, **no_pilot},
            )
            for name, (gait, spine, f) in WALKS.items()
        ]
        self.simulator = Simulator(setup, "c")
        self.walks = worlds(cases, setup.defaults(), Settings((profile,), repeats=1)).values
        self.instances, self.deviations = np.empty((0, len(defaults))), np.empty((0, n))

    def predict(self, values: np.ndarray) -> np.ndarray:
        """Deviations (k, targets) of robot instances (k, q); parameters after the first q have their defaults."""
        instances = np.tile(list(self.defaults.values()), (len(values), 1))
        instances[:, : values.shape[1]] = [[float(f"{x:.4g}") for x in row] for row in values]
        for batch in np.array_split(instances, -(-len(instances) // BATCH)):
            each = dict(zip(self.defaults, np.repeat(batch, len(WALKS), axis=0).T, strict=True))
            same = {name: np.tile(column, len(batch)) for name, column in self.walks.items()}
            result = self.simulator.run(
                same | each | {"damping.ankle": each["damping.knee"]}, Run(cycles=8.0)
            )
            speed = result.metrics["speed"] * same.get("tracking.clock_ratio", 1.0)
            speed = np.where(result.status == "ok", speed, np.nan).reshape(len(batch), -1)
            speed[np.isnan(speed).any(axis=1)] = np.nan
            at = dict(zip(WALKS, speed.T, strict=True)) | {"theory": np.full(len(batch), THEORY)}
            ratio = np.stack([at[one] / at[other] for *_, one, other in TARGETS], axis=1)
            low, high, tolerance = np.array([target[:3] for target in TARGETS]).T
            ratio = np.log(np.where(ratio > 0, ratio, np.nan))
            away = np.maximum(ratio - np.log(high), 0.0) + np.minimum(ratio - np.log(low), 0.0)
            self.deviations = np.vstack([self.deviations, away / tolerance])
        self.instances = np.vstack([self.instances, instances])
        return self.deviations[-len(instances) :]


def bounds(profile: str) -> dict[str, tuple[float, float]]:
    return SEARCHED | UNCERTAIN | ({"servo.kp": (5.0, 120.0)} if profile == "as_published" else {})


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--profile", default="exact", type=click.Choice(["exact", "as_published"]))
@click.option("--generations", default=10)
@click.option("--samples", default=256)
@click.option("--tolerance", default=0.5)
def main(out: Path, profile: str, generations: int, samples: int, tolerance: float) -> None:
    known, ranges = all_parameters(), bounds(profile)
    defaults = {name: body_values(profile).get(name, known[name].default) for name in ranges}
    parameters = [
        Parameter(n, "", known[n].unit, defaults[n], *ranges[n], "", math.nan) for n in ranges
    ]
    problem = PublishedSpeeds(defaults, profile)
    problem.predict(np.array([list(defaults.values())]))
    list(
        Estimation(ParameterSpace(parameters[: len(SEARCHED)]), problem).search_globally(
            generations, generations, seed=0
        )
    )
    Estimation(ParameterSpace(parameters), problem).scan(samples, seed=0)
    objective = np.nan_to_num(np.sqrt(np.mean(problem.deviations**2, axis=1)), nan=math.inf)
    tried = len(objective) - samples
    chosen = [
        int(np.argmin(objective[:tried])),
        *(tried + np.flatnonzero(objective[tried:] <= tolerance)),
    ]
    columns = dict(zip(ranges, problem.instances[chosen].T, strict=True))
    columns["damping.ankle"] = columns["damping.knee"]
    about = f"{len(chosen) - 1} of {samples} robot instances, objective at most {tolerance:g}, profile {profile}"
    pairs = list(
        itertools.combinations(
            [shown(p.name, p.unit, columns[p.name], log=True) for p in parameters], 2
        )
    )
    cost, title = (
        shown("objective", "1", objective[chosen], side="min"),
        "Robot instances that walk as published",
    )
    write_figures([("ensemble", pair_scatters(pairs, cost, title, f"{about}; "))], out)
    (out / "ensemble.csv").write_bytes(ensemble_text(f"{about}.", columns, objective[chosen]))
    click.echo(
        f"{about}. Objective: {objective[0]:.3f} of the profile, {objective[chosen[0]]:.3f} of the best."
    )


if __name__ == "__main__":
    main()
