"""Gait metrics, accumulated during the run: `init` and `update` for one world, and `result` at the end.

Angles are defined in `attitude`. Measuring starts after the warm-up and stops at the end of the run, at the end of the
gait cycle in which the requested distance is covered, or when the robot falls or diverges; measurements until then are
kept. A fall or a divergence counts only during the warm-up and the measured run: how long a world continues after that
depends on the others in its batch.

The warm-up and the run end between two ticks: a tick is weighted by its measured part, positions are interpolated
linearly within a tick, and other readings are constant over the tick before them. So every metric is continuous in both
ends, and its derivatives are finite. Discrete events are not differentiable: the gait cycle in which the distance is
covered, a fall, a divergence.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.control.path import PathPoint
from nermo_mjx.kinematics.body import attitude, uprightness
from nermo_mjx.robot import LIMBS, ModelParameters, Sensors
from nermo_mjx.robot.model_parameters import Servo
from nermo_mjx.rollout import (
    electrical,
    eye_metrics,
    path_metrics,
    reduction,
    stride_metrics,
    transitions,
)
from nermo_mjx.rollout.custom_metrics import OwnMetric
from nermo_mjx.rollout.metric_table import ANGLES, METRICS, PAIRS, TRANSITION
from nermo_mjx.rollout.path_metrics import MeasuredPart, begins_in_run, measured_part, root
from nermo_mjx.rollout.setup import Window
from nermo_mjx.shapes import Array, Scalar, Truth

#: A foot is unloaded below the first force and loaded above the second [N], with a smooth transition. 3 % of
#: the robot's weight on one foot of four, which is halfway, is far below any stance.
LOADED: Final = (0.01, 0.03)
#: Loads and times below this count as zero [N s, s].
SHORTEST_LOAD: Final = 1e-6
#: Below this distance the cost of transport is undefined [m].
SHORTEST_WAY: Final = 1e-3
#: The robot has fallen when its torso tilts by more than 60 degrees or its IMU comes this near to the ground [m].
FALLEN_COSINE: Final = 0.5
FALLEN_HEIGHT: Final = 0.025
#: Speed above which the simulation counts as diverged [m/s].
DIVERGED_SPEED: Final = 50.0
#: Thickness of the sole [m]. A contact that is deeper for more than this share of the time, or ever deeper than that
#: [m], is none of a sole any more.
SUNK: Final = 0.004
SUNK_TIME: Final = 0.05
DEEPEST: Final = 0.006
#: Share of time without a contact from which a run is no walk.
FLOATED: Final = 0.5
GRAVITY: Final = 9.81
#: Integrals over the measured time of one number: of times [s], work and energy [J], the torque of motors [N m s], the
#: squared error [m^2 s] and speed of the image [rad^2/s]. Others are of the feet: times [s], ways [m], forces [N s].
SUMS: Final = (
    "work",
    "tail_loaded",
    "clamped",
    "airborne",
    "sunk",
    "square_error",
    "image",
    *electrical.DRAWN,
)


class Ending(enum.Enum):
    """How a world's run ended: tables contain a member's name, and its value is the sentence for it.

    >>> Ending["fell"].value
    'The robot fell.'
    """

    ok = "The robot walked to the end."
    fell = "The robot fell."
    diverged = "The simulation diverged."
    sank = "The robot sank in by more than the sole's thickness of 4 mm for a twentieth of the time, or by 6 mm once."
    floated = "The robot touched nothing for more than half of the time."
    unsolved = "The constraint solver stopped short in more than one step of a thousand: the numbers are rough."


def endings(table: Mapping[str, np.ndarray], unsolved: np.ndarray) -> np.ndarray:
    """The name of each world's `Ending` (n,), from its metrics; the most severe one if there are several."""
    flags = {
        Ending.diverged: table["diverged"] > 0,
        Ending.fell: table["fell"] > 0,
        Ending.sank: (table["penetration"] > DEEPEST) | (table["sunk_time"] > SUNK_TIME),
        Ending.floated: table["airborne_time"] > FLOATED,
        Ending.unsolved: unsolved,
    }
    return np.select(list(flags.values()), [ending.name for ending in flags], Ending.ok.name)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MetricState:
    """Accumulators of one world.

    Attributes:
        time, way: measured time [s], distance along the smoothed heading [m].
        travelled: distance since the start, including the warm-up [m].
        sums: integrals over the measured time, by name; `update` has their integrands.
        mean, square: Welford's running mean and sum of squared deviations of (roll, pitch, yaw).
        readings: (roll, pitch, yaw, cross-track error) at the last tick [rad, m]; yaw is unwrapped.
        low, high: extremes of the readings.
        course, turning: smoothed yaw [rad] and its rate [rad/s].
        position: IMU at the last tick; origin, end: positions where measuring began and ended, (3,) each.
        heading: yaw where measuring began and ended (2,) [rad].
        path: how the path was followed.
        eyes: motion of the eyes.
        penetration: depth of the deepest contact since the start [m].
        driven: how servos and compliant joints moved in the last step.
        own: accumulators of custom metrics of the run; None without any.
        strides: of the feet, with the custom metrics of a stride.
        switching_roll: largest roll while switches act [rad]; None without a schedule.
        on_path: whether the pilot has a path.
        lost: whether the readings have become invalid, including after the run's end.
        failure_time: end of the tick in which the run failed [s]; 0 until then.
        fell, diverged, begun, finished: flags of the run.
    """

    time: Scalar
    way: Scalar
    travelled: Scalar
    sums: dict[str, Array]
    mean: Float[Array, " 3"]
    square: Float[Array, " 3"]
    readings: Float[Array, " 4"]
    low: Float[Array, " 4"]
    high: Float[Array, " 4"]
    course: Scalar
    turning: Scalar
    position: Float[Array, " 3"]
    origin: Float[Array, " 3"]
    end: Float[Array, " 3"]
    heading: Float[Array, " 2"]
    path: path_metrics.PathState
    eyes: eye_metrics.EyeState
    penetration: Scalar
    driven: electrical.Driven
    own: reduction.OwnState | None
    strides: stride_metrics.StrideState
    switching_roll: Scalar | None
    on_path: Truth
    lost: Truth
    failure_time: Scalar
    fell: Truth
    diverged: Truth
    begun: Truth
    finished: Truth


