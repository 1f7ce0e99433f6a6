"""The protocol of the physics engines.

An engine advances a batch of worlds by control ticks. In each tick the *loop* (controller and metrics, pure functions
that do not depend on the engine) reads the sensors of the previous tick and sets the servos; then the physics runs
`steps_per_tick` steps. The loop is the same code in every engine: traced into the scan (`mjx`, `warp`), or jitted and
called between ticks (`c`).
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from typing import Any, Final, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float

from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.robot import ParameterError
from nermo_mjx.runtime import compiler_options, cpu_batch_limit, start_jax
from nermo_mjx.shapes import Array


@runtime_checkable
class Loop(Protocol):
    """Computation between two ticks of physics, in one world; pure, jittable functions of pytrees."""

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per control tick."""

    def init(self, params: Any, sensordata: Any) -> Any:
        """Initial state of the loop, from the parameters and the sensors (n_sensordata,) at rest."""

    def step(self, params: Any, state: Any, sensordata: Any) -> tuple[Any, Any]:
        """New state and `ctrl` (n_servos,) from the last tick's sensors, (steps_per_tick, n_sensordata); a force on the
        torso along x and y [N] may follow in `ctrl`."""


@runtime_checkable
class DrivenLoop(Loop, Protocol):
    """A loop that receives inputs before some of its ticks, and returns observations after them."""

    def input(self, params: Any) -> Any:
        """The input array (k,) among the parameters."""

    def observe(self, params: Any, state: Any, sensordata: Any) -> Any:
        """Observations after a tick, any pytree, from the state before its `step` and the tick's sensors."""


@dataclasses.dataclass(frozen=True)
class Trace:
    """The data of a recorded run, world first, one entry per tick.

    Attributes:
        qpos, qvel: State at the end of each tick, (n, ticks, nq) and (n, ticks, nv).
        ctrl: Servo targets during the tick, (n, ticks, n_servos).
        sensordata: Sensor readings of the last step of each tick, (n, ticks, n_sensordata).
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensordata: np.ndarray


@runtime_checkable
class Session(Protocol):
    """A batch of worlds being simulated."""

    @property
    def loop_state(self) -> Any:
        """State of the loop, leaves with a leading world axis."""

    @property
    def unsolved(self) -> np.ndarray:
        """Number of steps of each world (n,) in which the constraint solver did not converge, if the solver reports
        it."""

    def advance(self, ticks: int) -> None:
        """Run all worlds for `ticks` control ticks."""

    def record(self, ticks: int) -> Trace:
        """Like `advance`, and return the recorded data."""

    def retire(self, done: np.ndarray) -> None:
        """Declare the worlds in the mask (n,) finished, so that the engine can omit their physics from now on."""


@runtime_checkable
class Engine(Protocol):
    """Opens sessions for one robot and one loop, which share compiled programs."""

    name: str

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> Session:
        """Start a batch at rest.

        Args:
            params: Parameters of the loop, every leaf with a leading world axis (n, ...).
            qpos: Initial positions, (n, nq).
            fields: Fields of the model that differ between worlds, (n, ...) each (see `Variation`).
        """


# ---
# Sharding of a batch of worlds over the local devices.
#
# Each device runs its own worlds and never waits for another one: the program is sharded with `jax.shard_map`. With
# JAX's automatic partitioning all devices would synchronise in each iteration of the solver's loop.


#: Environment variable with the default number of devices.
DEVICES_VARIABLE: Final = "NERMO_MJX_DEVICES"
#: World axis of an argument or a result: the first axis, the second, or none.
FIRST_AXIS: Final = PartitionSpec("worlds")
SECOND_AXIS: Final = PartitionSpec(None, "worlds")
NO_AXIS: Final = PartitionSpec()


@dataclasses.dataclass(frozen=True)
class Devices:
    """Devices over which the worlds of a batch are sharded.

    Attributes:
        mesh: Mesh with one axis, `worlds`; None for a single device.
    """

    mesh: Mesh | None = None

    @property
    def count(self) -> int:
        """Number of devices."""
        return 1 if self.mesh is None else int(self.mesh.size)

    def padded(self, worlds: int) -> int:
        """`worlds`, rounded up to a multiple of the number of devices."""
        return -(-worlds // self.count) * self.count

    def put(self, tree: Any) -> Any:
        """Arrays (n, ...) sharded over the devices, (padded(n), ...); the last world is repeated as padding."""
        if self.mesh is None:
            return jax.device_put(tree)
        return jax.device_put(
            jax.tree.map(self._filled, tree), NamedSharding(self.mesh, FIRST_AXIS)
        )

    def take(self, tree: Any, worlds: int) -> Any:
        """Arrays from `put` or a sharded function without the padding, on the host."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda leaf: leaf[:worlds], jax.device_get(tree))

    def divide(
        self, function: Callable[..., Any], arguments: Any, results: Any
    ) -> Callable[..., Any]:
        """A function of batches that runs on each device with that device's worlds.

        Args:
            function: Jittable function of arrays.
            arguments, results: `FIRST_AXIS`, `SECOND_AXIS` or `NO_AXIS` for each argument, and for each part of the result.
        """
        if self.mesh is None:
            return function
        # Without JAX's check of varying values, which loops in other libraries fail.
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=arguments, out_specs=results, check_vma=False
        )

    def _filled(self, leaf: Any) -> np.ndarray:
        padding = self.padded(len(leaf)) - len(leaf)
        return np.pad(leaf, [(0, padding)] + [(0, 0)] * (np.ndim(leaf) - 1), mode="edge")


