"""Signals beside each other: lag, residual and gain of two channels, and what looks wrong in a robot's log."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from nermo_mjx.hardware.log import MOVED, Channel, Log, several

#: Largest lag that is looked for [s].
LONGEST_LAG: Final = 0.25
#: Shares of the largest correlation that are its hill, and that are as high: then the smallest lag is meant.
_HILL: Final = 0.95
_ALIKE: Final = 0.99


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
    found = np.stack(
        [np.interp(times, channel.times, each, np.nan, np.nan) for each in flat.T], axis=-1
    )
    for begin, end in channel.gaps:
        found[(times > begin) & (times < end)] = np.nan
    return found.reshape(len(times), *channel.values.shape[1:])


def lag_of(channel: Channel, other: Channel) -> tuple[float, float]:
    """How long one channel is behind another one of one column [s], and their correlation then.

    The sign is that of their correlation without a lag; the lag has the largest one of this sign, at the vertex of a
    parabola through its hill, so between samples, too.
    """
    step = max(channel.interval, other.interval)
    count = max(2, int(LONGEST_LAG / step))
    lags = step * np.arange(-count, count + 1)
    found = np.array(
        [_correlation(channel.values, values_at(other, channel.times - lag)) for lag in lags]
    )
    sign = 1.0 if found[count] >= 0.0 else -1.0
    found = sign * found
    if found.max() <= 0.0:
        return 0.0, sign * float(found[count])
    # Each hill around a maximum, of those that are as high as the highest the nearest: signals may be periodic.
    edges = np.flatnonzero(
        np.diff(found >= _HILL * found.max(), prepend=False, append=False)
    ).reshape(-1, 2)
    hills = [hill for hill in edges if found[slice(*hill)].max() >= _ALIKE * found.max()]
    begin, end = min(hills, key=lambda hill: abs(lags[slice(*hill)].mean()))
    best = begin + int(np.argmax(found[begin:end]))
    near = slice(max(0, min(begin, best - 1)), max(end, best + 2))
    bend, slope, _ = (
        np.polyfit(lags[near] - lags[best], found[near], 2)
        if np.ptp(found[near])
        else (0.0, 0.0, 0.0)
    )
    vertex = lags[best] - (0.5 * slope / bend if bend < 0.0 else 0.0)
    return float(np.clip(vertex, *lags[near][[0, -1]])), sign * float(found[best])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    both = np.isfinite(b)
    if both.sum() < 3 or np.ptp(a[both]) == 0.0 or np.ptp(b[both]) == 0.0:
        return 0.0
    return float(np.corrcoef(a[both], b[both])[0, 1])


def channel_differences(log: Log, other: Log) -> list[Difference]:
    """The channels of one log minus those of another one, axis by axis, of the quantities and things that both have.

    Two channels are compared at the time stamps of the coarser one, whose signal between them is not known, and in its
    frame (`in_frame_of`). Exchanging the logs changes the signs of `bias` and `lag`, and the names.
    """
    found = []
    for channel in log.channels:
        twin = other.of_quantity(channel.quantity).get(channel.of)
        if twin is None:
            continue
        coarse, fine = sorted((channel, twin), key=_fineness)
        sign = 1.0 if coarse is channel else -1.0
        pairs = zip(
            axes_of(channel), axes_of(coarse), axes_of(in_frame_of(fine, coarse)), strict=False
        )
        for (name, _), (_, one), (_, two) in pairs:
            residual = one.values - values_at(two, one.times)
            residual = residual[np.isfinite(residual)]
            if len(residual):
                rms, bias = float(np.sqrt(np.mean(residual**2))), float(residual.mean())
                lag, correlation = lag_of(one, two)
                sizes = rms, sign * bias, float(one.values.std())
                found.append(Difference(name, channel.unit, *sizes, sign * lag, correlation))
    return found


def _fineness(channel: Channel) -> tuple[Any, ...]:
    """Orders channels from coarse to fine; of equal stamps by the values, so that no order of two logs matters."""
    return -channel.interval, len(channel.times), -channel.times[0], channel.values.tobytes()


def in_frame_of(twin: Channel, channel: Channel) -> Channel:
    """A track or a yaw in the frame of another one: turned about the vertical and shifted so that the residual is least
    [Umeyama, IEEE PAMI 13, 1991]; other quantities as they are."""
    if channel.quantity not in ("position", "yaw"):
        return twin
    there = values_at(twin, channel.times)
    both = np.isfinite(there).reshape(len(there), -1).all(axis=1)
    if not both.any():
        return twin
    here, there, moved = (
        each.reshape(len(each), -1) for each in (channel.values[both], there[both], twin.values)
    )
    axes = min(here.shape[1], there.shape[1])
    seen = here - here.mean(axis=0)
    shown = there - there.mean(axis=0)
    moved = moved - there.mean(axis=0)
    if channel.quantity == "position":
        turn = np.vdot(shown[:, 0] + 1j * shown[:, 1], seen[:, 0] + 1j * seen[:, 1])
        ground = (moved[:, 0] + 1j * moved[:, 1]) * turn / max(abs(turn), 1e-300)
        moved = np.stack([ground.real, ground.imag, *moved.T[2:]], axis=-1)
    values = moved[:, :axes] + here.mean(axis=0)[:axes]
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
        (name, dataclasses.replace(channel, values=each))
        for name, each in zip(names, flat, strict=True)
    ]


# ---
# What looks wrong in a log: each sentence names what it was found of.

#: Correlation of an angle with its command below which it does not follow it.
_FOLLOWS: Final = 0.5
#: Gains of an angle, and its distance from its command [rad, m], that no servo in order has.
_GAINS: Final = (0.5, 2.0)
_OFF: Final = 0.2
#: A servo is late where its lag is beyond all others' by more than this [s], and by more than these are apart.
_LATE: Final = 0.01
#: A clock drifts where lags in so many parts of a log change by more than this in all [s], and than so many standard
#: deviations.
_PARTS: Final = 6
_DRIFTED: Final = 0.01
_CERTAIN: Final = 5.0
#: Interval beyond which the unit of a time is in doubt [s].
_SLOWEST: Final = 2.0
#: Turns of servos [rad], angular velocities [rad/s], and weights [m/s^2] beyond which a unit is wrong: 2,000 deg/s is
#: what gyros measure.
_TURNS: Final = 2.0 * np.pi
_FASTEST: Final = 36.0
_WEIGHT: Final = (5.0, 15.0)
#: A signal is saturated where it stays at its largest value for so many samples, and its command moves by more than so
#: many levels and standard deviations then; or without a command, where it is there so many times as often as near it.
_STAYS: Final = 5
_BEYOND: Final = 0.5
_OFTEN: Final = 10


def findings_of(log: Log) -> tuple[str, ...]:
    """What looks wrong with a log's channels, in sentences; nothing of a log that is in order."""
    commands, angles = log.of_quantity("command"), log.of_quantity("angle")
    pairs = [
        (angles[of], commands[of])
        for of in angles
        if of in commands and np.ptp(commands[of].values) > MOVED
    ]
    lags = {angle.of: lag_of(angle, command) for angle, command in pairs}
    found = [*log.findings]
    for angle, command in pairs:
        others = [lag for of, (lag, _) in lags.items() if of != angle.of]
        found += _servo_findings(angle, command, *lags[angle.of], others)
    found += _drifts(log, pairs)
    alone, unled = (
        [of for of in a if of not in b] for a, b in ((commands, angles), (angles, commands))
    )
    for of in alone:
        for other in difflib.get_close_matches(of, unled, 1, 0.8):
            found.append(
                f"{commands[of].name} is of {of!r}, and {angles[other].name} of {other!r}: are both of one servo?"
            )
    if slow := [each.name for each in log.channels if each.interval > _SLOWEST]:
        every = max(each.interval for each in log.channels)
        found.append(
            f"{several(slow)}: a sample comes every {every:.3g} s: has the time another unit?"
        )
    for channel in log.channels:
        led = channel.quantity == "angle" and channel.of in lags
        expected = (
            values_at(commands[channel.of], channel.times - lags[channel.of][0]) if led else None
        )
        found += _own_findings(channel, expected)
    return tuple(found)


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
    if abs(correlation) < _FOLLOWS:
        yield f"{name} does not follow its command ({correlation:.2f})."
        return
    if correlation < 0.0:
        yield f"{name} seems mirrored ({correlation:.2f})."
    there = values_at(command, angle.times - lag)
    both = np.isfinite(there)
    gain = np.polyfit(there[both], angle.values[both], 1)[0]
    offset = (angle.values - there)[both].mean()
    if not _GAINS[0] < abs(gain) < _GAINS[1]:
        yield f"{name} moves {abs(gain):.3g} times as far as its command: one of the two has another unit."
    elif correlation > 0.0 and abs(offset) > _OFF:
        yield f"{name} stands {offset:.2g} {angle.unit} off its command: one of the two has another zero."
    if lag < -max(angle.interval, command.interval):
        yield f"{name} is {-1e3 * lag:.0f} ms ahead of its command: one of the two has another clock."
    elif len(others) > 1 and lag - max(others) > max(_LATE, np.ptp(others)):
        most = f"{1e3 * max(others):.0f} ms at most"
        yield f"{name} lags by {1e3 * lag:.0f} ms behind its command, the other servos by {most}."


