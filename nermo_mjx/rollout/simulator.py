"""A batch of worlds from named parameters to named metrics, on any engine."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import jax
import numpy as np

from nermo_mjx.control.protocol import ControllerLike
from nermo_mjx.physics import Trace, Variation, make_engine
from nermo_mjx.physics.lanes import Lanes
from nermo_mjx.progress import shown_share
from nermo_mjx.recording import Recording, recording_of
from nermo_mjx.robot import Sensors
from nermo_mjx.robot.geometry import names_geometry
from nermo_mjx.robot.model_parameters import is_shaped
from nermo_mjx.robot.quantity import ParameterError, of_type, values_of
from nermo_mjx.rollout import metrics as measures
from nermo_mjx.rollout.custom_metrics import OwnMetric
from nermo_mjx.rollout.electrical import Supply
from nermo_mjx.rollout.loop import LoopParameters, checked_loop, loop_parameters, terrain_of
from nermo_mjx.rollout.path_metrics import ticks_until
from nermo_mjx.rollout.run import LONGEST_RUN_SECONDS, Run, StartPose, too_many
from nermo_mjx.rollout.saving import Keeper, Saving, Series
from nermo_mjx.rollout.setup import Setup, Window, WorldParameters, with_own, without_presettings
from nermo_mjx.runs.code import versions
from nermo_mjx.runs.files import plain_json

# ---
# The results of a batch of worlds: metrics, how each ended, and the recording if requested.


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

    def until(self, ticks: int) -> History:
        """The first ticks."""
        arrays = {name: getattr(self, name)[:, :ticks] for name in ("qpos", "qvel", "ctrl")}
        sensors = {name: values[:, :ticks] for name, values in self.sensors.items()}
        return History(self.time[:ticks], **arrays, sensors=sensors)


@dataclasses.dataclass(frozen=True)
class RunResult:
    """The results of a batch of n worlds.

    Attributes:
        metrics: name -> (n,), as `all_metrics` describes them.
        status: (n,) of the names in `metrics.Ending`: `ok`, `fell`, `diverged`, `sank`, `floated`, `unsolved`.
        setup, length: of the run.
        worlds: all parameters, leaves with a leading world axis.
        named: the explicitly named ones.
        engine: that was used.
        steps: physics steps of one world.
        ticks: control ticks of each world (n,), whatever ran beside it: until it was done.
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
    ticks: np.ndarray
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
            raise ParameterError(
                "record is False: a recording needs Simulator.run(..., record=True)."
            )
        if not 0 <= world < len(self.status):
            raise ParameterError(f"world is {world}: allowed is 0 to {len(self.status) - 1}.")
        model, metadata = self.setup.load().model, plain_json(self.about(world))
        return recording_of(
            self.trace.until(int(self.ticks[world])), model, world=world, metadata=metadata
        )

    def about(self, world: int = 0) -> dict[str, Any]:
        """Description and results of one world: `metrics`, `parameters`, `setup`, `run`, `engine` and `versions`; and
        `units` of custom metrics, which are stored nowhere else."""
        measured = {name: float(column[world]) for name, column in self.metrics.items()}
        flags = {name: bool(measured[name]) for name in ("fell", "diverged")}
        run = {
            name: None if value is None else float(np.broadcast_to(value, len(self.status))[world])
            for name, value in dataclasses.asdict(self.length).items()
        }
        return {
            "metrics": {**measured, **flags, "status": str(self.status[world])},
            "parameters": {name: float(column[world]) for name, column in self.parameters.items()},
            "setup": self.setup.fields(),
            "run": run,
            "engine": self.engine,
            "versions": versions(),
            **(
                {
                    "units": {
                        custom_metric.name: custom_metric.unit
                        for custom_metric in self.setup.own_metrics
                    }
                }
                if self.setup.metrics
                else {}
            ),
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
        columns = (
            {name: parameters[name] for name in self.named} | self.metrics | {"status": self.status}
        )
        return pandas.DataFrame(columns)


#: Ticks between progress reports.
REPORT_TICKS = 25
#: What compiling takes on two free cores [s]; from the cache a program of `c` takes less than `PATIENCE` [s].
COMPILE_SECONDS: Final = {"c": 5, "mjx": 30, "warp": 30}
PATIENCE: Final = 3.0
#: What a recording takes for a tick of a world, and at most [bytes].
TICK_BYTES = 1_500
MOST_RECORDED = 4e9
#: Share of a world's steps in which the constraint solver may fail to converge before its status says so. Of 78,000
#: steps of tumbling robots 2 do not converge on an accelerator, and none on a CPU.
UNSOLVED = 1e-3


@dataclasses.dataclass(frozen=True)
class Batch:
    """A batch of n worlds ready for an engine.

    Attributes:
        params: the loop's, every leaf with a leading world axis, in JAX's default precision.
        qpos: start poses (n, nq).
        fields: model fields that differ between worlds, (n, ...) each.
        ticks: control ticks until each world is done (n,).
        may_end_early: whether worlds are finished when they have walked their distance.
        mass, gravity: of each robot (n,) [kg, m/s^2].
        supply: servos and battery, leaves (n,).
        worlds, named, length: see `RunResult`.
    """

    params: LoopParameters
    qpos: np.ndarray
    fields: dict[str, np.ndarray]
    ticks: np.ndarray
    may_end_early: bool
    mass: np.ndarray
    gravity: np.ndarray
    supply: Supply
    worlds: WorldParameters
    named: tuple[str, ...]
    length: Run


class Simulator:
    """Runs batches of one setup; compiled programs are shared by all its runs."""

    def __init__(
        self,
        setup: Setup | None = None,
        engine: str = "auto",
        devices: int | None = None,
        threads: int | None = None,
        *,
        controller: ControllerLike | str | None = None,
        metrics: Sequence[OwnMetric | str] | str = (),
    ) -> None:
        """
        Args:
            setup: static choices.
            engine: `auto`, `c`, `mjx` or `warp`.
            devices: local devices that share a batch in `mjx` and `warp`; None for `$NERMO_MJX_DEVICES`, or else all.
            threads: processors that share a batch in `c`; None for `$NERMO_MJX_THREADS`, or else all.
            controller: instead of the setup's, see `Setup.controller`.
            metrics: in addition to the setup's, see `Setup.metrics`.

        Raises:
            ParameterError: an unknown engine, one that cannot run here, too many devices, no thread, an object that is
                not a controller, or a metric that cannot be computed.
        """
        self.setup = with_own(setup, controller, metrics)
        self.loop = checked_loop(self.setup)
        self.robot, self.controller = self.loop.robot, self.loop.controller
        self.engine = make_engine(engine, self.robot, self.loop, devices, threads)
        self.variation = Variation(self.robot)
        self.start = StartPose(self.robot, self.controller)
        self._compiled: set[tuple[int, tuple[str, ...], bool]] = set()
        self._results = Lanes(functools.partial(measures.result, custom=self.loop.custom_metrics))

    def with_setup(self, setup: Setup) -> Simulator:
        """A simulator for a setup that differs only in `PRESETTINGS`, with the same programs: nothing is recompiled.

        Raises:
            ParameterError: it differs in other choices.
        """
        if without_presettings(setup) != without_presettings(self.setup):
            raise ParameterError(
                "setup differs in more than gait, steering and profile: it needs its own simulator."
            )
        simulator = copy.copy(self)
        simulator.setup = setup
        return simulator

    def parameters(self, values: Mapping[str, Any], policy: Any = None) -> WorldParameters:
        """Checked parameters of a batch: the setup's defaults, with the named values replaced.

        Args:
            values: name -> number or (n,) array, or texts with a unit such as "-45 deg". The gait factor follows a duty
                factor that is named without it.
            policy: see `run`.

        Raises:
            ParameterError: unknown name, value out of range or not of shape () or (n,), or a stride outside the legs'
                workspace.
        """
        values = self.setup.numbers(values)
        params = self.setup.world(
            {name: _numbers(name, value) for name, value in values.items()}, policy
        )
        self.setup.check(params)
        return params

    def prepare(
        self, values: Mapping[str, Any], run: Run | None = None, policy: Any = None
    ) -> Batch:
        """The batch that `run` passes to the engine; the arguments are the same."""
        values = {**self.setup.body, **self.setup.numbers(values)}
        # Of the same structure: parameters have a geometry if one is named.
        single = self.setup.world({name: 0.0 for name in values if names_geometry([name])})
        params, worlds = _batched(self.parameters(values, policy), single, values)
        if wrong := too_many(worlds):
            raise ParameterError(f"the batch is too large: {wrong}")
        run = of_type("run", Run() if run is None else run, Run, "a Run")
        rate = np.asarray(self.controller.cycle_rate(params.control), float)
        begin, end = (np.broadcast_to(bound, worlds) for bound in run.seconds(rate))
        if end.max() > LONGEST_RUN_SECONDS:
            raise ParameterError(
                f"run.cycles last {end.max():g} s at {np.min(rate):g} Hz: allowed are {LONGEST_RUN_SECONDS:g} s."
            )
        distance = np.broadcast_to(1e6 if run.distance is None else run.distance, worlds)
        window = Window(begin=begin, end=end, distance=distance)
        mass = np.asarray(params.model.mass.front + params.model.mass.rear, float)
        terrain = terrain_of(self.robot, params)
        body = params.model if is_shaped(values) else None
        loop = loop_parameters(self.robot, params, window, values)
        return Batch(
            params=default_precision(loop),
            qpos=self.start.batch(self.loop.control_at(loop, 0.0), params.start, terrain, body),
            fields=self.variation.batch(params.model, worlds, values),
            ticks=ticks_until(end, self.controller.dt),
            may_end_early=run.distance is not None,
            mass=mass,
            supply=Supply.of(params.model, self.robot),
            gravity=np.asarray(params.model.ground.gravity, float),
            worlds=params,
            named=tuple(values),
            length=run,
        )

    def __call__(
        self, values: Mapping[str, Any] | None = None, run: Run | None = None, *, policy: Any = None
    ) -> dict[str, np.ndarray]:
        """The metrics of a batch, as named in `all_metrics(setup)`: the `metrics` of `run` alone."""
        return self.run(values or {}, run, policy=policy).metrics

    def run(
        self,
        values: Mapping[str, Any],
        run: Run | None = None,
        record: bool = False,
        progress: Callable[[float], None] | bool | None = None,
        notify: Callable[[str], None] | None = None,
        policy: Any = None,
        save: Saving | None = None,
    ) -> RunResult:
        """Simulate one batch.

        >>> result = Simulator(engine="c").run({"frequency": [0.6, 0.8]}, Run(duration=0.2))
        >>> result.metrics["speed"].shape, result.status.tolist()
        ((2,), ['ok', 'ok'])

        Args:
            values: parameter name -> number or (n,) array, or texts with a unit such as "-45 deg"; unnamed ones have
                the setup's default.
            run: length and warm-up; eight gait cycles, two of them warm-up, by default.
            record: store every tick of every world (memory: about 1.5 kB per tick and world).
            progress: called with the finished share, in [0, 1]; by default it is shown where somebody looks, if it
                takes long. False silences it.
            notify: called with a sentence before this simulator compiles a program for the first time.
            policy: the controller's parameters instead of the setup's, a pytree like `controller.parameters`. A leaf
                with an additional leading axis has one entry per world. Named values override it.
            save: signals whose time series are stored, as the result's `series`.

        Raises:
            ParameterError: see `parameters`, and `Keeper`.
        """
        began = time.perf_counter()
        with _compile_time() as compile_time, shown_share("walk", progress) as tell:
            keeper = (
                None
                if save is None
                else Keeper(
                    of_type("save", save, Saving, "a Saving"), self.robot, self.controller.dt
                )
            )
            result = self.run_batch(self.prepare(values, run, policy), record, tell, notify, keeper)
        wall = time.perf_counter() - began
        return dataclasses.replace(result, wall_seconds=wall, compile_seconds=sum(compile_time))

    def run_batch(
        self,
        batch: Batch,
        record: bool = False,
        progress: Callable[[float], None] | None = None,
        notify: Callable[[str], None] | None = None,
        keeper: Keeper | None = None,
    ) -> RunResult:
        """Simulate what `prepare` has made, and maybe the caller changed; the other arguments are those of `run`."""
        traced, ends, ticks = record or keeper is not None, batch.ticks, int(batch.ticks.max())
        if record:
            _check_recorded(ticks, len(batch.qpos))
        program = (len(batch.qpos), tuple(batch.fields), traced)
        says = contextlib.nullcontext() if program in self._compiled else self._compiling(notify)
        self._compiled.add(program)
        with says:
            session = self.engine.open(batch.params, batch.qpos, batch.fields)
        # Whole blocks only: a recorded block of another length would need another program.
        ticks = -(-ticks // REPORT_TICKS) * REPORT_TICKS if traced else ticks
        traces: list[Trace] = []
        unsolved = np.zeros(len(ends), int)
        for begin in range(0, ticks, REPORT_TICKS):
            done = min(begin + REPORT_TICKS, ticks)
            if traced:
                trace = session.record(done - begin)
                traces += [trace] if record else []
                if keeper is not None:
                    keeper.add(trace)
            else:
                session.advance(done - begin)
            if batch.may_end_early:
                state = session.loop_state.metrics
                early = (
                    np.asarray(state.finished) | np.asarray(state.fell) | np.asarray(state.diverged)
                )
                ends = np.where(early, np.minimum(ends, done), ends)
            over = ends <= done
            if (last := over & (ends > begin)).any():
                unsolved[last] = session.unsolved[last]
            if not record:
                session.retire(over)
            if progress:
                progress(1.0 if over.all() else done / ticks)
            if over.all():
                break

        measured = self._results(
            session.loop_state.metrics, batch.mass, batch.gravity, batch.supply
        )
        table = {name: np.asarray(column, float) for name, column in measured.items()}
        return RunResult(
            metrics=table,
            status=measures.endings(table, unsolved > UNSOLVED * ends * self.loop.steps_per_tick),
            setup=self.setup,
            length=batch.length,
            worlds=batch.worlds,
            named=batch.named,
            engine=self.engine.name,
            steps=done * self.loop.steps_per_tick,
            ticks=ends,
            trace=self._history(traces, int(ends.max())) if record else None,
            series=None if keeper is None else keeper.series(self._ends(batch, table, ends)),
        )

    @contextlib.contextmanager
    def _compiling(self, notify: Callable[[str], None] | None) -> Iterator[None]:
        """Says that a program is being compiled: by `notify` at once, or else in the log if it takes long."""
        sentence = (
            f"compiling the {self.engine.name} program,"
            f" about {COMPILE_SECONDS[self.engine.name]} s, once per machine"
        )
        if notify is not None:
            notify(sentence)
            yield
            return
        timer = threading.Timer(PATIENCE, _say_once, [sentence])
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _ends(self, batch: Batch, table: Mapping[str, np.ndarray], ticks: np.ndarray) -> np.ndarray:
        """When each world's run ended (n,) [s]: at its distance or at its length, or before its state diverged."""
        begin = np.asarray(batch.params.window.begin, float)
        end = np.asarray(batch.params.window.end, float)
        end = np.minimum(end, ticks * self.controller.dt)
        whole = np.where(table["fell"] > 0, end, begin + table["duration"])
        return np.where(table["diverged"] > 0, table["failure_time"] - self.controller.dt, whole)

    def _history(self, traces: list[Trace], ticks: int) -> History:
        qpos, qvel, ctrl, sensordata = (
            np.concatenate([getattr(trace, name) for trace in traces], axis=1)[:, :ticks]
            for name in ("qpos", "qvel", "ctrl", "sensordata")
        )
        sensors: Sensors = self.robot.sensors(sensordata)
        named = {
            field.name: np.asarray(getattr(sensors, field.name))
            for field in dataclasses.fields(sensors)
        }
        time_axis = (1 + np.arange(qpos.shape[1])) * self.controller.dt
        return History(time_axis, qpos, qvel, ctrl, named)


@contextlib.contextmanager
def _compile_time() -> Iterator[list[float]]:
    """Seconds that JAX spends in this thread on tracing and compiling, in pieces."""
    pieces: list[float] = []
    thread = threading.get_ident()

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/") and threading.get_ident() == thread:
            pieces.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield pieces
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@functools.cache
def _say_once(sentence: str) -> None:
    logging.getLogger(__name__).warning(sentence)


def _numbers(name: str, value: Any) -> np.ndarray:
    """The value of a parameter as numbers, () or (n,)."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ParameterError(
            f"{name} is {value!r}: expected a number, or an array with one for each world."
        ) from None
    if numbers.ndim > 1:
        raise ParameterError(
            f"{name} has shape {numbers.shape}: allowed is a number, or (n,) with one for each world."
        )
    return numbers


def _batched(
    params: WorldParameters, single: WorldParameters, values: Mapping[str, Any]
) -> tuple[WorldParameters, int]:
    """All leaves with a leading world axis, and the number of worlds; `single` has the shapes of one world."""
    sizes = {np.shape(value)[0]: name for name, value in values.items() if np.ndim(value)}
    leaf_pairs = zip(jax.tree.leaves(params.control), jax.tree.leaves(single.control), strict=True)
    for leaf, single_leaf in leaf_pairs:
        extra = np.shape(leaf)[: np.ndim(leaf) - np.ndim(single_leaf)]
        if len(extra) > 1 or np.shape(leaf)[len(extra) :] != np.shape(single_leaf):
            raise ParameterError(
                f"policy has a leaf of shape {np.shape(leaf)}: expected {np.shape(single_leaf)}, or one entry more in front, a "
                "world each."
            )
        if extra:
            sizes.setdefault(extra[0], "policy")
    if len(sizes) > 1:
        (a, first), (b, second) = sorted(sizes.items())[:2]
        raise ParameterError(
            f"{second} has {b} values and {first} has {a}: all arrays must have one length."
        )
    worlds = next(iter(sizes), 1)
    if not worlds:
        raise ParameterError(f"{sizes[0]} has no values: a batch has at least one world.")

    def spread(leaf: Any, single_leaf: Any) -> np.ndarray:
        leaf = np.asarray(leaf)
        return np.broadcast_to(leaf, (worlds, *leaf.shape[leaf.ndim - np.ndim(single_leaf) :]))

    return jax.tree.map(spread, params, single), worlds


def default_precision(tree: Any) -> Any:
    """Floats in JAX's default precision; integers and flags are unchanged."""
    real = jax.dtypes.canonicalize_dtype(float)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, real if leaf.dtype.kind == "f" else None), tree
    )


def _check_recorded(ticks: int, worlds: int) -> None:
    """Raise a `ParameterError` if the recording of a batch takes too much memory."""
    needed = TICK_BYTES * ticks * worlds
    if needed > MOST_RECORDED:
        raise ParameterError(
            f"the recording of {ticks:,} ticks of {worlds:,} worlds takes {needed / 1e9:,.1f} GB: "
            f"allowed are {MOST_RECORDED / 1e9:g} GB; take a shorter run, or fewer at once."
        )
