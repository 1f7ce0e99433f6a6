"""Signals beside each other: lag, residual and gain of two channels, and what looks wrong in a robot's log."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from nermo_mjx.hardware.log import MOTION_THRESHOLD, Channel, Log, several

#: Largest lag that is looked for [s].
LONGEST_LAG_SECONDS: Final = 0.25
#: Shares of the largest correlation that are its hill, and that are as high: then the smallest lag is meant.
_HILL_SHARE: Final = 0.95
_PEAK_SHARE: Final = 0.99


@dataclasses.dataclass(frozen=True)
class Difference:
    """A channel compared with another one of the same thing, at the times of the coarser one.

    Attributes:
        name: of the channel; with its axis, if it has several.
        unit: of `rms` and `bias`.
        rms, bias: root mean square and mean of the channel minus the other one.
        amplitude: Root mean square of the coarser channel about its mean.
        lag: of the channel behind the other one [s], 0 where one of them stands still.
        correlation: at that lag; 0 where one of them stands still.
    """

    name: str
    unit: str
    rms: float
    bias: float
    amplitude: float
    lag: float
    correlation: float


def values_at(channel: Channel, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n ..."]:
    """A channel's values at other times, linear between its samples; NaN before, after, and in its gaps."""
    flat = channel.values.reshape(len(channel.times), -1)
    interpolated = np.stack(
        [np.interp(times, channel.times, component, np.nan, np.nan) for component in flat.T],
        axis=-1,
    )
    for begin, end in channel.gaps:
        interpolated[(times > begin) & (times < end)] = np.nan
    return interpolated.reshape(len(times), *channel.values.shape[1:])


def lag_of(channel: Channel, reference: Channel) -> tuple[float, float]:
    """How long one channel is behind another one of one column [s], and their correlation then.

    The sign is that of their correlation without a lag; the lag has the largest one of this sign, at the vertex of a
    parabola through its hill, so between samples, too.
    """
    step = max(channel.interval, reference.interval)
    count = max(2, int(LONGEST_LAG_SECONDS / step))
    lags = step * np.arange(-count, count + 1)
    correlations = np.array(
        [_correlation(channel.values, values_at(reference, channel.times - lag)) for lag in lags]
    )
    sign = 1.0 if correlations[count] >= 0.0 else -1.0
    correlations = sign * correlations
    if correlations.max() <= 0.0:
        return 0.0, sign * float(correlations[count])
    # Each hill around a maximum, of those that are as high as the highest the nearest: signals may be periodic.
    edges = np.flatnonzero(
        np.diff(correlations >= _HILL_SHARE * correlations.max(), prepend=False, append=False)
    ).reshape(-1, 2)
    hills = [
        hill
        for hill in edges
        if correlations[slice(*hill)].max() >= _PEAK_SHARE * correlations.max()
    ]
    begin, end = min(hills, key=lambda hill: abs(lags[slice(*hill)].mean()))
    best = begin + int(np.argmax(correlations[begin:end]))
    near = slice(max(0, min(begin, best - 1)), max(end, best + 2))
    bend, slope, _ = (
        np.polyfit(lags[near] - lags[best], correlations[near], 2)
        if np.ptp(correlations[near])
        else (0.0, 0.0, 0.0)
    )
    vertex = lags[best] - (0.5 * slope / bend if bend < 0.0 else 0.0)
    return float(np.clip(vertex, *lags[near][[0, -1]])), sign * float(correlations[best])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    is_finite = np.isfinite(b)
    if is_finite.sum() < 3 or np.ptp(a[is_finite]) == 0.0 or np.ptp(b[is_finite]) == 0.0:
        return 0.0
    return float(np.corrcoef(a[is_finite], b[is_finite])[0, 1])


