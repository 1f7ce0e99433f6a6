# Tests of identify/identification.py, identify/body.py, identify/twin.py, identify/report.py, identify/proposal.py
"""Identification from a log: a model under logged commands, and what the command says of it."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nermo_mjx.cli import main as command
from nermo_mjx.files import FileError
from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.identify.body import MjcfBody, NermoBody
from nermo_mjx.identify.identification import Identification, identify_log
from nermo_mjx.identify.twin import LoggedTwin, truncate_log
from nermo_mjx.learn.spec import Training
from nermo_mjx.optimize import Search, Tuning
from nermo_mjx.robot import SERVOS, ParameterError, identified
from nermo_mjx.sweep import Sweep


def main(arguments: list[str]) -> int:
    """Run a command, and return its exit code."""
    with pytest.raises(SystemExit) as ended:
        command(arguments)
    return int(ended.value.code or 0)


#: The arm of which gain, damping, armature and mass are free: only their ratios show in its angles.
ARM = """<mujoco><option timestep="0.002"/><worldbody>{base}<body name="arm" pos="0 0 1">{free}
<geom type="sphere" size="0.01" mass="0.5"/><body name="link"><joint name="j" axis="0 1 0" damping="{damping}"
armature="{armature}"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="{mass}"/></body></body></worldbody>
<actuator><{actuator} name="servo" joint="j" {gain}/></actuator></mujoco>"""
TRUTH = {"damping": 0.02, "armature": 0.002, "mass": 0.1, "kp": 2.0}
START = {"damping": 0.05, "armature": 0.004, "mass": 0.05, "kp": 1.0}
SCALES = ("damping", "armature", "mass", "kp")
NOISE = 1e-3


def arm(values: dict[str, float], free: str = "", actuator: str = "position") -> str:
    gain = f'kp="{values["kp"]}"' if actuator == "position" else f'gear="{values["kp"]}"'
    return ARM.format(**values, free=free, base="", actuator=actuator, gain=gain)


def logged(
    seconds: float = 4.0,
    seed: int = 0,
    bias: float = 0.0,
    steps_late: int = 0,
    actuator: str = "position",
) -> Log:
    """The arm under a chirp that is held for 10 ms, by `mj_step`."""
    model = mujoco.MjModel.from_xml_string(arm(TRUTH, actuator=actuator))
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    time = np.arange(round(seconds * 100)) / 100
    size = 0.5 if actuator == "position" else 0.02
    command = size * np.sin(2 * np.pi * (0.5 + 1.5 * time / seconds) * time)
    held, angles = np.repeat(command, 5), []
    for step in range(len(held)):
        data.ctrl[:] = held[max(step - steps_late, 0)] + bias
        angles.append(data.qpos[0])
        mujoco.mj_step(model, data)
    seen = np.array(angles)[::5] + random.normal(0.0, NOISE, len(time))
    return Log(
        (
            Channel("command", "command", "servo", time, command),
            Channel("angle", "angle", "j", time, seen),
        ),
        "log",
    )


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("arm") / "arm.xml"
    file.write_text(arm(START))
    return file


def identified_arm(path: Path, free: tuple[str, ...], *logs: Log, **more: object) -> Identification:
    return identify_log(logs, path, free, **more)


def values_of(found: Identification) -> dict[str, float]:
    return {
        each.name: value
        for each, value in zip(found.fit.space.parameters, found.fit.values, strict=True)
    }


def test_the_prediction_at_the_truth_is_the_log_to_its_noise(path: Path) -> None:
    log = logged(bias=0.05, steps_late=6)
    body = MjcfBody(path, [log], (*SCALES, "bias", "delay"))
    names = ["damping.j", "armature.j", "mass.link", "kp.servo", "bias.servo", "delay"]
    twin = LoggedTwin(body, [log], names)
    away = twin.predict(np.array([[0.02, 0.002, 0.1, 2.0, 0.05, 0.012]]))[0] - twin.measured.values
    late = twin.measured.time > 1.0  # it begins at the measured angle, whose velocity is not known
    assert np.std(away[late]) == pytest.approx(NOISE, rel=0.1)
    assert abs(away[late].mean()) < NOISE / 5


def test_an_arm_whose_scale_no_angle_shows_is_known_in_ratios_only(path: Path) -> None:
    found = identified_arm(path, SCALES, logged())
    said = " ".join(found.sentences())
    assert not found.fit.determined.any()
    assert found.right
    assert "Determined only together:" in said
    assert "kp.servo / mass.link" in said
    values = values_of(found)
    assert values["damping.j"] / values["kp.servo"] == pytest.approx(0.01, rel=0.01)
    assert values["kp.servo"] / values["mass.link"] == pytest.approx(20.0, rel=0.02)
    assert 0.9 < found.errors["identified"] < 1.1 < found.errors["default body"]


def test_what_is_determined_is_found_and_covered(path: Path) -> None:
    found = identified_arm(
        path, ("damping", "kp", "armature", "bias", "delay"), logged(bias=0.05, steps_late=6)
    )
    body = MjcfBody(path, [logged()], ())
    assert body.parameters == {}
    truth = {
        "damping.j": 0.01,
        "kp.servo": 1.0,
        "armature.j": 0.001,
        "bias.servo": 0.05,
        "delay": 0.012,
    }  # at its mass
    assert found.right
    assert found.fit.determined.all()
    for (name, value), (low, high) in zip(values_of(found).items(), found.intervals, strict=True):
        assert value == pytest.approx(truth[name], rel=0.05, abs=1e-3)
        assert low - (high - low) <= truth[name] <= high + (high - low)


@pytest.mark.release
def test_a_wrong_class_is_named_and_what_it_lacks(path: Path) -> None:
    found = identified_arm(path, ("damping", "bias"), logged())
    said = " ".join(found.sentences())
    assert not found.right
    assert "This class of models is wrong" in said
    assert re.search(
        r"On what was not fitted they are [\d.]+ % of the channels' signals, with the default body [\d.]+ %\.",
        said,
    )
    cause = next(each for each in found.sentences() if each.startswith("What was left out"))
    assert found.missing["kp"] > 0.5
    assert "kp" in cause


@pytest.mark.release
def test_the_simplest_class_leaves_out_what_is_not_there(path: Path) -> None:
    found = identified_arm(path, ("damping", "armature", "kp", "bias", "frictionloss"), logged())
    assert {"bias", "frictionloss"} <= set(found.left_out)
    assert found.errors["simplest class"] < 1.1
    # Values are those of the class that is nearer to what was not fitted.
    names = [each.name for each in found.fit.space.parameters]
    own = [names.index(each.name) for each in found.simplest.space.parameters]
    better, worse = (
        dataclasses.replace(
            found, errors=found.errors | {"simplest class": share * found.errors["identified"]}
        )
        for share in (0.6, 1.01)
    )
    np.testing.assert_array_equal(better.values[own], found.simplest.values)
    assert better.values[names.index("bias.servo")] == 0.0
    np.testing.assert_array_equal(worse.values, found.fit.values)
    assert any("follows the noise" in each for each in better.sentences())
    assert not any("follows the noise" in each for each in worse.sentences())


def test_every_body_of_the_posterior_explains_the_log(path: Path) -> None:
    """Those of the simplest class have what it leaves out at its neutral value, not as another class draws it."""
    found, both = identified_arm(path, SCALES, logged()), list[float]()
    twin, left = (
        found.fitted.twin,
        [each.kind in found.left_out for each in found.fit.space.parameters],
    )
    assert any(left)
    for away in twin.predict(found.bodies[:: len(found.bodies) // 20]) - twin.measured.values:
        both.append(float(np.sqrt(np.mean(away[twin.measured.time > 1.0] ** 2))) / NOISE)
    assert max(both) < 2.0


@pytest.mark.release
def test_the_result_is_the_same_twice(path: Path) -> None:
    one, other = (identified_arm(path, ("damping", "kp"), logged(2.0)) for _ in range(2))
    assert np.array_equal(one.fit.values, other.fit.values)
    assert np.array_equal(one.intervals, other.intervals)


def test_two_logs_of_one_command_say_how_well_the_robot_repeats_itself(path: Path) -> None:
    found = identified_arm(path, ("damping", "kp", "armature"), logged(2.0), logged(2.0, seed=1))
    assert found.repeatability["angle"] == pytest.approx(1.0, rel=0.2)
    assert "Two logs of one command" in " ".join(found.sentences())


def test_an_arm_that_motors_push_is_set_to_its_angles_again(tmp_path: Path) -> None:
    file = tmp_path / "motor.xml"
    file.write_text(arm(TRUTH | {"damping": 0.05}, actuator="motor"))
    log = logged(actuator="motor")
    found = identified_arm(file, ("damping",), log)
    assert values_of(found)["damping.j"] == pytest.approx(0.02, rel=0.05)


def test_a_model_without_servos_is_told_what_it_needs(tmp_path: Path) -> None:
    file, log = tmp_path / "motor.xml", logged(0.5)
    command, angle = (dataclasses.replace(each, unit="rad", of="j") for each in log.channels)
    for text, sentence in (
        (
            arm(TRUTH, actuator="motor"),
            r"^channel 'command' commands positions, .* a force: write <position name=\"servo\"",
        ),
        (
            re.sub("<actuator>.*</actuator>", "", arm(TRUTH)),
            "^no actuator of the model turns the joint 'j': write <pos",
        ),
    ):
        file.write_text(text)
        with pytest.raises(ParameterError, match=sentence):
            identify_log([Log((command, angle), "log")], file, ("damping",))


def test_a_base_that_no_channel_sees_is_held(tmp_path: Path) -> None:
    file = tmp_path / "floating.xml"
    ground = '<worldbody><geom type="plane" size="1 1 1" pos="0 0 1"/>'
    file.write_text(arm(START, free="<freejoint/>").replace("<worldbody>", ground))
    body = MjcfBody(file, [logged(0.5)], ("kp", "damping", "frictionloss"))
    assert body.model.nv == 1
    assert "held" in body.notes[0]
    data = mujoco.MjData(body.model)
    mujoco.mj_forward(body.model, data)
    assert data.ncon == 0, (
        "a base that moves does not touch its own limbs, and one that hangs is above ground"
    )
    other = mujoco.MjModel.from_xml_string(
        body.mjcf_text(["damping.j", "frictionloss.j"], np.array([0.3, 0.1]))
    )
    assert other.dof_damping.tolist() == [0.0] * 6 + [0.3]
    assert other.dof_frictionloss.tolist() == [0.0] * 6 + [0.1]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"of": "elbow"}, "no servo or joint 'elbow'"),
        ({"quantity": "gyro", "of": "imu", "values": np.zeros((400, 3))}, "no gyro sensor 'imu'"),
        ({"quantity": "position", "of": "torso", "values": np.zeros((400, 2))}, "no body 'torso'"),
        ({"quantity": "current"}, "no channel of the log is one that a model predicts"),
    ],
)
def test_channels_that_the_model_lacks_are_refused(
    path: Path, change: dict[str, object], sentence: str
) -> None:
    commands, angle = logged().channels
    log = Log((commands, dataclasses.replace(angle, **change)), "log")
    with pytest.raises(ParameterError, match=sentence):
        LoggedTwin(MjcfBody(path, [log], ("kp",)), [log], ["kp.servo"])


@pytest.mark.parametrize(
    ("wanted", "sentence"),
    [
        ({"free": ("colour",)}, "'colour' is no kind"),
        ({"free": ("tendon",)}, "nothing is free"),
        ({"free": ("kp",), "ranges": {"mass": (1, 2)}}, "no free parameter"),
        ({"free": ("kp",), "ranges": {"kp": (2, 1)}}, "is empty"),
    ],
)
def test_wrong_wishes_are_refused(path: Path, wanted: dict[str, object], sentence: str) -> None:
    log = logged(0.5)
    with pytest.raises(ParameterError, match=sentence):
        identify_log([log], path, **wanted)


@pytest.mark.parametrize(
    ("channels", "sentence"),
    [
        (
            lambda commands, angle: (angle,),
            r"^log: no channel is a command, by which the model could be driven\.$",
        ),
        (
            lambda *both: truncate_log(Log(both, "log"), 0.03).channels,
            r"^channel 'angle' has 1 numbers in what is fitted: ",
        ),
        (
            lambda commands, angle: (commands, *truncate_log(Log((angle,), "log"), 1.0).channels),
            "has 0 numbers in what is not",
        ),
    ],
)
def test_logs_that_cannot_be_judged_are_refused(
    path: Path, channels: Callable[..., tuple[Channel, ...]], sentence: str
) -> None:
    log = Log(channels(*logged(2.0).channels), "log")
    with pytest.raises(ParameterError, match=sentence):
        identify_log([log], path, ("mass",))


def test_a_file_that_is_no_mjcf_is_refused(tmp_path: Path) -> None:
    (tmp_path / "no.xml").write_text("<mujoco><nothing/></mujoco>")
    with pytest.raises(ParameterError, match=r"^model is .*no\.xml': MuJoCo refuses it: "):
        MjcfBody(tmp_path / "no.xml", [logged(0.5)], ("kp",))
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises((ParameterError, FileError), match="pipe"):
        MjcfBody(tmp_path / "pipe.xml", [logged(0.5)], ("kp",))


def written(tmp_path: Path, log: Log) -> list[str]:
    commands, angle = log.channels
    rows = [
        f"{t:.4f},{u:.6f},{np.degrees(q):.6f}"
        for t, u, q in zip(commands.times, commands.values, angle.values, strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["t,command,angle", *rows]))
    (tmp_path / "log.yaml").write_text(
        "time: {column: t, unit: s}\nchannels:\n  command: {quantity: command, of: servo, unit: rad}\n"
        "  angle: {quantity: angle, of: j, unit: deg}\n"
    )
    return [
        "identify",
        "--log",
        str(tmp_path / "log.csv"),
        "--channels",
        str(tmp_path / "log.yaml"),
    ]


def test_replay_drives_any_model_by_the_commands(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The true arm leaves the noise of the encoder alone; the other arm is farther away."""
    _, _, *arguments = written(tmp_path, logged())[1:]
    (tmp_path / "true.xml").write_text(arm(TRUTH))
    found = {}
    for name, model in (("true", tmp_path / "true.xml"), ("other", path)):
        log = str(tmp_path / "log.csv")
        assert main(["replay", "--commands", log, *arguments, "--model", str(model), "--json"]) == 0
        content = json.loads(capsys.readouterr().out)
        (found[name],) = content["channels"]
        assert (content["model"], content["not_simulated"], found[name]["name"]) == (
            str(model),
            [],
            "angle",
        )
    assert found["true"]["rms"] == pytest.approx(NOISE, rel=0.15)
    assert found["true"]["correlation"] > 0.999
    assert found["other"]["rms"] > 20 * NOISE
    assert (
        main(["replay", "--commands", log, *arguments, "--model", str(path), "--scene", "stairs"])
        == 2
    )
    assert "--scene is for Nermo: it has no effect with --model" in capsys.readouterr().err
    lines = (tmp_path / "log.yaml").read_text().splitlines(keepends=True)
    (tmp_path / "silent.yaml").write_text("".join(line for line in lines if "command" not in line))
    silent = ["--channels", str(tmp_path / "silent.yaml"), "--model", str(path)]
    assert main(["replay", "--commands", log, *silent]) == 2
    assert "no channel is a command, by which the model could be driven" in capsys.readouterr().err
    assert main(["replay", str(tmp_path), "--row", "0", "--model", str(path)]) == 2
    assert "--model has no effect without --commands LOG" in capsys.readouterr().err