def _drifts(log: Log, pairs: Sequence[tuple[Channel, Channel]]) -> Iterator[str]:
    """Clocks that run away from another one: angles behind their commands, and the change of a yaw behind a gyro."""
    yaw, gyro = log.channel("yaw"), log.channel("gyro")
    seen = {angle.name: (angle, command) for angle, command in pairs}
    if yaw is not None and gyro is not None:
        rate = dataclasses.replace(yaw, values=np.gradient(yaw.values, yaw.times))
        seen[yaw.name] = rate, dataclasses.replace(gyro, values=gyro.values[:, 2])
    found: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for name, (channel, other) in seen.items():
        # Channels that share most stamps are of one clock; their lags may change with the motion.
        few, many = sorted((each.times.round(9) for each in (channel, other)), key=len)
        if np.isin(few, many).mean() > 0.5:
            continue
        parts = [
            part for part in np.array_split(np.arange(len(channel.times)), _PARTS) if len(part) > 2
        ]
        pieces = [
            dataclasses.replace(channel, times=channel.times[p], values=channel.values[p])
            for p in parts
        ]
        lags = np.array([lag_of(each, other) for each in pieces]).T[0]
        middle = [each.times.mean() for each in pieces]
        (slope, _), (variance, *_) = np.polyfit(middle, lags, 1, cov=True)
        change = abs(slope) * np.ptp(channel.times)
        if change > _DRIFTED and abs(slope) > _CERTAIN * np.sqrt(variance[0]):
            found.setdefault((channel.quantity, other.quantity), []).append((name, float(slope)))
    for (_, behind), each in found.items():
        names, slopes = zip(*each, strict=True)
        slope = float(np.median(slopes))
        yield (
            f"{several(names)}: the lag behind the {behind} {'grows' if slope > 0 else 'shrinks'} by "
            f"{1e3 * abs(slope):.2g} ms in a second: do the clocks differ, by scale: {1 / (1 + slope):.5g}?"
        )


