# Tests of cli/logs.py, hardware/twin.py
"""The commands around a robot's own log, on one that another simulation made."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command import call, json_of
from fakes.measured import write_log

from nermo_mjx.hardware import read_log
from nermo_mjx.recording import Recording

DATA = Path(__file__).parents[1] / "data"
FAULTS = {"delay": 0.02, "quantum": np.radians(0.5), "lost": 0.02, "noise": 0.004}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two logs of one command, with 20 ms of delay, and the twin driven by the first."""
    folder = tmp_path_factory.mktemp("logs")
    write_log(folder, seconds=4.0, **FAULTS)
    write_log(folder, seconds=4.0, **FAULTS, seed=5, name="again")
    replayed = json_of(
        "replay", "--commands", folder / "robot.csv", "--record", folder / "twin.npz"
    )
    (folder / "replay.json").write_text(json.dumps(replayed))
    return folder


@pytest.mark.release
def test_a_log_is_shown_back_and_checked(folder) -> None:
    report = json_of("log", folder / "robot.csv")
    assert [channel["quantity"] for channel in report["channels"][:2]] == ["command", "angle"]
    spine = next(channel for channel in report["channels"] if channel["channel"] == "pos_spine")
    assert spine["rate"] == pytest.approx(100.0)
    assert spine["lag"] == pytest.approx(0.02, abs=0.006), "the delay, and the servo's own"
    assert len(report["findings"]) == 1
    assert re.search(
        r"\d+ gaps, the longest .* [123]\.?\d* % of the samples are missing", report["findings"][0]
    )
    text = call("log", folder / "robot.csv", "--channels", folder / "robot.yaml").stdout
    assert "t_ms" in text
    assert re.search(r"pos_spine +angle +spine +100 ", text)
    assert max(map(len, call("log", "--help").stdout.splitlines())) <= 80


@pytest.mark.release
def test_the_twin_is_driven_by_the_commands(folder) -> None:
    """What differs is what the other simulation did otherwise: 20 ms of delay, 5 less as its commands are held."""
    differences = {
        entry["name"]: entry
        for entry in json.loads((folder / "replay.json").read_text())["channels"]
    }
    assert set(differences) > {
        "pos_spine",
        "gyro x",
        "accelerometer z",
        "marker x",
        "marker y",
        "heading",
    }
    assert not any(name.startswith("cmd") for name in differences)
    for name in ("pos_spine", "pos_neck", "pos_front_left_knee", "pos_rear_right_hip"):
        assert differences[name]["lag"] == pytest.approx(0.015, abs=0.002)
        assert np.degrees(differences[name]["rms"]) < 1.0
        assert differences[name]["correlation"] > 0.99
    assert differences["marker y"]["correlation"] > 0.9


@pytest.mark.release
def test_commands_act_at_their_times(folder) -> None:
    """In each step of physics the last command that had been given by then."""
    log, twin = (
        read_log(folder / "robot.csv", folder / "robot.yaml"),
        Recording.load(folder / "twin.npz"),
    )
    dt = 0.002
    np.testing.assert_allclose(np.diff(twin.time), dt, atol=1e-9)
    command, twin_commands = log.of_quantity("command")["spine"], twin.ctrl[:, 8]
    for tick in (0, 1, 777, len(twin_commands) - 1):
        last = command.values[command.times <= tick * dt + 1e-9][-1]
        assert twin_commands[tick] == pytest.approx(last, abs=1e-6)


@pytest.mark.release
def test_a_twin_of_the_robots_delay_is_nearer(folder, tmp_path) -> None:
    """The residual tells a better twin from a worse one: the same log without its delay."""
    write_log(tmp_path, seconds=4.0, **{**FAULTS, "delay": 0.0})
    nearer = {
        e["name"]: e["rms"]
        for e in json_of("replay", "--commands", tmp_path / "robot.csv")["channels"]
    }
    errors = {
        e["name"]: e["rms"] for e in json.loads((folder / "replay.json").read_text())["channels"]
    }
    assert all(nearer[name] < 0.6 * errors[name] for name in ("pos_spine", "pos_neck", "heading"))


