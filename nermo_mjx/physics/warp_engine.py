"""MJX with MuJoCo Warp below it: the fastest batches on an NVIDIA GPU, in single precision and without derivatives.

Controller, metrics and scan are those of the engine `mjx`; a step of physics is one call of MuJoCo Warp for all worlds
of a device.
"""

from __future__ import annotations

import copy
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.extend import backend
from jax.extend.core import ClosedJaxpr
from jaxtyping import Bool

from nermo_mjx.dynamics import rows
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.physics.mjx_engine import MjxEngine
from nermo_mjx.robot import ParameterError
from nermo_mjx.shapes import Truth


def obstacle() -> str | None:
    """Why Warp cannot run in this process, as a clause with the remedy; None if it can."""
    if jax.default_backend() != "gpu" or "cuda" not in backend.backends():
        return (
            f"it needs an NVIDIA GPU, and JAX computes on {jax.default_backend()} here; take the engine mjx or c, or "
            "install nermo-mjx[cuda,warp] on a machine that has one."
        )
    if importlib.util.find_spec("warp") is None:
        return "the package warp-lang is not installed; add it with pip install 'nermo-mjx[warp]'."
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        return "it computes in single precision; switch jax_enable_x64 off, or take the engine mjx."
    return None


class WarpEngine(MjxEngine):
    """Batches through MuJoCo Warp; a new value or number of ticks never recompiles."""

    name = "warp"

    def put(self, model: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
        """See `MjxEngine.put`."""
        _silence()
        self._reference = copy.copy(model)
        # Warp does not support the flag, and never resets a world by itself.
        self._reference.opt.disableflags &= ~mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        self._capacity = rows.capacity(self._reference)
        self._among: dict[int, mjx.Data] = {}
        return mjx.put_model(self._reference, impl="warp"), self.data_among(1)

    def data_among(self, worlds: int) -> mjx.Data:
        """See `MjxEngine.data_among`; all worlds of a device share one list of contacts, whose length is fixed."""
        if worlds not in self._among:
            contacts, constraints = self._capacity
            with jax.ensure_compile_time_eval():  # also called during tracing
                data = mjx.make_data(self._reference, impl="warp", naconmax=worlds * contacts, njmax=constraints)
            self._among[worlds] = data
        return self._among[worlds]

    def physics_step(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """See `MjxEngine.physics_step`.

        Raises:
            ParameterError: when a derivative is taken.
        """
        return _step(model, data)

    def read_entries(self, program: ClosedJaxpr) -> Bool[np.ndarray, " nsensordata"]:
        """All of them: Warp's model is a program that computes every sensor."""
        return np.full(self.model.nsensordata, True)

    def is_unsolved(self, data: mjx.Data) -> Truth:
        """See `MjxEngine.is_unsolved`; Warp's solver does not report it."""
        return jnp.zeros((), bool)


@jax.custom_jvp
def _step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    return mjx.step(model, data)


@_step.defjvp
def _(primals: Any, tangents: Any) -> tuple[Any, Any]:
    raise ParameterError("engine is 'warp': it has no derivatives; take the engine mjx for gradients.")


def _silence() -> None:
    """Keep Warp's messages about its start and its kernels off standard output."""
    import warp

    warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)
