"""Metrics over the gait cycle: peaks of the pitch, correlation of yaw with the spine, slip over the stance.

The walks are recorded; pitch, yaw and the spine's angle are folded over the phase of the gait, on the controller's
clock, so that noise does not count as a peak. Plain NumPy, after the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import jax
import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks

from nermo_mjx.experiments.cases import Column, Worlds
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.robot.parameters import LIMBS, SERVOS
from nermo_mjx.rollout import History, Run, Simulator

#: Parts of a gait cycle over which curves are folded; in the profile as_published it has 50 ticks.
PARTS: Final = 50
#: A peak counts if its prominence is this fraction of the curve's range.
PROMINENT: Final = 0.2
#: A foot bears load above this force [N], as in `rollout.metrics`.
LOADED: Final = 0.02
#: A foot lifts off from this share of its stance on, until this share of the cycle after it.
LAST_OF_STANCE: Final = 2 / 3
AFTER_STANCE: Final = 1 / 6
#: Share of the cycle after a leg's planned lift-off in which the pitch is attributed to the lift-off.
LIFT_OFF: Final = 0.25
#: Number of worlds recorded at once: 2 MB each.
_AT_ONCE: Final = 64
_attitude = jax.jit(attitude)

ABOUT: Final = {
    "pitch_peaks": Column("1", "nose-up peaks of the pitch's mean course over a gait cycle"),
    "pitch_peak_up": Column("rad", "highest nose-up peak of that course above its mean"),
    "pitch_lift_off": Column("rad", "largest nose-up pitch above the mean in the quarter cycle after a lift-off"),
    "yaw_spine_correlation": Column("1", "of yaw and spine servo angle over the gait cycle; NaN if one is still"),
    "slip_rear_touch_down": Column("m/s", "horizontal speed of the loaded rear feet in the first third of the stance"),
    "slip_rear_mid_stance": Column("m/s", "the same in its second third"),
    "slip_rear_lift_off": Column("m/s", "the same from there on, a sixth of the cycle into the swing"),
}


def measured(simulator: Simulator, batch: Worlds, wanted: np.ndarray, run: Run) -> dict[str, np.ndarray]:
    """`ABOUT` of the wanted worlds of a batch, which are simulated again and recorded; NaN for the others.

    Args:
        wanted: mask (n,).
        run: its warm-up is excluded, and the rest is whole gait cycles.
    """
    columns = {name: np.full(len(wanted), np.nan) for name in ABOUT}
    everything, rows = batch.all_values(simulator.setup.defaults()), np.flatnonzero(wanted)
    for begin in range(0, len(rows), _AT_ONCE):
        chosen = rows[begin : begin + _AT_ONCE]
        result = simulator.run({name: values[chosen] for name, values in batch.values.items()}, run, record=True)
        assert result.trace is not None
        for i, row in enumerate(chosen):
            if result.status[i] == "ok":
                values = {name: float(column[row]) for name, column in everything.items()}
                for name, value in of_world(result.trace, i, values, run).items():
                    columns[name][row] = value
    return columns


def of_world(trace: History, world: int, values: Mapping[str, float], run: Run) -> dict[str, float]:
    """`ABOUT` of one recorded world; `values` are all its parameters, by name."""
    rate = values["frequency"] / values["tracking.clock_ratio"]
    warmup, end = run.seconds(np.asarray(rate))
    inside = (trace.time > float(warmup) + 1e-6) & (trace.time < float(end) + 1e-6)
    phase = values["start.phase"] + rate * trace.time[inside]
    sensors = {
        name: np.asarray(trace.sensors[name][world][inside], float)
        for name in ("servo_angle", "foot_force", "foot_velocity")
    }
    # Of the whole trace: its length is the same for all worlds, so that one program serves them all.
    _, pitch, yaw = np.asarray(_attitude(trace.sensors["orientation"][world]), float)[inside].T
    spine = sensors["servo_angle"][:, SERVOS.index("spine")]
    stance = {limb: values["offset." + limb] for limb in LIMBS}
    return {
        **pitch_course(folded(phase, pitch), values["duty"], list(stance.values())),
        "yaw_spine_correlation": _correlation(folded(phase, np.unwrap(yaw)), folded(phase, spine)),
        **rear_slip(phase, sensors["foot_force"], sensors["foot_velocity"], values["duty"], stance),
    }


def folded(phase: Float[np.ndarray, " T"], values: Float[np.ndarray, " T"]) -> Float[np.ndarray, " parts"]:
    """Mean course over a gait cycle, minus its mean and the drift over the walk; phase in cycles."""
    drift = np.polynomial.Polynomial.fit(phase, values, 1)(phase)
    part = np.floor((phase % 1.0) * PARTS).astype(int) % PARTS
    count = np.maximum(np.bincount(part, minlength=PARTS), 1)
    course = np.bincount(part, values - drift, minlength=PARTS) / count
    return course - course.mean()


def pitch_course(pitch: Float[np.ndarray, " parts"], duty: float, offsets: list[float]) -> dict[str, float]:
    """The pitch's part of `ABOUT`, from its mean course.

    Args:
        pitch: positive nose down [rad].
        duty, offsets: of the gait; a leg is planned to lift off at offset + duty.
    """
    up = -pitch
    twice = np.tile(up, 3)
    peaks, _ = find_peaks(twice, prominence=PROMINENT * np.ptp(up)) if np.ptp(up) > 0.0 else (np.zeros(0), {})
    middle = (np.arange(PARTS) + 0.5) / PARTS
    after = [((middle - offset - duty) % 1.0) < LIFT_OFF for offset in offsets]
    return {
        "pitch_peaks": float(np.sum((peaks >= PARTS) & (peaks < 2 * PARTS))),
        "pitch_peak_up": float(up.max()),
        "pitch_lift_off": float(up[np.logical_or.reduce(after)].max()),
    }


def rear_slip(
    phase: Float[np.ndarray, " T"],
    force: Float[np.ndarray, "T 4"],
    velocity: Float[np.ndarray, "T 4 3"],
    duty: float,
    offsets: Mapping[str, float],
) -> dict[str, float]:
    """The slip's part of `ABOUT`: mean horizontal speed of the loaded rear feet in three parts of their stance."""
    speed, ways = np.linalg.norm(velocity[..., :2], axis=-1), np.zeros((3, 2))
    for i, limb in enumerate(LIMBS):
        if not limb.startswith("rear"):
            continue
        since = (phase - offsets[limb]) % 1.0
        loaded = force[:, i] > LOADED
        parts = (since < duty / 3, (since >= duty / 3) & (since < LAST_OF_STANCE * duty),
                 (since >= LAST_OF_STANCE * duty) & (since < duty + AFTER_STANCE))  # fmt: skip
        for part, chosen in enumerate(parts):
            ways[part] += speed[chosen & loaded, i].sum(), (chosen & loaded).sum()
    means = np.divide(ways[:, 0], ways[:, 1], out=np.full(3, np.nan), where=ways[:, 1] > 0)
    names = ("slip_rear_touch_down", "slip_rear_mid_stance", "slip_rear_lift_off")
    return dict(zip(names, means.tolist(), strict=True))


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Pearson correlation; NaN if one of them hardly moves [rad]."""
    if min(np.ptp(one), np.ptp(other)) < 1e-3:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])
