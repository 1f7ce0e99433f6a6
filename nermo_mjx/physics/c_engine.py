"""MuJoCo's C engine on all cores, the jitted controller between ticks: CPU batches, and the reference of the others."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from nermo_mjx.physics.engine import Loop, Trace
from nermo_mjx.robot import Robot


@contextlib.contextmanager
def _warnings_logged() -> Iterator[None]:
    """Log what MuJoCo warns of, at level debug; by itself it prints, and leaves a file in the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(logging.getLogger(__name__).debug)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


class CEngine:
    """Batches through `mujoco.batch`: bit for bit the same at any number of threads."""

    name = "c"

    def __init__(self, robot: Robot, loop: Loop, threads: int = 0) -> None:
        """`threads` 0 means all cores."""
        self.robot, self.loop, self.threads = robot, loop, threads
        self.init = jax.jit(jax.vmap(loop.init))
        self.step = jax.jit(jax.vmap(loop.step), donate_argnums=1)

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> CSession:
        """See `Engine.open`."""
        return CSession(self, params, qpos, fields)


class CSession:
    """A batch of worlds in MuJoCo's C engine; see `Session`."""

    def __init__(self, engine: CEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> None:
        self.engine, self.params = engine, jax.device_put(params)
        self.steps = engine.loop.steps_per_tick
        self.batch = Batch(engine.robot.model, len(qpos), nthread=engine.threads)
        for name, values in fields.items():
            self.batch.expand(name)[...] = values
        if "body_mass" in fields:
            self.batch.set_const()
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self.qpos[...] = qpos
        at_rest = self.batch.bind("sensordata")
        self.batch.forward()
        self.loop_state = engine.init(self.params, at_rest)
        self.sensordata = np.repeat(at_rest[:, None], self.steps, axis=1)
        self._moving: np.ndarray | None = None

    def advance(self, ticks: int) -> None:
        """See `Session.advance`."""
        with _warnings_logged():
            for _ in range(ticks):
                self._tick()

    def record(self, ticks: int) -> Trace:
        """See `Session.record`."""
        rows: list[tuple[np.ndarray, ...]] = []
        with _warnings_logged():
            for _ in range(ticks):
                self._tick()
                rows.append((self.qpos.copy(), self.qvel.copy(), self.ctrl.copy(), self.sensordata[:, -1].copy()))
        return Trace(*(np.stack(column, axis=1) for column in zip(*rows, strict=True)))

    def retire(self, done: np.ndarray) -> None:
        """See `Session.retire`."""
        self._moving = np.flatnonzero(~done) if done.any() else None

    def _tick(self) -> None:
        self.loop_state, ctrl = self.engine.step(self.params, self.loop_state, self.sensordata)
        self.ctrl[...] = np.asarray(ctrl)
        moving, failed = self._moving, []
        if moving is not None and not len(moving):
            return
        out = self.sensordata if moving is None else self.sensordata[moving]
        try:
            self.batch.rollout(self.steps, record=("sensordata",), ids=moving, out={"sensordata": out})
        except SimulationError as error:
            # The worlds that failed kept their state; the loop sees them as diverged, the others are not touched.
            failed = error.ids
        if moving is not None:
            self.sensordata[moving] = out
        self.sensordata[failed] = np.nan
        # MuJoCo stops a world that raises a warning (a non-finite or huge acceleration) and repeats its last record.
        stopped = self.batch.warning.reshape(len(self.qpos), -1).any(axis=1)
        if stopped.any():
            self.sensordata[stopped] = np.nan
