"""What computes a sweep's chunks: a simulator that is warm after its first, here or on another machine."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from nermo_mjx.rollout import Run, Saving, Series, Setup, Simulator
from nermo_mjx.runs.code import CodeStamp, stamp


class SimulatorLike(Protocol):
    """What a sweep, and what shows a tuning, need of a simulator; see `nermo_mjx.rollout.Simulator`."""

    #: The engine, or its name.
    engine: Any

    def run(
        self,
        values: Mapping[str, np.ndarray],
        run: Run,
        record: bool = False,
        *,
        progress: Callable[[float], None] | None = None,
        notify: Callable[[str], None] | None = None,
        save: Saving | None = None,
    ) -> Any: ...


@dataclasses.dataclass(frozen=True)
class Simulated:
    """A batch's results.

    Attributes:
        metrics: name -> (worlds,).
        status: (worlds,) of `ok`, `fell`, `diverged`.
        steps: physics steps of all worlds.
        seconds: the time they took [s].
        series: time series of all worlds, if the sweep saves any.
    """

    metrics: dict[str, np.ndarray]
    status: np.ndarray
    steps: float
    seconds: float
    series: Series | None = None


class BatchSimulator:
    """Simulates batches of one sweep; a `nermo_mjx.runs.workers.Computer`."""

    def __init__(
        self,
        setup: Setup,
        run: Run,
        engine: str,
        simulator: SimulatorLike | None = None,
        notify: Callable[[str], None] | None = None,
        save: Saving | None = None,
    ) -> None:
        """
        Args:
            setup, run: of the sweep.
            engine: name of the engine, never "auto".
            simulator: stands in for `Simulator(setup, engine)`.
            notify: called with a sentence when it compiles.
            save: which time series are kept.
        """
        self.save = save
        self.setup, self.run, self.engine, self.notify = setup, run, engine, notify
        self._simulator = simulator

    @property
    def used(self) -> SimulatorLike | None:
        """What has simulated here, if anything has."""
        return self._simulator

    def __getstate__(self) -> dict[str, Any]:
        """For another machine, where nobody is told that it compiles."""
        return self.__dict__ | {"notify": None}

    def warm(self) -> None:
        """Make the simulator; raises `ParameterError` where its engine cannot run."""
        self._simulator = self._simulator or Simulator(self.setup, self.engine)

    def stamp(self) -> CodeStamp:
        """Of the code, the model and the engine that simulate here."""
        return stamp(self.setup.load().fingerprint, self.engine)

    def __call__(self, values: Mapping[str, np.ndarray], progress: Callable[[float], None] | None = None) -> Simulated:
        """Simulate a batch: name -> (worlds,)."""
        self.warm()
        assert self._simulator is not None
        began = time.perf_counter()
        saved: dict[str, Any] = {} if self.save is None else {"save": self.save}
        result = self._simulator.run(values, self.run, progress=progress, notify=self.notify, **saved)
        status = np.asarray(result.status)
        metrics = {name: np.asarray(column) for name, column in result.metrics.items()}
        seconds = round(time.perf_counter() - began, 3)
        return Simulated(
            metrics, status, result.steps * len(status), seconds, None if self.save is None else result.series
        )
