"""Gait metrics, reduced as the run goes: a pair `init`, `update` over one world, and `result` at the end.

Angles are defined in `attitude`. Measuring starts after the warm-up and stops at the end of the run, at the end of the
gait cycle in which the wanted distance is covered, or when the robot falls or diverges; what was measured until then
stays.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nermo_mjx.control.path import PathPoint
from nermo_mjx.robot import LIMBS, Sensors
from nermo_mjx.rollout import path_metrics
from nermo_mjx.rollout.attitude import attitude, uprightness
from nermo_mjx.rollout.parameters import Window

#: A foot is loaded above this force [N]: 3 % of the robot's weight on one foot of four is far below any stance.
LOADED: Final = 0.02
#: The robot has fallen when its torso tilts by more than 60 degrees or its IMU comes this near to the ground [m].
FALLEN_COSINE: Final = 0.5
FALLEN_HEIGHT: Final = 0.025
#: Faster than this, the numbers are no longer those of a robot [m/s].
DIVERGED_SPEED: Final = 50.0
GRAVITY: Final = 9.81
ANGLES: Final = ("roll", "pitch", "yaw")


@dataclasses.dataclass(frozen=True)
class Metric:
    """Unit and meaning of a metric."""

    unit: str
    doc: str


METRICS: Final[dict[str, Metric]] = {
    "speed": Metric("m/s", "distance over duration"),
    "distance": Metric("m", "way along the pilot's path, or along the smoothed heading, while measured"),
    "duration": Metric("s", "time measured"),
    "lateral_drift": Metric("m", "displacement along x, left of the straight pilot's line, while measured"),
    **{
        f"{angle}_{statistic}": Metric("rad", f"{statistic} of the torso's {angle}")
        for angle in ANGLES
        for statistic in ("mean", "std", "min", "max")
    },
    "cross_track_peak": Metric("m", "largest distance from the pilot's path; NaN for a pilot without one"),
    "cross_track_walked": Metric("m", "largest distance of a gait cycle's mean position from the pilot's path"),
    "turning_radius": Metric("m", "radius of the circle fitted to the cycles' mean positions; NaN if straight"),
    "slip": Metric("m/s", "mean horizontal speed of loaded feet"),
    **{f"duty_{limb}": Metric("1", f"share of time with the {limb.replace('_', ' ')} foot loaded") for limb in LIMBS},
    "servo_work": Metric("J", "positive mechanical work of all servos while measured"),
    "cost_of_transport": Metric("1", "servo work over weight and distance; NaN below 1 mm"),
    "fell": Metric("1", "1 if the torso tilted past 60 degrees or came to the ground"),
    "diverged": Metric("1", "1 if the simulation lost its numbers"),
}  # fmt: skip


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MetricState:
    """Accumulators of one world.

    Attributes:
        time, work, way: measured time [s], positive servo work [J], way along the smoothed heading [m].
        travelled: way since the start, warm-up included [m].
        mean, square: Welford's running mean and sum of squared deviations of (roll, pitch, yaw).
        low, high: extremes of (roll, pitch, yaw).
        course, turning: smoothed yaw [rad] and its rate [rad/s].
        position: IMU at the last tick; origin, end: where measuring began and ended (3,) each.
        loaded, slid: time each foot was loaded, and the way it slid meanwhile (4,) each.
        turns: whole turns of yaw, so that it does not jump at +-pi; yaw: the last reading.
        path: how the path was followed.
        on_path: whether the pilot has a path.
        fell, diverged, begun, finished: flags.
    """

    time: Float[Array, ""]
    work: Float[Array, ""]
    way: Float[Array, ""]
    travelled: Float[Array, ""]
    mean: Float[Array, " 3"]
    square: Float[Array, " 3"]
    low: Float[Array, " 3"]
    high: Float[Array, " 3"]
    course: Float[Array, ""]
    turning: Float[Array, ""]
    position: Float[Array, " 3"]
    origin: Float[Array, " 3"]
    end: Float[Array, " 3"]
    loaded: Float[Array, " 4"]
    slid: Float[Array, " 4"]
    turns: Float[Array, ""]
    yaw: Float[Array, ""]
    path: path_metrics.PathState
    on_path: Bool[Array, ""]
    fell: Bool[Array, ""]
    diverged: Bool[Array, ""]
    begun: Bool[Array, ""]
    finished: Bool[Array, ""]


def init(sensors: Sensors) -> MetricState:
    """Accumulators before the first tick, from the readings at rest."""
    position, yaw = sensors.position, attitude(sensors.orientation)[2]
    zero, three, four = jnp.zeros((), position.dtype), jnp.zeros_like(position), jnp.zeros_like(sensors.foot_force)
    no = jnp.zeros((), bool)
    return MetricState(
        time=zero, work=zero, way=zero, travelled=zero, mean=three, square=three, low=three + jnp.inf,
        high=three - jnp.inf, course=yaw, turning=zero, position=position, origin=position, end=position, loaded=four,
        slid=four, turns=zero, yaw=yaw, path=path_metrics.init(position), on_path=no,
        fell=no, diverged=no, begun=no, finished=no,
    )  # fmt: skip


def update(
    window: Window,
    state: MetricState,
    sensors: Sensors,
    time: Float[Array, ""],
    dt: float,
    cycle_rate: Any,
    path: PathPoint | None = None,
) -> MetricState:
    """Add one control tick.

    Args:
        window: when to measure.
        state: accumulators so far.
        sensors: readings of the tick's physics steps, leading axis (steps,).
        time: at the end of the tick [s].
        dt: length of the tick [s].
        cycle_rate: gait cycles per simulated second, the bandwidth of the smoothed heading [rad/s].
        path: point of the pilot's path beside the torso, where it follows one.
    """
    finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(sensors)]).all()
    diverged = state.diverged | ~finite | (jnp.abs(sensors.linear_velocity).max() > DIVERGED_SPEED)
    # Past a divergence the readings mean nothing: they are replaced, so that no NaN reaches the accumulators.
    sensors = jax.tree.map(lambda leaf: jnp.where(diverged, 0.0, leaf), sensors)
    last = jax.tree.map(lambda leaf: leaf[-1], sensors)

    fallen = (uprightness(last.orientation) < FALLEN_COSINE) | (last.position[2] < FALLEN_HEIGHT)
    fell = state.fell | (fallen & ~diverged)
    inside = (time > window.begin + 0.5 * dt) & (time <= window.end + 0.5 * dt) & ~state.finished & ~fell & ~diverged
    weight = jnp.where(inside, dt, 0.0)

    angles = attitude(last.orientation)
    jump = angles[2] - state.yaw
    turns = state.turns - jnp.round(jump / (2 * jnp.pi))
    angles = angles.at[2].add(2 * jnp.pi * turns)

    # Critically damped tracking of yaw and its rate: no lag in a steady turn, little of the spine's sway.
    expected = state.course + dt * state.turning
    surprise = jnp.where(diverged, 0.0, dt * cycle_rate * (angles[2] - expected))
    course, turning = expected + 2.0 * surprise, state.turning + cycle_rate * surprise
    ahead = jnp.stack([jnp.sin(course), -jnp.cos(course)]) if path is None else path.tangent
    step = jnp.where(diverged, 0.0, (last.position - state.position)[:2] @ ahead)
    travelled = state.travelled + step
    elapsed = state.time + weight
    share = weight / jnp.maximum(elapsed, dt)
    deviation = angles - state.mean
    mean = state.mean + share * deviation

    origin = jnp.where(state.begun, state.origin, jnp.where(inside, state.position, last.position))
    # Half a tick early, or rounding would decide whether a cycle of whole ticks has ended.
    cycle_ends = jnp.floor((elapsed + 0.5 * dt) * cycle_rate) > jnp.floor((state.time + 0.5 * dt) * cycle_rate)
    error = jnp.zeros(()) if path is None else jnp.where(diverged, 0.0, path.error)
    followed = path_metrics.update(state.path, (last.position - origin)[:2], error, weight, cycle_ends)

    power = jnp.maximum(sensors.servo_torque * sensors.servo_velocity, 0.0).sum(axis=-1).mean()
    contact = sensors.foot_force > LOADED
    speed = jnp.sqrt(jnp.sum(sensors.foot_velocity[..., :2] ** 2, axis=-1) + 1e-12)
    return MetricState(
        time=elapsed,
        work=state.work + weight * power,
        way=state.way + jnp.where(inside, step, 0.0),
        travelled=travelled,
        mean=mean,
        square=state.square + weight * deviation * (angles - mean),
        low=jnp.where(inside, jnp.minimum(state.low, angles), state.low),
        high=jnp.where(inside, jnp.maximum(state.high, angles), state.high),
        course=course,
        turning=turning,
        position=jnp.where(diverged, state.position, last.position),
        end=jnp.where(inside | ~state.begun, last.position, state.end),
        origin=origin,
        loaded=state.loaded + weight * contact.mean(axis=0),
        slid=state.slid + weight * (contact * speed).mean(axis=0),
        turns=turns,
        yaw=angles[2] - 2 * jnp.pi * turns,
        path=jax.tree.map(lambda new, old: jnp.where(inside, new, old), followed, state.path),
        on_path=jnp.asarray(path is not None),
        fell=fell,
        diverged=diverged,
        begun=state.begun | inside,
        finished=state.finished | (cycle_ends & (travelled >= window.distance)),
    )


def result(state: MetricState, mass: Float[Array, ""]) -> dict[str, Float[Array, ""]]:
    """The metrics of one world, named as in `METRICS`. What was never measured is NaN.

    Args:
        state: accumulators at the end.
        mass: of the robot [kg].
    """
    time = jnp.where(state.time > 0, state.time, jnp.nan)
    std = jnp.sqrt(jnp.maximum(state.square, 0.0) / time)
    distance = jnp.where(state.time > 0, state.way, jnp.nan)
    loaded = state.loaded.sum()
    metrics = {
        "speed": distance / time,
        "distance": distance,
        "duration": state.time,
        "lateral_drift": jnp.where(state.begun, state.end[0] - state.origin[0], jnp.nan),
        "cross_track_peak": jnp.where(state.on_path & state.begun, state.path.peak, jnp.nan),
        "cross_track_walked": jnp.where(state.on_path & state.begun, state.path.walked, jnp.nan),
        "turning_radius": jnp.where(state.begun, path_metrics.radius(state.path), jnp.nan),
        "slip": state.slid.sum() / jnp.where(loaded > 0, loaded, jnp.nan),
        "servo_work": state.work,
        "cost_of_transport": state.work / jnp.where(distance > 1e-3, mass * GRAVITY * distance, jnp.nan),
        "fell": state.fell.astype(time.dtype),
        "diverged": state.diverged.astype(time.dtype),
    }
    for i, angle in enumerate(ANGLES):
        values = {"mean": state.mean[i], "std": std[i], "min": state.low[i], "max": state.high[i]}
        metrics |= {f"{angle}_{name}": jnp.where(state.begun, value, jnp.nan) for name, value in values.items()}
    metrics |= {f"duty_{limb}": state.loaded[i] / time for i, limb in enumerate(LIMBS)}
    return {name: metrics[name] for name in METRICS}
