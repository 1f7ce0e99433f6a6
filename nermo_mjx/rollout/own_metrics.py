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
from nermo_mjx.runtime import start_jax
from nermo_mjx.trust import CODE_EXECUTION

# ---
# The built-in metrics of every run: name, unit, meaning, and which direction is better.


ANGLES: Final = ("roll", "pitch", "yaw")
#: Pairs of feet, and their indices in `LIMBS`.
PAIRS: Final = {"front": slice(0, 2), "rear": slice(2, 4)}


#: Better directions of a metric, and the word of summaries and figures for each.
SIDES: Final = {"high": "max", "low": "min", "zero": "nearest zero"}


@dataclasses.dataclass(frozen=True)
class Metric:
    """Unit and meaning of a metric, and which direction is better: one of `SIDES`, or None if none is."""

    unit: str
    doc: str
    better: str | None = None


METRICS: Final[dict[str, Metric]] = {
    "speed": Metric("m/s", "distance over duration", "high"),
    "distance": Metric(
        "m", "way along the pilot's path, or along the smoothed heading, while measured"
    ),
    "duration": Metric("s", "time measured"),
    "lateral_drift": Metric(
        "m", "displacement along x, left of the straight pilot's line, while measured", "zero"
    ),
    **{
        f"{angle}_{statistic}": Metric("rad", f"{statistic} of the torso's {angle}", better)
        for angle in ANGLES
        for statistic, better in (("mean", None), ("std", "low"), ("min", None), ("max", None))
    },
    **{
        f"head_{angle}_{statistic}": Metric("rad", f"{statistic} of the head's {angle}", better)
        for angle in ("pitch", "yaw")
        for statistic, better in (("mean", None), ("std", "low"))
    },
    "picture_motion": Metric(
        "rad/s", "speed of far things across the eyes' pictures, root mean square", "low"
    ),
    "cross_track_peak": Metric(
        "m", "largest distance from the pilot's path; NaN for a pilot without one", "low"
    ),
    "cross_track_rms": Metric(
        "m", "root mean square of the distance from the pilot's path; NaN without a path", "low"
    ),
    "cross_track_walked": Metric(
        "m", "largest distance of a gait cycle's mean position from the pilot's path", "low"
    ),
    "cross_track_noise": Metric(
        "m", "sway: root mean square of that distance about each gait cycle's mean", "low"
    ),
    "turning_radius": Metric(
        "m", "radius of the circle fitted to the cycles' mean positions; NaN if straight"
    ),
    "turn_rate": Metric("rad/s", "yaw gained over duration, positive to the left"),
    "slip": Metric("m/s", "mean horizontal speed of loaded feet", "low"),
    **{
        f"slip_{limb}": Metric("m/s", f"the same of the {limb.replace('_', ' ')} foot", "low")
        for limb in LIMBS
    },
    **{
        f"duty_{limb}": Metric("1", f"share of time with the {limb.replace('_', ' ')} foot loaded")
        for limb in LIMBS
    },
    **{
        f"loaded_{pair}": Metric("1", f"share of time with a {pair} foot loaded, mean of the pair")
        for pair in PAIRS
    },
    **{
        f"swing_loaded_{pair}": Metric(
            "1", f"share of its commanded swing with a {pair} foot loaded, mean of the pair"
        )
        for pair in PAIRS
    },
    "strides": Metric(
        "1", "whole strides measured, touch-down to touch-down, of the foot that made the fewest"
    ),
    "stride_length": Metric("m", "way of the torso in a stride, mean of all feet's"),
    "stride_length_cv": Metric(
        "1", "standard deviation over mean of a foot's strides, of three or more", "low"
    ),
    "stride_time": Metric("s", "from touch-down to touch-down, mean of all feet's strides"),
    "stance_time": Metric("s", "time of a stride with its foot loaded, mean of all feet's strides"),
    "duty_factor": Metric("1", "as walked: stance time over stride time"),
    **{
        f"load_{limb}": Metric("N", f"mean force on the {limb.replace('_', ' ')} foot")
        for limb in LIMBS
    },
    "front_load_share": Metric("1", "share of the front feet in the load of all feet"),
    "tail_time": Metric("1", "share of time with the tail loaded"),
    "tail_load_share": Metric("1", "share of the tail in the load of feet and tail"),
    "servo_work": Metric("J", "positive mechanical work of all servos while measured", "low"),
    "servo_net_work": Metric(
        "J", "mechanical work of all servos while measured, less what they take back"
    ),
    "servo_damper_work": Metric(
        "J", "work that the dampers of the servos' joints take of it", "low"
    ),
    "joint_damper_work": Metric(
        "J", "work that the dampers of knees, ankles, spine and tail take of it"
    ),
    "constraint_work": Metric("J", "what is left of it: taken by contact and tendons, or stored"),
    **{
        f"limited_{group}": Metric(
            "1", f"share of time with the torque of the {group.replace('_', ' ')} at its limit"
        )
        for group in ("front_hips", "rear_hips", "front_knees", "rear_knees", "spine")
    },
    "cost_of_transport": Metric("1", "servo work over weight and distance; NaN below 1 mm", "low"),
    "motor_current": Metric(
        "A", "mean current in the motors of all servos, by their torque", "low"
    ),
    "servo_current": Metric("A", "mean current that all servos draw from the battery", "low"),
    "electrical_power": Metric("W", "mean electrical power of all servos", "low"),
    "electrical_cost_of_transport": Metric(
        "1", "electrical energy of all servos over weight and distance; NaN below 1 mm", "low"
    ),
    "charge": Metric("C", "drawn by all servos while measured", "low"),
    "battery_time": Metric("s", "time in which servos and electronics empty the battery", "high"),
    "servo_clamped": Metric(
        "1", "share of time with a servo asked for an angle beyond its range", "low"
    ),
    "airborne_time": Metric("1", "share of time without any contact"),
    "penetration": Metric("m", "depth of the deepest contact since the start", "low"),
    "sunk_time": Metric("1", "share of time with a contact deeper than the sole is thick", "low"),
    "fell": Metric("1", "1 if the torso tilted past 60 degrees or came to the ground", "low"),
    "diverged": Metric("1", "1 if the simulation lost its numbers", "low"),
    "failure_time": Metric(
        "s", "end of the first control tick in which it fell or diverged; NaN if it did neither"
    ),
}

