"""Adam with a controlled rate, and the optimizers of optax by name, with options and schedules.

An optimizer takes trial steps when it is created, so that a wrong option is reported before an expensive simulation.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.specs.reading import describe

# ---
# Adam with an automatic learning rate: it adapts to the objective values after each step.
#
# A step is rate * m / sqrt(v), with Adam's means of the gradients m and of their squares v, corrected for their initial
# values (Kingma and Ba, ICLR 2015). If an evaluation is the best so far, the rate grows by a fifth. If two evaluations
# in a row are not better, or if the robot fell, the rate is multiplied by 0.7, and the next step starts from the best
# point again.
#
# The direction is averaged, so that the landscape may be rough: a walk's speed has teeth as steep as the overall hill,
# 0.1 of a unit of u wide. A descent that requires improvement in every step gets stuck in them; for example, a trust
# region with the BFGS update, which is much faster on smooth functions, got stuck at once.


#: Initial rate, in coordinates u per step: a thirteenth of a parameter's range in its middle.
INITIAL_RATE: Final = 0.3
_MOST: Final = 1.0
_GROWS, _SHRINKS, _WAITS = 1.2, 0.7, 2
_MEMORY: Final = (0.8, 0.9)


class ControlledAdam(NamedTuple):
    """State of the optimizer.

    Attributes:
        adam: Means of the gradients and of their squares.
        rate: Maximum length of the next step along each parameter.
        best, best_u: Lowest value so far, infinite before the first, and its point (p,).
        waited: Number of evaluations since the best one.
    """

    adam: optax.ScaleByAdamState
    rate: Float[Array, ""]
    best: Float[Array, ""]
    best_u: Float[Array, " p"]
    waited: Int[Array, ""]


def controlled_adam(rate: float = INITIAL_RATE) -> optax.GradientTransformationExtraArgs:
    """The optimizer, for the vector u of one start; `update` needs `value`, which is infinite if the robot fell.

    Args:
        rate: Initial rate, in coordinates u per step.

    >>> import jax
    >>> bowl = lambda u: jnp.sum((u - jnp.array([1.0, 3.0])) ** 2 * jnp.array([1.0, 20.0]))
    >>> optimizer, u = controlled_adam(), jnp.zeros(2)
    >>> state = optimizer.init(u)
    >>> for _ in range(60):
    ...     step, state = optimizer.update(jax.grad(bowl)(u), state, u, value=bowl(u))
    ...     u = u + step
    >>> [round(float(each), 2) for each in state.best_u]
    [1.0, 3.0]
    """
    direction = optax.scale_by_adam(*_MEMORY)

    def init(u: Array) -> ControlledAdam:
        lowest_value = jnp.asarray(jnp.inf, u.dtype)
        return ControlledAdam(
            direction.init(u), jnp.asarray(rate, u.dtype), lowest_value, u, jnp.zeros((), int)
        )

    def update(
        gradient: Array, state: ControlledAdam, u: Array | None = None, *, value: Array, **_: object
    ) -> tuple[Array, ControlledAdam]:
        assert u is not None
        walked, better = jnp.isfinite(value), value < state.best
        ahead, adam = direction.update(gradient, state.adam)
        before, _ = direction.update(jnp.zeros_like(gradient), state.adam)
        # A fall has no gradient, so that the direction stays.
        ahead = jnp.where(walked, ahead, before)
        adam = optax.tree.where(walked, adam, state.adam)
        waited = jnp.where(better, 0, state.waited + 1)
        back = ~better & (~walked | (waited >= _WAITS))
        factor = jnp.where(better, _GROWS, jnp.where(back, _SHRINKS, 1.0))
        after = ControlledAdam(
            adam=adam,
            rate=jnp.minimum(state.rate * factor, _MOST).astype(state.rate.dtype),
            best=jnp.where(better, value, state.best).astype(state.best.dtype),
            best_u=jnp.where(better, u, state.best_u),
            waited=jnp.where(back, 0, waited),
        )
        return jnp.where(back, after.best_u, u) - after.rate * ahead - u, after

    return optax.GradientTransformationExtraArgs(init, update)


#: The optimizer with an automatic learning rate, which uses the objective's value.
CONTROLLED: Final = "controlled_adam"
#: The default learning rate of an optimizer, in coordinates u (`nermo_mjx.optimize.objective`) per step.
LEARNING_RATE: Final = 0.1
_SCHEDULE_ENDINGS: Final = ("", "_schedule", "_decay_schedule")


@dataclasses.dataclass(frozen=True)
class Optimizer:
    """An optimizer by name; hashable, so that it is static in compiled programs.

    Attributes:
        name: `controlled_adam`, or the name of an optax function with a learning rate: `adam`, `sgd`, ...
        options: Keyword arguments of this function. A schedule is written as
            {name: cosine_decay_schedule, option: value}, or as {cosine: {option: value}}.
        clip: Maximum norm of a gradient (2-norm over the parameters of one start); None for no clipping.

    Raises:
        ParameterError: A name or option is unknown or does not work; the message is one sentence that starts with the
            field (`optimizer.name`, `optimizer.learning_rate`, ...).
    """

    name: str = CONTROLLED
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    clip: float | None = None

    def __post_init__(self) -> None:
        if self.name != CONTROLLED and "learning_rate" not in self.options:
            object.__setattr__(self, "options", {"learning_rate": LEARNING_RATE, **self.options})
        if self.clip is not None and not 0.0 < self.clip < float("inf"):
            raise ParameterError(f"optimizer.clip is {self.clip:g}: allowed is (0, inf).")
        _try_out(self)

    def __hash__(self) -> int:
        return hash((self.name, *sorted(self.options), self.clip))

    @property
    def reads_values(self) -> bool:
        """Whether the optimizer uses objective values, so that it can react to a fall."""
        return self.name == CONTROLLED

    def build(self) -> optax.GradientTransformationExtraArgs:
        """The pure functions `init` and `update`, for the vector u of one start; `update` has the argument `value`."""
        make = optimizers().get(self.name)
        if make is None:
            allowed = f"{', '.join(OPTIMIZER_NAMES)}{did_you_mean(self.name, OPTIMIZER_NAMES)}"
            raise ParameterError(f"optimizer.name is {self.name!r}: allowed are {allowed}")
        values = {
            k: _schedule(k, value) if isinstance(value, Mapping) else value
            for k, value in self.options.items()
        }
        optimizer = _call("optimizer", self.name, make, values)
        optimizer = (
            optimizer
            if self.clip is None
            else optax.chain(optax.clip_by_global_norm(self.clip), optimizer)
        )
        return optax.with_extra_args_support(optimizer)

    def written(self) -> dict[str, Any]:
        """The fields of the optimizer in a tuning file."""
        return {"name": self.name, **self.options} | (
            {} if self.clip is None else {"clip": self.clip}
        )


def optimizers() -> dict[str, Callable[..., optax.GradientTransformation]]:
    """`controlled_adam`, and the optimizers of optax that have a learning rate, by name."""
    names = {
        name: function
        for name, function in _functions()
        if "learning_rate" in inspect.signature(function).parameters
    }
    return {CONTROLLED: controlled_adam, **names}


def schedules() -> dict[str, Callable[..., optax.Schedule]]:
    """The schedules of optax, by name."""
    return {
        name: function for name, function in _functions() if name.endswith(("_schedule", "_decay"))
    }


def _functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public functions of optax, whole transformations only."""
    for name in dir(optax):
        function = getattr(optax, name)
        if isinstance(function, (types.FunctionType, functools.partial)) and not name.startswith(
            ("_", "scale_by_")
        ):
            yield name, function


