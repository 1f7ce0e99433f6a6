# Tests of hardware/signals.py
"""What looks wrong in a log: known faults are found, at their size, and a log in order has none."""

import dataclasses
import re

import numpy as np
import pytest
from fakes import measured

from nermo_mjx.hardware import read_log
from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.hardware.signals import Difference, channel_differences, findings_of, lag_of

SERVOS = ("hip_1", "hip_2", "hip_3", "front_knee", "spine")


def sines(times, k=0):
    """A signal of three sines whose periods have no common multiple within the log."""
    return sum(
        0.2 / (i + 1) * np.sin(2 * np.pi * (0.6 + 0.83 * i + 0.11 * k) * times + i * k)
        for i in range(3)
    )


def log_with(lag=0.012, seed=0, noise=0.003, quantum=0.0175, rate=100.0, **faults):
    """Commands and angles of five servos, gyro and accelerometer; a fault is a function of a servo's angles."""
    random, times, channels = np.random.default_rng(seed), np.arange(0.0, 12.0, 1.0 / rate), []
    for k, servo in enumerate(SERVOS):
        delay = faults.get(f"late_{servo}", 0.0)
        angles = sines(times - lag - delay, k) + noise * random.standard_normal(len(times))
        angles = faults.get(servo, lambda values: values)(np.round(angles / quantum) * quantum)
        channels.append(Channel(f"cmd_{servo}", "command", servo, times, sines(times, k), "rad"))
        channels.append(Channel(f"pos_{servo}", "angle", servo, times, angles, "rad"))
    turning = np.stack(
        [sines(times, k + 7) for k in range(3)], axis=-1
    ) + 0.01 * random.standard_normal((len(times), 3))
    weight = np.array([0.0, 0.0, 9.81]) + 0.3 * random.standard_normal((len(times), 3))
    channels.append(
        Channel("gyro", "gyro", "imu", times, faults.get("gyro", lambda v: v)(turning), "rad/s")
    )
    channels.append(
        Channel(
            "acc", "accelerometer", "imu", times, faults.get("acc", lambda v: v)(weight), "m/s^2"
        )
    )
    return Log(tuple(channels), "log")


@pytest.mark.parametrize("seed", range(5))
def test_a_log_in_order_has_no_findings(seed):
    for quantum, rate in ((0.0175, 100.0), (1e-6, 50.0), (0.005, 333.0)):
        assert findings_of(log_with(seed=seed, quantum=quantum, rate=rate)) == ()


@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"lost": 0.0, "quantum": np.radians(1.0)},
        {"rate": 50.0, "noise": 0.01},
        {"gain": 0.7},
        {"delay": 0.04},
    ],
)
def test_a_simulated_robot_in_order_has_no_findings(faults, tmp_path):
    """On its feet, so that loads make its servos late by 1 to 30 ms."""
    assert findings_of(read_log(*measured.write_log(tmp_path, seconds=5.0, **faults))) == ()