#: The headings of lists of metrics, by the first metric below each.
HEADINGS: Final = {
    "speed": "Walk",
    "roll_mean": "Attitude",
    "head_pitch_mean": "Head and eyes",
    "cross_track_peak": "Path",
    "slip": "Feet",
    "servo_work": "Energy",
    "servo_clamped": "Checks",
}


def headed() -> dict[str, str]:
    """The heading of each built-in metric.

    >>> headed()["roll_std"], headed()["electrical_cost_of_transport"]
    ('Attitude', 'Energy')
    """
    found, heading = {}, ""
    for name in METRICS:
        found[name] = heading = HEADINGS.get(name, heading)
    return found


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
        found = OwnMetric(
            unit, doc or f"{reduce} of {name}", better, name, function, reduce, per, limb, across
        )
        if not isinstance(unit, str) or not unit:
            raise ParameterError(
                f"metrics has {found.place} with the unit {unit!r}: expected a text, such as 'rad/s'."
            )
        choices: dict[str, tuple[str | None, ...]] = {
            "better": (None, *SIDES),
            "reduce": REDUCTIONS,
        }
        choices |= {"per": PER, "limb": LIMBS, "across": ACROSS}
        for field, allowed in choices.items():
            value = getattr(found, field)
            if value not in allowed:
                hint = did_you_mean(str(value), filter(None, allowed))
                listed = ", ".join(map(str, allowed))
                raise ParameterError(
                    f"metrics has {found.place} with {field}={value!r}: allowed is {listed}{hint}"
                )
        return found

    return made