def _own_findings(channel: Channel, expected: np.ndarray | None) -> Iterator[str]:
    """What looks wrong in one channel alone; `expected` is its command, if it has one, at its lag."""
    most = float(np.abs(channel.values).max())
    if channel.quantity in ("command", "angle") and channel.unit == "rad" and most > _TURNS:
        yield f"{channel.name} reaches {most:.3g} rad: is its unit deg, or its zero another one?"
    if channel.quantity == "gyro" and most > _FASTEST:
        yield f"{channel.name} reaches {most:.3g} rad/s: is its unit deg/s?"
    if channel.quantity == "accelerometer":
        weight = float(np.median(np.linalg.norm(channel.values, axis=-1)))
        if not _WEIGHT[0] < weight < _WEIGHT[1]:
            yield f"{channel.name} has a median of {weight:.3g} m/s^2, not of gravity: has it another unit?"
    if channel.quantity in ("angle", "velocity", "gyro", "accelerometer", "current"):
        for name, axis in axes_of(channel):
            for sign, end in ((1.0, "upper"), (-1.0, "lower")):
                if _is_saturated(sign * axis.values, expected):
                    at = f"{sign * (sign * axis.values).max():.3g} {axis.unit}"
                    yield f"{name} stays at its {end} end, {at}: is it saturated?"


def _is_saturated(values: np.ndarray, expected: np.ndarray | None) -> bool:
    """Whether a signal stays at its largest value while what it should follow goes on, or more often than near it."""
    at, levels = values == values.max(), np.unique(values)
    lengths = np.diff(np.flatnonzero(np.diff(at, prepend=False, append=False)))[::2]
    if lengths.max(initial=0) < _STAYS or len(levels) < _STAYS:
        return False
    width = float(np.median(np.diff(levels)))
    if expected is not None:
        going = expected[at & np.isfinite(expected)]
        return len(going) > 0 and bool(
            np.ptp(going) > max(_STAYS * width, _BEYOND * np.nanstd(expected))
        )
    near = ((values < values.max()) & (values >= values.max() - 3.0 * width)).sum() / 3.0
    return bool(at.sum() > _OFTEN * max(near, 1.0))
