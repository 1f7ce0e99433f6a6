"""Cases of an experiment, the batch of worlds that they form, and its run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from nermo_mjx.control.published import AS_BUILT, body_values, published_values
from nermo_mjx.experiments.outcome import BODY, Column
from nermo_mjx.experiments.settings import Settings, body_count
from nermo_mjx.recording import Recording, recording_of
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.rollout import METRICS, Run, RunResult, Simulator
from nermo_mjx.rollout.parameters import WorldParameters
from nermo_mjx.sweep.spec import START_SPREAD

#: Published amplitude of the stride extension [rad of spine servo]: 0.1 rad in each joint.
AMPLITUDE: Final = 0.4
FREQUENCIES: Final = (0.5, 0.67, 0.8)
Label = str | float | bool
#: Labels that several experiments have.
LABELS: Final = {
    "profile": Column("1", "exact or as_published"),
    "gait": Column("1", "trt: trot, trt1: walking trot, lat: lateral sequence walk"),
    "frequency": Column("Hz", "gait cycles per second of the controller's clock"),
    "repeat": Column("1", "index of the repeat; each starts a little shifted"),
    BODY: Column("1", "number of the identified body"),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """One case before profiles and repeats.

    Attributes:
        labels: what distinguishes it from the others, by column.
        gait, steering: named choices of `published_values`.
        values: parameters by name, on top of those.
    """

    labels: Mapping[str, Label]
    gait: str
    steering: str = "leg"
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Worlds:
    """A batch of n worlds.

    Attributes:
        labels: the cases' columns, and `profile` and `repeat`, (n,) each.
        values: parameter name -> (n,), for `Simulator.run`.
    """

    labels: dict[str, np.ndarray]
    values: dict[str, np.ndarray]

    def all_values(self, defaults: Mapping[str, float]) -> dict[str, np.ndarray]:
        """`values`, completed with the defaults of all other parameters, (n,) each."""
        n = len(next(iter(self.labels.values())))
        return {name: np.full(n, value) for name, value in defaults.items()} | self.values


def worlds(
    cases: Sequence[Case],
    defaults: Mapping[str, float],
    settings: Settings,
) -> Worlds:
    """Every case in every profile, `repeats` times from starts that differ by a seeded shift, and for every body.

    The shift of a repeat is the same for all cases, so that cases are compared from equal starts; the first repeat is
    shifted, too.

    Args:
        cases: all with the same labels.
        defaults: value of every parameter that no case names.
        settings: of the experiment; of several bodies, the column `BODY` numbers them from 1.

    Raises:
        ParameterError: see `settings.body_count`.
    """
    shifts, bodies = [_shift(settings.seed, repeat) for repeat in range(settings.repeats)], settings.bodies
    labels: list[dict[str, Label]] = []
    rows: list[dict[str, float]] = []
    for profile in settings.profiles:
        for case in cases:
            named = published_values(case.gait, steering=case.steering, profile=profile)
            built = {**AS_BUILT, **body_values(profile)} if profile == "as_built" else {}
            for repeat, shift in enumerate(shifts):
                labels.append({"profile": profile, **case.labels, "repeat": repeat})
                rows.append({**shift, **settings.values, **named, **case.values, **built})
    names = dict.fromkeys(name for row in rows for name in row)
    values = {name: np.array([row.get(name, defaults[name]) for row in rows]) for name in names}
    batch = Worlds({name: np.array([row[name] for row in labels]) for name in labels[0]}, values)
    return batch if bodies is None else _of_bodies(batch, bodies, {name for case in cases for name in case.values})


def _of_bodies(batch: Worlds, bodies: Mapping[str, np.ndarray], decided: set[str]) -> Worlds:
    """All worlds of a batch for each body, identified by the second label; values set by the cases take precedence."""
    count, size = body_count(bodies), len(next(iter(batch.labels.values())))
    labels = {name: np.tile(column, count) for name, column in batch.labels.items()}
    first, *rest = labels
    numbered = {first: labels[first], BODY: np.repeat(1 + np.arange(count), size)} | {
        name: labels[name] for name in rest
    }
    values = {name: np.tile(column, count) for name, column in batch.values.items()}
    each = {name: np.repeat(np.asarray(of, float), size) for name, of in bodies.items() if name not in decided}
    return Worlds(numbered, values | each)


def _shift(seed: int, repeat: int) -> dict[str, float]:
    random = np.random.default_rng((seed, repeat))
    return {name: float(random.uniform(-width, width)) for name, width in START_SPREAD.items()}


def settable(cases: Sequence[Case]) -> frozenset[str]:
    """Parameters that may be set for all worlds of an experiment: those that are set neither by a case nor by a
    repeat."""
    decided = set(START_SPREAD)
    for case in cases:
        decided |= {*published_values(case.gait, profile="as_published"), *case.values}
    return frozenset(name for name, _ in quantities(WorldParameters)) - decided


def measured(
    simulator: Simulator, batch: Worlds, run: Run, *, progress: Callable[[float], None] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Labels, metrics and status of each world, and what the measured columns mean."""
    return table_of(batch, simulator.run(batch.values, run, progress=progress))


def recorded(simulator: Simulator, batch: Worlds, run: Run, names: Sequence[str]) -> dict[str, Recording]:
    """The recording of each world, by the names given."""
    return recordings_of(simulator, batch, simulator.run(batch.values, run, record=True), dict(enumerate(names)))


def table_of(batch: Worlds, result: RunResult) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """See `measured`."""
    columns = {**batch.labels, **result.metrics, "status": result.status}
    about = {name: Column(metric.unit, metric.doc) for name, metric in METRICS.items()}
    return columns, about | {"status": Column("1", "ok, or how the run ended")}


def recordings_of(
    simulator: Simulator, batch: Worlds, result: RunResult, names: Mapping[int, str]
) -> dict[str, Recording]:
    """The recordings of the worlds whose name is given."""
    recordings = {}
    for world, name in names.items():
        metadata = {
            "case": name,
            "setup": {"scene": simulator.setup.scene, "spine": simulator.setup.spine},
            "labels": {key: column[world].item() for key, column in batch.labels.items()},
            "parameters": {key: float(column[world]) for key, column in batch.values.items()},
            "metrics": {key: float(column[world]) for key, column in result.metrics.items()}
            | {"status": str(result.status[world])},
            "engine": result.engine,
        }
        recordings[name] = recording_of(result.trace, simulator.robot.model, world=world, metadata=metadata)
    return recordings