@pytest.mark.release
def test_the_command_writes_a_report_the_model_and_what_to_measure_next(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = written(tmp_path, logged(bias=0.05))
    out = tmp_path / "out"
    code = main(
        [
            *arguments,
            "--model",
            str(path),
            "--free",
            "kp,damping,armature,bias",
            "--range",
            "kp=0.5:3",
            "--out",
            str(out),
        ]
    )
    said = capsys.readouterr().out
    assert not code
    assert "Determined: " in said
    assert "Error on what was not fitted" in said
    content = json.loads((out / "identification.json").read_text())
    assert content["right"]
    assert content["parameters"]["kp.servo"]["low"] == 0.5
    assert {"report.html", "identified.xml", "plots"} <= {each.name for each in out.iterdir()}
    assert "To make it again" in (out / "report.html").read_text()
    assert 'src="http' not in (out / "report.html").read_text()
    model = mujoco.MjModel.from_xml_path(str(out / "identified.xml"))
    assert model.actuator_gainprm[0, 0] == pytest.approx(
        content["parameters"]["kp.servo"]["value"], rel=1e-4
    )
    assert model.dof_damping[0] == pytest.approx(
        content["parameters"]["damping.j"]["value"], rel=1e-4
    )
    assert not main(["status", str(out)])
    assert re.search(r"an identification from a log, \d+ steps, complete", capsys.readouterr().out)
    assert main(["plot", str(out)])
    assert "only the command that made" in capsys.readouterr().err
    assert not main(["view", str(out), "--out", str(tmp_path / "page.html"), "--no-open"])
    assert (tmp_path / "page.html").read_text() == (out / "report.html").read_text()
    assert (out / "report.html").read_text().count("data:image/svg+xml;base64,") == 3
    (out / "identification.json").unlink()
    assert main(["view", str(out), "--no-open"])
    assert "contains no complete identification" in capsys.readouterr().err
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "run.json").write_text('{"kind": "sweep"}')
    assert main([*arguments, "--model", str(path), "--out", str(tmp_path / "sweep")])
    assert "holds a sweep, and not an identification from a log" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--range", "kp=2"], "expected NAME=LOW:HIGH"),
        (["--range", "kp=-1:2"], "--range kp: -1 to 2 is not above 0, as kp.servo is"),
        (["--range", "kp=1:inf"], "--range kp: 1 to inf is empty, or has no end"),
        (["--free", "colour"], "is no kind of parameters"),
        (["--robot", "nermo_lite"], "--model is another robot: give it, or --robot"),
    ],
)
def test_wrong_options_end_in_a_sentence(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], sentence: str
) -> None:
    arguments = written(tmp_path, logged(0.5))
    assert main([*arguments, "--model", str(path), *more, "--out", str(tmp_path / "out")]) != 0
    assert sentence in capsys.readouterr().err


