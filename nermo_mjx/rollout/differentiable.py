"""A differentiable walk: named values in, named metrics out, in one function for JAX's transformations.

On the engine `c` the derivative is a central difference of whole walks: each traced number adds two walks to the batch.
It is computed in float64, with the solver's tolerance at `TOLERANCE` and a width of `WIDTH` of a parameter's scale. On
`mjx` JAX differentiates the walk itself, for example in reverse mode. In float64, both agree to 1e-4.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike
from jaxtyping import Float

from nermo_mjx.control.controller import Controller, canonical
from nermo_mjx.control.protocol import ControllerLike
from nermo_mjx.dynamics.checkpointing import checkpointed_scan
from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.physics.open_loop import first_order_callback
from nermo_mjx.physics.variation import Variation
from nermo_mjx.robot.model_parameters import is_shaped
from nermo_mjx.robot.quantity import ParameterError, Quantity, choice, of_type
from nermo_mjx.rollout import metrics as measures
from nermo_mjx.rollout.custom_metrics import OwnMetric
from nermo_mjx.rollout.electrical import Supply
from nermo_mjx.rollout.loop import checked_loop, loop_parameters
from nermo_mjx.rollout.path_metrics import ticks_until
from nermo_mjx.rollout.run import Run, StartPose
from nermo_mjx.rollout.setup import Setup, Window, all_metrics, all_parameters, with_own
from nermo_mjx.rollout.simulator import COMPILE_SECONDS, Simulator
from nermo_mjx.runtime import callback_device, start_jax
from nermo_mjx.shapes import Array, Scalar

if TYPE_CHECKING:
    from nermo_mjx.physics.mjx_engine import Carry, MjxEngine

#: Engines of a rollout; `auto` is `c` on a CPU for up to `MOST_DIFFERENCES` traced numbers, and else `mjx`.
ROLLOUT_ENGINES: Final = ("auto", "c", "mjx")
#: Up to so many parameters, whole walks of the engine `c` cost less than one gradient in MJX, which is 34 of them.
MOST_DIFFERENCES: Final = 20
#: Cost of value and gradient in MJX, in runs of it without: 4.5 were measured for any number of parameters.
MJX_GRADIENT: Final = 5.0
_FIRST_ONLY: Final = (
    "A second derivative of a walk is not computed on engine c: take Rollout(..., engine='mjx')."
)
#: Half-width of the differences, as a share of a parameter's scale; tolerance of the solver. Widths from 1e-8 to 1e-6
#: give the same derivative; from 1e-5 on contacts change within the width.
SLOPE_WIDTH: Final = 1e-7
TOLERANCE: Final = 1e-12
#: The slopes on the two sides of a point differ by this share of the larger one only if there is a kink between them.
KINK: Final = 0.01
#: Rounding of a metric after a walk, absolute and as a share of it; 7e-14 was seen.
NOISE: Final = 1e-12


def engine_for(numbers: int) -> str:
    """The engine that `auto` takes for so many traced numbers, if it can do what is asked."""
    start_jax()
    return "c" if jax.default_backend() == "cpu" and numbers <= MOST_DIFFERENCES else "mjx"


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
    """One walk as a pure function, for `jax.grad`, `jax.jit`, `jax.vmap`, `jax.jvp`, `jax.lax.scan` and their
    combinations.

        rollout = Rollout(Setup(spine="stride_extension"), Run(cycles=4, warmup_cycles=1))
        speed = lambda amplitude: rollout({"spine.amplitude": amplitude})["speed"]
        slope = jax.grad(speed)(0.2)

    On the engine `c` a derivative with respect to n traced numbers takes 2 n + 1 walks in one batch, of which
    `jax.vmap` makes a larger one. It computes in float64 whatever JAX's precision, and gives its results in that. Where
    a metric has a kink within the width of the differences, a warning says so. Second derivatives, and derivatives with
    respect to start states and to a controller's `policy`, need the engine `mjx`.

    On the engine `mjx` JAX differentiates controller, metrics, start pose and body, and `dynamics.step` the physics. In
    float64 the derivatives of both engines agree to 1e-4. In reverse mode memory grows with the square root of the
    run's length. The precision is JAX's at the time the rollout is created (`jax.enable_x64`). It runs the same
    computation as the engine `mjx`, except that forces and accelerations read zero before the first tick, which may
    affect a controller. With `compiler_options()` a jitted program takes half the time on a CPU before JAX 0.12.
    """

    def __init__(
        self,
        setup: Setup | None = None,
        run: Run | None = None,
        engine: str = "auto",
        *,
        slowest: float | None = None,
        controller: ControllerLike | str | None = None,
        metrics: Sequence[OwnMetric | str] | str = (),
    ) -> None:
        """
        Args:
            setup: static choices.
            run: length and warm-up, the same for all worlds; without `distance`, which has no derivative.
            engine: `c`, `mjx`, or `auto`: `c` on a CPU if it can do what is asked and at most `MOST_DIFFERENCES`
                numbers are traced. The log says once which one it is.
            slowest: lowest frequency that a traced value may have [Hz], if the run is given in gait cycles and its
                frequency is traced: the number of ticks is fixed when a program is traced. For a custom controller, the
                lowest rate of gait cycles. On `c` only `record` needs it.
            controller: instead of the setup's, see `Setup.controller`.
            metrics: in addition to the setup's, see `Setup.metrics`.

        Raises:
            ParameterError: an unknown engine; a run that ends by distance, or has one length per world; an object that
                is not a controller, or a metric that cannot be computed.
        """
        self.setup = with_own(setup, controller, metrics)
        self.length = of_type("run", Run() if run is None else run, Run, "a Run")
        of_type("slowest", slowest, (float, int, type(None)), "a frequency in Hz")
        self._wanted = choice("engine", engine, ROLLOUT_ENGINES)
        if self.length.distance is not None:
            raise ParameterError(
                "run.distance is given: a differentiable run ends by cycles or duration."
            )
        lengths = (
            self.length.cycles,
            self.length.warmup_cycles,
            self.length.duration,
            self.length.warmup,
        )
        if any(jnp.ndim(value) for value in lengths if value is not None):
            raise ParameterError(
                "run has one length for each world: a differentiable run takes one for all."
            )
        self.slowest = slowest
        self.loop = checked_loop(self.setup)
        self.robot, self.controller = self.loop.robot, self.loop.controller
        self.variation = Variation(self.robot)
        self.start = StartPose(self.robot, self.controller)
        self._said: set[str] = set()
        start_jax()
        self._x64 = bool(jax.config.read("jax_enable_x64"))
        if self._wanted == "mjx":
            self.engine  # noqa: B018  # made here, in the precision of now

    @functools.cached_property
    def engine(self) -> MjxEngine:
        """The engine that traces the walk; made when it is first needed."""
        from nermo_mjx.physics.mjx_engine import (
            MjxEngine,
        )  # slow to import, and not needed on the engine c

        with jax.enable_x64(self._x64), jax.ensure_compile_time_eval():
            return MjxEngine(self.robot, self.loop)

    @functools.cached_property
    def _differences(self) -> WalkDifferences:
        return WalkDifferences(self.setup, self.length)

    def __call__(
        self,
        values: Mapping[str, ArrayLike | str] | None = None,
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        *,
        policy: Any = None,
    ) -> dict[str, Scalar]:
        """The metrics of one world, as named in `all_metrics(setup)`.

        Args:
            values: parameter name -> number, array of shape () or text with a unit such as "-45 deg"; unnamed ones have
                the setup's default.
            qpos: initial positions (nq,); by default the gait's start pose.
            qvel: initial velocities (nv,); by default at rest.
            policy: the controller's parameters instead of the setup's, a pytree like `controller.parameters`, traced or
                not. Named values override it.

        Raises:
            ParameterError: an unknown name; a value out of range, if it is not traced; a traced frequency without
                `slowest`, where it is needed; something that the engine `c` cannot do, if that was asked for.
        """
        return self._walk(values or {}, qpos, qvel, policy, path=False)[0]

    def record(
        self,
        values: Mapping[str, ArrayLike | str],
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        *,
        policy: Any = None,
    ) -> tuple[dict[str, Scalar], Path]:
        """The metrics and the path of one world; both are differentiable. The arguments are the same."""
        return self._walk(values, qpos, qvel, policy, path=True)

    def slopes(
        self, values: Mapping[str, float], names: Sequence[str], width: float = SLOPE_WIDTH
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Derivative of every metric to the n named ones of `values`, on the engine `c`, in float64.

        Args:
            values: parameter name -> number.
            names: to differentiate by.
            width: half-width of the differences, as a share of each parameter's scale.
        """
        parameters = {**self.setup.body, **self.setup.numbers(values)}
        self._check(parameters, None)
        return self._differences.slopes(
            {name: float(value) for name, value in parameters.items()}, tuple(names), width
        )

    def gradient_spread(
        self, values: Mapping[str, float], names: Sequence[str]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """How far the derivatives of `WIDTH` and of a tenth of it are apart, as a share of the larger: a derivative
        is sure to so many digits. Near a kink it is large. The arguments are those of `slopes`."""
        wide, narrow = (
            self.slopes(values, names, width) for width in (SLOPE_WIDTH, 0.1 * SLOPE_WIDTH)
        )
        larger = {name: np.maximum(np.abs(wide[name]), np.abs(narrow[name])) for name in wide}
        return {
            name: np.abs(wide[name] - narrow[name]) / np.where(largest > 0, largest, 1.0)
            for name, largest in larger.items()
        }

    def _walk(
        self,
        values: Mapping[str, ArrayLike | str],
        qpos: ArrayLike | None,
        qvel: ArrayLike | None,
        policy: Any,
        *,
        path: bool,
    ) -> tuple[dict[str, Scalar], Path]:
        parameters = {**self.setup.body, **self.setup.numbers(values)}
        self._check(parameters, policy)
        if self._chosen(parameters, qpos, qvel, policy) == "mjx":
            return self._traced(parameters, qpos, qvel, policy)
        ticks = self._ticks(parameters, policy) if path else None
        return self._differences.walk(
            parameters, None if qpos is None else np.asarray(qpos, float), policy, ticks
        )

    def _chosen(self, values: Mapping[str, Any], qpos: Any, qvel: Any, policy: Any) -> str:
        """The engine for such arguments, which is said once."""
        beyond = ""
        if _traced(policy):
            beyond = "The derivative to a controller's policy"
        elif _traced(qpos):
            beyond = "The derivative to a start state"
        elif qvel is not None:
            beyond = "A start with velocities"
        if self._wanted == "c" and beyond:
            raise ParameterError(
                f"{beyond} is not computed on engine c: take Rollout(..., engine='mjx')."
            )
        numbers = sum(map(_traced, values.values()))
        engine = (
            self._wanted if self._wanted != "auto" else "mjx" if beyond else engine_for(numbers)
        )
        if numbers and engine not in self._said and self._wanted == "auto":
            self._said.add(engine)
            how = (
                "central differences of whole walks"
                if engine == "c"
                else "tracing: compiling takes minutes on a CPU"
            )
            logging.getLogger(__name__).warning(
                "Rollout: engine %s for %d traced numbers, by %s.", engine, numbers, how
            )
        return engine

    def _check(self, values: Mapping[str, ArrayLike], policy: Any) -> None:
        """Reject what is wrong among values that are not traced."""
        for name, value in values.items():
            if jnp.ndim(value):
                shape = jnp.shape(value)
                raise ParameterError(
                    f"{name} has shape {shape}: a rollout is one world; use jax.vmap for a batch."
                )
        constants = {name: value for name, value in values.items() if not _traced(value)}
        self.setup.world(values)  # unknown names
        checked = self.setup.world(constants, None if _traced(policy) else policy)
        self.setup.check(checked, jointly=len(constants) == len(values) and not _traced(policy))

    @full_precision
    def _traced(
        self,
        values: Mapping[str, ArrayLike],
        qpos: ArrayLike | None,
        qvel: ArrayLike | None,
        policy: Any,
    ) -> tuple[dict[str, Scalar], Path]:
        """The walk in MJX."""
        if "mjx" not in self._said:
            self._said.add("mjx")
            what = f"compiling the mjx program, about {COMPILE_SECONDS['mjx']} s, a gradient minutes, once per machine"
            logging.getLogger(__name__).warning("Rollout: %s.", what)
        params = canonical(
            self.setup.world(
                {name: jnp.asarray(value, float) for name, value in values.items()}, policy
            )
        )
        body = self.variation.differentiable(params.model, values)
        begin, end = self.length.seconds(canonical(self.controller.cycle_rate(params.control)))
        window = Window(
            begin=jnp.asarray(begin, float), end=jnp.asarray(end, float), distance=jnp.asarray(1e6)
        )
        loop = loop_parameters(self.robot, params, window, values)
        ticks = self._ticks(values, policy)
        if qpos is None:
            shape = params.model if is_shaped(values) else None
            qpos = self.start.qpos(
                self.loop.control_at(loop, 0.0), params.start, loop.terrain, shape
            )
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
        gravity, supply = params.model.ground.gravity, Supply.of(params.model, self.robot)
        measured = measures.result(
            carry.loop.metrics, mass, gravity, supply, self.setup.own_metrics
        )
        return {name: jnp.where(complete, value, jnp.nan) for name, value in measured.items()}, path

    def _ticks(self, values: Mapping[str, ArrayLike], policy: Any) -> int:
        return int(ticks_until(self.seconds(values, policy), self.controller.dt))

    def seconds(self, values: Mapping[str, ArrayLike], policy: Any = None) -> float:
        """Simulated time of a run with these values [s]; of the slowest allowed one, if the frequency is traced.

        Raises:
            ParameterError: it depends on a traced value, and no `slowest` is given.
        """
        if self.length.duration is not None:
            return float(self.length.duration)
        traced = [name for name in self.setup.timing if _traced(values.get(name))]
        # Traced values become NaN, and so does a rate that depends on them.
        constants = {
            name: values[name] for name in self.setup.timing if name in values
        } | dict.fromkeys(traced, math.nan)
        if traced == ["frequency"] and self.slowest is not None:
            constants["frequency"] = self.slowest
        params = jax.tree.map(
            lambda leaf: np.full(jnp.shape(leaf), np.nan) if _traced(leaf) else leaf, policy
        )
        rate = float(self.setup.cycle_rate(constants, params))
        if (
            math.isnan(rate)
            and self.slowest is not None
            and not isinstance(self.controller, Controller)
        ):
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
# Walks on the engine c, and the differences between them.


class WalkDifferences:
    """Walks of the engine `c` in float64 as a function of their traced values, under JAX's transformations."""

    def __init__(self, setup: Setup, run: Run) -> None:
        """Nothing is compiled before the first walk."""
        self.setup, self.length = setup, run
        self.metrics = tuple(all_metrics(setup))
        self._about = all_parameters(setup)
        self._made: dict[Any, Callable[..., Any]] = {}
        self._told: set[tuple[str, ...]] = set()
        self._lock = threading.Lock()

    @functools.cached_property
    def _simulator(self) -> Simulator:
        simulator = Simulator(self.setup, "c")
        engine: Any = simulator.engine
        engine.model.opt.tolerance = TOLERANCE
        return simulator

    def walk(
        self, values: Mapping[str, Any], qpos: np.ndarray | None, policy: Any, ticks: int | None
    ) -> tuple[dict[str, Scalar], Path]:
        """Metrics, and the path of so many `ticks`; None for an empty path."""
        traced = {
            name: jnp.asarray(value, float) for name, value in values.items() if _traced(value)
        }
        fixed = {
            name: float(np.asarray(value)) for name, value in values.items() if name not in traced
        }
        simulate = functools.partial(self._simulate, tuple(traced), fixed, qpos, policy, ticks)
        if not traced:
            with jax.ensure_compile_time_eval():
                results = simulate(np.zeros((1, 0)))
                return self._arranged([jnp.asarray(result[0], float) for result in results])
        # JAX keeps what it has compiled for a function, if it is the same one.
        key = (tuple(traced), tuple(fixed.items()), ticks, jax.dtypes.canonicalize_dtype(float))
        if qpos is not None or policy is not None or key not in self._made:
            self._made[key] = self._differentiable(simulate, tuple(traced), ticks)
        return self._arranged(self._made[key](*traced.values()))

    def _arranged(self, results: Sequence[Any]) -> tuple[dict[str, Scalar], Path]:
        return dict(zip(self.metrics, results[0], strict=True)), Path(*results[1:])

    def _differentiable(
        self,
        simulate: Callable[[np.ndarray], list[np.ndarray]],
        names: tuple[str, ...],
        ticks: int | None,
    ) -> Callable[..., Any]:
        """A function of p scalars, with its derivative: metrics (m,) as a list, and the arrays of the path."""
        model, real = self._simulator_model, jnp.zeros(()).dtype
        ticks = ticks or 0
        shapes = [(len(self.metrics),), (ticks, model.nq), (ticks, model.nv), (ticks, model.nu)]
        shapes_of_walk = [jax.ShapeDtypeStruct(shape, real) for shape in shapes]

        def values(*arguments: Any) -> list[np.ndarray]:
            lead, points = _rows(arguments)
            return [
                result.reshape(*lead, *result.shape[1:]).astype(real) for result in simulate(points)
            ]

        def slopes(
            varied: tuple[int, ...], *arguments: Any
        ) -> tuple[list[np.ndarray], list[np.ndarray]]:
            lead, points = _rows(arguments)
            results, derivative = self._slopes(
                simulate, names, points, varied, SLOPE_WIDTH, warn=True
            )
            shaped = (
                [result.reshape(*lead, *result.shape[1:]).astype(real) for result in part]
                for part in (results, derivative)
            )
            return next(shaped), next(shaped)

        @jax.custom_jvp
        def walk(*arguments: Array) -> tuple[list[Array], ...]:
            metrics, *path = first_order_callback(values, shapes_of_walk, _FIRST_ONLY, *arguments)
            return [metrics[i] for i in range(len(self.metrics))], *path

        def rule(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
            varied = tuple(
                i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)
            )
            columns = [
                jax.ShapeDtypeStruct((*result.shape, len(varied)), real)
                for result in shapes_of_walk
            ]
            slopes_of_varied = functools.partial(slopes, varied)
            results, derivative = first_order_callback(
                slopes_of_varied, (shapes_of_walk, columns), _FIRST_ONLY, *primals
            )

            def along(columns: Array) -> Array:
                """Linear in the tangents, so that JAX transposes it; a sum, which all transformations round alike."""
                return sum(
                    (columns[..., k] * tangents[i] for k, i in enumerate(varied)),
                    jnp.zeros(columns.shape[:-1]),
                )

            # Each metric by itself: one without a derivative must not make those of others NaN.
            metrics, *path = results
            slope, *path_slopes = derivative
            result = range(len(self.metrics))
            return ([metrics[i] for i in result], *path), (
                [along(slope[i]) for i in result],
                *map(along, path_slopes),
            )

        walk.defjvp(rule, symbolic_zeros=True)
        return walk

    @functools.cached_property
    def _simulator_model(self) -> Any:
        return self.setup.load().model

    def _simulate(
        self,
        names: tuple[str, ...],
        fixed: Mapping[str, float],
        qpos: np.ndarray | None,
        policy: Any,
        ticks: int | None,
        points: np.ndarray,
    ) -> list[np.ndarray]:
        """Metrics (n, m) and the arrays of the path (n, ticks, ...) of walks at n points (n, p), in float64."""
        with jax.enable_x64(True), jax.default_device(callback_device()):
            with self._lock:
                simulator = self._simulator
            columns = {name: points[:, i] for i, name in enumerate(names)}
            batch = simulator.prepare({**fixed, **columns}, self.length, policy)
            if qpos is not None:
                batch = dataclasses.replace(batch, qpos=np.broadcast_to(qpos, batch.qpos.shape))
            if ticks is not None:
                batch = dataclasses.replace(batch, ticks=np.full(len(batch.qpos), ticks))
            result = simulator.run_batch(batch, record=ticks is not None)
        # A world without traced values is one world.
        metrics = np.stack([result.metrics[name] for name in self.metrics], axis=-1)
        if result.trace is None:
            model = self._simulator_model
            return [
                metrics,
                *(np.zeros((len(metrics), 0, size)) for size in (model.nq, model.nv, model.nu)),
            ]
        return [metrics, result.trace.qpos, result.trace.qvel, result.trace.ctrl]

    def _slopes(
        self,
        simulate: Callable[[np.ndarray], list[np.ndarray]],
        names: tuple[str, ...],
        points: np.ndarray,
        varied: tuple[int, ...],
        width: float,
        warn: bool = False,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """What `simulate` gives at n points (n, p), and its derivatives to the moved ones of the parameters."""
        declarations = [self._about[names[i]] for i in varied]
        varied_points = points[:, list(varied)]
        scale = np.array([_scale(declaration) for declaration in declarations])
        above = np.minimum(
            varied_points + width * scale, [outputs.high for outputs in declarations]
        )
        below = np.maximum(varied_points - width * scale, [outputs.low for outputs in declarations])
        worlds = np.repeat(points[:, None], 1 + 2 * len(varied), axis=1)
        for k, i in enumerate(varied):
            worlds[:, 1 + k, i], worlds[:, 1 + len(varied) + k, i] = above[:, k], below[:, k]
        differences = [
            outputs.reshape(*worlds.shape[:2], *outputs.shape[1:])
            for outputs in simulate(worlds.reshape(-1, len(names)))
        ]
        values, derivatives = [], []
        for outputs in differences:
            centre, up, down = np.split(np.moveaxis(outputs, 1, -1), [1, 1 + len(varied)], axis=-1)
            run = (above - below).reshape(len(points), *[1] * (outputs.ndim - 2), len(varied))
            values.append(centre[..., 0])
            derivatives.append((up - down) / run)
            if warn and outputs.ndim == 3:  # the metrics
                with np.errstate(divide="ignore", invalid="ignore"):
                    right = (up - centre) / (above - varied_points)[:, None]
                    left_slope = (centre - down) / (varied_points - below)[:, None]
                    larger = np.maximum(np.abs(right), np.abs(left_slope))
                    noise = NOISE * (1.0 + np.abs(centre)) / (0.5 * run)
                    kink = np.abs(right - left_slope) > np.maximum(KINK * larger, noise)
                self._tell(names, points, varied, kink & np.isfinite(larger), right, left_slope)
        return values, derivatives

    def _tell(
        self,
        names: tuple[str, ...],
        points: np.ndarray,
        varied: tuple[int, ...],
        kink: np.ndarray,
        right: np.ndarray,
        left_slope: np.ndarray,
    ) -> None:
        """Warn of kinks (n, m, p), once for each set of metrics."""
        metrics = tuple(
            name
            for name, has_kink in zip(self.metrics, np.any(kink, axis=(0, 2)).tolist(), strict=True)
            if has_kink
        )
        if not metrics or metrics in self._told:
            return
        self._told.add(metrics)
        n, m, k = np.argwhere(kink)[0]
        position = ", ".join(
            f"{name} {value:g}" for name, value in zip(names, points[n], strict=True)
        )
        warnings.warn(
            f"{', '.join(metrics)} has a kink within the width of the differences at {position}: the slope of "
            f"{self.metrics[m]} by {names[varied[k]]} is {left_slope[n, m, k]:g} on one side and {right[n, m, k]:g} on the "
            "other; its derivative is their mean.",
            stacklevel=2,
        )

    def slopes(
        self, values: Mapping[str, float], names: tuple[str, ...], width: float
    ) -> dict[str, np.ndarray]:
        """See `Rollout.slopes`."""
        fixed = {name: value for name, value in values.items() if name not in names}
        simulate = functools.partial(self._simulate, names, fixed, None, None, None)
        point, moved = np.array([[values[name] for name in names]]), tuple(range(len(names)))
        _, (slopes, *_) = self._slopes(simulate, names, point, moved, width)
        return dict(zip(self.metrics, slopes[0], strict=True))


def _rows(arguments: Sequence[Any]) -> tuple[tuple[int, ...], np.ndarray]:
    """Leading axes of p arrays of one shape, and their values as rows (n, p)."""
    stacked = np.stack([np.asarray(argument, float) for argument in arguments], axis=-1)
    return stacked.shape[:-1], stacked.reshape(-1, stacked.shape[-1])


def _scale(declaration: Quantity) -> float:
    """How large a parameter is: its default's size, or its range where that is zero, but at most 1."""
    return abs(float(np.asarray(declaration.default))) or min(
        declaration.high - declaration.low, 1.0
    )
