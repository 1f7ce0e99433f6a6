"""Custom metrics: declaring, naming, loading and checking pure functions of the sensors."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, Field

from nermo_mjx.control.protocol import Source, function_place, user_code
from nermo_mjx.files import MAX_JSON_BYTES, json_of, read_bytes
from nermo_mjx.robot import LIMBS, ParameterError, RobotConfig, Sensors, load_robot
from nermo_mjx.robot.quantity import did_you_mean
from nermo_mjx.rollout.metric_table import SIDES, Metric
from nermo_mjx.runtime import start_jax
from nermo_mjx.trust import CODE_EXECUTION

#: Reductions of a function's values.
REDUCTIONS: Final = ("mean", "rms", "std", "min", "max", "peak", "range", "last", "integral")
#: What a value is of, and how the values of strides become one number.
PER: Final = ("run", "stride")
ACROSS: Final = ("mean", "std", "cv")
#: How a text names metrics; without a name, all in the file or module.
FORM: Final = "FILE.py, FILE.py:NAME, MODULE or MODULE:NAME"


@dataclasses.dataclass(frozen=True)
class OwnMetric(Metric):
    """A custom metric, created by `metric`; calling it calls the function.

    Attributes:
        name: of the function, and of the column.
        function: from `Sensors` at one time to a number; pure JAX.
        reduce: one of `REDUCTIONS`.
        per: one of `PER`; limb: whose strides, one of `LIMBS`.
        across: one of `ACROSS`, for the values of strides.
    """

    name: str = ""
    function: Callable[[Sensors], Any] = lambda sensors: 0.0
    reduce: str = "mean"
    per: str = "run"
    limb: str = LIMBS[0]
    across: str = "mean"

    def __call__(self, sensors: Sensors) -> Any:
        return self.function(sensors)

    @property
    def place(self) -> str:
        """Location of the function, for messages: `yaw_shake (my_metrics.py:4)`."""
        return function_place(self.name, self.function)


def metric(
    *,
    unit: str,
    better: str | None = None,
    reduce: str = "mean",
    per: str = "run",
    limb: str = LIMBS[0],
    across: str = "mean",
) -> Callable[[Callable[[Sensors], Any]], OwnMetric]:
    """Turn a pure function of the sensors into a metric, for simulators, rollouts, sweeps, tunings and searches.

    >>> @metric(unit="rad/s", better="low", reduce="rms")
    ... def yaw_shake(sensors):
    ...     "Turning of the torso about its own axis."
    ...     return sensors.gyro[2]
    >>> yaw_shake.name, yaw_shake.doc
    ('yaw_shake', 'Turning of the torso about its own axis')

    The function is called with the `Sensors` of one world at one time, in SI units, once per physics step while the run
    is measured, and returns one number. It is compiled: use `jax.numpy` instead of NumPy, `jnp.where` instead of `if`.
    Its name becomes the column's, and the first line of its docstring the column's description.

    Args:
        unit: of the reduced number; "1" for a pure number.
        better: `high`, `low`, `zero` (nearest to zero), or None if no value is better than another.
        reduce: `mean`, `rms` (root mean square), `std`, `min`, `max`, `peak` (largest magnitude), `range` (between the
            extremes), `last` (where measuring ends), or `integral` (over the measured seconds).
        per: `run`, or `stride`: the reduction is that of each stride, from a touch-down of `limb` to its next one.
        limb: whose strides: `front_left`, `front_right`, `rear_left` or `rear_right`.
        across: what of the strides' values is the metric: `mean`, `std` (sample standard deviation), or `cv`
            (coefficient of variation); NaN with fewer than one, and three strides.

    Raises:
        ParameterError: no unit, or an unknown side, reduction, limb...
    """

    def made(function: Callable[[Sensors], Any]) -> OwnMetric:
        name = getattr(function, "__name__", type(function).__name__)
        if not callable(function) or not name.isidentifier():
            raise ParameterError(
                f"metrics has {name}: expected a function with a name, which the column gets."
            )
        doc = (getattr(function, "__doc__", None) or "").strip().partition("\n")[0].rstrip(".")
        custom_metric = OwnMetric(
            unit, doc or f"{reduce} of {name}", better, name, function, reduce, per, limb, across
        )
        if not isinstance(unit, str) or not unit:
            raise ParameterError(
                f"metrics has {custom_metric.place} with the unit {unit!r}: expected a text, such as 'rad/s'."
            )
        choices: dict[str, tuple[str | None, ...]] = {
            "better": (None, *SIDES),
            "reduce": REDUCTIONS,
        }
        choices |= {"per": PER, "limb": LIMBS, "across": ACROSS}
        for field, allowed in choices.items():
            value = getattr(custom_metric, field)
            if value not in allowed:
                hint = did_you_mean(str(value), filter(None, allowed))
                listed = ", ".join(map(str, allowed))
                raise ParameterError(
                    f"metrics has {custom_metric.place} with {field}={value!r}: allowed is {listed}{hint}"
                )
        return custom_metric

    return made


def load_metrics(reference: str) -> tuple[OwnMetric, ...]:
    """The metrics that a text names, in the order of their file; the same objects as long as the file does not change.

    Args:
        reference: `FILE.py`, `FILE.py:NAME`, `MODULE` or `MODULE:NAME`.

    Raises:
        ParameterError: the file, module or name does not exist, cannot be imported, or contains no metric.
        FileError: nothing may be run here, and what says what is in the file is damaged.
    """
    source = source_of(reference)
    name = source.name
    if not CODE_EXECUTION.get() and (declared := _read_only(source)) is not None:
        return declared
    module = source.module()
    metrics_by_name = {
        key: item for key, item in vars(module).items() if isinstance(item, OwnMetric)
    }
    if name in vars(module) and name not in metrics_by_name:
        raise ParameterError(
            f"{source.subject}: {name} is no metric; write @metric(unit=...) above its function."
        )
    if name and name not in metrics_by_name:
        raise source.missing(list(metrics_by_name))
    if not metrics_by_name:
        raise ParameterError(
            f"{source.subject}: it has no metric; write @metric(unit=...) above a function."
        )
    return tuple(item for key, item in metrics_by_name.items() if name in ("", key))


#: The file beside a directory's copies of metrics that says what is in them: whoever only reads does not run these.
METRICS_FILE: Final = "metrics.json"


class _Kept(BaseModel, extra="forbid"):
    """A metric in `KEPT`."""

    name: Annotated[str, Field(pattern=r"^[^\W\d]\w*$")]
    unit: str
    doc: str
    better: Literal["high", "low", "zero"] | None


def kept_metrics(references: Iterable[str]) -> bytes:
    """The content of `KEPT`: digest of a file -> name, unit, meaning and side of each metric in it that is named."""
    metrics_by_file: dict[str, list[dict[str, Any]]] = {}
    for reference in (
        candidate for candidate in references if source_of(candidate).place.endswith(".py")
    ):
        metrics_by_file.setdefault(_digest_of_file(source_of(reference)), []).extend(
            {field: getattr(candidate, field) for field in _Kept.model_fields}
            for candidate in load_metrics(reference)
        )
    return (json.dumps(metrics_by_file, indent=2) + "\n").encode()


def _read_only(source: Source) -> tuple[OwnMetric, ...] | None:
    """What is known of a file's metrics without running it; None if nothing is."""
    path = Path(source.place).with_name(METRICS_FILE)
    if not source.place.endswith(".py") or not path.exists():
        return None
    several = json_of(read_bytes(path, MAX_JSON_BYTES), dict[str, list[_Kept]], path).get(
        _digest_of_file(source)
    )
    if several is None:
        return None
    metrics = [OwnMetric(**fields, function=lambda sensors: sensors.gyro[0]) for fields in several]
    return tuple(
        custom_metric for custom_metric in metrics if source.name in ("", custom_metric.name)
    )