def choose_devices(requested: int | None = None) -> Devices:
    """The local devices that this process uses.

    Args:
        requested: Number of devices; None for `$NERMO_MJX_DEVICES`, or else all.

    Raises:
        ParameterError: There are fewer devices.
    """
    start_jax()
    local = jax.local_devices()
    name, value = "devices", str(requested)
    if requested is None:
        name, value = DEVICES_VARIABLE, os.environ.get(DEVICES_VARIABLE) or str(len(local))
    if not value.isdecimal() or not 1 <= (count := int(value)) <= len(local):
        raise ParameterError(
            f"{name} is {value}: allowed is 1 to {len(local)}, as many as JAX finds here."
        )
    # Where batches must stay small to keep programs from hanging, they run in parts on one device.
    if count == 1 or batch_limit() is not None:
        return Devices()
    return Devices(Mesh(np.array(local[:count]), ("worlds",)))


def batch_limit() -> int | None:
    """Maximum number of worlds in one program on this backend; see `runtime.cpu_batch_limit`."""
    return cpu_batch_limit() if jax.default_backend() == "cpu" else None


# ---
# A loop for a batch of worlds, with its parameters and its state packed into one row per world.
#
# Each input and output array of a compiled program costs a microsecond or two. The loop has a hundred, which is half
# the time of a call with few worlds.


#: Worlds that are observed at a time. The heights of the ground ahead of 32 worlds would exceed what XLA compiles to a
#: single function (`runtime.EXTRA_OPTIONS`); and a block of few worlds is not observed in all of its lanes.
_OBSERVED_WORLDS: Final = 8