def _schedule(key: str, fields: Mapping[str, Any]) -> optax.Schedule:
    """The schedule of {name: NAME, option: value, ...} or {NAME: {option: value}}; NAME may omit `_schedule`."""
    field, values = f"optimizer.{key}", dict(fields)
    if "name" in values:
        name = str(values.pop("name"))
    elif len(values) == 1 and isinstance(next(iter(values.values())), Mapping):
        name, values = next((str(name), dict(options)) for name, options in values.items())
    else:
        example = "{name: cosine_decay_schedule, init_value: 0.1, decay_steps: 40}"
        raise ParameterError(
            f"{field} is {describe(fields)}: expected a number, or a schedule such as {example}."
        )
    schedule_functions = schedules()
    full = next(
        (name + ending for ending in _SCHEDULE_ENDINGS if name + ending in schedule_functions), None
    )
    if full is None:
        raise ParameterError(
            f"{field} is the schedule {name!r}: allowed are {', '.join(schedule_functions)}"
            f"{did_you_mean(name, schedule_functions)}"
        )
    # In {10: 0.5}, steps are whole numbers, although every key in a file is a text.
    for option, value in values.items():
        if isinstance(value, Mapping):
            values[option] = {int(step): scale for step, scale in value.items()}
    schedule = _call(field, full, schedule_functions[full], values)
    with jax.ensure_compile_time_eval():  # also if the optimizer is built while a program is traced
        first = np.asarray(schedule(jnp.zeros((), int)))
    if first.shape != () or not np.isfinite(first):
        raise ParameterError(f"{field} starts at {first}: expected a finite number.")
    return schedule


