"""Adam with a controlled rate, a line search, or any optax optimizer by name, with its options and schedules by name;
tried out before anything expensive starts."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.specs.reading import describe
from nermo_mjx.tune.controlled_adam import controlled_adam
from nermo_mjx.tune.line_search import LineSearch

#: The optimizer with an automatic learning rate, which uses the objective's value.
CONTROLLED: Final = "controlled_adam"
#: The one that tries points along the gradient (`nermo_mjx.tune.line_search`).
LINE: Final = "line_search"
#: The default learning rate of an optimizer, in coordinates u (`nermo_mjx.tune.bounds`) per step.
LEARNING_RATE: Final = 0.1
_SCHEDULE_ENDINGS: Final = ("", "_schedule", "_decay_schedule")


@dataclasses.dataclass(frozen=True)
class Optimizer:
    """An optimizer by name; hashable, so that it is static in compiled programs.

    Attributes:
        name: `controlled_adam` (`nermo_mjx.tune.controlled_adam`), `line_search` (`nermo_mjx.tune.line_search`), or of
            a function of optax that has a learning rate: `adam`, `sgd`, `lion`, ...
        options: keyword arguments of that function. A schedule is written as
            {name: cosine_decay_schedule, option: value}, or as {cosine: {option: value}}.
        clip: a longer gradient (2-norm over the parameters of one start) is clipped to this norm; None: no clipping.

    Raises:
        ParameterError: an unknown name or option, or one that does not work; the message starts with the field
            (`optimizer.name`, `optimizer.learning_rate`, ...) and is one sentence.
    """

    name: str = CONTROLLED
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    clip: float | None = None

    def __post_init__(self) -> None:
        if self.name not in (CONTROLLED, LINE) and "learning_rate" not in self.options:
            object.__setattr__(self, "options", {"learning_rate": LEARNING_RATE, **self.options})
        if self.clip is not None and not 0.0 < self.clip < float("inf"):
            raise ParameterError(f"optimizer.clip is {self.clip:g}: allowed is (0, inf).")
        if not self.searches:
            _try_out(self)
            return
        if self.clip is not None:
            raise ParameterError("optimizer.clip is not read by line_search, which uses a gradient's direction alone.")
        self.line_search()

    def __hash__(self) -> int:
        return hash((self.name, *sorted(self.options), self.clip))

    @property
    def reads_values(self) -> bool:
        """Whether it uses objective values, so that it can react to a fall."""
        return self.name == CONTROLLED

    @property
    def searches(self) -> bool:
        """Whether it is the line search."""
        return self.name == LINE

    def line_search(self) -> LineSearch:
        """The line search with these options."""
        search: LineSearch = _call("optimizer", self.name, LineSearch, self.options)
        return search

    def init(self, u: Float[Array, " p"]) -> Any:
        """The state at the beginning from the vector u of one start."""
        return self.line_search().init(u) if self.searches else self.build().init(u)

    def build(self) -> optax.GradientTransformationExtraArgs:
        """The pair of pure functions `init` and `update`, for the vector u of one start; `update` is given `value`."""
        make = optimizers().get(self.name)
        if make is None:
            raise ParameterError(f"optimizer.name is {self.name!r}: allowed are {', '.join(NAMES)}"
                                 f"{did_you_mean(self.name, NAMES)}")  # fmt: skip
        values = {key: _schedule(key, value) if isinstance(value, Mapping) else value
                  for key, value in self.options.items()}  # fmt: skip
        chosen = _call("optimizer", self.name, make, values)
        chosen = chosen if self.clip is None else optax.chain(optax.clip_by_global_norm(self.clip), chosen)
        return optax.with_extra_args_support(chosen)

    def written(self) -> dict[str, Any]:
        """As written in a tuning file."""
        return {"name": self.name, **self.options} | ({} if self.clip is None else {"clip": self.clip})


def optimizers() -> dict[str, Callable[..., optax.GradientTransformation]]:
    """`controlled_adam`, and the optimizers of optax that have a learning rate, by name."""
    known = {name: each for name, each in _functions() if "learning_rate" in inspect.signature(each).parameters}
    return {CONTROLLED: controlled_adam, **known}


def schedules() -> dict[str, Callable[..., optax.Schedule]]:
    """The schedules of optax, by name."""
    return {name: each for name, each in _functions() if name.endswith(("_schedule", "_decay"))}


def _functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public functions of optax, whole transformations only."""
    for name in dir(optax):
        each = getattr(optax, name)
        if isinstance(each, (types.FunctionType, functools.partial)) and not name.startswith(("_", "scale_by_")):
            yield name, each


