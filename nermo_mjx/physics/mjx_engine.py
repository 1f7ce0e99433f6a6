"""MJX: controller and physics in one jitted program, for GPU and TPU batches.

Only (qpos, qvel, act, warm start) travels through the scan, never the whole `mjx.Data`: memory stays flat for large
batches, and MJX's integer fields, which change type under x64, stay out of the carry.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from mujoco.batch import Batch

from nermo_mjx.physics import differentiable
from nermo_mjx.physics.engine import Loop, Trace
from nermo_mjx.physics.mjx_import import mjx
from nermo_mjx.physics.variation import DERIVED_FIELDS
from nermo_mjx.robot import Robot
from nermo_mjx.runtime import cpu_batch_limit

#: Most iterations of the solver's line search. C's ends by itself after a few, and needs more than this in one step of
#: thousands, where it would stop at a wrong solution. MJX's never reaches its tolerance in float32 and makes all of
#: MuJoCo's 50, which are half of a step's time; with 10 of them 77,000 solutions had the same residual after the Newton
#: step of `differentiable`.
LINE_SEARCH: Final = 10


class MjxState(NamedTuple):
    """What the physics carries from step to step in one world."""

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    qacc_warmstart: Float[Array, " nv"]


class Carry(NamedTuple):
    """What the scan carries in one world: physics, the loop's state, and the sensors of the last tick's steps."""

    physics: MjxState
    loop: Any
    sensordata: Float[Array, "steps n"]


class MjxEngine:
    """Batches through MJX-JAX; a new value, batch of parameters or number of ticks never recompiles."""

    name = "mjx"

    def __init__(self, robot: Robot, loop: Loop) -> None:
        self.robot, self.loop = robot, loop
        model = robot.model.__copy__()
        model.opt.ls_iterations = LINE_SEARCH
        self.model = mjx.put_model(model)
        self.data = mjx.make_data(self.model)
        self.open_worlds = jax.jit(jax.vmap(self.start))
        self.advance = jax.jit(self._advance, donate_argnums=2)
        self.record = jax.jit(self._record, static_argnums=3, donate_argnums=2)

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> MjxSession:
        """See `Engine.open`."""
        return MjxSession(self, params, qpos, fields)

    def physics_step(self, model: mjx.Model, state: MjxState, ctrl: Float[Array, " nu"]) -> tuple[MjxState, Array]:
        """One step of physics in one world: the new state, and the step's sensor readings."""
        data = differentiable.step(model, self.data.replace(ctrl=ctrl, **state._asdict()))
        return MjxState(data.qpos, data.qvel, data.act, data.qacc_warmstart), data.sensordata

    def start(self, params: Any, qpos: Array, qvel: Array, sensordata: Array) -> Carry:
        """Carry of one world before its first tick, from its state and its sensors there."""
        nothing = jnp.zeros((self.model.nv,), qpos.dtype)
        physics = MjxState(qpos, qvel, jnp.zeros((self.model.na,), qpos.dtype), nothing)
        steps = self.loop.steps_per_tick
        return Carry(physics, self.loop.init(params, sensordata), jnp.tile(sensordata, (steps, 1)))

    def tick(self, params: Any, fields: dict[str, Array], carry: Carry) -> tuple[Carry, Array]:
        """One control tick of one world: the new carry, and the servos' targets."""
        model = self.model.tree_replace(fields)
        loop, ctrl = self.loop.step(params, carry.loop, carry.sensordata)

        def step(state: MjxState, _: None) -> tuple[MjxState, Array]:
            return self.physics_step(model, state, ctrl)

        physics, sensordata = jax.lax.scan(step, carry.physics, None, length=self.loop.steps_per_tick)
        return Carry(physics, loop, sensordata), ctrl

    def _ticks(self, params: Any, fields: dict[str, Array], carry: Carry) -> tuple[Carry, Array]:
        return jax.vmap(self.tick)(params, fields, carry)

    def _advance(self, params: Any, fields: dict[str, Array], carry: Carry, ticks: Array) -> Carry:
        return jax.lax.fori_loop(0, ticks, lambda _, c: self._ticks(params, fields, c)[0], carry)

    def _record(self, params: Any, fields: dict[str, Array], carry: Carry, ticks: int) -> tuple[Carry, Any]:
        def tick(c: Carry, _: None) -> tuple[Carry, Any]:
            c, ctrl = self._ticks(params, fields, c)
            return c, (c.physics.qpos, c.physics.qvel, ctrl, c.sensordata[:, -1])

        return jax.lax.scan(tick, carry, None, length=ticks)


class MjxSession:
    """A batch of worlds in MJX; see `Session`."""

    def __init__(self, engine: MjxEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> None:
        self.engine = engine
        worlds = len(qpos)
        at_rest, fields = _constants(engine.robot, qpos, fields)
        real = engine.data.qpos.dtype
        self.params = jax.device_put(params)
        self.fields = {name: jnp.asarray(values, real) for name, values in fields.items()}
        qvel = np.zeros((worlds, engine.model.nv))
        self.carry = engine.open_worlds(self.params, *(jnp.asarray(each, real) for each in (qpos, qvel, at_rest)))
        self.slices = _slices(worlds, cpu_batch_limit())

    @property
    def loop_state(self) -> Any:
        """See `Session.loop_state`."""
        return self.carry.loop

    def advance(self, ticks: int) -> None:
        """See `Session.advance`."""
        parts = [self.engine.advance(*self._part(span), jnp.int32(ticks)) for span in self.slices]
        self.carry = _join(parts)

    def record(self, ticks: int) -> Trace:
        """See `Session.record`."""
        parts = [self.engine.record(*self._part(span), ticks) for span in self.slices]
        self.carry = _join([carry for carry, _ in parts])
        columns = zip(*(rows for _, rows in parts), strict=True)
        return Trace(*(np.concatenate([np.moveaxis(np.asarray(part), 0, 1) for part in column]) for column in columns))

    def retire(self, done: np.ndarray) -> None:
        """See `Session.retire`; all worlds are one program here, so there is nothing to save."""

    def _part(self, span: slice) -> tuple[Any, Any, Any]:
        if len(self.slices) == 1:
            return self.params, self.fields, self.carry
        return jax.tree.map(lambda leaf: leaf[span], (self.params, self.fields, self.carry))


def _slices(worlds: int, limit: int | None) -> list[slice]:
    size = worlds if limit is None else min(worlds, limit)
    return [slice(start, start + size) for start in range(0, worlds, size)]


def _join(parts: list[Any]) -> Any:
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _constants(
    robot: Robot, qpos: np.ndarray, fields: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Sensor readings at rest, and the fields with the constants MuJoCo derives from them, both from the C engine.

    MJX has no `mj_setConst`; and a `forward` before the scan would double what XLA compiles.
    """
    batch = Batch(robot.model, len(qpos))
    for name, values in fields.items():
        batch.expand(name)[...] = values
    derived = {}
    if "body_mass" in fields:
        batch.set_const()
        derived = {name: batch.expand(name).copy() for name in DERIVED_FIELDS}
    sensordata = batch.bind("sensordata")
    batch.bind("qpos")[...] = qpos
    batch.forward()
    return sensordata.copy(), fields | derived
