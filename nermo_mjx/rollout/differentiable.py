"""A differentiable walk: named values in, named metrics out, in one pure JAX function."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from nermo_mjx.control.controller import Controller, canonical
from nermo_mjx.control.protocol import ControllerLike
from nermo_mjx.dynamics.checkpointing import checkpointed_scan
from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.physics.mjx_engine import Carry, MjxEngine
from nermo_mjx.physics.variation import Variation
from nermo_mjx.robot.model_parameters import is_shaped
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import metrics as measures
from nermo_mjx.rollout.electrical import Supply
from nermo_mjx.rollout.loop import checked_loop, loop_parameters
from nermo_mjx.rollout.own_metrics import OwnMetric
from nermo_mjx.rollout.run import Run, StartPose
from nermo_mjx.rollout.setup import Setup, Window, WorldParameters, with_own
from nermo_mjx.shapes import Array, Scalar


class Path(NamedTuple):
    """The trajectory of a walk, one row per control tick.

    Attributes:
        qpos, qvel: state at the end of each tick, (ticks, nq) and (ticks, nv).
        ctrl: servo targets during the tick, (ticks, n_servos) [rad].
    """

    qpos: Float[Array, "ticks nq"]
    qvel: Float[Array, "ticks nv"]
    ctrl: Float[Array, "ticks n_servos"]


class Rollout:
    """One walk as a pure function, for `jax.jit`, `jax.vmap`, `jax.grad`, `jax.jvp` and their combinations.

        rollout = Rollout(Setup(spine="stride_extension"), Run(cycles=4, warmup_cycles=1))
        speed = lambda amplitude: rollout({"spine.amplitude": amplitude})["speed"]
        slope = jax.jit(jax.grad(speed), compiler_options=nermo_mjx.compiler_options())(0.2)

    Derivatives are exact: of controller, metrics, start pose and body in JAX, of the physics by
    `physics.differentiable`. In reverse mode memory grows with the square root of the run's length. The precision is
    JAX's at the time the rollout is created (`jax.enable_x64`). It runs the same computation as the engine `mjx`,
    except that forces and accelerations read zero before the first tick, which may affect a controller. The compiler
    options halve its run time on a CPU, and can be left out.
    """

    def __init__(
        self,
        setup: Setup | None = None,
        run: Run | None = None,
        *,
        slowest: float | None = None,
        controller: ControllerLike | str | None = None,
        metrics: Sequence[OwnMetric | str] | str = (),
    ) -> None:
        """
        Args:
            setup: static choices.
            run: length and warm-up, the same for all worlds; without `distance`, which has no derivative.
            slowest: lowest frequency that a traced value may have [Hz], if the run is given in gait cycles and its
                frequency is traced: the number of ticks is fixed when a program is traced. For a custom controller, the
                lowest rate of gait cycles.
            controller: instead of the setup's, see `Setup.controller`.
            metrics: in addition to the setup's, see `Setup.metrics`.

        Raises:
            ParameterError: a run that ends by distance, or has one length per world; an object that is not a
                controller, or a metric that cannot be computed.
        """
        self.setup, self.length = with_own(setup, controller, metrics), run or Run()
        if self.length.distance is not None:
            raise ParameterError("run.distance is given: a differentiable run ends by cycles or duration.")
        lengths = (self.length.cycles, self.length.warmup_cycles, self.length.duration, self.length.warmup)
        if any(jnp.ndim(value) for value in lengths if value is not None):
            raise ParameterError("run has one length for each world: a differentiable run takes one for all.")
        self.slowest = slowest
        self.loop = checked_loop(self.setup)
        self.robot, self.controller = self.loop.robot, self.loop.controller
        self.engine = MjxEngine(self.robot, self.loop)
        self.variation = Variation(self.robot)
        self.start = StartPose(self.robot, self.controller)

    @property
    def identity(self) -> str | None:
        """Everything that determines this walk, except its arguments; None if user code is involved."""
        if self.setup.controller is not None or self.setup.command is not None or self.setup.metrics:
            return None
        chosen = self.setup.fields(), self.setup.waypoints, self.robot.config, self.robot.fingerprint
        return repr((*chosen, self.length, self.slowest, self.engine.devices.count))

    def __call__(
        self,
        values: Mapping[str, ArrayLike] | None = None,
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        *,
        policy: Any = None,
    ) -> dict[str, Scalar]:
        """The metrics of one world, as named in `all_metrics(setup)`.

        Args:
            values: parameter name -> number or array of shape (); unnamed ones have the setup's default. qpos: initial
            positions (nq,); by default the gait's start pose.
            qvel: initial velocities (nv,); by default at rest.
            policy: the controller's parameters instead of the setup's, a pytree like `controller.parameters`, traced or
                not. Named values override it.

        Raises:
            ParameterError: an unknown name; a value out of range, if it is not traced; a traced frequency without
                `slowest`.
        """
        return self.record(values or {}, qpos, qvel, policy=policy)[0]

    @full_precision
    def record(
        self,
        values: Mapping[str, ArrayLike],
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        *,
        policy: Any = None,
    ) -> tuple[dict[str, Scalar], Path]:
        """The metrics and the path of one world; both are differentiable. The arguments are the same."""
        values = {**self.setup.body, **values}
        params = self._parameters(values, policy)
        body = self.variation.differentiable(params.model, values)
        begin, end = self.length.seconds(canonical(self.controller.cycle_rate(params.control)))
        window = Window(begin=jnp.asarray(begin, float), end=jnp.asarray(end, float), distance=jnp.asarray(1e6))
        loop = loop_parameters(self.robot, params, window, values)
        ticks = math.ceil(self.seconds(values, policy) / self.controller.dt - 1e-6) + 1
        if qpos is None:
            shape = params.model if is_shaped(values) else None
            qpos = self.start.qpos(self.loop.control_at(loop, 0.0), params.start, loop.terrain, shape)
        first = jnp.asarray(qpos, float)
        still = jnp.zeros((self.robot.model.nv,)) if qvel is None else jnp.asarray(qvel, float)
        carry = self.engine.start(loop, first, still, self.robot.sensordata_at_rest(first))
        carry = self.engine.playing(carry, body)

        def tick(carry: Carry) -> tuple[Carry, Path]:
            carry, ctrl = self.engine.tick(loop, body, carry)
            return carry, Path(carry.physics.qpos, carry.physics.qvel, ctrl)

        carry, path = checkpointed_scan(tick, carry, ticks)
        mass = jnp.asarray(params.model.mass.front + params.model.mass.rear, float)
        # A traced frequency below `slowest` would not finish its run: NaN is better than a wrong result.
        complete = loop.window.end <= (ticks - 1 + 1e-3) * self.controller.dt
        gravity, supply = params.model.ground.gravity, Supply.of(params.model)
        measured = measures.result(carry.loop.metrics, mass, gravity, supply, self.setup.own_metrics)
        return {name: jnp.where(complete, value, jnp.nan) for name, value in measured.items()}, path

    def _parameters(self, values: Mapping[str, ArrayLike], policy: Any) -> WorldParameters:
        for name, value in values.items():
            if jnp.ndim(value):
                shape = jnp.shape(value)
                raise ParameterError(f"{name} has shape {shape}: a rollout is one world; use jax.vmap for a batch.")
        params = self.setup.world({name: jnp.asarray(value, float) for name, value in values.items()}, policy)
        known = {name: value for name, value in values.items() if not _traced(value)}
        checked = self.setup.world(known, None if _traced(policy) else policy)
        self.setup.check(checked, jointly=len(known) == len(values) and not _traced(policy))
        return canonical(params)

    def seconds(self, values: Mapping[str, ArrayLike], policy: Any = None) -> float:
        """Simulated time of a run with these values [s]; of the slowest allowed one, if the frequency is traced.

        Raises:
            ParameterError: it depends on a traced value, and no `slowest` is given.
        """
        if self.length.duration is not None:
            return float(self.length.duration)
        traced = [name for name in self.setup.timing if _traced(values.get(name))]
        # Traced values become NaN, and so does a rate that depends on them.
        known = {name: values[name] for name in self.setup.timing if name in values} | dict.fromkeys(traced, math.nan)
        if traced == ["frequency"] and self.slowest is not None:
            known["frequency"] = self.slowest
        given = jax.tree.map(lambda leaf: np.full(jnp.shape(leaf), np.nan) if _traced(leaf) else leaf, policy)
        rate = float(self.setup.cycle_rate(known, given))
        if math.isnan(rate) and self.slowest is not None and not isinstance(self.controller, Controller):
            rate = self.slowest
        if math.isnan(rate):
            raise ParameterError(
                f"{next(iter(traced), 'policy')} is traced and the run is given in gait cycles, so that its length is "
                "not known: give Rollout(slowest=...), the lowest frequency [Hz], or a run in seconds, "
                "Run(duration=...)."
            )
        return float(self.length.seconds(rate)[1])


def _traced(tree: Any) -> bool:
    """Whether any leaf is traced."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