def init(
    sensors: Sensors, custom: tuple[OwnMetric, ...] = (), switches: bool = False
) -> MetricState:
    """Accumulators before the first tick, from the readings at rest, with those of custom metrics and of switches."""
    position, angles = sensors.position, attitude(sensors.orientation)
    zero = jnp.zeros((), position.dtype)
    three = jnp.zeros_like(position)
    four = jnp.zeros_like(sensors.foot_force)
    readings = jnp.append(angles, zero)
    no = jnp.zeros((), bool)
    sums = dict.fromkeys(SUMS, zero) | dict.fromkeys(
        ("loaded", "slid", "swing", "swing_loaded"), four
    )
    if switches:
        sums |= dict.fromkeys(("switching_slid", "switching_loaded"), zero)
        sums |= dict.fromkeys(("switching_time", "switching_way"), jnp.zeros(3, zero.dtype))
    return MetricState(
        time=zero,
        way=zero,
        travelled=zero,
        sums=sums
        | {"load": jnp.append(four, zero)}
        | electrical.unspent(zero.dtype, sensors.joint_velocity.shape[-1]),
        mean=three,
        square=three,
        readings=readings,
        low=readings + jnp.inf,
        high=readings - jnp.inf,
        course=angles[2],
        turning=zero,
        position=position,
        origin=position,
        end=position,
        heading=jnp.stack([angles[2], angles[2]]),
        path=path_metrics.init_path(position),
        eyes=eye_metrics.init_eye(sensors),
        penetration=zero,
        driven=_driven(sensors),
        own=reduction.init_own(runs, sensors) if (runs := per(custom, "run")) else None,
        strides=stride_metrics.init_strides(per(custom, "stride"), sensors),
        switching_roll=zero if switches else None,
        on_path=no,
        lost=no,
        failure_time=zero,
        fell=no,
        diverged=no,
        begun=no,
        finished=no,
    )