def channel_differences(log: Log, reference: Log) -> list[Difference]:
    """The channels of one log minus those of another one, axis by axis, of the quantities and things that both have.

    Two channels are compared at the time stamps of the coarser one, whose signal between them is not known, and in its
    frame (`in_frame_of`). Exchanging the logs changes the signs of `bias` and `lag`, and the names.
    """
    differences = []
    for channel in log.channels:
        twin = reference.of_quantity(channel.quantity).get(channel.of)
        if twin is None:
            continue
        coarse, fine = sorted((channel, twin), key=_fineness)
        sign = 1.0 if coarse is channel else -1.0
        pairs = zip(
            axes_of(channel), axes_of(coarse), axes_of(in_frame_of(fine, coarse)), strict=False
        )
        for (name, _), (_, first), (_, two) in pairs:
            residual = first.values - values_at(two, first.times)
            residual = residual[np.isfinite(residual)]
            if len(residual):
                rms, bias = float(np.sqrt(np.mean(residual**2))), float(residual.mean())
                lag, correlation = lag_of(first, two)
                sizes = rms, sign * bias, float(first.values.std())
                differences.append(Difference(name, channel.unit, *sizes, sign * lag, correlation))
    return differences


def _fineness(channel: Channel) -> tuple[Any, ...]:
    """Orders channels from coarse to fine; of equal stamps by the values, so that no order of two logs matters."""
    return -channel.interval, len(channel.times), -channel.times[0], channel.values.tobytes()


def in_frame_of(twin: Channel, channel: Channel) -> Channel:
    """A track or a yaw in the frame of another one: turned about the vertical and shifted so that the residual is least
    [Umeyama, IEEE PAMI 13, 1991]; other quantities as they are."""
    if channel.quantity not in ("position", "yaw"):
        return twin
    twin_values = values_at(twin, channel.times)
    is_finite = np.isfinite(twin_values).reshape(len(twin_values), -1).all(axis=1)
    if not is_finite.any():
        return twin
    channel_points, twin_values, all_points = (
        points.reshape(len(points), -1)
        for points in (channel.values[is_finite], twin_values[is_finite], twin.values)
    )
    axes = min(channel_points.shape[1], twin_values.shape[1])
    channel_centred = channel_points - channel_points.mean(axis=0)
    twin_centred = twin_values - twin_values.mean(axis=0)
    all_points = all_points - twin_values.mean(axis=0)
    if channel.quantity == "position":
        turn = np.vdot(
            twin_centred[:, 0] + 1j * twin_centred[:, 1],
            channel_centred[:, 0] + 1j * channel_centred[:, 1],
        )
        ground = (all_points[:, 0] + 1j * all_points[:, 1]) * turn / max(abs(turn), 1e-300)
        all_points = np.stack([ground.real, ground.imag, *all_points.T[2:]], axis=-1)
    values = all_points[:, :axes] + channel_points.mean(axis=0)[:axes]
    return dataclasses.replace(twin, values=values if channel.values.ndim > 1 else values[:, 0])


def axes_of(channel: Channel) -> list[tuple[str, Channel]]:
    """A channel of each axis, with its name."""
    flat = channel.values.reshape(len(channel.times), -1).T
    names = (
        [f"{channel.name} {axis}" for axis in "xyz"[: len(flat)]]
        if channel.values.ndim > 1
        else [channel.name]
    )
    return [
        (name, dataclasses.replace(channel, values=component))
        for name, component in zip(names, flat, strict=True)
    ]


# ---
# What looks wrong in a log: each sentence names what it was found of.

#: Correlation of an angle with its command below which it does not follow it.
_MIN_CORRELATION: Final = 0.5
#: Gains of an angle, and its distance from its command [rad, m], that no servo in order has.
_GAIN_RANGE: Final = (0.5, 2.0)
_LARGEST_OFFSET: Final = 0.2
#: A servo is late where its lag is beyond all others' by more than this [s], and by more than these are apart.
_LAG_MARGIN_SECONDS: Final = 0.01
#: A clock drifts where lags in so many parts of a log change by more than this in all [s], and than so many standard
#: deviations.
_LOG_SECTIONS: Final = 6
_DRIFT_SECONDS: Final = 0.01
_DRIFT_DEVIATIONS: Final = 5.0
#: Interval beyond which the unit of a time is in doubt [s].
_LONGEST_INTERVAL_SECONDS: Final = 2.0
#: Turns of servos [rad], angular velocities [rad/s], and weights [m/s^2] beyond which a unit is wrong: 2,000 deg/s is
#: what gyros measure.
_LARGEST_SERVO_ANGLE: Final = 2.0 * np.pi
_LARGEST_ANGULAR_VELOCITY: Final = 36.0
_GRAVITY_RANGE: Final = (5.0, 15.0)
#: A signal is saturated where it stays at its largest value for so many samples, and its command moves by more than so
#: many levels and standard deviations then; or without a command, where it is there so many times as often as near it.
_SATURATION_SAMPLES: Final = 5
_SATURATION_DEVIATIONS: Final = 0.5
_SATURATION_RATIO: Final = 10


