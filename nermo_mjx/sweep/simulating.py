"""The computer of a sweep's chunks: a simulator that is warm after its first one, here or on another machine."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import jax
import numpy as np

from nermo_mjx.physics import resolve_engine
from nermo_mjx.physics.engine import choose_devices
from nermo_mjx.rollout import Run, Saving, Series, Setup, Simulator
from nermo_mjx.rollout.setup import without_presettings
from nermo_mjx.runs.code import CodeStamp, stamp
from nermo_mjx.runtime import cpu_count
from nermo_mjx.specs.walk import WalkSpec

#: Number of simulators kept warm: fast-varying structures recur for each slow-varying one.
MAX_KEPT_SIMULATORS: Final = 4


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
            engine: name of the engine, never "auto".
            simulator: replaces the simulators of all structures.
            notify: called with a message if one compiles.
            save: which time series are kept.
        """
        self.walks, self.engine, self.save = tuple(walks), engine, save
        self._given, self._notify = simulator, notify
        self._current: tuple[int, SimulatorLike] | None = None
        self._kept: dict[Setup, Simulator] = {}

    @property
    def used(self) -> SimulatorLike | None:
        """The last simulator used here, if any."""
        return None if self._current is None else self._current[1]

    def __getstate__(self) -> dict[str, Any]:
        """For another machine, without what is warm, and without the message that it compiles."""
        return self.__dict__ | {"_notify": None, "_current": None, "_kept": {}}

    def warm(self) -> None:
        """Make the first structure's simulator; raises `ParameterError` where its engine cannot run."""
        self.simulator(0 if self._current is None else self._current[0])

    def stamp(self, structure: int = 0) -> CodeStamp:
        """Stamp of the code, a structure's model and the engine that simulate here."""
        return stamp(self.walks[structure].setup.load().fingerprint, self.engine)

    def __call__(
        self,
        task: tuple[int, Mapping[str, np.ndarray]],
        progress: Callable[[float], None] | None = None,
    ) -> Simulated:
        """Simulate a batch of a structure: its place, and name -> (worlds,)."""
        structure, values = task
        simulator, began = self.simulator(structure), time.perf_counter()
        saved: dict[str, Any] = {} if self.save is None else {"save": self.save}
        result = simulator.run(
            values, self.walks[structure].run, progress=progress, notify=self._notify, **saved
        )
        status = np.asarray(result.status)
        metrics = {name: np.asarray(column) for name, column in result.metrics.items()}
        steps, seconds = result.steps * len(status), time.perf_counter() - began
        return Simulated(metrics, status, steps, seconds, result.series if saved else None)

    def simulator(self, structure: int = 0) -> SimulatorLike:
        """A structure's simulator, created on first use."""
        if self._current is None or self._current[0] != structure:
            self._current, simulator = None, self._given
            if (
                simulator is None
            ):  # with the programs of one that was made before, where these are the same
                setup = self.walks[structure].setup
                programs = without_presettings(setup)
                stored = self._kept.pop(programs, None)
                while (
                    len(self._kept) >= MAX_KEPT_SIMULATORS
                ):  # its memory goes before the next one takes some
                    del self._kept[next(iter(self._kept))]
                simulator = (
                    Simulator(setup, self.engine) if stored is None else stored.with_setup(setup)
                )
                self._kept[programs] = simulator
            self._current = structure, simulator
        return self._current[1]


def engine_name(requested: str, simulator: SimulatorLike | None, former_engine: str | None) -> str:
    """Name of the engine that really runs: of the simulator that is given, or the one a directory was begun with."""
    if simulator is not None:
        return str(getattr(simulator.engine, "name", simulator.engine))
    return (
        requested
        if requested != "auto"
        else former_engine
        if former_engine not in (None, "auto")
        else resolve_engine(requested)
    )


# ---
# How fast this machine simulates a walk, from a short measurement: estimates for sweeps, searches and tunings.


#: Simulated time of the probe [s]; with 16 worlds it takes two cores a tenth of a second.
PROBE: Final = 0.5


def pace(simulator: SimulatorLike, setup: Setup, worlds: int) -> float:
    """Simulated seconds of all worlds together per second of wall time, once programs are compiled.

    Args:
        worlds: of a batch.
    """
    frequency = {
        name: np.full(worlds, setup.defaults()[name])
        for name in ("frequency",)
        if name in setup.timing
    }
    values = frequency or {
        name: np.full(worlds, value) for name, value in list(setup.defaults().items())[:1]
    }
    run = Run(duration=PROBE, warmup=0.0)
    simulator.run(values, run)
    began = time.perf_counter()
    simulator.run(values, run)
    return worlds * PROBE / (time.perf_counter() - began)


# ---
# The default number of rows per chunk: enough to fill the machine, but no great loss if it is killed.


#: Rows of a chunk for each core with MuJoCo C: with two cores, 64 walks of eight cycles take six seconds.
CORE_ROWS = 32
#: Number of chunks above which chunks grow, and by up to which factor: each is a file, and is checked on resuming.
MANY_CHUNKS, MOST_GROWTH = 10_000, 10
#: Share of a device's memory for a batch.
MEMORY_SHARE: Final = 0.5
#: What a world takes of it, by engine [bytes]. `mjx`: what XLA plans for a walk, arguments and results included, by
#: docs/benchmarks/gpu_plan.py; a test holds it to the latest run there. `warp` allocates memory
#: that the plan does not see: a guess, and a conservative one.
ENGINE_WORLD_BYTES: Final = {"mjx": 36_000, "warp": 1_000_000}
#: Worlds that saturate a device; more of them only take longer, and are lost together.
BUSY_WORLDS = 8192


def chunk_rows(
    engine: str,
    rows: int,
    *,
    memory: int | None = None,
    devices: int = 1,
    cores: int = 1,
    parts: int = 1,
) -> int:
    """Rows of a chunk.

    Args:
        engine: name of the engine that runs, `c` or one for devices.
        rows: of the whole sweep.
        memory: of one device [bytes]; None for the CPU, also as a device.
        devices: that share a batch; the result is a multiple of them.
        cores: of this machine.
        parts: processes that share the chunks; each should get one.
    """
    share = math.ceil(rows / parts)
    if engine == "c" or memory is None:
        usual = CORE_ROWS * cores
        return min(max(usual, min(math.ceil(rows / MANY_CHUNKS), usual * MOST_GROWTH)), share)
    worlds = min(int(memory * MEMORY_SHARE / ENGINE_WORLD_BYTES[engine]), BUSY_WORLDS)
    return max(min(worlds, math.ceil(share / devices)), 1) * devices


def chunk_rows_here(engine: str, rows: int, parts: int = 1) -> int:
    """`chunk_rows` for this machine's devices and cores."""
    cores = cpu_count()
    engine = resolve_engine(engine)
    memory, devices = None, 1
    if engine != "c":
        limits = [
            (device.memory_stats() or {}).get("bytes_limit") for device in jax.local_devices()
        ]
        # Of the smallest device; not reported by a CPU.
        memory = (
            None if None in limits else min(int(limit) for limit in limits if limit is not None)
        )
        devices = choose_devices().count
    return chunk_rows(engine, rows, memory=memory, devices=devices, cores=cores, parts=parts)
