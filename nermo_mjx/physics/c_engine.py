"""MuJoCo's C engine on all cores, with the jitted controller between ticks: CPU batches, and the reference engine.

A batch is cut into blocks. Each core takes one block after the other through all ticks, so no core waits for another
one, or for the controller, between ticks. The controller is always compiled for `BLOCK_WORLDS` worlds, and in that shape a
world's results depend neither on its position nor on its neighbours: they are bit-identical for any batch, order and
number of cores.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import logging
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, TypeAlias, TypeVar

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from nermo_mjx.physics.engine import Loop, PackedLoop, Trace
from nermo_mjx.physics.servo_play import SERVO_PLAY, Play, ServosWithPlay
from nermo_mjx.physics.variation import vary
from nermo_mjx.robot import ParameterError, Robot
from nermo_mjx.runtime import processor_device, start_jax, thread_count
from nermo_mjx.shapes import Array

#: Number of worlds in every call of the compiled loop, padded if necessary: XLA's rounding depends on the batch's
#: shape.
BLOCK_WORLDS: Final = 32
#: Minimum number of worlds for which a separate block pays off, including its call of the loop.
MIN_BLOCK_WORLDS: Final = 8

#: A number of processors, None for those that `thread_count` finds, or a pool of as many threads.
Threads: TypeAlias = int | ThreadPoolExecutor | None

Result = TypeVar("Result")


@contextlib.contextmanager
def _warnings_logged() -> Iterator[None]:
    """Log MuJoCo's warnings at level debug; by default it prints them, and writes a file to the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(logging.getLogger(__name__).debug)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


class CEngine:
    """Batches through `mujoco.batch`: bit for bit the same at any number of threads."""

    name = "c"

    def __init__(self, robot: Robot, loop: Loop, threads: Threads = None) -> None:
        """
        Args:
            robot, loop: Robot and loop to simulate.
            threads: Processors that share a batch; None for `$NERMO_MJX_THREADS`, or else all. Several engines can share
                a pool, which runs one block per thread, of any batch.

        Raises:
            ParameterError: There is fewer than one thread.
        """
        start_jax()
        self.robot, self.loop = robot, loop
        self.model = copy.copy(robot.physical)
        # Few joints move each foot, so that sparse Jacobians save time. MJX does not use this option here: a sparse model
        # would change the path through its code.
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        self.shared = threads if isinstance(threads, ThreadPoolExecutor) else None
        try:
            self.threads = 1 if isinstance(threads, ThreadPoolExecutor) else thread_count(threads)
        except ValueError as error:
            raise ParameterError(str(error)) from None
        self._packed: dict[Any, PackedLoop] = {}

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> CSession:
        """See `Engine.open`."""
        return CSession(self, params, qpos, fields)

    def packed(self, params: Any, sensordata: np.ndarray) -> PackedLoop:
        """The loop for parameters of this structure; compiled once."""
        leaves, structure = jax.tree.flatten(params)
        kind = (
            structure,
            *((leaf.shape[1:], leaf.dtype) for leaf in (*leaves, sensordata)),
            jax.config.read("jax_enable_x64"),
        )
        if kind not in self._packed:
            self._packed[kind] = PackedLoop(self.loop, params, sensordata)
        return self._packed[kind]

    @functools.cached_property
    def pool(self) -> ThreadPoolExecutor:
        """The threads, one per core."""
        return self.shared or ThreadPoolExecutor(self.threads, thread_name_prefix="nermo_mjx")


