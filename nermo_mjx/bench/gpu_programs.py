"""The programs that a GPU runs, each with the shapes of its arguments for a batch of any size."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.bench.gradient import FREQUENCY, NAMES, differentiable_walk
from nermo_mjx.physics.mjx_engine import MjxEngine
from nermo_mjx.rollout.derivative import value_and_gradient
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Simulator

#: Length of the walk that is differentiated, in gait cycles.
CYCLES: Final = 1.0


class Program(NamedTuple):
    """A function for `jax.jit`, and the shapes that it is compiled for.

    Attributes:
        function: of a batch, pure.
        arguments: pytrees of `jax.ShapeDtypeStruct`.
        donated: positions of the donated arguments.
        ticks: number of control ticks; None if the caller sets it at run time.
        steps_per_tick: physics steps in each.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    donated: tuple[int, ...]
    ticks: int | None
    steps_per_tick: int

    def jitted(self, device: Any = None) -> Any:
        """`jax.jit` of the function, for a specific device if one is given."""
        where = {} if device is None else {"in_shardings": device, "out_shardings": device}
        return jax.jit(self.function, donate_argnums=self.donated, **where)


def walk(worlds: int) -> Program:
    """The program that advances a batch of the engine `mjx`: controller, metrics and physics."""
    simulator = Simulator(Setup(spine="stride_extension"), "mjx", devices=1)
    engine = simulator.engine
    assert isinstance(engine, MjxEngine)
    batch = simulator.prepare({"frequency": np.full(1, FREQUENCY)})
    real, model = engine.data.qpos.dtype, engine.model
    state = [jax.ShapeDtypeStruct((1, size), real) for size in (model.nq, model.nv, model.nsensordata)]
    carry = jax.eval_shape(engine.open_worlds, batch.params, *state)
    shapes = jax.tree.map(lambda leaf: _among(leaf, worlds), (batch.params, batch.fields, carry))
    ticks = jax.ShapeDtypeStruct((), jnp.int32)
    return Program(
        inspect.unwrap(engine.advance, stop=inspect.ismethod),
        (*shapes, ticks),
        (2,),
        None,
        simulator.loop.steps_per_tick,
    )


def _gradient(mode: str, worlds: int) -> Program:
    """Mean speed and its gradient by the stride extension's parameters, over `CYCLES` of a walk."""
    rollout, speed = differentiable_walk(CYCLES)
    steps = rollout.engine.loop.steps_per_tick
    ticks = round(rollout.seconds({"frequency": FREQUENCY}) / rollout.controller.dt) + 1
    points = jax.ShapeDtypeStruct((worlds, len(NAMES)), jnp.zeros(()).dtype)
    return Program(jax.vmap(value_and_gradient(speed, mode)), (points,), (), ticks, steps)


def _among(leaf: Any, worlds: int) -> jax.ShapeDtypeStruct:
    """The shape of a batch of one world, changed to several worlds."""
    return jax.ShapeDtypeStruct((worlds, *leaf.shape[1:]), jax.dtypes.canonicalize_dtype(leaf.dtype))


#: Name -> the function that builds the program for a number of worlds.
PROGRAMS: Final[Mapping[str, Callable[[int], Program]]] = {
    "walk": walk,
    "forward": lambda worlds: _gradient("forward", worlds),
    "reverse": lambda worlds: _gradient("reverse", worlds),
}