def load_metrics(where: str) -> tuple[OwnMetric, ...]:
    """The metrics that a text names, in the order of their file; the same objects as long as the file does not change.

    Args:
        where: `FILE.py`, `FILE.py:NAME`, `MODULE` or `MODULE:NAME`.

    Raises:
        ParameterError: the file, module or name does not exist, cannot be imported, or contains no metric.
        FileError: nothing may be run here, and what says what is in the file is damaged.
    """
    source = source_of(where)
    name = source.name
    if not CODE_EXECUTION.get() and (known := _read_only(source)) is not None:
        return known
    module = source.module()
    found = {key: each for key, each in vars(module).items() if isinstance(each, OwnMetric)}
    if name in vars(module) and name not in found:
        raise ParameterError(
            f"{source.subject}: {name} is no metric; write @metric(unit=...) above its function."
        )
    if name and name not in found:
        raise source.missing(list(found))
    if not found:
        raise ParameterError(
            f"{source.subject}: it has no metric; write @metric(unit=...) above a function."
        )
    return tuple(each for key, each in found.items() if name in ("", key))


#: The file beside a directory's copies of metrics that says what is in them: whoever only reads does not run these.
KEPT: Final = "metrics.json"


class _Kept(BaseModel, extra="forbid"):
    """A metric in `KEPT`."""

    name: Annotated[str, Field(pattern=r"^[^\W\d]\w*$")]
    unit: str
    doc: str
    better: Literal["high", "low", "zero"] | None


def kept_metrics(named: Iterable[str]) -> bytes:
    """The content of `KEPT`: digest of a file -> name, unit, meaning and side of each metric in it that is named."""
    found: dict[str, list[dict[str, Any]]] = {}
    for where in (each for each in named if source_of(each).place.endswith(".py")):
        found.setdefault(_digest_of_file(source_of(where)), []).extend(
            {field: getattr(each, field) for field in _Kept.model_fields}
            for each in load_metrics(where)
        )
    return (json.dumps(found, indent=2) + "\n").encode()


def _read_only(source: Source) -> tuple[OwnMetric, ...] | None:
    """What is known of a file's metrics without running it; None if nothing is."""
    path = Path(source.place).with_name(KEPT)
    if not source.place.endswith(".py") or not path.exists():
        return None
    several = json_of(read_bytes(path, MAX_JSON_BYTES), dict[str, list[_Kept]], path).get(
        _digest_of_file(source)
    )
    if several is None:
        return None
    found = [OwnMetric(**about, function=lambda sensors: sensors.gyro[0]) for about in several]
    return tuple(each for each in found if source.name in ("", each.name))


def _digest_of_file(source: Source) -> str:
    return hashlib.sha256(source.content()[1]).hexdigest()


def metrics_digest(where: str) -> str:
    """A hash of the names of metrics and of the file that defines them; not of what that file imports.

    Raises:
        ParameterError: see `load_metrics`.
    """
    return source_of(where).digest(*(each.name for each in load_metrics(where)))


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
    for each in metrics:
        numbers_at_rest(f"metrics has {each.place}", each.function, at_rest(config))


def at_rest(config: RobotConfig) -> Sensors:
    """The readings of a robot at rest: no forces, no velocities."""
    start_jax()
    robot = load_robot(config)
    with jax.ensure_compile_time_eval():
        reading = np.asarray(robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0)))
        return robot.sensors(jnp.asarray(reading))


def numbers_at_rest(
    subject: str, function: Callable[[Any], Any], given: Any, *, several: bool = False
) -> np.ndarray:
    """What an own function gives for a robot at rest, `given`; `subject` begins messages.

    Raises:
        ParameterError: it cannot be compiled, or gives something else than one finite number, or with `several` a list.
    """
    with user_code(f"{subject}, which fails"):
        found = jax.jit(function)(given)
    number = isinstance(found, jax.Array) and not jnp.issubdtype(found.dtype, jnp.complexfloating)
    if not number or found.ndim > several or not found.size:
        expected = "one number, or several in one axis" if several else "one number"
        raise ParameterError(f"{subject}, which gives {described(found)}: expected {expected}.")
    values = np.asarray(found, float)
    if not np.isfinite(values).all():
        wrong = f"{float(values):g}" if not values.ndim else values.tolist()
        raise ParameterError(
            f"{subject}, which gives {wrong} for a robot at rest, where forces and velocities are 0: guard it, as by "
            "jnp.where."
        )
    return np.asarray(found)


def described(given: Any) -> str:
    """What a function gave, in words."""
    shape = getattr(given, "shape", None)
    if shape == ():
        return f"one number of type {given.dtype}"
    return f"an array of shape {shape}" if shape else type(given).__name__