class CSession:
    """A batch of worlds in MuJoCo's C engine; see `Session`."""

    def __init__(
        self, engine: CEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]
    ) -> None:
        self.engine = engine
        self._spans = _spans(len(qpos), engine.threads)
        threads = max(1, engine.threads // len(self._spans))
        self._x64 = bool(jax.config.read("jax_enable_x64"))
        self._device = processor_device()
        self._blocks = []
        with jax.default_device(self._device):
            for span in self._spans:
                lanes = np.pad(span, (0, BLOCK_WORLDS - len(span)), mode="edge")
                part = jax.tree.map(lambda leaf, lanes=lanes: np.asarray(leaf)[lanes], params)
                varied = {name: values[span] for name, values in fields.items()}
                self._blocks.append(_Block(engine, part, qpos[span], varied, threads))
            self.loop.step(
                *self.arguments
            )  # compile now, before several threads need it at the same time

    @property
    def loop_state(self) -> Any:
        """See `Session.loop_state`."""
        with jax.default_device(self._device):
            parts = [block.loop_state for block in self._blocks]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    @property
    def unsolved(self) -> np.ndarray:
        """See `Session.unsolved`; the C solver does not report it."""
        return np.zeros(sum(map(len, self._spans)), int)

    @property
    def loop(self) -> PackedLoop:
        """The loop that all blocks share."""
        return self._blocks[0].loop

    @property
    def arguments(self) -> tuple[jax.Array, Array, Array, np.ndarray]:
        """Arguments of the next call of `loop.step`, for `BLOCK_WORLDS` worlds of any batch."""
        return self._blocks[0].arguments

    @property
    def qpos(self) -> np.ndarray:
        """Positions of all worlds (n, nq)."""
        return np.concatenate([block.qpos for block in self._blocks])

    @property
    def qvel(self) -> np.ndarray:
        """Velocities of all worlds (n, nv)."""
        return np.concatenate([block.qvel for block in self._blocks])

    def advance(self, ticks: int) -> None:
        """See `Session.advance`."""
        self._each(lambda block: block.advance(ticks))

    def record(self, ticks: int) -> Trace:
        """See `Session.record`."""
        parts = self._each(lambda block: block.record(ticks))
        return Trace(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def retire(self, done: np.ndarray) -> None:
        """See `Session.retire`."""
        for span, block in zip(self._spans, self._blocks, strict=True):
            block.moving = np.flatnonzero(~done[span])

    def _each(self, work: Callable[[_Block], Result]) -> list[Result]:
        """The results of `work` for each block, with the blocks in parallel on all cores."""

        def run(block: _Block) -> Result:
            with (
                jax.enable_x64(self._x64),
                jax.default_device(self._device),
            ):  # settings of a thread
                return work(block)

        with _warnings_logged():
            if len(self._blocks) == 1 and self.engine.shared is None:
                return [run(self._blocks[0])]
            return list(self.engine.pool.map(run, self._blocks))


class CBodies:
    """The bodies of n worlds, under servo targets `ctrl` (n, n_servos) [rad].

    Attributes:
        qpos, qvel, sensordata: Views of the state and the sensors of all worlds (n, nq), (n, nv), (n, n_sensordata).
        moving: Indices of the worlds that are stepped.
    """

    def __init__(
        self, engine: CEngine, qpos: np.ndarray, fields: dict[str, np.ndarray], threads: int
    ) -> None:
        self.engine, self.worlds = engine, len(qpos)
        self.steps = engine.loop.steps_per_tick
        self.batch = Batch(engine.model, self.worlds, nthread=threads)
        self.models = vary(self.batch, engine.model, fields)
        self.servos = None
        if SERVO_PLAY in fields:
            play = Play.unpacked(np.array(fields[SERVO_PLAY]))
            self.servos = ServosWithPlay(engine.model, play, self.worlds)
        self.qpos, self.qvel, self.ctrl = (
            self.batch.bind(name) for name in ("qpos", "qvel", "ctrl")
        )
        self.qpos[...] = qpos
        self.sensordata = self.batch.bind("sensordata")
        self.batch.forward()
        self.moving = np.arange(self.worlds)

    def move(self, readings: np.ndarray) -> None:
        """Simulate one tick, and write the sensors to `readings` (n, steps, n_sensordata); NaN for a failed world."""
        ids = None if len(self.moving) == self.worlds else self.moving
        out = readings if ids is None else readings[ids]
        lost = (
            self._rollout(self.steps, ids, out)
            if self.servos is None
            else self._play(self.servos, ids, out)
        )
        if ids is not None:
            readings[ids] = out
        if len(lost):
            readings[lost] = np.nan
        # MuJoCo stops a world that raises a warning (a non-finite or huge acceleration) and repeats its last record.
        if self.batch.warning.any():
            readings[self.batch.warning.reshape(self.worlds, -1).any(axis=1)] = np.nan

    def _rollout(self, steps: int, ids: np.ndarray | None, out: np.ndarray) -> list[int]:
        """Run steps of physics, and return the failed worlds, which keep their state; other worlds are not affected."""
        try:
            self.batch.rollout(steps, record=("sensordata",), ids=ids, out={"sensordata": out})
        except SimulationError as error:
            return list(error.ids)
        return []

    def _play(self, servos: ServosWithPlay, ids: np.ndarray | None, out: np.ndarray) -> list[int]:
        """Run the steps of a tick one by one, with the controls of servos with play, and return the failed worlds."""
        target, diverged = self.ctrl.copy(), []
        for step in range(self.steps):
            self.ctrl[...] = servos.controls(target, self.qpos, self.qvel)
            first_output = np.empty_like(out[:, :1])
            diverged += self._rollout(1, ids, first_output)
            out[:, step : step + 1] = first_output
        self.ctrl[...] = target
        return diverged


class _Block(CBodies):
    """Some worlds of a batch: n in MuJoCo, and their loop in `BLOCK_WORLDS` lanes, of which the first n are used."""

    def __init__(
        self,
        engine: CEngine,
        params: Any,
        qpos: np.ndarray,
        fields: dict[str, np.ndarray],
        threads: int,
    ) -> None:
        super().__init__(engine, qpos, fields, threads)
        lanes = np.pad(self.sensordata, ((0, BLOCK_WORLDS - self.worlds), (0, 0)), mode="edge")
        self.loop = engine.packed(params, lanes)
        self.params = self.loop.pack(params)
        self._state = self.loop.init(self.params, lanes)
        self._sensordata = np.repeat(lanes[:, None], self.steps, axis=1)

    @property
    def loop_state(self) -> Any:
        """State of the loop, leaves (n, ...)."""
        return jax.tree.map(
            lambda leaf: np.asarray(leaf)[: self.worlds], self.loop.unpack(self._state)
        )

    @property
    def arguments(self) -> tuple[jax.Array, Array, Array, np.ndarray]:
        """Arguments of the next call of `loop.step`."""
        return self.loop.once, self.params, self._state, self._sensordata

    def advance(self, ticks: int) -> None:
        """See `Session.advance`."""
        for _ in range(ticks):
            self._tick()

    def record(self, ticks: int) -> tuple[np.ndarray, ...]:
        """The fields of a `Trace`."""
        rows: list[tuple[np.ndarray, ...]] = []
        for _ in range(ticks):
            self._tick()
            last = self._sensordata[: self.worlds, -1]
            rows.append((self.qpos.copy(), self.qvel.copy(), self.ctrl.copy(), last.copy()))
        return tuple(np.stack(column, axis=1) for column in zip(*rows, strict=True))

    def _tick(self) -> None:
        if not len(self.moving):
            return
        self._state, ctrl = self.loop.step(*self.arguments)
        self.ctrl[...], force = np.split(
            np.asarray(ctrl)[: self.worlds], self.ctrl.shape[1:], axis=1
        )
        if force.size:
            self.batch.bind("xfrc_applied")[:, self.engine.model.body("torso").id, :2] = force
        self.move(self._sensordata[: self.worlds])


def _spans(worlds: int, threads: int) -> list[np.ndarray]:
    """Worlds of each block: of equal size, and enough blocks to keep all threads busy to the end."""
    fewest = math.ceil(worlds / BLOCK_WORLDS)
    even = math.ceil(fewest / threads) * threads
    return np.array_split(np.arange(worlds), min(even, max(fewest, worlds // MIN_BLOCK_WORLDS)))


# ---
# Worlds of the C engine that receive inputs every few ticks, and can be reset individually.


class CDriven(CSession):
    """A batch whose loop is a `DrivenLoop`. Results depend neither on the batch nor on the number of cores."""

    def __init__(
        self, engine: CEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]
    ) -> None:
        super().__init__(engine, params, qpos, fields)
        for block in self._blocks:
            block.params = np.array(block.params)

    def observe(self) -> Any:
        """Observations of all worlds: leaves (n, ...)."""
        return _joined(self._each(_observed))

    def drive(self, inputs: np.ndarray, ticks: int) -> Any:
        """Run all worlds for some ticks with inputs (n, k); returns their observations afterwards, leaves (n, ...)."""
        drive_inputs = {
            id(block): inputs[span] for span, block in zip(self._spans, self._blocks, strict=True)
        }

        def run(block: _Block) -> Any:
            block.params[: block.worlds, self.loop.input] = drive_inputs[id(block)]
            block.advance(ticks)
            return _observed(block)

        return _joined(self._each(run))

    def restart(
        self, worlds: np.ndarray, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]
    ) -> Any:
        """Reset some worlds, at rest.

        Args:
            worlds: Indices (k,) of the worlds, in increasing order.
            params, qpos, fields: Arguments of `CSession` for these worlds.

        Returns:
            Observations of these worlds, leaves (k, ...).
        """
        parts = []
        for span, block in zip(self._spans, self._blocks, strict=True):
            world_indices = np.flatnonzero(np.isin(worlds, span))
            if len(world_indices):
                parts.append((block, worlds[world_indices] - span[0], world_indices))
        observations = []
        with jax.default_device(self._device):
            for block, ids, world_indices in parts:
                selected_params = jax.tree.map(
                    lambda leaf, world_indices=world_indices: np.asarray(leaf)[world_indices],
                    params,
                )
                observations.append(
                    _restarted(
                        block,
                        ids,
                        selected_params,
                        qpos[world_indices],
                        {k: v[world_indices] for k, v in fields.items()},
                    )
                )
        return _joined(observations)


def _observed(block: _Block) -> Any:
    _, params, state, sensordata = block.arguments
    return block.loop.observe(block.worlds, params, state, sensordata)


def _restarted(
    block: _Block, ids: np.ndarray, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]
) -> Any:
    batch, lanes = (
        block.batch,
        np.pad(np.arange(len(ids)), (0, BLOCK_WORLDS - len(ids)), mode="edge"),
    )
    batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
    block.models = vary(batch, block.engine.model, fields, block.models, ids)
    block.qpos[ids] = qpos
    if block.servos is not None:
        for leaf, values in zip(block.servos.play, Play.unpacked(fields[SERVO_PLAY]), strict=True):
            leaf[ids] = values
        block.servos.motor[ids] = 0.0
    batch.forward(ids)
    at_rest = np.array(batch.bind("sensordata"))[ids]
    packed = np.asarray(block.loop.pack(jax.tree.map(lambda leaf: leaf[lanes], params)))
    state = np.array(block._state)
    state[ids] = np.asarray(block.loop.init(packed, at_rest[lanes]))[: len(ids)]
    block._state = state
    block.params[ids] = packed[: len(ids)]
    block._sensordata[ids] = at_rest[:, None]
    return jax.tree.map(lambda leaf: leaf[ids], _observed(block))


def _joined(parts: list[Any]) -> Any:
    return (
        parts[0]
        if len(parts) == 1
        else jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    )