class Tick(NamedTuple):
    """A control tick, as the metrics measure it.

    Attributes:
        sensors: Readings of the physics steps of the tick, leading axis (steps,).
        time: Time at the end of the tick [s]; 0 at the first one, whose readings are those at rest.
        dt: Length of the tick [s].
        cycle_rate: Gait cycles per simulated second, the bandwidth of the smoothed heading [rad/s].
        path: Point of the pilot's path next to the torso, if the pilot follows a path.
        stance: Feet in planned contact during the tick; all of them if nothing is planned.
        ground: Height of the ground beneath the torso [m].
        brake: Brake of the servos by their back-EMF (`Servo.brake`); None for servos without.
        servo: Parameters of the servos.
        clamped: 1 if the controller asked a servo for an angle beyond its range, else 0.
        transition: Times at which the transition begins and ends [s], with a schedule.
    """

    sensors: Sensors
    time: Scalar
    dt: float
    cycle_rate: Any
    path: PathPoint | None = None
    stance: Bool[Array, " 4"] | None = None
    ground: Any = 0.0
    brake: Any = None
    servo: Servo = ModelParameters().servo
    clamped: Any = 0.0
    transition: tuple[Scalar, Scalar] | None = None


# Long because each sum of a control tick is one statement.
def update(
    window: Window, state: MetricState, tick: Tick, custom: tuple[OwnMetric, ...] = ()
) -> MetricState:
    """Add one control tick.

    Args:
        window: Time in which metrics are measured.
        state: Accumulators so far.
        tick: Tick to add.
        custom: Custom metrics, the same as for `init`.
    """
    is_lost, tick = _without_invalid(state, tick)
    sensors, time, dt, rate, path = tick.sensors, tick.time, tick.dt, tick.cycle_rate, tick.path
    last = jax.tree.map(lambda leaf: leaf[-1], sensors)
    failure = _failure(window, state, tick, last, is_lost)

    angles = attitude(last.orientation)
    turns = jnp.round((angles[2] - state.readings[2]) / (2 * jnp.pi))
    angles = angles.at[2].add(-2 * jnp.pi * turns)
    course, turning = _course(state, tick, angles[2], is_lost)
    ahead = jnp.stack([jnp.sin(course), -jnp.cos(course)]) if path is None else path.tangent
    step = jnp.where(is_lost, 0.0, (last.position - state.position)[:2] @ ahead)
    travelled = state.travelled + step

    goes_on, far_enough = (
        ~(failure["fell"] | is_lost | state.finished),
        travelled >= window.distance,
    )
    part = measured_part(window, state.time, state.path.cycles, time, dt, rate, goes_on, far_enough)
    share = jnp.where(state.begun, part.weight / jnp.where(state.begun, part.elapsed, 1.0), 1.0)
    deviation = angles - state.mean
    mean = state.mean + share * deviation
    error = jnp.zeros(()) if path is None else jnp.where(is_lost, 0.0, path.error)
    readings = jnp.append(angles, error)
    low, high = _extremes(state, readings, part)
    loaded, slid = _contact(sensors)
    integrals = _integrals(state, tick, part.weight, error, loaded, slid)
    switching, roll = _switching(state, tick, part.weight, slid, loaded, step / dt, angles[0])
    ends = _ends(state, last.position, angles[2], part)
    displacement = (last.position - ends["origin"])[:2]
    is_counted = ~is_lost & (time > 0.0)
    return MetricState(
        time=part.elapsed,
        way=state.way + part.weight / dt * step,
        travelled=travelled,
        sums={name: state.sums[name] + value for name, value in (integrals | switching).items()},
        mean=mean,
        square=state.square + part.weight * deviation * (angles - mean),
        readings=readings,
        low=low,
        high=high,
        course=course,
        turning=turning,
        position=jnp.where(is_lost, state.position, last.position),
        path=path_metrics.update_path(
            state.path, displacement, error, part.weight, part.rest, part.cycle_ends
        ),
        eyes=eye_metrics.update_eye(state.eyes, last, part.weight, share),
        driven=_driven(last),
        own=None
        if state.own is None
        else reduction.update_own(per(custom, "run"), state.own, sensors, part, share, is_counted),
        strides=stride_metrics.update_strides(
            per(custom, "stride"), state.strides, sensors, loaded, step / dt, part, rate, is_counted
        ),
        switching_roll=roll,
        on_path=jnp.asarray(path is not None),
        lost=is_lost,
        begun=state.begun | part.inside,
        finished=state.finished | part.arrived,
        **failure,
        **ends,
    )