def findings_of(log: Log) -> tuple[str, ...]:
    """What looks wrong with a log's channels, in sentences; nothing of a log that is in order."""
    commands, angles = log.of_quantity("command"), log.of_quantity("angle")
    pairs = [
        (angles[servo], commands[servo])
        for servo in angles
        if servo in commands and np.ptp(commands[servo].values) > MOTION_THRESHOLD
    ]
    lags = {angle.of: lag_of(angle, command) for angle, command in pairs}
    findings = [*log.findings]
    for angle, command in pairs:
        others = [lag for servo, (lag, _) in lags.items() if servo != angle.of]
        findings += _servo_findings(angle, command, *lags[angle.of], others)
    findings += _drifts(log, pairs)
    angle_only, unled = (
        [servo for servo in a if servo not in b]
        for a, b in ((commands, angles), (angles, commands))
    )
    for servo in angle_only:
        for similar_name in difflib.get_close_matches(servo, unled, 1, 0.8):
            findings.append(
                f"{commands[servo].name} is of {servo!r}, and {angles[similar_name].name} of"
                f" {similar_name!r}: are both of one servo?"
            )
    if slow := [
        channel.name for channel in log.channels if channel.interval > _LONGEST_INTERVAL_SECONDS
    ]:
        every = max(channel.interval for channel in log.channels)
        findings.append(
            f"{several(slow)}: a sample comes every {every:.3g} s: has the time another unit?"
        )
    for channel in log.channels:
        led = channel.quantity == "angle" and channel.of in lags
        expected = (
            values_at(commands[channel.of], channel.times - lags[channel.of][0]) if led else None
        )
        findings += _own_findings(channel, expected)
    return tuple(findings)


def _servo_findings(
    angle: Channel, command: Channel, lag: float, correlation: float, others: Sequence[float]
) -> Iterator[str]:
    """What looks wrong with the angle of a servo, compared with its command.

    Args:
        angle: Angle of the servo.
        command: Command of the servo.
        lag: Lag of the angle behind the command [s].
        correlation: Correlation of both at this lag.
        others: Lags of the other servos [s].
    """
    name = angle.of.replace("_", " ")
    if abs(correlation) < _MIN_CORRELATION:
        yield f"{name} does not follow its command ({correlation:.2f})."
        return
    if correlation < 0.0:
        yield f"{name} seems mirrored ({correlation:.2f})."
    command_values = values_at(command, angle.times - lag)
    is_finite = np.isfinite(command_values)
    gain = np.polyfit(command_values[is_finite], angle.values[is_finite], 1)[0]
    offset = (angle.values - command_values)[is_finite].mean()
    if not _GAIN_RANGE[0] < abs(gain) < _GAIN_RANGE[1]:
        yield f"{name} moves {abs(gain):.3g} times as far as its command: one of the two has another unit."
    elif correlation > 0.0 and abs(offset) > _LARGEST_OFFSET:
        yield f"{name} stands {offset:.2g} {angle.unit} off its command: one of the two has another zero."
    if lag < -max(angle.interval, command.interval):
        yield f"{name} is {-1e3 * lag:.0f} ms ahead of its command: one of the two has another clock."
    elif len(others) > 1 and lag - max(others) > max(_LAG_MARGIN_SECONDS, np.ptp(others)):
        largest_lag = f"{1e3 * max(others):.0f} ms at most"
        yield f"{name} lags by {1e3 * lag:.0f} ms behind its command, the other servos by {largest_lag}."


