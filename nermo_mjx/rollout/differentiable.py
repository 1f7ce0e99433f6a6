"""A differentiable walk: named values in, named metrics out, in one pure JAX function."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from nermo_mjx.control.build import check
from nermo_mjx.control.parameters import with_gait_factor
from nermo_mjx.physics.checkpointing import checkpointed_scan
from nermo_mjx.physics.mjx_engine import Carry, MjxEngine
from nermo_mjx.physics.precision import full_precision
from nermo_mjx.physics.variation import Variation
from nermo_mjx.robot.quantity import ParameterError, replace_quantities
from nermo_mjx.rollout import metrics
from nermo_mjx.rollout.loop import ClosedLoop, LoopParameters
from nermo_mjx.rollout.parameters import Window, WorldParameters
from nermo_mjx.rollout.setup import Run, Setup, check_world
from nermo_mjx.rollout.start import StartPose


class Path(NamedTuple):
    """What a walk leaves, one row a control tick.

    Attributes:
        qpos, qvel: state at the end of each tick, (ticks, nq) and (ticks, nv).
        ctrl: servo targets during the tick, (ticks, n_servos) [rad].
    """

    qpos: Float[Array, "ticks nq"]
    qvel: Float[Array, "ticks nv"]
    ctrl: Float[Array, "ticks n_servos"]


class Rollout:
    """One walk as a pure function, for `jax.jit`, `jax.vmap`, `jax.grad`, `jax.jvp` and all that is made of them.

        rollout = Rollout(Setup(spine="stride_extension"), Run(cycles=4, warmup_cycles=1))
        speed = lambda amplitude: rollout({"spine.amplitude": amplitude})["speed"]
        slope = jax.jit(jax.grad(speed), compiler_options=nermo_mjx.compiler_options())(0.2)

    Derivatives are exact: of controller, metrics, start pose and body in JAX, of the physics by
    `physics.differentiable`. In reverse mode memory grows with the square root of the run's length. The precision is
    JAX's own when the rollout is made (`jax.enable_x64`). What it runs is what the engine `mjx` runs. The compiler's
    options halve the time that it takes on a CPU, and can be left out.
    """

    def __init__(self, setup: Setup | None = None, run: Run | None = None, *, slowest: float | None = None) -> None:
        """
        Args:
            setup: what is chosen by name.
            run: length and warm-up, the same for all worlds; without `distance`, which has no derivative.
            slowest: lowest frequency that a traced value may have [Hz], if the run is given in gait cycles and its
                frequency is traced: the number of ticks is fixed when a program is made.

        Raises:
            ParameterError: a run that ends by distance, or with one length for each world.
        """
        self.setup, self.length = setup or Setup(), run or Run()
        if self.length.distance is not None:
            raise ParameterError("run.distance is given: a differentiable run ends by cycles or duration.")
        lengths = (self.length.cycles, self.length.warmup_cycles, self.length.duration, self.length.warmup)
        if any(jnp.ndim(value) for value in lengths if value is not None):
            raise ParameterError("run has one length for each world: a differentiable run takes one for all.")
        self.slowest = slowest
        self.robot = self.setup.load()
        self.controller = self.setup.controller()
        self.engine = MjxEngine(self.robot, ClosedLoop(self.robot, self.controller))
        self.variation = Variation(self.robot)
        self.start = StartPose(self.robot, self.controller)

    @functools.cached_property
    def _defaults(self) -> WorldParameters:
        return replace_quantities(WorldParameters(), self.setup.defaults())

    def __call__(
        self, values: Mapping[str, ArrayLike], qpos: ArrayLike | None = None, qvel: ArrayLike | None = None
    ) -> dict[str, Float[Array, ""]]:
        """The metrics of one world, as named in `METRICS`.

        Args:
            values: parameter name -> number or array of shape (); what is not named has the setup's default.
            qpos: first positions (nq,); by default the pose in which the gait starts.
            qvel: first velocities (nv,); by default at rest.

        Raises:
            ParameterError: an unknown name; a value out of range, if it is not traced; a traced frequency without
                `slowest`.
        """
        return self.record(values, qpos, qvel)[0]

    @full_precision
    def record(
        self, values: Mapping[str, ArrayLike], qpos: ArrayLike | None = None, qvel: ArrayLike | None = None
    ) -> tuple[dict[str, Float[Array, ""]], Path]:
        """The metrics and the path of one world; both are differentiable. The arguments are the same."""
        params = self._parameters(values)
        body = self.variation.differentiable(params.model, values)
        loop, ticks = self._loop_parameters(params, values)
        first = self.start.qpos(params.control, params.start) if qpos is None else jnp.asarray(qpos, float)
        still = jnp.zeros((self.robot.model.nv,)) if qvel is None else jnp.asarray(qvel, float)
        carry = self.engine.start(loop, first, still, self.robot.sensordata_at_rest(first))

        def tick(carry: Carry) -> tuple[Carry, Path]:
            carry, ctrl = self.engine.tick(loop, body, carry)
            return carry, Path(carry.physics.qpos, carry.physics.qvel, ctrl)

        carry, path = checkpointed_scan(tick, carry, ticks)
        mass = jnp.asarray(params.model.mass.front + params.model.mass.rear, float)
        # A traced frequency below `slowest` does not get through its run: no number is better than a wrong one.
        complete = loop.window.end <= (ticks - 1 + 1e-3) * self.controller.dt
        measured = metrics.result(carry.loop.metrics, mass, params.model.ground.gravity)
        return {name: jnp.where(complete, value, jnp.nan) for name, value in measured.items()}, path

    def _parameters(self, values: Mapping[str, ArrayLike]) -> WorldParameters:
        for name, value in values.items():
            if jnp.ndim(value):
                shape = jnp.shape(value)
                raise ParameterError(f"{name} has shape {shape}: a rollout is one world; use jax.vmap for a batch.")
        given = with_gait_factor({name: jnp.asarray(value) for name, value in values.items()})
        params = replace_quantities(self._defaults, given)
        known = {name: value for name, value in values.items() if not isinstance(value, jax.core.Tracer)}
        checked = replace_quantities(self._defaults, known)
        check_world(checked, self.setup.timestep)
        if len(known) == len(values):
            check(checked.control, routing=self.setup.routing)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)

    def _loop_parameters(self, params: WorldParameters, values: Mapping[str, ArrayLike]) -> tuple[LoopParameters, int]:
        """Parameters of the loop, and the number of ticks that covers the run at any frequency that is allowed."""
        gait, tracking = params.control.gait, params.control.tracking
        begin, end = self.length.seconds(gait.frequency, tracking.clock_ratio)
        window = Window(begin=jnp.asarray(begin, float), end=jnp.asarray(end, float), distance=jnp.asarray(1e6))
        loop = LoopParameters(params.control, params.start, window, params.model.servo.speed)
        return loop, math.ceil(self.seconds(values) / self.controller.dt - 1e-6) + 1

    def seconds(self, values: Mapping[str, ArrayLike]) -> float:
        """Simulated time of a run with these values [s]; of the slowest that is allowed, if the frequency is traced.

        Raises:
            ParameterError: it depends on a traced value, and no `slowest` is given.
        """
        if self.length.duration is not None:
            return float(self.length.duration)
        defaults = self.setup.defaults()
        timing = {name: values.get(name, defaults[name]) for name in ("frequency", "tracking.clock_ratio")}
        traced = [name for name, value in timing.items() if isinstance(value, jax.core.Tracer)]
        if traced == ["frequency"] and self.slowest is not None:
            timing["frequency"] = self.slowest
        elif traced:
            raise ParameterError(
                f"{traced[0]} is traced and the run is given in gait cycles, so that its length is not known: "
                "give Rollout(slowest=...), the lowest frequency [Hz], or a run in seconds, Run(duration=...)."
            )
        _, end = self.length.seconds(*(float(np.asarray(value)) for value in timing.values()))
        return float(end)