def _digest_of_file(source: Source) -> str:
    return hashlib.sha256(source.content()[1]).hexdigest()


def metrics_digest(reference: str) -> str:
    """A hash of the names of metrics and of the file that defines them; not of what that file imports.

    Raises:
        ParameterError: see `load_metrics`.
    """
    return source_of(reference).digest(
        *(custom_metric.name for custom_metric in load_metrics(reference))
    )


def source_of(where: str) -> Source:
    """The file or module of a text that names metrics, and the name in it.

    Raises:
        ParameterError: the text has another form.
    """
    return Source.named("metrics has", where, FORM)


@functools.lru_cache(maxsize=32)
def check_metrics(config: RobotConfig, metrics: tuple[OwnMetric, ...]) -> None:
    """Reject functions that cannot be compiled, or do not return one finite number, before anything is simulated.

    They are called with the readings of the robot at rest: no forces, no velocities.

    Args:
        config: of the robot.
        metrics: all of them.

    Raises:
        ParameterError: names the function, its file and what is wrong.
    """
    for custom_metric in metrics:
        numbers_at_rest(
            f"metrics has {custom_metric.place}", custom_metric.function, at_rest(config)
        )


def at_rest(config: RobotConfig) -> Sensors:
    """The readings of a robot at rest: no forces, no velocities."""
    start_jax()
    robot = load_robot(config)
    with jax.ensure_compile_time_eval():
        reading = np.asarray(robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0)))
        return robot.sensors(jnp.asarray(reading))


def numbers_at_rest(
    subject: str, function: Callable[[Any], Any], argument: Any, *, several: bool = False
) -> np.ndarray:
    """What an own function gives for a robot at rest, `given`; `subject` begins messages.

    Raises:
        ParameterError: it cannot be compiled, or gives something else than one finite number, or with `several` a list.
    """
    with user_code(f"{subject}, which fails"):
        result = jax.jit(function)(argument)
    number = isinstance(result, jax.Array) and not jnp.issubdtype(result.dtype, jnp.complexfloating)
    if not number or result.ndim > several or not result.size:
        expected = "one number, or several in one axis" if several else "one number"
        raise ParameterError(f"{subject}, which gives {described(result)}: expected {expected}.")
    values = np.asarray(result, float)
    if not np.isfinite(values).all():
        wrong = f"{float(values):g}" if not values.ndim else values.tolist()
        raise ParameterError(
            f"{subject}, which gives {wrong} for a robot at rest, where forces and velocities are 0: guard it, as by "
            "jnp.where."
        )
    return np.asarray(result)


def described(value: Any) -> str:
    """What a function gave, in words."""
    shape = getattr(value, "shape", None)
    if shape == ():
        return f"one number of type {value.dtype}"
    return f"an array of shape {shape}" if shape else type(value).__name__