@pytest.mark.release
def test_view_and_plot_lay_measured_over_simulated(folder, tmp_path) -> None:
    from nermo_mjx.view.recorded import beside_log

    plots_by_key = {
        plot_shown.key: plot_shown for plot_shown in beside_log(Recording.load(folder / "twin.npz"))
    }
    spine = plots_by_key["log_pos_spine"]
    measured, simulated = (line.values for line in spine.lines)
    assert re.fullmatch(r"pos_spine: lag 1[3-7] ms, RMS 0\.\d+", spine.title)
    assert np.isnan(measured).any(), "gaps are no samples"
    assert np.nanstd(measured - simulated) < 0.3 * np.nanstd(simulated)
    files = json_of("plot", folder / "twin.npz", "--out", tmp_path, "--format", "png")["files"]
    assert any(file.endswith("beside-robot.png") for file in files)
    page = json_of("view", folder / "twin.npz", "--out", tmp_path / "twin.html", "--no-open")[
        "page"
    ]
    assert "pos_spine: lag 1" in Path(page).read_text()


@pytest.mark.release
def test_compare_says_how_far_logs_and_recordings_are_apart(folder) -> None:
    """A robot repeats itself within its noise; the twin is farther away, and the signs of lags follow B minus A."""
    again = {
        e["name"]: e
        for e in json_of("compare", folder / "robot.csv", folder / "again.csv")["channels"]
    }
    twin = {
        e["name"]: e
        for e in json_of("compare", folder / "robot.csv", folder / "twin.npz")["channels"]
    }
    back = {
        e["name"]: e
        for e in json_of("compare", folder / "twin.npz", folder / "robot.csv")["channels"]
    }
    assert again["cmd_spine"]["rms"] == pytest.approx(0.0, abs=1e-5)
    noise = np.hypot(FAULTS["noise"], FAULTS["quantum"] / np.sqrt(12.0)) * np.sqrt(2.0)
    assert again["pos_spine"]["rms"] == pytest.approx(noise, rel=0.1)
    assert twin["pos_spine"]["rms"] > 1.5 * noise
    assert twin["pos_spine"]["lag"] == pytest.approx(-0.015, abs=0.002)
    assert back["pos_spine"]["lag"] == pytest.approx(0.015, abs=0.002)
    assert "deg" in call("compare", folder / "robot.csv", folder / "twin.npz").stdout
    # In either order at the log's 100 Hz, as `replay --commands` reports it: log minus twin.
    replayed = {
        entry["name"]: entry
        for entry in json.loads((folder / "replay.json").read_text())["channels"]
    }
    assert twin.keys() == back.keys() == replayed.keys()
    for name, sign, difference in (
        (n, s, f[n]) for n in replayed for s, f in ((1.0, back), (-1.0, twin))
    ):
        for size in ("rms", "amplitude", "correlation"):
            assert difference[size] == pytest.approx(replayed[name][size], rel=1e-9, abs=1e-12), (
                name
            )
        for signed in ("bias", "lag"):
            assert difference[signed] == pytest.approx(
                sign * replayed[name][signed], rel=1e-9, abs=1e-12
            ), name


@pytest.mark.release
def test_a_track_alone_is_enough(folder, tmp_path) -> None:
    """All that a robot without sensors can give: commands, and a marker in a video."""
    lines = (folder / "robot.yaml").read_text().splitlines()
    remaining_lines = [line for line in lines if not re.match(r"  (pos|gyro|acc)", line)]
    (tmp_path / "track.yaml").write_text("\n".join(remaining_lines) + "\n")
    report = json_of(
        "replay", "--commands", folder / "robot.csv", "--channels", tmp_path / "track.yaml"
    )
    assert [channel["name"] for channel in report["channels"]] == [
        "marker x",
        "marker y",
        "heading",
    ]
    only = [line for line in remaining_lines if "cmd" not in line]
    (tmp_path / "only.yaml").write_text("\n".join(only) + "\n")
    assert json_of("log", folder / "robot.csv", "--channels", tmp_path / "only.yaml")[
        "seconds"
    ] == pytest.approx(4, abs=0.05)
    refused = call(
        "replay", "--commands", folder / "robot.csv", "--channels", tmp_path / "only.yaml"
    )
    assert refused.exit_code == 2
    assert "no channel is a command" in refused.stderr