# --- Nermo


def test_nermo_is_driven_and_its_bodies_differ() -> None:
    body = NermoBody(
        "nermo_lite", ("kp", "damping", "mass", "friction", "delay", "bias", "backlash")
    )
    time = np.arange(100) / 100
    channels = [Channel(f"c_{s}", "command", s, time, 0.2 * np.sin(12 * time)) for s in SERVOS[:8]]
    channels += [Channel("hip", "angle", "front_left_hip", time, np.zeros(100))]
    channels += [Channel("knee", "angle", "front_left_knee", time, np.zeros(100))]
    channels += [Channel("track", "position", "torso", time, np.zeros((100, 2)))]
    log = Log(tuple(channels), "log")
    names = ["servo.kp", "mass.front", "delay", "bias.front_left_hip"]
    twin = LoggedTwin(body, [log], names)
    found = twin.predict(
        np.array([[19.11, 0.12, 0.0, 0.0], [19.11, 0.12, 0.0, 0.05], [6.0, 0.2, 0.03, 0.0]])
    )
    hip = found[:, twin.measured.channel == twin.labels.index("hip")]
    assert np.isfinite(found).all()
    assert np.mean(hip[1] - hip[0]) == pytest.approx(0.05, abs=0.01)
    assert np.argmax(hip[2]) > np.argmax(hip[0])  # later
    address = body.model.jnt_qposadr[body.joint("front_left_knee")]
    assert (
        body.model.joint("front_left_pulley").qposadr[0] == address
    )  # what the servo turns, not the leg's own knee


