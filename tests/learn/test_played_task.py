# Tests of learn/evaluation.py, learn/directory.py, view/trained.py
"""A training's task played without a policy or with a random one; the page and the videos of a training at work."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import pytest
from command import call, json_of

from nermo_mjx import ParameterError, Run, Simulator
from nermo_mjx.learn import PPO, Policy, Training, run_training
from nermo_mjx.learn.directory import HISTORY_FILE, training_status
from nermo_mjx.learn.evaluation import (
    EVALUATION_OFFSET,
    BodySample,
    played_task,
    sample_bodies,
)
from nermo_mjx.learn.policy import RandomPolicy
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.view import Page

#: Two checkpoints of one iteration.
FILE = {
    "physics": "fast",
    "run": {"duration": 0.4, "warmup": 0.1},
    "randomize": {"start.phase": [0.0, 1.0], "command.speed": [0.05, 0.15]},
    "worlds": 2,
    "steps": 16,
    "checkpoint": 8,
    "algorithm": {"ppo": {"horizon": 4, "hidden": [4]}},
    "evaluate": {"bodies": 1},
    "plots": False,
}


@pytest.fixture(scope="module")
def training():
    return Training.from_dict(FILE)


def way(recording) -> float:
    return float(np.linalg.norm(recording.qpos[-1, :2] - recording.qpos[0, :2]))


@pytest.mark.long
@pytest.mark.release
def test_zero_is_the_controller_alone_and_obeys_a_command(training):
    world_values = {
        name: float(column[0])
        for name, column in sample_bodies(
            training, training.task, BodySample(1, EVALUATION_OFFSET)
        ).items()
    }
    slow, fast = (
        played_task(training, "zero", seconds=4.0, values={"command.speed": speed})
        for speed in (0.05, 0.15)
    )
    assert way(slow) == pytest.approx(4.0 * 0.05, rel=0.15)
    assert way(fast) > 1.35 * way(slow), "as far as the stride lasts"
    uncommanded = Training.from_dict(FILE | {"randomize": {"start.phase": [0.0, 1.0]}})
    walk = played_task(uncommanded, "zero", seconds=0.5)
    start = {"start.phase": world_values["start.phase"]}
    reference_walk = (
        Simulator(training.setup, engine="c")
        .run(start, Run(duration=0.5, warmup=0.0), record=True)
        .recording()
    )
    np.testing.assert_allclose(walk.qpos, reference_walk.qpos, atol=1e-5)


@pytest.mark.release
def test_random_actions_are_drawn_anew_and_are_the_same_in_every_run(training):
    first, repeated = (
        played_task(training, "random", scene="planks", values={"terrain.height": 0.003})
        for _ in range(2)
    )
    np.testing.assert_array_equal(first.qpos, repeated.qpos)
    assert np.ptp(np.diff(first.ctrl[5:, 0])) > 0.02
    environment = training.environment("c")
    policy = RandomPolicy(**vars(Policy.of(environment, PPO().begin(environment, 0))))
    states = [SimpleNamespace(tick=tick, action=jnp.zeros(9)) for tick in range(200)]
    actions = np.stack([policy.choose(policy.parameters, state, jnp.zeros(3)) for state in states])
    assert abs(actions.mean()) < 0.05
    assert abs(actions.std() - 3**-0.5) < 0.02
    assert np.abs(actions).max() <= 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy", "gone.npz"], "controller is 'gone.npz': it cannot be read"),
        (["--policy", "none"], "controller is 'none': it cannot be read"),
        (["--scene", "stair"], "scene is 'stair': did you mean 'stairs'?"),
        (
            ["--set", "terrain.slope=0.1", "--scene", "stairs"],
            "terrain.slope is given, and 'stairs' does not have it",
        ),
        (["--set", "command.speed=7"], "command.speed is 7"),
        (
            ["--set", "command.sped=1"],
            "command.sped is not a parameter; did you mean command.speed?",
        ),
        (["--xml", "a.xml"], "--xml has no effect without a recording."),
        (["--video", "a.txt"], "a video ends in"),
    ],
)
def test_what_cannot_be_played_is_one_sentence(tmp_path, options, message):
    path = tmp_path / "training.yaml"
    path.write_text(Training.from_dict(FILE).to_yaml())
    result = call("play", path, *options)
    assert (result.exit_code != 0, message in result.stderr) == (True, True), result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_what_is_of_a_training_is_refused_for_a_recording(tmp_path):
    (tmp_path / "walk.npz").touch()
    messages = call("play", tmp_path / "walk.npz", "--policy", "zero").stderr
    assert "--policy has no effect without a training." in messages


@pytest.fixture(scope="module")
def at_work(tmp_path_factory, training):
    """A training that made videos."""
    out = tmp_path_factory.mktemp("training") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nermo_mjx.learn.run._evaluate", lambda *_: None)
        run_training(training, out, video=True)
    return out


@pytest.mark.long
@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_a_video_shows_the_policy_of_each_checkpoint(at_work):
    videos = sorted(at_work.glob("videos/*"))
    assert [video.name for video in videos] == ["000000000008.mp4", "000000000016.mp4"]
    frames = [iio.imread(video) for video in videos]
    assert [len(images) for images in frames] == [13, 13]
    assert all(images.std() > 10 for images in frames)


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_a_page_follows_a_training_until_it_has_ended(at_work, tmp_path, monkeypatch):
    """A page for each checkpoint in one file, which a browser loads anew until the training is complete."""
    status, pages = training_status(at_work), []
    assert status.complete
    states = iter([dataclasses.replace(status, complete=False)] * 4 + [status] * 9)
    monkeypatch.setattr("nermo_mjx.learn.directory.training_status", lambda _: next(states))
    monkeypatch.setattr(
        "nermo_mjx.view.trained.trained",
        lambda path, reload: pages.append(reload) or Page(f"page {len(pages)}", 100, 1),
    )

    def slept(seconds):
        if len(pages) < 2:
            (at_work / HISTORY_FILE).touch()  # a checkpoint

    monkeypatch.setattr("time.sleep", slept)
    page = tmp_path / "page.html"
    output = json_of("view", at_work, "--follow", "--out", page, "--no-open")
    assert (output["page"], output["complete"], output["iterations"]) == (str(page), True, 2)
    assert page.read_text() == f"page {len(pages)}"
    assert (pages[0], pages[1], pages[-1]) == (20.0, 20.0, None)


def test_only_a_training_can_be_followed(tmp_path):
    assert f"{tmp_path} is not a results directory" in call("view", tmp_path, "--follow").stderr
    with RunDirectory(tmp_path / "sweep", "sweep") as directory:
        directory.note_session({})
    message = f"--follow is for the directory of a training, but {tmp_path / 'sweep'} is none."
    assert message in call("view", tmp_path / "sweep", "--follow").stderr


def test_a_policy_is_not_given_what_it_was_not_trained_with(training, tmp_path):
    environment = training.environment("c")
    file = tmp_path / "policy.npz"
    file.write_bytes(Policy.of(environment, PPO().begin(environment, 0)).content())
    for name in ("command.yaw_rate", "sensing.delay", "sensing.gyro_noise"):
        with pytest.raises(
            ParameterError, match=f"{name} is given, and the policy was not trained with it"
        ):
            played_task(training, str(file), values={name: 0.01})
