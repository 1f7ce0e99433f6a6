"""A loop for a batch of worlds, with its parameters and its state packed into one row per world.

Each input and output array of a compiled program costs a microsecond or two. The loop has a hundred, which is half the
time of a call with few worlds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.physics.engine import DrivenLoop, Loop
from nermo_mjx.runtime import compiler_options
from nermo_mjx.shapes import Array

#: Worlds that are observed at a time. The heights of the ground ahead of 32 worlds would exceed what XLA compiles to a
#: single function (`runtime.EXTRA_OPTIONS`); and a block of few worlds is not observed in all of its lanes.
_OBSERVED: Final = 8


class PackedLoop:
    """`Loop.init` and `Loop.step` over rows, jitted; `DrivenLoop.observe`, too, if the loop is one.

    Integers and flags are stored as floats, exact up to 2^24: the control ticks of 46 hours.
    """

    def __init__(self, loop: Loop, params: Any, sensordata: np.ndarray) -> None:
        """
        Args:
            loop: of one world.
            params: of an example batch, leaves (n, ...).
            sensordata: readings of that batch (n, n_sensordata).
        """
        one = jax.eval_shape(lambda params: jax.tree.map(lambda leaf: leaf[0], params), params)
        # Jitted, so that functions used twice are traced once.
        start = jax.jit(full_precision(loop.init), inline=True)
        real = jax.dtypes.canonicalize_dtype(sensordata.dtype)
        state = jax.eval_shape(start, one, jax.ShapeDtypeStruct(sensordata.shape[1:], real))
        unpack_params, unpack_state = _unpacking(one), _unpacking(state)

        def init(params: Float[Array, " p"], sensordata: Float[Array, " n"]) -> Float[Array, " s"]:
            return ravel_pytree(start(unpack_params(params), sensordata))[0]

        @functools.partial(jax.jit, inline=True)
        @full_precision
        @jax.vmap
        def step(
            params: Float[Array, " p"], state: Float[Array, " s"], sensordata: Float[Array, "steps n"]
        ) -> tuple[Float[Array, " s"], Float[Array, " n_servos"]]:
            after, ctrl = loop.step(unpack_params(params), unpack_state(state), sensordata)
            return ravel_pytree(after)[0], ctrl

        def step_once(once: Any, params: Array, state: Array, sensordata: Array) -> tuple[Array, Array]:
            """One step, as a loop with one iteration that XLA compiles to a single function
            (`runtime.EXTRA_OPTIONS`)."""

            def body(round_: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
                # Made to depend on the iteration, or else computations on them alone would be hoisted out of the loop.
                _, given, readings = jax.lax.optimization_barrier((round_, params, sensordata))
                return step(given, carry[0], readings)

            n_servos = jax.eval_shape(step, params, state, sensordata)[1]
            blank = jnp.zeros(n_servos.shape, n_servos.dtype)
            return jax.lax.fori_loop(0, once, body, (state, blank))

        self.pack = jax.jit(jax.vmap(lambda params: ravel_pytree(params)[0]))
        self.unpack = jax.jit(jax.vmap(unpack_state))
        options = compiler_options()
        self.init = jax.jit(jax.vmap(init), compiler_options=options)
        self.step = jax.jit(step_once, compiler_options=options)
        if isinstance(loop, DrivenLoop):
            self._drive(loop, one, state, sensordata)
        #: First argument of `step`: not a constant, or XLA would remove the loop.
        self.once = jax.device_put(np.int32(1))

    def _drive(self, loop: DrivenLoop, one: Any, state: Any, sensordata: np.ndarray) -> None:
        """The additional interface of a driven loop."""
        unpack_params, unpack_state = _unpacking(one), _unpacking(state)
        one_world = jax.jit(full_precision(loop.observe), inline=True)
        real = jax.dtypes.canonicalize_dtype(sensordata.dtype)
        readings = jax.ShapeDtypeStruct((loop.steps_per_tick, *sensordata.shape[1:]), real)
        self._seen = jax.eval_shape(one_world, one, state, readings)
        width = sum(leaf.size for leaf in jax.tree.leaves(self._seen))

        @jax.vmap
        def some(
            params: Float[Array, " p"], state: Float[Array, " s"], sensordata: Float[Array, "steps n"]
        ) -> Float[Array, " o"]:
            return ravel_pytree(one_world(unpack_params(params), unpack_state(state), sensordata))[0]

        def observe(rounds: Any, *given: Array) -> Float[Array, "n o"]:
            """The observations of the first `rounds` times `_OBSERVED` worlds."""

            def body(round_: Array, seen: Array) -> Array:
                at = round_ * _OBSERVED
                rows = [jax.lax.dynamic_slice_in_dim(each, at, _OBSERVED) for each in given]
                return jax.lax.dynamic_update_slice_in_dim(seen, some(*rows), at, 0)

            return jax.lax.fori_loop(0, rounds, body, jnp.zeros((len(given[0]), width), given[0].dtype))

        self._observe = jax.jit(observe, compiler_options=compiler_options())
        places = np.arange(sum(leaf.size for leaf in jax.tree.leaves(one)))
        #: Columns of the packed parameters that hold the inputs.
        self.input = np.asarray(loop.input(unpack_params(jnp.asarray(places, float)))).astype(int)

    def observe(self, worlds: int, params: Array, state: Array, sensordata: np.ndarray) -> Any:
        """Observations of the first worlds, leaves (worlds, ...)."""
        rows = np.asarray(self._observe(np.int32(-(-worlds // _OBSERVED)), params, state, sensordata))[:worlds]
        leaves, structure = jax.tree.flatten(self._seen)
        parts = np.split(rows, np.cumsum([leaf.size for leaf in leaves])[:-1], axis=1)
        split = zip(parts, leaves, strict=True)
        return jax.tree.unflatten(structure, [part.reshape(-1, *leaf.shape).astype(leaf.dtype) for part, leaf in split])


def _unpacking(tree: Any) -> Callable[[Array], Any]:
    """Function from a row to a tree of these shapes; built without computing one, which would compile many small
    programs."""
    found: list[Callable[[Array], Any]] = []
    jax.eval_shape(lambda tree: found.append(ravel_pytree(tree)[1]), tree)
    return found[0]