def _failure(
    window: Window, state: MetricState, tick: Tick, last: Sensors, lost: Truth
) -> dict[str, Any]:
    """Falls, divergence and penetration so far, as fields of `MetricState`; `last` are the last readings."""
    fallen = (uprightness(last.orientation) < FALLEN_COSINE) | (
        last.position[2] - tick.ground < FALLEN_HEIGHT
    )
    ended = state.fell | state.diverged | state.finished
    judged = ~ended & begins_in_run(window, tick.time, tick.dt)
    deepest = jnp.maximum(state.penetration, -tick.sensors.contact_distance.min())
    return {
        "fell": state.fell | (judged & fallen & ~lost),
        "diverged": state.diverged | (judged & lost),
        "failure_time": jnp.where(judged & (fallen | lost), tick.time, state.failure_time),
        "penetration": jnp.where(judged & ~lost, deepest, state.penetration),
    }


def _without_invalid(state: MetricState, tick: Tick) -> tuple[Truth, Tick]:
    """Whether readings have become invalid, and the tick with zeros instead: no NaN reaches the accumulators."""
    sensors = tick.sensors
    # If the accelerometer is non-finite, so are the velocities one step later; not reading it saves computing it.
    leaves = jax.tree.leaves(dataclasses.replace(sensors, accelerometer=sensors.gyro))
    finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]).all()
    lost = state.lost | ~finite | (jnp.abs(sensors.linear_velocity).max() > DIVERGED_SPEED)
    valid = jax.tree.map(lambda leaf: jnp.where(lost | ~jnp.isfinite(leaf), 0.0, leaf), sensors)
    return lost, tick._replace(sensors=valid)


def _course(state: MetricState, tick: Tick, yaw: Scalar, lost: Truth) -> tuple[Scalar, Scalar]:
    """Smoothed yaw [rad] and its rate [rad/s].

    Critically damped tracking of both: no lag in a steady turn, and little of the spine's sway remains.
    """
    expected = state.course + tick.dt * state.turning
    surprise = jnp.where(lost, 0.0, tick.dt * tick.cycle_rate * (yaw - expected))
    return expected + 2.0 * surprise, state.turning + tick.cycle_rate * surprise


def _ends(
    state: MetricState, position: Float[Array, " 3"], yaw: Scalar, part: MeasuredPart
) -> dict[str, Array]:
    """Positions where measuring began and ended so far, and the yaw there, as fields of `MetricState`."""
    first, final = (
        _between(state.position, position, end_time) for end_time in (part.begin, part.end)
    )
    begin, end = (_between(state.readings[2], yaw, end_time) for end_time in (part.begin, part.end))
    begin = jnp.where(state.begun, state.heading[0], begin)
    return {
        "origin": jnp.where(state.begun, state.origin, first),
        "end": jnp.where(part.inside, final, state.end),
        "heading": jnp.stack([begin, jnp.where(part.inside, end, state.heading[1])]),
    }


def _contact(sensors: Sensors) -> tuple[Float[Array, " 4"], Float[Array, " 4"]]:
    """Fraction of the tick in which each foot is loaded, and its mean horizontal speed while loaded [m/s]."""
    contact = _share_loaded(sensors.foot_force)
    speed = jnp.sqrt(jnp.sum(sensors.foot_velocity[..., :2] ** 2, axis=-1) + 1e-12)
    return contact.mean(axis=0), (contact * speed).mean(axis=0)


def _integrals(
    state: MetricState,
    tick: Tick,
    weight: Scalar,
    error: Scalar,
    loaded: Float[Array, " 4"],
    slid: Float[Array, " 4"],
) -> dict[str, Array]:
    """Integrals of `MetricState.sums` over the measured part of a tick.

    Args:
        state: Accumulators before the tick.
        tick: Tick with valid readings.
        weight: Length of the measured part [s].
        error: Distance from the pilot's path [m].
        loaded: Fraction of the tick in which each foot is loaded.
        slid: Mean speed of each foot while loaded [m/s].
    """
    sensors, servo = tick.sensors, tick.servo
    torque = sensors.servo_torque
    if tick.brake is not None:
        torque = torque - tick.brake * sensors.servo_velocity
    swing = jnp.zeros_like(loaded)
    if tick.stance is not None:
        swing = jnp.where(tick.stance, 0.0, 1.0).astype(loaded.dtype)
    turning_head = eye_metrics.head_rate(sensors)
    # Angular speed of distant objects across the centre of the image [rad/s].
    image = jnp.sqrt(turning_head[..., 0] ** 2 + turning_head[..., 2] ** 2 + 1e-12)
    integrands = {
        "work": jnp.maximum(torque * sensors.servo_velocity, 0.0).sum(axis=-1).mean(),
        "loaded": loaded,
        "slid": slid,
        "swing": swing,
        "load": jnp.append(sensors.foot_force.mean(axis=0), sensors.tail_force.mean()),
        "tail_loaded": _share_loaded(sensors.tail_force).mean(),
        "clamped": tick.clamped,
        "airborne": jnp.mean(sensors.contact_distance >= 0.0),
        "sunk": jnp.mean(sensors.contact_distance < -SUNK),
        "square_error": error**2,
        "image": (image**2).mean(),
        **electrical.power_sums(torque, sensors.servo_velocity, servo),
        **electrical.spent(state.driven, _driven(sensors), servo),
    }
    integrals = {name: weight * value for name, value in integrands.items()}
    return integrals | {"swing_loaded": swing * integrals["loaded"]}