@pytest.mark.release
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["replay"], "Give a directory, a recorded drive, or --commands LOG."),
        (["replay", "--commands", "LOG", "--row", "3"], "--row has no effect without a directory"),
        (
            ["replay", "--commands", "LOG", "--sweep", "a.yaml"],
            "--sweep has no effect without a recorded drive",
        ),
        (
            ["replay", "DIR", "--row", "3", "--scene", "stairs"],
            "--scene has no effect without --commands LOG",
        ),
        (
            ["log", "MISSING"],
            "give the file of its channels, --channels FILE.yaml; by default it is",
        ),
        (["compare", "LOG"], "Give two directories A and B|is a file: give another log"),
        (
            ["compare", "LOG", "LOG", "--by", "gait"],
            "--by has no effect without directories of sweeps",
        ),
        (
            ["compare", "DIR", "DIR", "--channels", "a.yaml"],
            "--channels has no effect without a robot's log",
        ),
        (["log", "LOG", "--channels", "missing.yaml"], "missing.yaml: there is no such file"),
    ],
)
def test_wrong_use_is_one_sentence(words, sentence, folder) -> None:
    (folder / "dir").mkdir(exist_ok=True)
    (folder / "alone.csv").write_text("t,a\n0,1\n")
    names = {"LOG": folder / "robot.csv", "DIR": folder / "dir", "MISSING": folder / "alone.csv"}
    result = call(*(names.get(word, word) for word in words))
    assert result.exit_code == 2
    assert re.search(sentence, result.stderr)


@pytest.mark.release
def test_a_command_of_no_servo_is_refused(folder, tmp_path) -> None:
    text = (folder / "robot.yaml").read_text().replace("command, of: spine", "command, of: spin")
    (tmp_path / "wrong.yaml").write_text(text)
    result = call(
        "replay", "--commands", folder / "robot.csv", "--channels", tmp_path / "wrong.yaml"
    )
    assert result.exit_code == 2
    assert "channel 'cmd_spine' is 'spin': did you mean 'spine'?" in result.stderr


@pytest.mark.release
def test_a_drive_without_a_robot_prints_and_logs(tmp_path) -> None:
    result = call(
        "drive",
        "--connect",
        "print:",
        "--headless",
        "--seconds",
        "0.5",
        "--record",
        tmp_path / "r.csv",
    )
    assert result.exit_code == 0, result.stderr
    assert re.search(r"q_values: \[-?\d+, ", result.stderr)
    assert re.search(r"It walked for 0\.5 s, and \d+ commands were sent\.", result.stdout)
    log = read_log(tmp_path / "r.csv", tmp_path / "r.yaml")
    assert {channel.quantity for channel in log.channels} == {"command"}
    again = call(
        "drive",
        "--connect",
        "print:",
        "--headless",
        "--seconds",
        "0.5",
        "--record",
        tmp_path / "r.csv",
    )
    assert again.exit_code == 2
    assert "exists; name another file" in again.stderr


@pytest.mark.release
def test_a_log_of_commands_alone_gives_speed_and_angles_in_a_profile(tmp_path) -> None:
    """The author's commands of a trot at 0.8 Hz with the spine.

    Without its first cycles, this walk of the author's model has 101.8 mm/s of the controller's clock, and roll 4.58,
    pitch 1.07 and yaw 6.93 degrees.
    """
    cycles = pd.read_csv(DATA / "author_walk_cycles.csv", comment="#")
    walk = cycles[
        (cycles["gait"] == "trot") & (cycles["frequency"] == 0.8) & (cycles["spine"] == 1)
    ]
    servos = [*walk.columns[5:13], "spine"]
    commands = np.tile(walk.iloc[:, 5:].to_numpy(), (8, 1))
    table = pd.DataFrame(commands, columns=[f"cmd_{servo}" for servo in servos])
    table.insert(0, "time", 0.004 * np.arange(len(table)))
    table.to_csv(tmp_path / "author.csv", index=False)
    channels = ["time: {column: time, unit: s}", "channels:"]
    channels += [
        f"  cmd_{servo}: {{quantity: command, of: {servo}, unit: rad}}" for servo in servos
    ]
    (tmp_path / "author.yaml").write_text("\n".join(channels) + "\n")
    arguments = ("replay", "--commands", tmp_path / "author.csv", "--profile", "as_published")
    metrics = json_of(*arguments)["metrics"]
    assert 400 * metrics["speed"] == pytest.approx(101.8, rel=0.06)
    for axis, angle in {"roll": 4.58, "pitch": 1.07, "yaw": 6.93}.items():
        assert np.degrees(metrics[f"{axis}_std"]) == pytest.approx(angle, rel=0.12), axis
    shown = call(*arguments).stdout
    assert re.search(r"speed \[mm/s\] +roll \[deg\] +pitch \[deg\] +yaw \[deg\]", shown)
    default = json_of(*arguments[:3])["metrics"]
    assert default["speed"] != pytest.approx(metrics["speed"], rel=0.05)
