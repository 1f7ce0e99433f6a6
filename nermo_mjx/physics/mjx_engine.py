"""MJX: controller and physics in one jitted program, for GPU and TPU batches.

Only (qpos, qvel, act, warm start) travels through the scan, never the whole `mjx.Data`: memory stays flat for large
batches, and MJX's integer fields, which change type under x64, stay out of the carry.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib.util
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.extend import backend
from jax.extend.core import ClosedJaxpr, Var, jaxpr_as_fun
from jaxtyping import Bool, Float
from mujoco.batch import Batch

from nermo_mjx.dynamics import differentiable, rows
from nermo_mjx.dynamics.checkpointing import keeping_little
from nermo_mjx.dynamics.coverage import not_simulated
from nermo_mjx.dynamics.mjx_copy import make_data, put_model
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.dynamics.solver import MAX_ROUNDS
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.engine import (
    FIRST_AXIS,
    NO_AXIS,
    SECOND_AXIS,
    Loop,
    Trace,
    batch_limit,
    choose_devices,
)
from nermo_mjx.physics.servo_play import SERVO_PLAY, Play, played, servo_addresses, without_play
from nermo_mjx.physics.variation import DERIVED_FIELDS, moves_constants, vary
from nermo_mjx.robot import ParameterError, Robot
from nermo_mjx.runtime import compiler_options
from nermo_mjx.shapes import Array, Count, Dofs, Truth

# ---
# The loop's program determines which sensors are computed: an accelerometer alone needs a pass over the whole tree.


def read_entries(program: ClosedJaxpr, size: int) -> Bool[np.ndarray, " size"]:
    """The entries of its last argument that a program's results depend on.

    Args:
        program: Program whose last argument is (..., size); any use other than slicing reads all entries.
        size: Length of the last axis of this argument.
    """
    last, read = program.jaxpr.invars[-1], np.zeros(size, bool)
    needed = {var for var in program.jaxpr.outvars if isinstance(var, Var)}
    for step in reversed(program.jaxpr.eqns):
        if not (step.effects or needed.intersection(step.outvars)):
            continue
        needed.update(var for var in step.invars if isinstance(var, Var))
        if step.primitive.name == "slice" and step.invars[0] is last:
            read[step.params["start_indices"][-1] : step.params["limit_indices"][-1]] = True
        elif any(var is last for var in step.invars):
            read[:] = True
    read |= last in program.jaxpr.outvars
    return read


def with_sensors(model: mjx.Model, is_read: Bool[np.ndarray, " nsensordata"]) -> mjx.Model:
    """The model with only the sensors whose entries are read; the entries keep their positions."""
    if is_read.all():
        return model
    kept_sensors = np.array(
        [
            is_read[start : start + size].any()
            for start, size in zip(model.sensor_adr, model.sensor_dim, strict=True)
        ],
        bool,
    )
    fields = {
        field.name: np.asarray(getattr(model, field.name))[kept_sensors]
        for field in dataclasses.fields(model)
        if field.name.startswith("sensor_")
    }
    return model.replace(nsensor=int(kept_sensors.sum()), **fields)


class MjxState(NamedTuple):
    """The physics' carry of one world from step to step.

    `motor` holds the angles of the servos' motors from the middle of their play, if these have any.
    """

    qpos: Float[Array, " nq"]
    qvel: Dofs
    act: Float[Array, " na"]
    qacc_warmstart: Dofs
    motor: Float[Array, " n_servos"] | None = None

    def into(self, data: mjx.Data) -> mjx.Data:
        """Data with this state, without the motors, which are not part of MuJoCo's state."""
        return data.replace(
            qpos=self.qpos, qvel=self.qvel, act=self.act, qacc_warmstart=self.qacc_warmstart
        )


class Carry(NamedTuple):
    """The scan's carry of one world.

    Attributes:
        physics: state.
        loop: the loop's state.
        sensordata: readings of the last tick's steps.
        unsolved: number of steps in which the constraint solver did not converge.
    """

    physics: MjxState
    loop: Any
    sensordata: Float[Array, "steps n"]
    unsolved: Count