def _schedule(key: str, written: Mapping[str, Any]) -> optax.Schedule:
    """The schedule of {name: NAME, option: value, ...} or {NAME: {option: value}}; NAME may lack its ending."""
    field, values = f"optimizer.{key}", dict(written)
    if "name" in values:
        name = str(values.pop("name"))
    elif len(values) == 1 and isinstance(next(iter(values.values())), Mapping):
        name, values = next((str(name), dict(options)) for name, options in values.items())
    else:
        raise ParameterError(f"{field} is {describe(written)}: expected a number, or a schedule such as "
                             "{name: cosine_decay_schedule, init_value: 0.1, decay_steps: 40}.")  # fmt: skip
    known = schedules()
    full = next((name + ending for ending in _SCHEDULE_ENDINGS if name + ending in known), None)
    if full is None:
        raise ParameterError(
            f"{field} is the schedule {name!r}: allowed are {', '.join(known)}{did_you_mean(name, known)}"
        )
    # {10: 0.5}: steps are whole numbers, though every key of a file is a text.
    values = {option: {int(step): scale for step, scale in value.items()} if isinstance(value, Mapping) else value
              for option, value in values.items()}  # fmt: skip
    schedule = _call(field, full, known[full], values)
    with jax.ensure_compile_time_eval():  # a program that is traced builds its optimizer, too
        first = np.asarray(schedule(jnp.zeros((), int)))
    if first.shape != () or not np.isfinite(first):
        raise ParameterError(f"{field} starts at {first}: expected a finite number.")
    return schedule


def _call(field: str, name: str, make: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    """`make(**values)`; what it does not know, lacks or cannot use is a sentence about `field`."""
    options = [option for option, about in inspect.signature(make).parameters.items()
               if about.kind in (about.POSITIONAL_OR_KEYWORD, about.KEYWORD_ONLY)]  # fmt: skip
    for option in values:
        if option not in options:
            raise ParameterError(f"{field}.{option} is not an option of {name}; allowed are {', '.join(options)}"
                                 f"{did_you_mean(option, options)}")  # fmt: skip
    for option, about in inspect.signature(make).parameters.items():
        if about.default is about.empty and option in options and option not in values:
            raise ParameterError(f"{field} is {name} without {option}: it has no default there.")
    try:
        return make(**values)
    except Exception as error:  # whatever optax says about a value
        raise ParameterError(f"{field} is {name}, which refuses its options: {_line(error)}.") from None


@functools.lru_cache
def _try_out(optimizer: Optimizer) -> None:
    """Two updates of two starts with two parameters: what fails here would fail after the first simulation."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chosen = optimizer.build()
        point = jnp.array([[0.5, -0.3], [0.1, 0.2]])

        def updated(state: Any) -> Any:
            return jax.vmap(lambda *given: chosen.update(*given[:3], value=given[3]))(
                jnp.ones_like(point), state, point, point.sum(axis=1)
            )

        try:
            before = jax.eval_shape(jax.vmap(chosen.init), point)
            step, after = jax.jit(lambda: updated(updated(jax.vmap(chosen.init)(point))[1]))()
        except Exception as error:
            raise ParameterError(f"optimizer.name is {optimizer.name!r}, which does not work from gradients alone: "
                                 f"{_line(error)}.") from None  # fmt: skip
    if any(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in jax.tree.leaves(after)):
        raise ParameterError(f"optimizer.name is {optimizer.name!r}, which draws random numbers of its own, and a "
                             "checkpoint cannot hold them: let the estimator make the noise.")  # fmt: skip
    if not np.isfinite(step).all() or before != jax.eval_shape(lambda: after):
        raise ParameterError(f"optimizer.name is {optimizer.name!r}, whose steps with these options are {step[0]}: "
                             "expected finite numbers.")  # fmt: skip


def _line(error: Exception) -> str:
    """An exception in one line."""
    return " ".join(str(error).split()).rstrip(".")[:200]


#: Names of all optimizers.
NAMES: Final = (CONTROLLED, LINE, *(name for name in optimizers() if name != CONTROLLED))