def _drifts(log: Log, pairs: Sequence[tuple[Channel, Channel]]) -> Iterator[str]:
    """Clocks that run away from another one: angles behind their commands, and the change of a yaw behind a gyro."""
    yaw, gyro = log.channel("yaw"), log.channel("gyro")
    channels_by_name = {angle.name: (angle, command) for angle, command in pairs}
    if yaw is not None and gyro is not None:
        rate = dataclasses.replace(yaw, values=np.gradient(yaw.values, yaw.times))
        channels_by_name[yaw.name] = rate, dataclasses.replace(gyro, values=gyro.values[:, 2])
    drifts: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for name, (channel, command_channel) in channels_by_name.items():
        # Channels that share most stamps are of one clock; their lags may change with the motion.
        fewer_times, more_times = sorted(
            (pair_channel.times.round(9) for pair_channel in (channel, command_channel)), key=len
        )
        if np.isin(fewer_times, more_times).mean() > 0.5:
            continue
        parts = [
            part
            for part in np.array_split(np.arange(len(channel.times)), _LOG_SECTIONS)
            if len(part) > 2
        ]
        pieces = [
            dataclasses.replace(channel, times=channel.times[p], values=channel.values[p])
            for p in parts
        ]
        lags = np.array([lag_of(pair_channel, command_channel) for pair_channel in pieces]).T[0]
        middle = [pair_channel.times.mean() for pair_channel in pieces]
        (slope, _), (variance, *_) = np.polyfit(middle, lags, 1, cov=True)
        change = abs(slope) * np.ptp(channel.times)
        if change > _DRIFT_SECONDS and abs(slope) > _DRIFT_DEVIATIONS * np.sqrt(variance[0]):
            drifts.setdefault((channel.quantity, command_channel.quantity), []).append(
                (name, float(slope))
            )
    for (_, behind), pair_channel in drifts.items():
        names, slopes = zip(*pair_channel, strict=True)
        slope = float(np.median(slopes))
        yield (
            f"{several(names)}: the lag behind the {behind} {'grows' if slope > 0 else 'shrinks'} by "
            f"{1e3 * abs(slope):.2g} ms in a second: do the clocks differ, by scale: {1 / (1 + slope):.5g}?"
        )


def _own_findings(channel: Channel, expected: np.ndarray | None) -> Iterator[str]:
    """What looks wrong in one channel alone; `expected` is its command, if it has one, at its lag."""
    largest = float(np.abs(channel.values).max())
    if (
        channel.quantity in ("command", "angle")
        and channel.unit == "rad"
        and largest > _LARGEST_SERVO_ANGLE
    ):
        yield f"{channel.name} reaches {largest:.3g} rad: is its unit deg, or its zero another one?"
    if channel.quantity == "gyro" and largest > _LARGEST_ANGULAR_VELOCITY:
        yield f"{channel.name} reaches {largest:.3g} rad/s: is its unit deg/s?"
    if channel.quantity == "accelerometer":
        weight = float(np.median(np.linalg.norm(channel.values, axis=-1)))
        if not _GRAVITY_RANGE[0] < weight < _GRAVITY_RANGE[1]:
            yield f"{channel.name} has a median of {weight:.3g} m/s^2, not of gravity: has it another unit?"
    if channel.quantity in ("angle", "velocity", "gyro", "accelerometer", "current"):
        for name, axis in axes_of(channel):
            for sign, end in ((1.0, "upper"), (-1.0, "lower")):
                if _is_saturated(sign * axis.values, expected):
                    level_text = f"{sign * (sign * axis.values).max():.3g} {axis.unit}"
                    yield f"{name} stays at its {end} end, {level_text}: is it saturated?"


def _is_saturated(values: np.ndarray, expected: np.ndarray | None) -> bool:
    """Whether a signal stays at its largest value while what it should follow goes on, or more often than near it."""
    is_largest, levels = values == values.max(), np.unique(values)
    lengths = np.diff(np.flatnonzero(np.diff(is_largest, prepend=False, append=False)))[::2]
    if lengths.max(initial=0) < _SATURATION_SAMPLES or len(levels) < _SATURATION_SAMPLES:
        return False
    width = float(np.median(np.diff(levels)))
    if expected is not None:
        going = expected[is_largest & np.isfinite(expected)]
        return len(going) > 0 and bool(
            np.ptp(going)
            > max(_SATURATION_SAMPLES * width, _SATURATION_DEVIATIONS * np.nanstd(expected))
        )
    near = ((values < values.max()) & (values >= values.max() - 3.0 * width)).sum() / 3.0
    return bool(is_largest.sum() > _SATURATION_RATIO * max(near, 1.0))