def _call(field: str, name: str, make: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    """`make(**values)`; unknown, missing or unusable arguments are reported in a sentence about `field`."""
    parameters = inspect.signature(make).parameters.values()
    options = {
        parameter.name: parameter
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    for option in values:
        if option not in options:
            allowed = f"{', '.join(options)}{did_you_mean(option, options)}"
            raise ParameterError(
                f"{field}.{option} is not an option of {name}; allowed are {allowed}"
            )
    for option, option_parameter in options.items():
        if option_parameter.default is option_parameter.empty and option not in values:
            raise ParameterError(f"{field} is {name} without {option}: it has no default there.")
    try:
        return make(**values)
    except Exception as error:  # optax raises many kinds of errors about a value
        raise ParameterError(
            f"{field} is {name}, which refuses its options: {_one_line(error)}."
        ) from None


@functools.lru_cache
def _try_out(optimizer: Optimizer) -> None:
    """Update two starts with two parameters twice, because an error would otherwise occur after the first simulation."""
    subject = f"optimizer.name is {optimizer.name!r}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        transformation = optimizer.build()
        point = jnp.array([[0.5, -0.3], [0.1, 0.2]])

        def update(state: Any) -> Any:
            return jax.vmap(
                lambda *arguments: transformation.update(*arguments[:3], value=arguments[3])
            )(jnp.ones_like(point), state, point, point.sum(axis=1))

        try:
            initial_shapes = jax.eval_shape(jax.vmap(transformation.init), point)
            step, final_state = jax.jit(
                lambda: update(update(jax.vmap(transformation.init)(point))[1])
            )()
        except Exception as error:
            raise ParameterError(
                f"{subject}, which does not work from gradients alone: {_one_line(error)}."
            ) from None
    if any(
        jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in jax.tree.leaves(final_state)
    ):
        raise ParameterError(
            f"{subject}, which draws random numbers of its own, and a checkpoint cannot hold them."
        )
    if not np.isfinite(step).all() or initial_shapes != jax.eval_shape(lambda: final_state):
        raise ParameterError(
            f"{subject}, whose steps with these options are {step[0]}: expected finite numbers."
        )


def _one_line(error: Exception) -> str:
    """An exception in one line."""
    return " ".join(str(error).split()).rstrip(".")[:200]


#: Names of all optimizers.
OPTIMIZER_NAMES: Final = (CONTROLLED, *(name for name in optimizers() if name != CONTROLLED))
