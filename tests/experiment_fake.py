"""A published experiment that simulates nothing: what it is asked for decides what it gives."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from nermo_mjx.experiments.catalogue import Experiment
from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.robot import load_robot
from nermo_mjx.view import Recording

ABOUT = {
    "profile": Column("1", "exact or as_published"),
    "gait": Column("1", "the gait"),
    "frequency": Column("Hz", "gait cycles per second"),
    "repeat": Column("1", "index of the repeat"),
    "speed": Column("m/s", "mean speed"),
    "theory_speed": Column("m/s", "speed without slip"),
    "followed": Column("1", "whether the path was followed"),
    "status": Column("1", "ok, or what became of the run"),
}
#: Speeds [m/s] of the trot at 0.5 and 0.8 Hz, in each profile.
SPEEDS = {"exact": (0.05, 0.08), "as_published": (0.045, 0.07)}


@dataclasses.dataclass
class Fake:
    """Counts its runs, and fails if it is told to."""

    name: str
    error: BaseException | None = None
    asked: list[dict[str, Any]] = dataclasses.field(default_factory=list)

    def run(self, **asked: Any) -> Outcome:
        """See `straight_line.run`."""
        self.asked.append(asked)
        asked["progress"](0.5)
        if self.error is not None:
            raise self.error
        rows = [
            (profile, "trt", frequency, repeat, speed + 1e-3 * repeat, 0.12 * frequency, repeat == 0, "ok")
            for profile in asked["profiles"]
            for frequency, speed in zip((0.5, 0.8), SPEEDS[profile], strict=True)
            for repeat in range(asked["repeats"])
        ]
        columns = {name: np.array(column) for name, column in zip(ABOUT, zip(*rows, strict=True), strict=True)}
        columns["theory_speed"][0] = np.nan
        asked["progress"](1.0)
        return Outcome(self.name, columns, ABOUT, {"trt, 0.8 Hz, with spine": recording()})

    def experiment(self) -> Experiment:
        """As the catalogue has one: a figure that holds, one that does not, a trend, and one that is not measured."""
        figures = (
            Figure(
                "speed at 0.8 Hz", 80.0, lambda o, p: 1e3 * o.mean("speed", profile=p, frequency=0.8), "mm/s", "6.2"
            ),
            Figure("ratio of speeds", 1.0, lambda o, p: 1.6, source="6.2", demanded=(0.9, 1.1)),
            Figure("faster | at 0.8 Hz", True, lambda o, p: True),
            Figure("word", "pass", lambda o, p: "fail"),
            Figure("interval", (0.25, 0.30), lambda o, p: float("nan")),
        )
        return Experiment(
            self.name, self.run, figures, SETTABLE, f"The {self.name}", "What is done.", quick="little",
            metrics=("speed", "theory_speed", "followed"),
        )  # fmt: skip


#: What may be set for a pretended experiment.
SETTABLE = frozenset({"contact.friction", "servo.kp"})


def recording() -> Recording:
    """A robot that stands still for half a second."""
    model = load_robot().model
    time = np.arange(0.01, 0.5, 0.01)
    return Recording(
        time, np.tile(model.qpos0, (len(time), 1)), np.zeros((len(time), model.nv)), np.zeros((len(time), model.nu)),
        metadata={"setup": {"scene": "flat"}, "labels": {"frequency": 0.8}},
    )  # fmt: skip