# ---
# Value and gradient of a scalar function of few or many parameters, in the cheaper mode.


MODES: Final = ("auto", "forward", "reverse")
#: Up to this many parameters forward mode is cheaper by the costs below, and it compiles faster.
MOST_FORWARD: Final = 4
#: Assumed cost of value and gradient relative to the value alone: in forward mode one run, and one more for each
#: parameter (2.6 runs were measured for two); in reverse mode five runs for any number (4.5 were measured).
FORWARD_COST: Final = 1.0
REVERSE_COST: Final = 5.0

#: A scalar function of a point (p,), with auxiliary output.
Function = Callable[[Float[Array, " p"]], tuple[Scalar, Any]]


def choose_mode(parameters: int, mode: str = "auto") -> str:
    """`forward` or `reverse`; `auto` decides by the number of parameters."""
    if mode != "auto":
        return mode
    return "forward" if parameters <= MOST_FORWARD else "reverse"


def cost(parameters: int, mode: str) -> float:
    """Cost of value and gradient, in runs of the function alone."""
    return 1.0 + FORWARD_COST * parameters if mode == "forward" else REVERSE_COST


def value_and_gradient(
    function: Function, mode: str
) -> Callable[[Float[Array, " p"]], tuple[Scalar, Float[Array, " p"], Any]]:
    """The function's value, its gradient, and its auxiliary output, in one pass.

    Args:
        function: point (p,) -> (value, anything).
        mode: `forward` or `reverse`.
    """

    derivative: Any = jax.jacfwd if mode == "forward" else jax.grad

    def evaluated(point: Array) -> tuple[Array, Array, Any]:
        def with_value(point: Array) -> tuple[Array, Any]:
            value, rest = function(point)
            return value, (value, rest)

        gradient, (value, rest) = derivative(with_value, has_aux=True)(point)
        return value, gradient, rest

    return evaluated
