# Tests of cli/walk.py, cli/jobs.py, cli/view.py, cli/tools.py, cli/choices.py
"""The command line, as a user and as a script meet it: help, exit codes, pure JSON, sentences instead of tracebacks."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner
from command import call, json_of
from fakes.experiment_fake import Fake, pretend

from nermo_mjx import Recording, load_robot
from nermo_mjx.cli import choices, main
from nermo_mjx.progress import COMPILATION_MESSAGE, ProgressBar, duration
from nermo_mjx.rollout import Setup
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.files import plain_json
from nermo_mjx.sweep import Sweep
from nermo_mjx.version import __version__

pytestmark = pytest.mark.usefixtures("shared_simulators")

#: A walk as short as a walk can be.
SHORT = ("walk", "--engine", "c", "--duration", "0.3", "--warmup", "0.1")


def refused(*arguments: str | Path) -> str:
    """The message of a misused command: exit code 2, nothing on standard output, no traceback."""
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    return result.stderr


# --- help


@pytest.mark.parametrize("command", [(), *((name,) for name in main.commands)])
def test_help_fits_80_columns_and_ends_with_an_example(command: tuple[str, ...]) -> None:
    text = call(*command, "--help").stdout
    assert max(map(len, text.splitlines())) <= 80
    assert "  nermo-mjx " in text[text.index("Options:") :]


@pytest.mark.release
@pytest.mark.parametrize(
    ("script", "heavy"),
    [
        (
            "from nermo_mjx.cli import main; main(['walk', '--help'], standalone_mode=False)",
            {"jax", "mujoco", "scipy", "pyarrow", "matplotlib"},
        ),
        # Together they take a quarter of a walk's import time, and only courses and result tables need them.
        (
            "import nermo_mjx.rollout, nermo_mjx.runs; nermo_mjx.rollout.Setup().load()",
            {"scipy.interpolate", "pyarrow"},
        ),
    ],
)
def test_what_is_not_needed_is_not_imported(script: str, heavy: set[str]) -> None:
    script = f"{script}\nimport sys\nassert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_the_package_is_a_command_too() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "nermo_mjx", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"nermo-mjx {__version__}\n"


def test_examples_in_the_help_are_valid_commands() -> None:
    for name, command in main.commands.items():
        lines = re.findall(r"^  nermo-mjx (.*)$", command.epilog or "", re.MULTILINE)
        assert lines
        for line in lines:
            # Files need not exist for the check of names and values.
            first, *words = re.sub(r"\b(walk|other|front)\.(npz|csv)", __file__, line).split()
            assert first == name
            command.make_context(name, words)


# --- wrong use


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["wlak"], "Did you mean 'walk'"),
        (["sweep", "--list-parameter"], "--list-parameters"),
        (["walk", "--gait", "canter"], "'trot', 'walking_trot', 'lateral_walk'"),
        (["walk", "--frequency", "50"], "frequency is 50: allowed is [0.001, 5] Hz."),
        (["walk", "--scene", "moon"], "scene is 'moon': allowed is 'balance_stand' or 'flat'"),
        (["walk", "--spine-amplitude", "0.2"], "--spine-amplitude has no effect with --spine none"),
        (
            ["walk", "--turn-rate", "0.2", "--pilot", "arc"],
            "--turn-rate has no effect with --pilot arc",
        ),
        (["walk", "--set", "frequency"], "expected NAME=VALUE"),
        (["walk", "--set", "frequncy=1"], "did you mean frequency?"),
        (["walk", "--set", "amplitude=1"], "did you mean spine.amplitude?"),
        (
            ["walk", "--set", "frequency=quick"],
            "frequency is 'quick': expected a number in Hz, such as 0.67 Hz.",
        ),
        (["walk", "--cycles", "3", "--duration", "2"], "Give --cycles or --duration, not both."),
        (
            ["walk", "--cycles", "2", "--warmup", "2"],
            "--warmup is 2: it must be shorter than the run, 2.",
        ),
        (["walk", "--video", "walk.avi"], "a video ends in .mp4, .gif or .webp"),
        (
            ["walk", "--video", "walk.mp4", "--camera", "moon"],
            "camera is 'moon': allowed is one of three_quarter",
        ),
        (
            ["drive", "--connect", "mqtt://a", "--serve", "mqtt://a"],
            "Give --connect URL or --serve URL, not both.",
        ),
        (["drive", "--rate", "30"], "--rate has no effect without --connect URL."),
        (
            ["drive", "--connect", "mqtt://a", "--loss", "0.5"],
            "--loss has no effect without --serve URL.",
        ),
        (
            ["drive", "--connect", "mqtt://a", "--headless", "--port", "8"],
            "--port has no effect without a page.",
        ),
        (["drive", "--robot", "nermo_5"], "'nermo_5' is not one of 'nermo_lite', 'nermo_41'"),
        (["drive", "--record", "a.csv"], "--record has no effect without --connect URL."),
        (
            ["drive", "--connect", "print:", "--headless", "--record", "a.npz"],
            "--record has no effect without a page.",
        ),
        (
            ["drive", "--connect", "print:", "--headless", "--rate", "200"],
            "rate is 200 Hz: allowed is (0, 100], the",
        ),
        (
            ["drive", "--connect", "tcp://me:secret@a", "--headless"],
            "connect is 'tcp://...@a': allowed is mqtt://HOST[:P",
        ),
        (
            ["drive", "--serve", "mqtt://me:secret@a:99999"],
            "serve is 'mqtt://...@a:99999': allowed is mqtt://HOST[:",
        ),
        (["replay", "."], "Give --row N, a row of the table."),
        (["servos", "--frequency", "0.8"], "Give --out FILE.csv, --send URL, or both."),
        (["plot", "missing"], "missing: there is no such file or directory."),
        (["sweep"], "A sweep needs SPEC.yaml or --rows FILE, and --out DIR"),
        (["sweep", "missing.yaml", "--out", "runs"], "missing.yaml: there is no such file."),
        (["sweep", "a.yaml", "--out", "b", "--shard", "4/4"], "I from 0 to N - 1"),
        (
            ["experiment", "turnin", "--out", "a"],
            "not one of 'straight-line', 'turning', 'balance', 'maze', 'body', ",
        ),
        (
            ["experiment", "maze", "--out", "a", "--set", "frequency=1"],
            "frequency cannot be set for maze",
        ),
        (
            ["experiment", "maze", "--out", "a", "--set", "servo.kp"],
            "expected NAME=VALUE, such as frequency=0.67",
        ),
        (
            ["experiment", "maze", "--out", "a", "--set", "contact.friction=9"],
            "friction is 9: allowed is [0.05, 5].",
        ),
        (
            ["experiment", "maze", "--out", "/sys/kernel/nermo"],
            "cannot write in /sys/kernel/nermo: ",
        ),
    ],
)
def test_wrong_use_is_exit_code_2_and_one_sentence(arguments: list[str], sentence: str) -> None:
    with CliRunner().isolated_filesystem():
        message = " ".join(refused(*arguments).split())
        assert sentence in message
        assert "secret" not in message


@pytest.mark.parametrize(
    "command", ["render --out a.mp4", "view --out a.html", "plot --out plots", "play --xml a.xml"]
)
def test_what_is_no_recording_or_an_old_one_is_refused_with_the_remedy(
    command: str, tmp_path: Path
) -> None:
    name, *options = command.split()
    time, states = np.arange(1, 4) * 0.01, np.zeros((3, load_robot().model.nq))
    old = Recording(
        time, states, np.zeros((3, 3)), np.zeros((3, 11)), model_hash="0123456789abcdef"
    )
    (tmp_path / "text.npz").write_text("no recording")
    np.savez(tmp_path / "other.npz", speed=np.zeros(3))
    cases = {
        tmp_path
        / "text.npz": "so it is not a recording of nermo_mjx; nermo-mjx walk --record FILE.npz writes",
        tmp_path
        / "other.npz": "not a recording of nermo_mjx; nermo-mjx walk --record FILE.npz writes one, and "
        "nermo-mjx log reads a robot's log.",
        old.save(
            tmp_path / "old.npz"
        ): "made with another version of the robot's model; record the run again.",
    }
    files = sorted(tmp_path.iterdir())
    with contextlib.chdir(tmp_path):
        for path, sentence in cases.items():
            error = refused(name, path, *options)
            assert error.startswith(f"nermo-mjx: {path}: ")
            assert sentence in error
            assert error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == files


@pytest.mark.release
@pytest.mark.parametrize(
    ("variable", "command", "remedy"),
    [
        ("JAX_PLATFORMS=cuda", "walk --engine mjx --quiet", "unset it to compute on the CPU"),
        ("JAX_PLATFORMS=moon", "servos --out a.csv", "unset it to compute on the CPU"),
        ("MUJOCO_GL=glfw", "walk --duration 0.3 --quiet --video a.mp4", "set MUJOCO_GL=osmesa"),
        (
            "MUJOCO_GL=moon",
            "walk --duration 0.3 --quiet --video a.mp4",
            "allowed is egl, osmesa or glfw",
        ),
    ],
)
def test_what_the_environment_wants_and_the_machine_has_not_is_a_sentence(
    variable: str, command: str, remedy: str, tmp_path: Path
) -> None:
    name, value = variable.split("=")
    program = [sys.executable, "-m", "nermo_mjx", *command.split()]
    environment = os.environ | {name: value, "DISPLAY": ""}
    done = subprocess.run(program, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(rf"nermo-mjx: .*{re.escape(remedy)}.*\n", done.stderr)
    assert name in done.stderr
    assert list(tmp_path.iterdir()) == []


# --- failed, stopped


def test_a_failure_is_exit_code_1_and_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also Ctrl-C, which says what to do."""
    result = call("model", "--xml", tmp_path / "missing" / "robot.xml")
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1)
    assert "cannot be written" in result.stderr
    monkeypatch.setattr("nermo_mjx.cli.walk.planned_walk", Mock(side_effect=KeyboardInterrupt))
    result = call("walk")
    assert result.exit_code == 1
    assert result.stderr.startswith("nermo-mjx: stopped; ")


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    "sent", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_stopped_sweep_says_how_to_go_on_and_goes_on(tmp_path: Path, sent: int) -> None:
    spec, out = tmp_path / "sweep.yaml", tmp_path / "out"
    spec.write_text(
        "run: {cycles: 3, warmup_cycles: 1}\nvary: {frequency: {linspace: [0.8, 1.2, 24]}}\nchunk: 2\n"
    )
    # A shell starts background jobs with Ctrl-C ignored, and the tests may run in one.
    heed = "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    start = f"{heed}; runpy.run_module('nermo_mjx', run_name='__main__', alter_sys=True)"
    command = [sys.executable, "-c", start, "sweep", str(spec), "--out", str(out), "--engine", "c"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 120
    while not list(out.glob("results/*.parquet")) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(sent)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1, error
    assert "run the same command again" in error
    assert "Traceback" not in error
    result = json_of("sweep", spec, "--out", out, "--engine", "c")
    assert result["complete"]
    assert 0 < result["chunks_run"] < 12
    assert result["summary"]["rows"] == 24


# --- results


@pytest.mark.release
def test_walk_json_is_one_object_with_the_promised_fields(tmp_path: Path) -> None:
    from nermo_mjx.rollout import METRICS

    report = json_of(*SHORT, "--frequency", "0.9", "--set", "contact.friction=0.7")
    assert set(METRICS) | {"status"} <= set(report["metrics"])
    assert report["metrics"]["status"] == "ok"
    assert report["metrics"]["fell"] is False
    assert report["parameters"]["frequency"] == 0.9
    assert report["parameters"]["contact.friction"] == 0.7
    assert report["parameters"]["gait_factor"] == 2.0, "defaults are in it too"
    assert report["engine"] == "c"
    assert report["versions"]["mujoco"] == mujoco.__version__


@pytest.mark.release
def test_options_reach_the_simulation(tmp_path: Path) -> None:
    options = (
        "--spine",
        "stride_extension",
        "--spine-amplitude",
        "0.3",
        "--spine-phase",
        "0.5",
        "--stride",
        "0.8",
    )
    extra_options = (
        "--gait",
        "lateral_walk",
        "--offset-compensation",
        "--turn-rate",
        "0.4",
        "--steering",
        "mix",
        "--physics",
        "fast",
    )
    last = ("--tail", "articulated", "--profile", "as_published", "--seed", "3")
    report = json_of(*SHORT, *options, *extra_options, *last)
    expected = {
        "spine.amplitude": 0.3,
        "spine.phase": 0.5,
        "stride": 0.8,
        "spine.offset_compensation": 1.0,
        "pilot.turn_rate": 0.4,
        "turning.leg": 1.0,
        "turning.spine": 1.0,
    }
    assert expected.items() <= report["parameters"].items()
    assert report["parameters"]["tracking.foot_gain"] < 1.0
    assert report["parameters"]["start.x"] != 0.0
    setup = {
        "gait": "lateral_walk",
        "pilot": "open_loop",
        "tail": "articulated",
        "physics": "fast",
        # In `as_published` the controller acts every 4 ms: the longest step of `fast` that divides this period.
        "timestep": 0.002,
    }
    assert {name: report["setup"][name] for name in setup} == pytest.approx(setup)


def test_the_seed_decides_the_start() -> None:
    from nermo_mjx.cli.walk import _shifted_start

    assert _shifted_start(1) == _shifted_start(1) != _shifted_start(2)


@pytest.mark.release
@pytest.mark.parametrize(
    ("options", "theory"),
    [
        ((), r"80\.4"),
        (("--spine", "stride_extension"), r"101\.[5-7]"),
        (("--set", "duty=0.8"), r"50\.[23]"),
    ],
)
def test_walk_sums_up_in_millimetres_and_degrees(options: tuple[str, ...], theory: str) -> None:
    """In theory (5.33): 0.67 Hz, two strides of 60 mm, with the spine of 75.8 mm; 1 / 0.8 of 60 mm (erratum 20)."""
    result = call(*SHORT, *options)
    assert result.exit_code == 0
    for line in (
        r"speed +-?[\d.]+ +mm/s",
        rf"speed in theory +{theory} +mm/s",
        r"roll( +-?[\d.]+){4}",
    ):
        assert re.search(rf"^{line}$", result.stdout, re.MULTILINE)
    result = call(*SHORT, *options, "--quiet")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_a_recorded_walk_can_be_rendered(tmp_path: Path) -> None:
    record, video = tmp_path / "walk.npz", tmp_path / "walk.gif"
    report = json_of(*SHORT, "--record", record, "--tail", "articulated")
    assert report["metrics"]["status"] == "ok"
    recording = Recording.load(record)
    model = load_robot(tail="articulated").model
    recording.check_model(model)
    assert recording.ctrl.shape[1] == model.nu
    assert recording.sensors["foot_position"].shape[1:] == (4, 3)
    assert recording.metadata["metrics"] == report["metrics"]
    shape = json_of(
        "render", record, "--out", video, "--fps", "5", "--width", "64", "--height", "48"
    )
    assert shape["video"] == str(video)
    assert video.stat().st_size > 0


@pytest.mark.release
def test_sweep_json_and_directory(tmp_path: Path) -> None:
    spec, out = tmp_path / "sweep.yaml", tmp_path / "out"
    spec.write_text(
        "run: {duration: 0.3, warmup: 0.1}\nvary: {frequency: [0.6, 0.9]}\nplots: false\n"
    )
    result = json_of("sweep", spec, "--out", out, "--engine", "c", "--seed", "5")
    assert result["complete"]
    assert result["summary"]["status"] == {"ok": 2}
    assert result["summary"]["profiles"] == ["exact"]
    assert (out / "summary.json").exists()
    assert "seed: 5" in (out / "sweep.yaml").read_text()
    again = call("sweep", spec, "--out", out, "--engine", "c", "--seed", "5")
    assert again.exit_code == 0
    assert "2 runs, profile exact (2 ok)" in again.stdout
    assert str(out / "results") in again.stdout


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> dict[str, Fake]:
    """Experiments that simulate and draw nothing."""
    return pretend(monkeypatch)


def test_experiment_json_is_the_report_and_nothing_else(
    fakes: dict[str, Fake], tmp_path: Path
) -> None:
    options = ("--out", tmp_path, "--quick", "--seed", "5", "--set", "contact.friction=0.8")
    result = json_of("experiment", "all", *options)
    assert list(result["run"]) == list(choices.EXPERIMENTS)
    assert len(result["lines"]) == 5 * len(choices.EXPERIMENTS)
    stored = json.loads((tmp_path / "report.json").read_text())
    assert {name: result[name] for name in stored} == stored
    settings = fakes["maze"].asked[0]
    assert (settings.seed, settings.quick, settings.repeats, settings.values) == (
        5,
        True,
        1,
        {"contact.friction": 0.8},
    )
    assert json_of("experiment", "maze", *options)["run"] == {"maze": {"kept": True}}
    assert len(fakes["maze"].asked) == 1


def test_experiment_prints_figures_side_by_side_and_where_things_are(
    fakes: dict[str, Fake], tmp_path: Path
) -> None:
    result = call(
        "experiment",
        "turning",
        "--out",
        tmp_path / "out",
        "--no-video",
        "--profile",
        "as_published",
    )
    assert result.exit_code == 0, "a figure that does not hold is no failure"
    for line in (
        r"^figure +kind +published +author's model +as published +exact +as built +90 % +in it +holds$",
        r"^speed at 0\.8 Hz \[mm/s\] +predicted +80 +84\.9 +71\.0 +– +– +– +– +yes$",
    ):
        assert re.search(line, result.stdout, re.MULTILINE)
    assert "turning: 2 of 4 figures hold, 1 not judged or measured (6 runs in " in result.stdout
    assert (
        "predicted: 1 of 2 figures hold; chosen: 1 of 1 figures hold; fitted: 0 of 1"
        in result.stdout
    )
    assert "Only predicted lines count as evidence." in result.stdout
    assert str(tmp_path / "out" / "report.md") in result.stdout
    assert "videos" not in result.stdout


def test_an_experiment_ends_with_the_exit_code_of_what_happened(
    fakes: dict[str, Fake], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1 if it failed, was stopped, or another process works; 2 if other code made it, until that is accepted."""
    from nermo_mjx.view import RecordingError

    run = ("experiment", "all", "--out", tmp_path, "--no-video", "--quiet")
    failed = f"maze failed: it cannot be written. What was done before is kept in {tmp_path}.\n"
    stopped = (
        f"stopped; what is finished is kept in {tmp_path}. To resume, run the same command again.\n"
    )
    for error, sentence in (
        (RecordingError("it cannot be written."), failed),
        (KeyboardInterrupt(), stopped),
    ):
        fakes["maze"].error = error
        result = call(*run)
        assert (result.exit_code, result.stderr) == (1, f"nermo-mjx: {sentence}")
    assert len(json.loads((tmp_path / "report.json").read_text())["lines"]) == 15
    with RunDirectory(tmp_path, "experiments"):
        result = call(*run)
    in_use = f"nermo-mjx: another process works in {tmp_path}; wait for it, or choose another directory.\n"
    assert (result.exit_code, result.stderr) == (1, in_use)
    monkeypatch.setattr("nermo_mjx.runs.code.__version__", "9.9.9")
    fakes["maze"].error = None
    message = refused(*run)
    assert re.search(
        r"was made by other code: nermo-mjx \S+, not 9\.9\.9; .*--accept-new-code", message
    )
    assert message.count("\n") == 1
    for option, runs in (("--accept-new-code", 1), ("--again", 2)):
        assert call(*run, option).exit_code == 0
        assert len(fakes["turning"].asked) == runs


def test_identify_without_a_log_names_the_robot_instances_of_the_package(tmp_path: Path) -> None:
    message = refused("identify", "--out", tmp_path / "out")
    assert "identify needs --log FILE" in message
    assert "randomize: {from: identified}" in message
    assert not (tmp_path / "out").exists()


def test_list_parameters_shows_names_with_unit_default_and_range() -> None:
    from nermo_mjx.rollout import all_parameters

    text, listed = (
        call("sweep", "--list-parameters").stdout,
        json_of("sweep", "--list-parameters")["parameters"],
    )
    assert list(listed) == list(all_parameters())
    assert re.search(
        r"^spine\.amplitude +0\.4 +\[0, 0\.6\] rad +servo amplitude", text, re.MULTILINE
    )
    assert re.search(
        r"^foot\.front\.y1 \.\.\. foot\.front\.z8 +0 +\[-0\.02, 0\.02\] m", text, re.MULTILINE
    )
    assert listed["frequency"]["unit"] == "Hz"


def test_model_sums_up_masses_and_writes_one_file(tmp_path: Path) -> None:
    summary = json_of("model", "--xml", tmp_path / "robot.xml")
    mass = summary["mass"]
    assert mass["front"] + mass["rear"] == pytest.approx(mass["total"])
    assert summary["degrees_of_freedom"] > 20
    alone = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    assert alone.nv == summary["degrees_of_freedom"]
    assert alone.body_subtreemass[0] == pytest.approx(mass["total"])
    assert "total" in call("model").stdout


def test_what_libraries_print_does_not_reach_json(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = Mock(side_effect=lambda **config: print("hello from a library") or load_robot(**config))
    monkeypatch.setattr("nermo_mjx.robot.load_robot", noisy)
    assert json_of("model")["robot"] == "nermo_lite"


# --- small helpers


def test_json_values_are_plain_and_finite_and_durations_are_in_words() -> None:
    value = {
        "a": np.float32(math.inf),
        "b": np.arange(2),
        "c": [math.nan, Path("x")],
        "d": np.bool_(True),
        1: None,
    }
    assert plain_json(value) == {"a": None, "b": [0, 1], "c": [None, "x"], "d": True, "1": None}
    assert [duration(s) for s in (0.4, 59.6, 200, 7500)] == [
        "0 s",
        "1 min 0 s",
        "3 min 20 s",
        "2 h 5 min",
    ]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_without_a_terminal_is_a_line_now_and_then() -> None:
    often, seldom = io.StringIO(), io.StringIO()
    for every, stream in ((0.0, often), (60.0, seldom)):
        with ProgressBar("sweep", "runs", every=every, stream=stream) as progress:
            for done in (50, 75, 100):
                progress.count(done, 100)
    lines = often.getvalue().splitlines()
    assert (len(lines), lines[0]) == (3, "sweep: 50%, 50 of 100 runs")
    assert re.fullmatch(r"sweep: 100%, 100 of 100 runs, \S+ runs/s", lines[-1])
    assert len(seldom.getvalue().splitlines()) == 1, (
        "only the last line, so shortly after the start"
    )


def test_progress_on_a_terminal_is_a_bar_and_quiet_is_nothing() -> None:
    for quiet in (False, True):
        stream = Terminal()
        with ProgressBar("sweep", "runs", quiet=quiet, stream=stream) as progress:
            progress.share(0.5, 50, 100)
        assert ("sweep" in stream.getvalue()) is not quiet


def test_compilation_is_named_only_while_nothing_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nermo_mjx.progress.STALL_SECONDS", 0.05)
    slow, quick = io.StringIO(), io.StringIO()
    for stream, moves in ((slow, False), (quick, True)):
        with ProgressBar("walk", compiles=True, stream=stream) as progress:
            progress.share(0.0)
            progress.share(0.1 * moves)
            time.sleep(0.3)
    assert (slow.getvalue(), quick.getvalue()) == (f"walk: {COMPILATION_MESSAGE}\n", "")


def test_a_narrow_terminal_cuts_the_detail_and_not_the_time_left() -> None:
    stream = Terminal()
    with ProgressBar("tune", "evaluations", stream=stream) as progress:
        progress.share(0.0, 0, 10)
        progress.share(0.5, 5, 10, "best -0.5, " + "speed 80 mm/s, " * 10)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stream.getvalue())
    assert re.search(r"50%, 5 of 10 evaluations, [\d.e+]+ evaluations/s, \d+ s left", text)


@pytest.mark.parametrize(
    ("second", "told"),
    [(1.0, "1 evaluations/s, 8 s left"), (90.0, "1 min 30 s each, 12 min 0 s left")],
    ids=["fast", "slow"],
)
def test_the_pace_leaves_compilation_out(
    monkeypatch: pytest.MonkeyPatch, second: float, told: str
) -> None:
    """A minute of compilation, and then the same time for each: eight are left after two."""
    clock = iter([0.0, 0.0, 60.0, 60.0 + second])
    monkeypatch.setattr("nermo_mjx.progress.time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    progress = ProgressBar("tune", "evaluations", every=0.0, stream=stream)
    progress.share(0.0, 0, 10)
    progress._name_compilation()
    progress.share(0.1, 1, 10)
    progress.share(0.2, 2, 10)
    assert stream.getvalue().splitlines()[-1] == f"tune: 20%, 2 of 10 evaluations, {told}"


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "short"),
    [("trot", "trot"), ("walking_trot", "walking_trot"), ("lateral_walk", "lateral_walk")],
)
def test_gaits_have_the_names_of_the_field(name: str, short: str) -> None:
    assert Setup(gait=name) == Setup(gait=short)
    assert Sweep.from_dict({"gait": name, "vary": {"frequency": [0.6]}}).setup.gait == short
    refused(Sweep.from_dict, f"field 'gait' lists {short} twice", {"vary": {"gait": [name, short]}})
    done = call("walk", "--gait", name, "--cycles", "0.1", "--warmup", "0")
    assert done.exit_code == 0, done.output
    assert f"{name.replace('_', ' ')} at 0.67 Hz" in done.output