CASES = {
    "mirrored": ({"hip_3": np.negative}, r"hip 3 seems mirrored \(-(0\.99|1\.00)\)\."),
    "late": (
        {"late_front_knee": 0.034},
        r"front knee lags by 4\d ms behind its command, the other servos by 1\d ms",
    ),
    "ahead": ({"lag": -0.03}, r"hip 1 is 30 ms ahead of its command"),
    "unit": ({"spine": np.degrees}, r"spine moves 57\.\d times as far as its command"),
    "zero": ({"spine": lambda values: values + 0.5}, r"spine stands 0\.5 rad off its command"),
    "another's": (
        {"hip_1": lambda values: np.random.default_rng(9).permutation(values)},
        r"hip 1 does not follow its command",
    ),
    "saturated": (
        {"hip_2": lambda values: np.minimum(values, 0.175)},
        r"pos_hip_2 stays at its upper end, 0\.175 rad",
    ),
    "saturated below": (
        {"gyro": lambda values: np.maximum(values, -0.1)},
        r"gyro [xyz] stays at its lower end, -0\.1 r",
    ),
    "gyro in degrees": (
        {"gyro": lambda values: 300 * values},
        r"gyro reaches \d+ rad/s: is its unit deg/s\?",
    ),
    "weight in g": (
        {"acc": lambda values: values / 9.81},
        r"acc has a median of (1|0\.99\d|1\.0\d) m",
    ),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", range(3))
def test_a_fault_is_named(case, seed):
    """And, but for those of all channels, no other channel is."""
    faults, sentence = CASES[case]
    lag = faults.get("lag", 0.012)
    findings = findings_of(log_with(**{**faults, "lag": lag, "seed": seed}))
    assert any(re.match(sentence, finding) for finding in findings), findings
    subjects = {word for finding in findings for word in (finding.split(":")[0].split(" ")[0],)}
    assert case in ("ahead", "saturated below", "unit") or len(subjects) == 1, findings


@pytest.mark.parametrize("lag", [-0.05, 0.0, 0.0137, 0.034, 0.12])
@pytest.mark.parametrize("quantum", [1e-9, 0.0175])
def test_a_lag_is_found_between_samples(lag, quantum):
    """Samples are 10 ms apart, and noise and quantization are those of a servo; another rate is found, too."""
    log = log_with(lag=lag, quantum=quantum)
    lags = [
        lag_of(log.of_quantity("angle")[servo], log.of_quantity("command")[servo])[0]
        for servo in SERVOS
    ]
    np.testing.assert_allclose(lags, lag, atol=1.5e-3)
    fast = np.arange(0.0, 12.0, 1 / 150)
    command = Channel("cmd", "command", "spine", fast, sines(fast, 4), "rad")
    assert lag_of(log.of_quantity("angle")["spine"], command)[0] == pytest.approx(lag, abs=1.5e-3)


def test_names_and_times_in_doubt_are_named():
    log = log_with()
    spine = log.channel("command", "spine")
    log = dataclasses.replace(
        log,
        channels=tuple(
            dataclasses.replace(e, of="spin") if e is spine else e for e in log.channels
        ),
    )
    assert findings_of(log) == (
        "cmd_spine is of 'spin', and pos_spine of 'spine': are both of one servo?",
    )
    slow = tuple(
        dataclasses.replace(channel, times=1e3 * channel.times) for channel in log_with().channels
    )
    (finding,) = findings_of(Log(slow, "log"))
    assert (
        finding
        == "cmd_hip_1, pos_hip_1, cmd_hip_2 and 9 others: a sample comes every 10 s: has the time another unit?"
    )


def test_an_end_that_is_reached_only_before_the_command_begins_is_not_saturated():
    """A robot that rests at its end until it is lagging behind the first command."""
    times = np.arange(0.0, 12.0, 0.005)
    command = Channel("cmd", "command", "hip", times[20:], sines(times[20:]) - 1.0, "rad")
    angle = Channel(
        "pos", "angle", "hip", times, np.where(times < 0.1, 0.0, sines(times - 0.02) - 1.0), "rad"
    )
    assert not any("saturated" in finding for finding in findings_of(Log((command, angle), "log")))


@pytest.mark.parametrize("drift", [0.0, 2e-3, -3e-3])
def test_a_clock_that_drifts_is_found(drift):
    """The angles' clock, and that of a video whose yaw is beside a gyro; stamps of one clock are not suspected."""
    log, end = log_with(lag=0.02), 12.0
    turning = log.channel("gyro", "imu")
    yaw = np.cumsum(turning.values[:, 2]) * turning.interval
    log = dataclasses.replace(
        log, channels=(*log.channels, Channel("yaw", "yaw", "torso", turning.times, yaw, "rad"))
    )
    quantities = ("angle", "yaw")
    shifted = [
        dataclasses.replace(channel, times=channel.times * (1 + drift) + 1e-4)
        for channel in log.channels
    ]
    channels = [
        new if channel.quantity in quantities else channel
        for channel, new in zip(log.channels, shifted, strict=True)
    ]
    findings = [
        finding
        for finding in findings_of(dataclasses.replace(log, channels=tuple(channels)))
        if "clock" in finding
    ]
    if not drift:
        assert findings == []
        return
    scales = [float(re.search(r"scale: ([\d.]+)", finding).group(1)) for finding in findings]
    assert [finding.split(":")[0] for finding in findings] == [
        "pos_hip_1, pos_hip_2, pos_hip_3 and 2 others",
        "yaw",
    ]
    assert scales == pytest.approx([1 / (1 + drift)] * 2, abs=0.004 / end)
    delayed = [
        dataclasses.replace(channel, times=channel.times * (1 + drift)) for channel in log.channels
    ]
    assert findings_of(dataclasses.replace(log, channels=tuple(delayed))) == ()


def test_a_track_is_compared_in_its_own_frame():
    """The camera looks from elsewhere: what is left is what was added to the track."""
    times = np.arange(0.0, 5.0, 0.02)
    track = np.stack([0.1 * times, 0.02 * np.sin(times), 0.05 + 0.001 * np.sin(9 * times)], axis=-1)
    turn = np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    noise = 1e-3 * np.random.default_rng(0).standard_normal((len(times), 2))
    measured = track[:, :2] @ turn.T + [0.4, -0.7] + noise
    twin = Log(
        (
            Channel("p", "position", "torso", times, track, "m"),
            Channel("y", "yaw", "torso", times, track[:, 0], "rad"),
        ),
        "t",
    )
    log = Log(
        (
            Channel("mark", "position", "torso", times, measured, "m"),
            Channel("yaw", "yaw", "torso", times, track[:, 0] + 2.0, "rad"),
        ),
        "l",
    )
    x, y, yaw = channel_differences(log, twin)
    assert (x.name, y.name, x.unit) == ("mark x", "mark y", "m")
    assert [x.rms, y.rms] == pytest.approx([1e-3, 1e-3], rel=0.1)
    assert yaw.rms < 1e-12
    mirrored = dataclasses.replace(twin.channels[0], values=track * [1.0, -1.0, 1.0])
    assert channel_differences(log, Log((mirrored,), "mirrored"))[1].rms > 0.005, (
        "a mirrored track is no turned one"
    )


def test_gaps_are_not_compared():
    times = np.concatenate([np.arange(0, 2, 0.01), np.arange(3, 5, 0.01)])
    full = Channel("a", "angle", "x", times, sines(times), "rad")
    full_times = np.arange(0, 5, 0.01)
    partial = Channel(
        "a",
        "angle",
        "x",
        full_times,
        np.where((full_times > 2) & (full_times < 3), 9.0, sines(full_times)),
        "rad",
    )
    assert channel_differences(Log((full,), ""), Log((partial,), ""))[0].rms < 1e-9
    assert channel_differences(Log((partial,), ""), Log((full,), ""))[0].rms < 1e-9


def compared(a: Channel, b: Channel) -> tuple[list[Difference], list[Difference]]:
    """B minus A, and A minus B."""
    first, two = Log((a,), "a"), Log((b,), "b")
    return channel_differences(two, first), channel_differences(first, two)


@pytest.mark.parametrize("rates", [(100.0, 500.0), (500.0, 100.0)])
def test_two_rates_are_compared_at_the_coarser_stamps_in_either_order(rates) -> None:
    """A ripple of 100 Hz is zero at the stamps of the slow log, which knows nothing of what is between them: all that
    is left is an offset. At the stamps of the fast log, the ripple would add 0.3 / sqrt(2)."""

    def channel(rate: float, offset: float) -> Channel:
        times = np.arange(round(3.0 * rate)) / rate
        ripple = 0.3 * np.sin(2 * np.pi * 100.0 * times)
        return Channel(
            f"at {rate:g} Hz",
            "angle",
            "spine",
            times,
            np.sin(2 * np.pi * times) + ripple + offset,
            "rad",
        )

    (forward,), (back,) = compared(channel(rates[0], 0.0), channel(rates[1], 0.1))
    for comparison, sign in ((forward, 1.0), (back, -1.0)):
        assert comparison.rms == pytest.approx(0.1, abs=1e-9)
        assert comparison.bias == pytest.approx(0.1 * sign, abs=1e-9)
        assert comparison.amplitude == pytest.approx(1 / np.sqrt(2), rel=1e-3), "of the wave alone"
        assert comparison.correlation == pytest.approx(1.0, abs=1e-9)
        assert comparison.lag == pytest.approx(0.0, abs=1e-4)
    assert (forward.name, back.name) == (f"at {rates[1]:g} Hz", f"at {rates[0]:g} Hz")


@pytest.mark.parametrize("rates", [(100.0, 500.0), (500.0, 100.0), (100.0, 100.0), (100.0, 99.0)])
@pytest.mark.parametrize("axes", [(2, 2), (2, 3), (3, 2)])
def test_the_order_of_two_tracks_changes_signs_alone_in_either_order(rates, axes) -> None:
    """Noisy tracks with other stamps, frames and numbers of axes; the second one is 30 ms late."""
    random, channels = np.random.default_rng(4), list[Channel]()
    for rate, number, delay, turn in zip(rates, axes, (0.0, 0.03), (0.0, 0.7), strict=True):
        count = round(4.0 * rate)
        times = np.sort((np.arange(count) + random.uniform(-0.2, 0.2, count)) / rate) + 1.0
        phase = 3.0 * (times - delay)
        track = np.stack([np.sin(phase), 0.5 * np.cos(1.7 * phase), 0.1 * np.sin(phase)], axis=-1)
        track[:, :2] @= np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        track += random.normal(0.0, 0.01, track.shape)
        channels.append(Channel("track", "position", "torso", times, track[:, :number], "m"))
    forward, back = compared(*channels)
    assert len(forward) == len(back) == min(axes)
    for first, second in zip(forward, back, strict=True):
        assert (second.name, second.unit, second.rms, second.amplitude) == (
            first.name,
            first.unit,
            first.rms,
            first.amplitude,
        )
        assert (second.bias, second.lag, second.correlation) == (
            -first.bias,
            -first.lag,
            first.correlation,
        )
    assert forward[0].lag == pytest.approx(0.03, abs=0.005)