def _switching(
    state: MetricState,
    tick: Tick,
    weight: Scalar,
    slid: Float[Array, " 4"],
    loaded: Float[Array, " 4"],
    speed: Scalar,
    roll: Scalar,
) -> tuple[dict[str, Array], Scalar | None]:
    """Integrals over a transition of a schedule, and the largest roll in it [rad]; without a schedule, none."""
    if tick.transition is None or state.switching_roll is None:
        return {}, state.switching_roll
    measured = transitions.integrals(
        tick.transition, tick.time, weight, slid.sum(), loaded.sum(), speed
    )
    within = jnp.where(measured["switching_time"][1] > 0.0, jnp.abs(roll), 0.0)
    return measured, jnp.maximum(state.switching_roll, within)


def per(custom: tuple[OwnMetric, ...], period: str) -> tuple[OwnMetric, ...]:
    """The custom metrics of a `run`, or of a `stride`."""
    return tuple(custom_metric for custom_metric in custom if custom_metric.per == period)


def _extremes(state: MetricState, readings: Array, part: MeasuredPart) -> tuple[Array, Array]:
    """Lowest and highest readings so far.

    Readings stand for the tick before them, so their extremes are those since the end of the first tick. Where only a
    part of the first tick is measured, its reading is blended into the second's as that part vanishes.
    """
    start = part.begin + 1.0
    first = _between(
        state.readings, readings, jnp.where((start >= 0.0) & (start < part.end), start, part.end)
    )
    final = _between(state.readings, readings, part.end)
    low = jnp.minimum(jnp.where(start < 0.0, state.low, jnp.inf), jnp.minimum(first, final))
    high = jnp.maximum(jnp.where(start < 0.0, state.high, -jnp.inf), jnp.maximum(first, final))
    return jnp.where(part.inside, low, state.low), jnp.where(part.inside, high, state.high)


def _driven(sensors: Sensors) -> electrical.Driven:
    return sensors.servo_torque, sensors.servo_velocity, sensors.joint_velocity


def _between(before: Array, now: Array, share: Array) -> Array:
    return before + share * (now - before)


