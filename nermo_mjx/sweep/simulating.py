"""The computer of a sweep's chunks: a simulator that is warm after its first one, here or on another machine."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np

from nermo_mjx.rollout import Run, Saving, Series, Setup, Simulator
from nermo_mjx.rollout.setup import without_presettings
from nermo_mjx.runs.code import CodeStamp, stamp
from nermo_mjx.specs.walk import WalkSpec

#: Number of simulators kept warm: fast-varying structures recur for each slow-varying one.
MOST_KEPT: Final = 4


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
            simulator: replaces `Simulator(setup, engine)`.
            notify: called with a message if it compiles.
            save: which time series are kept.
        """
        self.save = save
        self.setup, self.run, self.engine, self.notify = setup, run, engine, notify
        self._simulator = simulator

    @property
    def used(self) -> SimulatorLike | None:
        """The simulator used here, if any."""
        return self._simulator

    def __getstate__(self) -> dict[str, Any]:
        """For another machine, without the message that it compiles."""
        return self.__dict__ | {"notify": None}

    def warm(self) -> None:
        """Make the simulator; raises `ParameterError` where its engine cannot run."""
        self._simulator = self._simulator or Simulator(self.setup, self.engine)

    @property
    def simulator(self) -> SimulatorLike:
        """The simulator, created on first use."""
        self.warm()
        assert self._simulator is not None
        return self._simulator

    def stamp(self) -> CodeStamp:
        """Stamp of the code, the model and the engine that simulate here."""
        return stamp(self.setup.load().fingerprint, self.engine)

    def __call__(self, values: Mapping[str, np.ndarray], progress: Callable[[float], None] | None = None) -> Simulated:
        """Simulate a batch: name -> (worlds,)."""
        simulator, began = self.simulator, time.perf_counter()
        saved: dict[str, Any] = {} if self.save is None else {"save": self.save}
        result = simulator.run(values, self.run, progress=progress, notify=self.notify, **saved)
        status = np.asarray(result.status)
        metrics = {name: np.asarray(column) for name, column in result.metrics.items()}
        seconds = time.perf_counter() - began
        return Simulated(
            metrics, status, result.steps * len(status), seconds, None if self.save is None else result.series
        )


class SweepSimulator:
    """Simulates batches of a sweep's structures, each by a simulator of its own; a `nermo_mjx.runs.workers.Computer`.

    Structures that differ in gait, steering or profile share one. Batches come structure by structure, so that few
    simulators are kept.
    """

    def __init__(
        self,
        walks: Sequence[WalkSpec],
        engine: str,
        simulator: SimulatorLike | None = None,
        notify: Callable[[str], None] | None = None,
        save: Saving | None = None,
    ) -> None:
        """
        Args:
            walks: of the structures.
            engine, simulator, notify, save: see `BatchSimulator`.
        """
        self.walks, self.engine, self.save = tuple(walks), engine, save
        self._given, self._notify = simulator, notify
        self._current: tuple[int, BatchSimulator] | None = None
        self._kept: dict[Setup, Simulator] = {}

    @property
    def used(self) -> SimulatorLike | None:
        """The last simulator used here, if any."""
        return None if self._current is None else self._current[1].used

    def __getstate__(self) -> dict[str, Any]:
        """For another machine; see `BatchSimulator`."""
        return self.__dict__ | {"_notify": None, "_current": None, "_kept": {}}

    def warm(self) -> None:
        """Make the first structure's simulator; raises `ParameterError` where its engine cannot run."""
        self._of(0 if self._current is None else self._current[0]).warm()

    def stamp(self, structure: int = 0) -> CodeStamp:
        """Stamp of the code, a structure's model and the engine that simulate here."""
        walk = self.walks[structure]
        return BatchSimulator(walk.setup, walk.run, self.engine).stamp()

    def __call__(
        self, task: tuple[int, Mapping[str, np.ndarray]], progress: Callable[[float], None] | None = None
    ) -> Simulated:
        """Simulate a batch of a structure: its place, and name -> (worlds,)."""
        structure, values = task
        return self._of(structure)(values, progress)

    def _of(self, structure: int) -> BatchSimulator:
        if self._current is None or self._current[0] != structure:
            self._current = None
            walk = self.walks[structure]
            made = BatchSimulator(
                walk.setup, walk.run, self.engine, self._given or self._simulator(walk.setup), self._notify, self.save
            )
            self._current = structure, made
        return self._current[1]

    def _simulator(self, setup: Setup) -> Simulator:
        """A simulator of a setup, with the programs of one that was made before where these are the same."""
        programs = without_presettings(setup)
        kept = self._kept.pop(programs, None)
        while len(self._kept) >= MOST_KEPT:  # its memory goes before the next one takes some
            del self._kept[next(iter(self._kept))]
        simulator = Simulator(setup, self.engine) if kept is None else kept.with_setup(setup)
        self._kept[programs] = simulator
        return simulator