class MjxEngine:
    """Batches through MJX-JAX; a new value, batch of parameters or number of ticks never recompiles."""

    name = "mjx"

    def __init__(self, robot: Robot, loop: Loop, devices: int | None = None) -> None:
        """
        Args:
            robot, loop: Robot and loop to simulate.
            devices: Local devices that share a batch; None for `$NERMO_MJX_DEVICES`, or else all.

        Raises:
            ParameterError: There are fewer devices.
        """
        self.robot, self.loop = robot, loop
        self.devices = choose_devices(devices)
        self.model, self.data = self.put(robot.physical)
        self._servo_qpos, self._servo_dofs = servo_addresses(robot.physical)
        options = compiler_options()
        self.open_worlds = jax.jit(self._open_worlds, compiler_options=options)
        self.advance = jax.jit(self._advance, donate_argnums=2, compiler_options=options)
        self.record = jax.jit(
            self._record, donate_argnums=2, static_argnums=3, compiler_options=options
        )

    def put(self, model: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
        """The model for MJX, and data of a single world.

        Raises:
            ParameterError: MJX does not simulate an element of the scene.
        """
        missing = not_simulated(model)
        if missing:
            raise ParameterError(
                f"engine is 'mjx', which does not simulate all of the scene, as 'c' does: {missing[0]}"
            )
        ours = put_model(model)
        return ours, make_data(ours)

    def data_among(self, worlds: int) -> mjx.Data:
        """Data of one of the worlds that a device runs together."""
        return self.data

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> MjxSession:
        """See `Engine.open`."""
        return MjxSession(self, params, qpos, fields)

    def physics_step(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """One step of physics in one world."""
        with warnings.catch_warnings():
            # Ignore the warning about side sites, because `load_robot` warns for the robots that they affect.
            warnings.filterwarnings("ignore", "tendon .* has a side site")
            return differentiable.step(model, data)

    def is_unsolved(self, data: mjx.Data) -> Truth:
        """Whether the constraint solver did not converge in the step that produced the data."""
        unsolved: Truth = rows.inner(data).solver_niter > MAX_ROUNDS
        return unsolved

    @full_precision
    def start(self, params: Any, qpos: Array, qvel: Array, sensordata: Array) -> Carry:
        """Carry of one world before its first tick, from its state and its sensors there."""
        nothing = jnp.zeros((self.model.nv,), qpos.dtype)
        physics = MjxState(qpos, qvel, jnp.zeros((self.model.na,), qpos.dtype), nothing)
        steps = self.loop.steps_per_tick
        state, readings = self.loop.init(params, sensordata), jnp.tile(sensordata, (steps, 1))
        return Carry(physics, state, readings, jnp.zeros((), jnp.int32))

    def playing(self, carry: Carry, fields: Mapping[str, Array]) -> Carry:
        """The carry of one world or several before the first tick, with the servos' motors if the fields have play."""
        if SERVO_PLAY not in fields:
            return carry
        motor = jnp.zeros_like(carry.physics.qpos[..., self._servo_qpos])
        return carry._replace(physics=carry.physics._replace(motor=motor))

    def tick(
        self, params: Any, fields: dict[str, Array], carry: Carry, *, record: bool = False
    ) -> tuple[Carry, Array]:
        """One control tick of one world: the new carry, and the servos' targets.

        Args:
            params, fields: Parameters of the loop, and fields that differ from the model.
            carry: Carry before the tick.
            record: Whether to compute all sensors, including sensors that the loop does not read.
        """
        return self._tick(False, record, self.data, params, fields, carry)

    @full_precision
    def _tick(
        self,
        batched: bool,
        shown: bool,
        blank: mjx.Data,
        params: Any,
        fields: dict[str, Array],
        carry: Carry,
    ) -> tuple[Carry, Array]:
        """`tick` of one world, or of all worlds of a device.

        With `vmap` inside the loop over the steps, the physics is batched while it is traced, not in a second pass.

        Args:
            batched: Whether there is more than one world.
            shown: Whether to compute all sensors, including sensors that the loop does not read.
            blank: Data of one world.
            params, fields, carry: Arguments of `tick`.
        """

        def each(function: Callable[..., Any]) -> Callable[..., Any]:
            return jax.vmap(function) if batched else function

        def of_one(leaf: Array) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(leaf.shape[batched:], leaf.dtype)

        given = params, carry.loop, carry.sensordata
        program, result = jax.make_jaxpr(self.loop.step, return_shape=True)(
            *jax.tree.map(of_one, given)
        )
        read = np.full(carry.sensordata.shape[-1], True) if shown else self.read_entries(program)
        found = each(jaxpr_as_fun(program))(*jax.tree.leaves(given))
        loop, ctrl = jax.tree.unflatten(jax.tree.structure(result), found)

        def advanced(
            fields: dict[str, Array], ctrl: Array, state: MjxState
        ) -> tuple[MjxState, tuple[Array, Array]]:
            model = with_sensors(self.model, read).tree_replace(without_play(fields))
            servo, motor = ctrl[: self.model.nu], state.motor
            if motor is not None:
                servo, motor = self._played(Play.unpacked(fields[SERVO_PLAY]), servo, state)
            data = blank.replace(ctrl=servo)
            if ctrl.size > servo.size:
                torso = self.robot.physical.body("torso").id
                data = data.replace(
                    xfrc_applied=data.xfrc_applied.at[torso, :2].set(ctrl[servo.size :])
                )
            following = self.physics_step(model, state.into(data))
            readings = following.sensordata, self.is_unsolved(following)
            return MjxState(
                following.qpos, following.qvel, following.act, following.qacc_warmstart, motor
            ), readings

        def step(state: MjxState, _: None) -> tuple[MjxState, tuple[Array, Array]]:
            after: tuple[MjxState, tuple[Array, Array]] = each(keeping_little(advanced))(
                fields, ctrl, state
            )
            return after

        steps = self.loop.steps_per_tick
        physics, (sensordata, unsolved) = jax.lax.scan(step, carry.physics, None, length=steps)
        counted = carry.unsolved + jnp.sum(unsolved, axis=0, dtype=jnp.int32)
        return Carry(physics, loop, jnp.moveaxis(sensordata, 0, -2), counted), ctrl[
            ..., : self.model.nu
        ]

    def _played(self, play: Play, ctrl: Array, state: MjxState) -> tuple[Array, Array]:
        """Controls of a step, and angles of the motors after it, for servos with play."""
        angle, velocity = state.qpos[self._servo_qpos], state.qvel[self._servo_dofs]
        return played(play, state.motor, ctrl, angle, velocity, float(self.robot.config.timestep))

    def read_entries(self, program: ClosedJaxpr) -> Bool[np.ndarray, " nsensordata"]:
        """Entries of the sensors' readings that the loop reads."""
        return read_entries(program, self.model.nsensordata)

    def _ticks(
        self, params: Any, fields: dict[str, Array], record: bool = False
    ) -> Callable[[Carry], tuple[Carry, Array]]:
        """`tick` for all worlds of a device; computes all sensors if their readings are returned."""
        return lambda carry: self._tick(
            True, record, self.data_among(len(carry.physics.qpos)), params, fields, carry
        )

    def _open_worlds(self, params: Any, qpos: Array, qvel: Array, sensordata: Array) -> Carry:
        return self.devices.divide(jax.vmap(self.start), (FIRST_AXIS,) * 4, FIRST_AXIS)(
            params, qpos, qvel, sensordata
        )

    def _advance(self, params: Any, fields: dict[str, Array], carry: Carry, ticks: Array) -> Carry:
        def advance(params: Any, fields: dict[str, Array], carry: Carry, ticks: Array) -> Carry:
            tick = self._ticks(params, fields)
            return jax.lax.fori_loop(0, ticks, lambda _, c: tick(c)[0], carry)

        return self.devices.divide(
            advance, (FIRST_AXIS, FIRST_AXIS, FIRST_AXIS, NO_AXIS), FIRST_AXIS
        )(params, fields, carry, ticks)

    def _record(
        self, params: Any, fields: dict[str, Array], carry: Carry, ticks: int
    ) -> tuple[Carry, Any]:
        def record(params: Any, fields: dict[str, Array], carry: Carry) -> tuple[Carry, Any]:
            tick = self._ticks(params, fields, record=True)

            def recorded(c: Carry, _: None) -> tuple[Carry, Any]:
                c, ctrl = tick(c)
                return c, (c.physics.qpos, c.physics.qvel, ctrl, c.sensordata[:, -1])

            return jax.lax.scan(recorded, carry, None, length=ticks)

        return self.devices.divide(record, (FIRST_AXIS,) * 3, (FIRST_AXIS, SECOND_AXIS))(
            params, fields, carry
        )


class MjxSession:
    """A batch of worlds in MJX; see `Session`."""

    def __init__(
        self, engine: MjxEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]
    ) -> None:
        self.engine, self.worlds = engine, len(qpos)
        at_rest, fields = _constants(engine.robot.physical, qpos, fields)
        real, put_on_devices = engine.data.qpos.dtype, engine.devices.put
        self.params = put_on_devices(params)
        self.fields = put_on_devices(
            {name: np.asarray(values, real) for name, values in fields.items()}
        )
        qvel = np.zeros((self.worlds, engine.model.nv))
        carry = engine.open_worlds(
            self.params,
            *put_on_devices([np.asarray(array, real) for array in (qpos, qvel, at_rest)]),
        )
        self.carry = engine.playing(carry, self.fields)
        padded = engine.devices.padded(self.worlds)
        size = min(padded, batch_limit() or padded)
        self.slices = [slice(start, start + size) for start in range(0, padded, size)]

    @property
    def loop_state(self) -> Any:
        """See `Session.loop_state`."""
        return self.engine.devices.take(self.carry.loop, self.worlds)

    @property
    def unsolved(self) -> np.ndarray:
        """See `Session.unsolved`."""
        return np.asarray(self.carry.unsolved)[: self.worlds]

    def advance(self, ticks: int) -> None:
        """See `Session.advance`."""
        parts = [self.engine.advance(*self._part(span), jnp.int32(ticks)) for span in self.slices]
        self.carry = _join(parts)

    def record(self, ticks: int) -> Trace:
        """See `Session.record`."""
        parts = [self.engine.record(*self._part(span), ticks) for span in self.slices]
        self.carry = _join([carry for carry, _ in parts])
        columns = zip(*(rows for _, rows in parts), strict=True)
        joined = (
            np.concatenate([np.moveaxis(np.asarray(part), 0, 1) for part in column])
            for column in columns
        )
        return Trace(*(column[: self.worlds] for column in joined))

    def retire(self, done: np.ndarray) -> None:
        """See `Session.retire`; it has no effect, because all worlds run in one program."""

    def _part(self, span: slice) -> tuple[Any, Any, Any]:
        if len(self.slices) == 1:
            return self.params, self.fields, self.carry
        return jax.tree.map(lambda leaf: leaf[span], (self.params, self.fields, self.carry))


def _join(parts: list[Any]) -> Any:
    return (
        parts[0]
        if len(parts) == 1
        else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    )


def _constants(
    model: mujoco.MjModel, qpos: np.ndarray, fields: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Sensor readings at rest, and the fields with the constants that MuJoCo derives from them, both from the C engine.

    MJX has no `mj_setConst`; and a `forward` before the scan would double what XLA compiles.
    """
    batch = Batch(model, len(qpos))
    models = vary(batch, model, fields)
    derived = {}
    if moves_constants(fields) and models is None:
        derived = {name: batch.expand(name).copy() for name in DERIVED_FIELDS}
    elif moves_constants(fields) and models is not None:
        derived = {
            name: np.stack([getattr(model, name) for model in models]) for name in DERIVED_FIELDS
        }
    sensordata = batch.bind("sensordata")
    batch.bind("qpos")[...] = qpos
    batch.forward()
    return sensordata.copy(), fields | derived


# ---
# MJX on top of MuJoCo Warp: the fastest batches on an NVIDIA GPU, in single precision and without derivatives.
#
# Controller, metrics and scan are those of the engine `mjx`; a step of physics is one call of MuJoCo Warp for all
# worlds of a device.


def obstacle() -> str | None:
    """The reason why Warp cannot run in this process, as a clause with the remedy; None if it can."""
    if jax.default_backend() != "gpu" or "cuda" not in backend.backends():
        return (
            f"it needs an NVIDIA GPU, and JAX computes on {jax.default_backend()} here; take the engine mjx or c, or "
            "install nermo-mjx[cuda,warp] on a machine that has one."
        )
    if importlib.util.find_spec("warp") is None:
        return "the package warp-lang is not installed; install the package with its extra warp."
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        return "it computes in single precision; switch jax_enable_x64 off, or take the engine mjx."
    return None


class WarpEngine(MjxEngine):
    """Batches through MuJoCo Warp; a new value or number of ticks never recompiles."""

    name = "warp"

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> WarpSession:
        """See `Engine.open`."""
        return WarpSession(self, params, qpos, fields)

    def put(self, model: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
        """See `MjxEngine.put`."""
        self._reference = copy.copy(model)
        # Warp does not support the flag, and never resets a world by itself.
        self._reference.opt.disableflags &= ~mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        sized = rows.inner(make_data(self._reference))
        self._capacity = int(sized.ncon), int(sized.nefc)
        self._among: dict[int, mjx.Data] = {}
        return mjx.put_model(self._reference, impl="warp"), self.data_among(1)

    def data_among(self, worlds: int) -> mjx.Data:
        """See `MjxEngine.data_among`; all worlds of a device share one list of contacts, whose length is fixed."""
        if worlds not in self._among:
            contacts, constraints = self._capacity
            with jax.ensure_compile_time_eval():  # also called during tracing
                data = mjx.make_data(
                    self._reference, impl="warp", naconmax=worlds * contacts, njmax=constraints
                )
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


#: Number of worlds that MuJoCo C simulates in addition to Warp, maximum number of control ticks, and maximum distance of
#: the torso between both [m]. On `mjx`, in single precision as well, the distances of 8,192 walks of six cycles agree with
#: MuJoCo C within 0.2 mm.
COMPANION_WORLDS: Final = 8
CHECKED_TICKS: Final = 100
LARGEST_DEVIATION_METRES: Final = 0.005


class WarpSession(MjxSession):
    """A batch of worlds in Warp; MuJoCo C also simulates a few of them, for the first second.

    On an NVIDIA H100, Warp 1.18 returned wrong states of large batches without an error (docs/benchmarks/README.md).
    """

    def __init__(
        self, engine: WarpEngine, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]
    ) -> None:
        super().__init__(engine, params, qpos, fields)
        self._chosen = checked_worlds = np.unique(
            np.linspace(0, self.worlds - 1, COMPANION_WORLDS).round().astype(int)
        )
        some_params, some_fields = jax.tree.map(
            lambda leaf: np.asarray(leaf)[checked_worlds], (params, fields)
        )
        self._beside = CEngine(engine.robot, engine.loop).open(
            some_params, qpos[checked_worlds], some_fields
        )
        self._ticks = 0

    def advance(self, ticks: int) -> None:
        """See `Session.advance`.

        Raises:
            ParameterError: Warp failed, or its positions disagree with MuJoCo C.
        """
        super().advance(ticks)
        self._check(ticks)

    def record(self, ticks: int) -> Trace:
        """See `Session.record`, and `advance` for its error."""
        trace = super().record(ticks)
        self._check(ticks)
        return trace

    def _check(self, ticks: int) -> None:
        self._ticks += ticks
        if self._ticks > CHECKED_TICKS:
            return
        self._beside.advance(ticks)
        right = self._beside.qpos[:, :3]
        try:
            positions = np.asarray(self.carry.physics.qpos)[self._chosen, :3]
        except jax.errors.JaxRuntimeError as error:
            reason = str(error).split("\n")[0]
            raise ParameterError(
                f"engine is 'warp': it failed on this device ({reason}); take the engine mjx."
            ) from None
        distance = np.abs(positions - right).max(axis=1)
        # A world that fails in C is not compared; a NaN of Warp alone is a difference.
        wrong = np.isfinite(right).all(axis=1) & ~(distance <= LARGEST_DEVIATION_METRES)
        if wrong.any():
            raise ParameterError(
                f"engine is 'warp': after {self._ticks} control ticks {wrong.sum()} of {len(wrong)} walks are not "
                f"where MuJoCo C has them: one is {distance[wrong][0]:.3g} m away, allowed are "
                f"{LARGEST_DEVIATION_METRES:g} m; take the engine mjx."
            )


@jax.custom_jvp
def _step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    return mjx.step(model, data)


@_step.defjvp
def _(primals: Any, tangents: Any) -> tuple[Any, Any]:
    raise ParameterError(
        "engine is 'warp': it has no derivatives; take the engine mjx for gradients."
    )
