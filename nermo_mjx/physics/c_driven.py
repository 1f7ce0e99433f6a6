"""Worlds of the C engine that are driven from outside, a few ticks at a time, and reset individually."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np

from nermo_mjx.physics.c_engine import LANES, CEngine, CSession, _Block
from nermo_mjx.physics.servo_play import SERVO_PLAY
from nermo_mjx.physics.variation import vary


class CDriven(CSession):
    """A batch whose loop is a `DrivenLoop`. Results depend neither on the batch nor on the number of cores."""

    def __init__(self, engine: CEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> None:
        super().__init__(engine, params, qpos, fields)
        for block in self._blocks:
            block.params = np.array(block.params)

    def observe(self) -> Any:
        """Observations of all worlds: leaves (n, ...)."""
        return _joined(self._each(_observed))

    def drive(self, inputs: np.ndarray, ticks: int) -> Any:
        """Run all worlds for some ticks with inputs (n, k); returns their observations afterwards, leaves (n, ...)."""
        given = {id(block): inputs[span] for span, block in zip(self._spans, self._blocks, strict=True)}

        def run(block: _Block) -> Any:
            block.params[: block.worlds, self.loop.input] = given[id(block)]
            block.advance(ticks)
            return _observed(block)

        return _joined(self._each(run))

    def restart(self, worlds: np.ndarray, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> Any:
        """Reset some worlds, at rest.

        Args:
            worlds: indices (k,), in increasing order.
            params, qpos, fields: as for `CSession`, of these worlds.

        Returns:
            Their observations, leaves (k, ...).
        """
        parts = []
        for span, block in zip(self._spans, self._blocks, strict=True):
            chosen = np.flatnonzero(np.isin(worlds, span))
            if len(chosen):
                parts.append((block, worlds[chosen] - span[0], chosen))
        seen = []
        for block, ids, chosen in parts:
            some = jax.tree.map(lambda leaf, chosen=chosen: np.asarray(leaf)[chosen], params)
            seen.append(_restarted(block, ids, some, qpos[chosen], {k: v[chosen] for k, v in fields.items()}))
        return _joined(seen)


def _observed(block: _Block) -> Any:
    _, params, state, sensordata = block.arguments
    return block.loop.observe(block.worlds, params, state, sensordata)


def _restarted(block: _Block, ids: np.ndarray, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> Any:
    batch, lanes = block.batch, np.pad(np.arange(len(ids)), (0, LANES - len(ids)), mode="edge")
    batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
    block.models = vary(batch, block.engine.model, fields, block.models, ids)
    block.qpos[ids] = qpos
    if block.servos is not None:
        block.servos.play[ids], block.servos.motor[ids] = fields[SERVO_PLAY], 0.0
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
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
