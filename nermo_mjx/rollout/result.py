"""The results of a batch of worlds: metrics, how each ended, and the recording if requested."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from nermo_mjx.recording import Recording, recording_of
from nermo_mjx.robot.quantity import ParameterError, values_of
from nermo_mjx.rollout.length import Run
from nermo_mjx.rollout.parameters import WorldParameters
from nermo_mjx.rollout.saving import Series
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.runs.provenance import versions
from nermo_mjx.runs.text import plain


@dataclasses.dataclass(frozen=True)
class History:
    """Time histories of every world, one entry per control tick.

    Attributes:
        time: end of each tick (ticks,) [s].
        qpos, qvel: positions and velocities (n, ticks, nq), (n, ticks, nv).
        ctrl: servo targets (n, ticks, n_servos) [rad].
        sensors: readings by name, (n, ticks, ...).
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensors: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class RunResult:
    """The results of a batch of n worlds.

    Attributes:
        metrics: name -> (n,), as `all_metrics` describes them.
        status: (n,) of the names in `metrics.Ending`: `ok`, `fell`, `diverged`, `unsolved`.
        setup, length: of the run.
        worlds: all parameters, leaves with a leading world axis.
        named: the explicitly named ones.
        engine: that was used.
        steps: physics steps of one world.
        wall_seconds: time spent.
        compile_seconds: the part of it that JAX spent on tracing, and on compiling programs or reading them from its
            cache; 0 if all programs had run before.
        trace: the recording, if requested.
        series: time series of the signals that were saved, if any were.
    """

    metrics: dict[str, np.ndarray]
    status: np.ndarray
    setup: Setup
    length: Run
    worlds: WorldParameters
    named: tuple[str, ...]
    engine: str
    steps: int
    wall_seconds: float = 0.0
    compile_seconds: float = 0.0
    trace: History | None = None
    series: Series | None = None

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """Every parameter that has a name -> (n,), defaults included."""
        return {name: np.asarray(values) for name, values in values_of(self.worlds)}

    def recording(self, world: int = 0) -> Recording:
        """The recording of one world, with all data that `nermo-mjx replay`, `view` and `render` use.

        >>> from nermo_mjx import Run, Simulator
        >>> result = Simulator(engine="c").run({"frequency": 0.8}, Run(duration=0.2), record=True)
        >>> result.recording().metadata["parameters"]["frequency"]
        0.8

        Raises:
            ParameterError: nothing was recorded, or the world does not exist.
        """
        if self.trace is None:
            raise ParameterError("record is False: a recording needs Simulator.run(..., record=True).")
        if not 0 <= world < len(self.status):
            raise ParameterError(f"world is {world}: allowed is 0 to {len(self.status) - 1}.")
        return recording_of(self.trace, self.setup.load().model, world=world, metadata=plain(self.about(world)))

    def about(self, world: int = 0) -> dict[str, Any]:
        """Description and results of one world: `metrics`, `parameters`, `setup`, `run`, `engine` and `versions`; and
        `units` of custom metrics, which are stored nowhere else."""
        measured = {name: float(column[world]) for name, column in self.metrics.items()}
        flags = {name: bool(measured[name]) for name in ("fell", "diverged")}
        run = {name: None if value is None else float(np.broadcast_to(value, len(self.status))[world])
               for name, value in dataclasses.asdict(self.length).items()}  # fmt: skip
        return {
            "metrics": {**measured, **flags, "status": str(self.status[world])},
            "parameters": {name: float(column[world]) for name, column in self.parameters.items()},
            "setup": self.setup.fields(),
            "run": run,
            "engine": self.engine,
            "versions": versions(),
            **({"units": {each.name: each.unit for each in self.setup.own_metrics}} if self.setup.metrics else {}),
        }

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame`, one row per world: the parameters that were named, all metrics, and the status.

        >>> from nermo_mjx import Run, Simulator
        >>> result = Simulator(engine="c").run({"frequency": [0.6, 0.8]}, Run(duration=0.2))
        >>> result.to_pandas()[["frequency", "status"]].values.tolist()
        [[0.6, 'ok'], [0.8, 'ok']]

        Raises:
            ImportError: pandas is not installed.
        """
        import pandas

        parameters = self.parameters
        columns = {name: parameters[name] for name in self.named} | self.metrics | {"status": self.status}
        return pandas.DataFrame(columns)