class PackedLoop:
    """`Loop.init` and `Loop.step` over rows, jitted; `DrivenLoop.observe`, too, if the loop is one.

    Integers and flags are stored as floats, exact up to 2^24: the control ticks of 46 hours.
    """

    def __init__(self, loop: Loop, params: Any, sensordata: np.ndarray) -> None:
        """
        Args:
            loop: Loop of one world.
            params: Parameters of an example batch, leaves (n, ...).
            sensordata: Sensor readings of this batch (n, n_sensordata).
        """
        world_params = jax.eval_shape(
            lambda params: jax.tree.map(lambda leaf: leaf[0], params), params
        )
        # Jitted, so that functions used twice are traced once.
        start = jax.jit(full_precision(loop.init), inline=True)
        real = jax.dtypes.canonicalize_dtype(sensordata.dtype)
        state = jax.eval_shape(
            start, world_params, jax.ShapeDtypeStruct(sensordata.shape[1:], real)
        )
        unpack_params, unpack_state = _unpacking(world_params), _unpacking(state)

        def init(params: Float[Array, " p"], sensordata: Float[Array, " n"]) -> Float[Array, " s"]:
            return ravel_pytree(start(unpack_params(params), sensordata))[0]

        @functools.partial(jax.jit, inline=True)
        @full_precision
        @jax.vmap
        def step(
            params: Float[Array, " p"],
            state: Float[Array, " s"],
            sensordata: Float[Array, "steps n"],
        ) -> tuple[Float[Array, " s"], Float[Array, " n_servos"]]:
            after, ctrl = loop.step(unpack_params(params), unpack_state(state), sensordata)
            return ravel_pytree(after)[0], ctrl

        def step_once(
            once: Any, params: Array, state: Array, sensordata: Array
        ) -> tuple[Array, Array]:
            """One step, as a loop with one iteration that XLA compiles to a single function
            (`runtime.EXTRA_OPTIONS`)."""

            def body(round_: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
                # The barrier makes the arguments depend on the iteration, so that XLA does not move their computations out of
                # the loop.
                _, params_of_round, readings = jax.lax.optimization_barrier(
                    (round_, params, sensordata)
                )
                return step(params_of_round, carry[0], readings)

            n_servos = jax.eval_shape(step, params, state, sensordata)[1]
            blank = jnp.zeros(n_servos.shape, n_servos.dtype)
            return jax.lax.fori_loop(0, once, body, (state, blank))

        once = compiler_options(level=0)
        self.pack = jax.jit(jax.vmap(lambda params: ravel_pytree(params)[0]), compiler_options=once)
        self.unpack = jax.jit(jax.vmap(unpack_state), compiler_options=once)
        self.init = jax.jit(jax.vmap(init), compiler_options=once)
        # Level 1 compiles in half the time of level 3, to the same bits, and takes 4 % longer.
        self.step = jax.jit(step_once, compiler_options=compiler_options(level=1))
        if isinstance(loop, DrivenLoop):
            self._drive(loop, world_params, state, sensordata)
        #: First argument of `step`: not a constant, or XLA would remove the loop.
        self.once = jax.device_put(np.int32(1))

    def _drive(
        self, loop: DrivenLoop, world_params: Any, state: Any, sensordata: np.ndarray
    ) -> None:
        """Compile the additional functions of a driven loop."""
        unpack_params, unpack_state = _unpacking(world_params), _unpacking(state)
        one_world = jax.jit(full_precision(loop.observe), inline=True)
        real = jax.dtypes.canonicalize_dtype(sensordata.dtype)
        readings = jax.ShapeDtypeStruct((loop.steps_per_tick, *sensordata.shape[1:]), real)
        self._seen = jax.eval_shape(one_world, world_params, state, readings)
        width = sum(leaf.size for leaf in jax.tree.leaves(self._seen))

        @jax.vmap
        def some(
            params: Float[Array, " p"],
            state: Float[Array, " s"],
            sensordata: Float[Array, "steps n"],
        ) -> Float[Array, " o"]:
            return ravel_pytree(one_world(unpack_params(params), unpack_state(state), sensordata))[
                0
            ]

        def observe(rounds: Any, *arguments: Array) -> Float[Array, "n o"]:
            """The observations of the first `rounds` times `_OBSERVED_WORLDS` worlds."""

            def body(round_: Array, observations: Array) -> Array:
                first_row = round_ * _OBSERVED_WORLDS
                rows = [
                    jax.lax.dynamic_slice_in_dim(argument, first_row, _OBSERVED_WORLDS)
                    for argument in arguments
                ]
                return jax.lax.dynamic_update_slice_in_dim(observations, some(*rows), first_row, 0)

            return jax.lax.fori_loop(
                0, rounds, body, jnp.zeros((len(arguments[0]), width), arguments[0].dtype)
            )

        self._observe = jax.jit(observe, compiler_options=compiler_options())
        places = np.arange(sum(leaf.size for leaf in jax.tree.leaves(world_params)))
        #: Columns of the packed parameters that hold the inputs.
        self.input = np.asarray(loop.input(unpack_params(jnp.asarray(places, float)))).astype(int)

    def observe(self, worlds: int, params: Array, state: Array, sensordata: np.ndarray) -> Any:
        """Observations of the first worlds, leaves (worlds, ...)."""
        rows = np.asarray(
            self._observe(np.int32(-(-worlds // _OBSERVED_WORLDS)), params, state, sensordata)
        )[:worlds]
        leaves, structure = jax.tree.flatten(self._seen)
        parts = np.split(rows, np.cumsum([leaf.size for leaf in leaves])[:-1], axis=1)
        split = zip(parts, leaves, strict=True)
        return jax.tree.unflatten(
            structure, [part.reshape(-1, *leaf.shape).astype(leaf.dtype) for part, leaf in split]
        )


def _unpacking(tree: Any) -> Callable[[Array], Any]:
    """Function from a row to a tree of these shapes.

    It is built without computing a row, which would compile many small programs.
    """
    unpackers: list[Callable[[Array], Any]] = []
    jax.eval_shape(lambda tree: unpackers.append(ravel_pytree(tree)[1]), tree)
    return unpackers[0]