@pytest.mark.parametrize("kind", [Search, Tuning, Training])
def test_the_best_body_stands_in_a_job_s_file(
    kind: type[Search | Tuning | Training], tmp_path: Path
) -> None:
    (tmp_path / "ensemble.csv").write_text(
        "servo.kp,mass.front,mass.rear,objective,weight\n12,0.15,0.1,1,1\n"
    )
    section = {Search: "vary: {servo.kp: {uniform: [9, 15]}}\nobjective: {maximize: speed}\n"}
    section[Tuning] = (
        "tune: {servo.kp: {start: 12, bounds: [9, 15]}}\nobjective:\n- {maximize: speed, scale: 0.1}\n"
    )
    text = section.get(kind, "randomize: {servo.kp: [9, 15]}\n") + "set: {mass.rear: 0.12}\n"
    (tmp_path / "job.yaml").write_text(text)
    made = kind.from_file(tmp_path / "job.yaml", str(tmp_path))
    assert dict(made.resolved()["set"] if kind is not Search else made.sweep.fixed) == {
        "mass.front": 0.15,
        "mass.rear": 0.12,
    }  # type: ignore[union-attr]
    with pytest.raises(ParameterError, match="no directory of an identification"):
        kind.from_file(tmp_path / "job.yaml", str(tmp_path / "none"))