def _share_loaded(force: Array) -> Array:
    """0 for an unloaded foot, 1 for a loaded one, with a smooth transition."""
    none, full = LOADED
    share = jnp.clip((force - none) / (full - none), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def _share(part: Array, whole: Array) -> Array:
    """`part` over `whole`; NaN if the whole is close to zero. The derivative is always finite."""
    some = whole > SHORTEST_LOAD
    return jnp.where(some, part / jnp.where(some, whole, 1.0), jnp.nan)


def result(
    state: MetricState,
    mass: Scalar,
    gravity: Any = GRAVITY,
    supply: electrical.Supply | None = None,
    custom: tuple[OwnMetric, ...] = (),
) -> dict[str, Scalar]:
    """The metrics of one world, named as in `METRICS`, and the custom ones. A metric that was never measured is NaN.

    Derivatives are finite even if other metrics are NaN.

    Args:
        state: accumulators at the end.
        mass: of the robot [kg].
        gravity: for the robot's weight [m/s^2].
        supply: servos and battery; the defaults if None.
        custom: custom metrics, the same as for `init`.
    """
    has_begun, time = state.begun, jnp.where(state.begun, state.time, 1.0)
    metrics = _walk_metrics(state, time) | _foot_metrics(state.sums, time)
    metrics |= _energy_metrics(state, time, mass * gravity, supply)
    if state.switching_roll is not None:
        metrics |= transitions.transition_result(state.sums, state.switching_roll)
    for name, value in metrics.items():
        is_known = has_begun & state.on_path if name.startswith("cross_track") else has_begun
        metrics[name] = jnp.where(is_known, value, jnp.nan)
    metrics |= {
        "duration": state.time,
        "servo_work": state.sums["work"],
        "fell": state.fell.astype(time.dtype),
        "diverged": state.diverged.astype(time.dtype),
        "failure_time": jnp.where(state.fell | state.diverged, state.failure_time, jnp.nan),
    }
    metrics |= stride_metrics.stride_result(state.strides, per(custom, "stride"))
    if state.own is not None:
        metrics |= reduction.own_result(per(custom, "run"), state.own, has_begun, time)
    names = (*METRICS, *TRANSITION, *(custom_metric.name for custom_metric in custom))
    return {name: metrics[name] for name in names if name in metrics}


def _walk_metrics(state: MetricState, time: Scalar) -> dict[str, Scalar]:
    """Metrics of the torso, the path and the eyes; `time` is the measured time [s], never 0."""
    sums, std = state.sums, root(state.square / time)
    metrics = {
        "speed": state.way / time,
        "distance": state.way,
        "lateral_drift": state.end[0] - state.origin[0],
        "cross_track_peak": jnp.maximum(state.high[3], -state.low[3]),
        "cross_track_rms": root(sums["square_error"] / time),
        "cross_track_walked": state.path.walked,
        "cross_track_noise": path_metrics.noise(state.path),
        "turning_radius": path_metrics.radius(state.path),
        "turn_rate": (state.heading[1] - state.heading[0]) / time,
        "picture_motion": root(sums["image"] / time),
        "servo_clamped": sums["clamped"] / time,
        "airborne_time": sums["airborne"] / time,
        "penetration": state.penetration,
        "sunk_time": sums["sunk"] / time,
    }
    for i, angle in enumerate(ANGLES):
        values = {"mean": state.mean[i], "std": std[i], "min": state.low[i], "max": state.high[i]}
        metrics |= {f"{angle}_{name}": value for name, value in values.items()}
    return metrics | eye_metrics.eye_result(state.eyes, time)


def _foot_metrics(sums: Mapping[str, Array], time: Scalar) -> dict[str, Scalar]:
    """Metrics of the contacts of feet and tail; `time` is the measured time [s], never 0."""
    metrics = {
        "slip": _share(sums["slid"].sum(), sums["loaded"].sum()),
        "front_load_share": _share(sums["load"][PAIRS["front"]].sum(), sums["load"][:4].sum()),
        "tail_time": sums["tail_loaded"] / time,
        "tail_load_share": _share(sums["load"][4], sums["load"].sum()),
    }
    for i, limb in enumerate(LIMBS):
        metrics |= {
            f"duty_{limb}": sums["loaded"][i] / time,
            f"slip_{limb}": _share(sums["slid"][i], sums["loaded"][i]),
            f"load_{limb}": sums["load"][i] / time,
        }
    for name, feet in PAIRS.items():
        metrics |= {
            f"loaded_{name}": sums["loaded"][feet].mean() / time,
            f"swing_loaded_{name}": _share(sums["swing_loaded"][feet], sums["swing"][feet]).mean(),
        }
    return metrics


def _energy_metrics(
    state: MetricState, time: Scalar, weight: Scalar, supply: electrical.Supply | None
) -> dict[str, Scalar]:
    """Metrics of work, current and cost of transport.

    Args:
        state: Accumulators at the end.
        time: Measured time [s], never 0.
        weight: Weight of the robot [N].
        supply: Servos and battery; the defaults if None.
    """
    sums, supply = state.sums, supply or electrical.Supply.of(ModelParameters())
    metrics = electrical.electrical_result(sums, time, supply)
    moved = state.begun & (state.way > SHORTEST_WAY)
    way = jnp.where(moved, state.way, 1.0)
    costs = {
        "cost_of_transport": sums["work"],
        "electrical_cost_of_transport": metrics["electrical_power"] * time,
    }
    metrics |= {
        name: jnp.where(moved, energy / (weight * way), jnp.nan) for name, energy in costs.items()
    }
    return metrics | electrical.budget(sums, time, supply)
