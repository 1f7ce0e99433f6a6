"""A published experiment that simulates nothing: its results depend only on its settings."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from nermo_mjx.experiments import plots
from nermo_mjx.experiments.cases import BODY, CaseRuns, Column, Settings, columns_about
from nermo_mjx.experiments.published import Experiment, Figure
from nermo_mjx.experiments.run import EXPERIMENTS
from nermo_mjx.robot import load_robot
from nermo_mjx.view import Recording

ABOUT = {
    "profile": Column("1", "exact, as_published or as_built"),
    "gait": Column("1", "the gait"),
    "frequency": Column("Hz", "gait cycles per second"),
    "repeat": Column("1", "index of the repeat"),
    "speed": Column("m/s", "mean speed"),
    "theory_speed": Column("m/s", "speed without slip"),
    "followed": Column("1", "whether the path was followed"),
    "status": Column("1", "ok, or what became of the run"),
}
#: The simulated profiles, in the order of the figures.
BOTH = ("as_published", "exact")
#: Name of its recording.
RUN = "trot, 0.8 Hz, with spine"
#: Speeds [m/s] of the trot at 0.5 and 0.8 Hz, in each profile.
SPEEDS = {"exact": (0.05, 0.08), "as_published": (0.045, 0.07), "as_built": (0.04, 0.06)}
#: What may be set for it.
SETTABLE = frozenset({"contact.friction", "servo.kp"})
#: A figure that holds, one that does not, a trend, a word, and one that is not measured.
FIGURES = (
    Figure(
        "speed at 0.8 Hz",
        "predicted",
        "number",
        lambda rows: 1e3 * rows.mean("speed", frequency=0.8),
        80.0,
        unit="mm/s",
        section="6.2",
        author=84.9,
        settings="tests",
    ),
    Figure(
        "ratio of speeds",
        "fitted",
        "effect",
        lambda rows: 1.6,
        1.2,
        section="6.2",
        sentence="faster by 20 %",
    ),
    Figure("faster | at 0.8 Hz", "chosen", "outcome", lambda rows: True, True),
    Figure(
        "word", "predicted", "outcome", lambda rows: "fail", "pass", reason="the feet are round."
    ),
    Figure("interval", "theory", "range", lambda rows: rows.mean("nothing"), [0.25, 0.30]),
)


@dataclasses.dataclass
class Fake:
    """Counts its runs, and fails on request. A body's speed is proportional to its friction."""

    name: str
    error: BaseException | None = None
    asked: list[Settings] = dataclasses.field(default_factory=list)

    def run(self, settings: Settings) -> CaseRuns:
        """See `Experiment`."""
        self.asked.append(settings)
        assert settings.progress is not None
        settings.progress(0.5)
        if self.error is not None:
            raise self.error
        bodies = settings.bodies
        rows = [
            (
                profile,
                body,
                "trot",
                frequency,
                repeat,
                factor * speed + 1e-3 * repeat,
                0.12 * frequency,
                repeat == 0,
                "ok",
            )
            for profile in settings.profiles
            for body, factor in enumerate(
                [1.0] if bodies is None else bodies["contact.friction"], start=1
            )
            for frequency, speed in zip((0.5, 0.8), SPEEDS[profile], strict=True)
            for repeat in range(settings.repeats)
        ]
        names = ["profile", BODY, *list(ABOUT)[1:]]
        columns = {
            name: np.array(column)
            for name, column in zip(names, zip(*rows, strict=True), strict=True)
        }
        if bodies is None:
            del columns[BODY]
        columns["theory_speed"][0] = np.nan
        settings.progress(1.0)
        columns_info = (
            ABOUT if bodies is None else ABOUT | {BODY: Column("1", "number of the body")}
        )
        return CaseRuns(
            self.name, columns, columns_info, {} if bodies is not None else {RUN: recording()}
        )

    @staticmethod
    def rows(settings: Settings) -> int:
        """See `Experiment`."""
        return len(settings.profiles) * max(settings.body_count, 1) * 2 * settings.repeats

    def experiment(self) -> Experiment:
        """As the catalogue has one."""
        metrics = ("speed", "theory_speed", "followed")
        options = {"quick": "little", "metrics": metrics, "own_figures": FIGURES}
        return Experiment(
            self.name, self.run, self.rows, SETTABLE, f"The {self.name}", "What is done.", **options
        )


def pretend(monkeypatch: pytest.MonkeyPatch) -> dict[str, Fake]:
    """Every experiment is one that simulates and draws nothing from now on."""
    fakes = {name: Fake(name) for name in EXPERIMENTS}
    for name, fake in fakes.items():
        monkeypatch.setitem(EXPERIMENTS, name, fake.experiment())
    monkeypatch.setattr(plots, "figures_of_experiment", lambda outcome, lines: [])
    return fakes


def made_up(
    experiment: str,
    cases: Iterable[Mapping[str, Any]],
    measured: Mapping[str, Any],
    profiles: Sequence[str] = BOTH,
    repeats: int = 2,
    recordings: Mapping[str, Recording] | None = None,
) -> CaseRuns:
    """An outcome: every case in each profile and repeat; `measured` are numbers or functions of the labels."""
    rows = [
        {"profile": profile, **case, "repeat": repeat}
        for profile, case, repeat in itertools.product(profiles, cases, range(repeats))
    ]
    for row in rows:
        row |= {name: value(row) if callable(value) else value for name, value in measured.items()}
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    columns_info = columns_about(experiment)
    return CaseRuns(
        experiment,
        columns,
        {name: columns_info.get(name, Column("1", "")) for name in columns},
        recordings or {},
    )


def recording() -> Recording:
    """A robot that stands still for half a second."""
    model = load_robot().model
    time = np.arange(0.01, 0.5, 0.01)
    qpos, nothing = np.tile(model.qpos0, (len(time), 1)), np.zeros((len(time), model.nv))
    metadata = {"setup": {"scene": "flat"}, "labels": {"frequency": 0.8}}
    return Recording(time, qpos, nothing, np.zeros((len(time), model.nu)), metadata=metadata)
