"""Simulation of experiments: a worker's task is one of them with its own body, or with a batch of identified ones."""

from __future__ import annotations

import collections
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from nermo_mjx.experiments import ensemble
from nermo_mjx.experiments.catalogue import Experiment
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.settings import Settings, body_count
from nermo_mjx.robot import load_robot
from nermo_mjx.runs.code import CodeStamp, stamp
from nermo_mjx.runs.provenance import session
from nermo_mjx.runs.workers import Workers


@dataclasses.dataclass(frozen=True)
class Part:
    """A task: all worlds of an experiment, or those of some identified bodies.

    Attributes:
        name: of the experiment.
        run: simulates it; settings: its settings, except for the engine.
        begin, bodies: the first of these bodies, and their total number; both 0 for the experiment's own.
        drawn: fingerprint of all of them.
    """

    name: str
    run: Callable[[Settings], Outcome]
    settings: Settings
    begin: int = 0
    bodies: int = 0
    drawn: str = ""

    @property
    def label(self) -> str:
        """Description of the task."""
        return f"{self.name}, {self.bodies} bodies" if self.bodies else self.name

    def share(self, done: float) -> float:
        """Share of all bodies that is finished, given the share of these."""
        return (self.begin + done * body_count(self.settings.bodies)) / self.bodies if self.bodies else done


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Results of an experiment, or of all its bodies: the session that started it, and its total duration [s]."""

    part: Part
    outcome: Outcome
    session: dict[str, Any]
    seconds: float


def own(chosen: Experiment, settings: Settings) -> Part:
    """An experiment with its own body."""
    return Part(chosen.name, chosen.run, settings)


def of_bodies(chosen: Experiment, bodies: Mapping[str, np.ndarray], settings: Settings) -> list[Part]:
    """An experiment of every body, once each in the profile `exact`, in batches; bodies are named values (n,)."""
    once = settings.but(profiles=(ensemble.PROFILE,), repeats=1)
    count, size, drawn = body_count(bodies), ensemble.AT_ONCE, ensemble.fingerprint(bodies)
    batches = {k: {name: of[k : k + size] for name, of in bodies.items()} for k in range(0, count, size)}
    return [Part(chosen.name, chosen.run, once.but(bodies=some), k, count, drawn) for k, some in batches.items()]


def simulate(
    parts: Sequence[Part], engine: str, workers: Workers, progress: Callable[[str, float], None]
) -> Iterator[Simulated]:
    """Simulate parts as workers become free; a result in several parts is yielded when the last of them has arrived.

    Raises:
        TaskFailed: a part failed; its key is the part's index.
        WorkersLost: no worker is left.
    """
    if not parts:
        return
    workers.begin(Simulation(engine))
    sessions: dict[str, dict[str, Any]] = {}
    came: dict[str, dict[int, tuple[Outcome, float]]] = collections.defaultdict(dict)
    bodies: collections.Counter[str] = collections.Counter()

    def tasks() -> Iterator[tuple[int, Part]]:
        for key, part in enumerate(parts):
            sessions.setdefault(part.label, session())
            yield key, part

    def tell(key: int, share: float) -> None:
        progress(parts[key].label, parts[key].share(share))

    for key, found in workers.results(tasks(), tell):
        part = parts[key]
        several = came[part.label]
        several[part.begin] = found
        bodies[part.label] += body_count(part.settings.bodies)
        # Remote workers do not report progress.
        progress(part.label, bodies[part.label] / part.bodies if part.bodies else 1.0)
        if len(several) == sum(each.label == part.label for each in parts):
            outcomes = {begin: outcome for begin, (outcome, _) in several.items()}
            outcome = ensemble.numbered(outcomes) if part.bodies else found[0]
            yield Simulated(part, outcome, sessions[part.label], sum(seconds for _, seconds in several.values()))


@dataclasses.dataclass(frozen=True)
class Simulation:
    """Simulates one part after the other; a `nermo_mjx.runs.workers.Computer`."""

    engine: str

    def warm(self) -> None:
        """Each experiment makes its own simulator."""

    def stamp(self) -> CodeStamp:
        """Stamp of the code, the model and the engine that simulate here."""
        return stamp(load_robot().fingerprint, self.engine)

    def __call__(self, part: Part, progress: Callable[[float], None] | None = None) -> tuple[Outcome, float]:
        """The result of a part, and its duration [s]."""
        begun = time.monotonic()
        outcome = part.run(part.settings.but(engine=self.engine, progress=progress or _untold))
        return outcome, time.monotonic() - begun


def _untold(share: float) -> None:
    """Progress is not reported."""