def test_a_training_draws_from_a_directory_as_a_sweep_does(tmp_path: Path) -> None:
    (tmp_path / "ensemble.csv").write_text("servo.kp,objective,weight\n12,1,1\n")
    training = Training.from_dict({"randomize": {"from": str(tmp_path), "start.yaw": [0.0, 0.1]}})
    assert (training.task.bodies, dict(training.task.randomize)) == (
        str(tmp_path),
        {"start.yaw": (0.0, 0.1)},
    )
    assert Training.from_dict(training.resolved()) == training
    with pytest.raises(ParameterError, match=r"'randomize\.from' stands beside 'task\.bodies'"):
        Training.from_dict({"randomize": {"from": str(tmp_path)}, "task": {"bodies": True}})


@pytest.mark.release
def test_bodies_of_an_identification_are_drawn_and_walked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ensemble.csv").write_text(
        "# made\nservo.kp,mass.front,objective,weight\n12,0.15,1,0.5\n14,0.16,1,0.5\n"
    )
    assert identified.bodies(str(tmp_path)).values["servo.kp"].tolist() == [12.0, 14.0]
    arguments = [
        "walk",
        "--engine",
        "c",
        "--duration",
        "0.1",
        "--json",
        "--body",
        str(tmp_path),
        "--set",
        "mass.front=0.17",
    ]
    assert not main(arguments)
    walked = json.loads(capsys.readouterr().out)["parameters"]
    assert (walked["servo.kp"], walked["mass.front"]) == (12.0, 0.17)
    assert main(["walk", "--body", str(tmp_path / "none")]) != 0
    assert "no directory of an identification" in capsys.readouterr().err
    file, out = tmp_path / "sweep.yaml", tmp_path / "swept"
    file.write_text("run: {duration: 0.1}\nvary: {mass.*: [0.17]}\nset: {frequency: 1.0}\n")
    assert not main(
        ["sweep", str(file), "--engine", "c", "--body", str(tmp_path), "--out", str(out)]
    )
    assert Sweep.from_directory(out).fixed == {"frequency": 1.0, "servo.kp": 12.0}
    (tmp_path / "ensemble.csv").write_text("nothing\n")
    identified.bodies.cache_clear()
    with pytest.raises(ParameterError, match="damaged"):
        identified.bodies(str(tmp_path))
