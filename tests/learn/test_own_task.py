# Tests of learn/own.py, learn/task.py
"""A task with code of one's own: what it does, what of it is refused, and whose code is run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from command import call
from test_training import bits

from nermo_mjx import ParameterError, Run, Setup, Simulator, trust
from nermo_mjx.control import protocol
from nermo_mjx.learn import (
    SENTENCES,
    Environment,
    Outcome,
    Sensed,
    Task,
    Term,
    Training,
    load_policy,
    run_training,
)
from nermo_mjx.learn.evaluation import (
    EVALUATION_OFFSET,
    BodySample,
    PolicyEvaluator,
    sample_bodies,
)
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.runs.job import Watch
from nermo_mjx.specs.reading import SpecError

SWEEPS = Path(__file__).parents[2] / "sweeps"
SETUP = Setup(physics="fast")
#: The shipped file, made small: two checkpoints of two iterations of two worlds.
SMALL = {
    "worlds": 2,
    "steps": 2 * 4 * 4,
    "checkpoint": 2 * 4 * 2,
    "algorithm": {"ppo": {"horizon": 4, "hidden": [4]}},
    "run": {"duration": 0.3, "warmup": 0.1},
    "evaluate": {"bodies": 2},
    "plots": False,
}
RIGHT = """\
import jax.numpy as jnp
from nermo_mjx.learn import Sensed, Term

def reward(m):
    return m.seconds

def seen(s):
    return s.gyro

def ends(s):
    return s.position[2] < 0.0

def drawn(key, steps):
    return {"command.speed": 0.1}
"""
USES = {
    "rewards": {"progress": 1.0, "my.py:reward": 1.0},
    "observe": ["gyro", "my.py:seen"],
    "terminations": ["my.py:ends"],
    "commands": "my.py:drawn",
}


def small(folder: Path, **task: Any) -> Path:
    """The shipped file and its code, made small, in a folder."""
    shutil.copy(SWEEPS / "own_task.py", folder)
    training = Training.from_file(SWEEPS / "train_own.yaml").resolved(SWEEPS)
    path = folder / "train.yaml"
    path.write_text(
        json.dumps(
            {**training, **SMALL, "task": {**training["task"], "episode_length": 0.2, **task}}
        )
    )
    return path


@pytest.fixture(scope="module")
def training_result(tmp_path_factory):
    """A finished training of it."""
    folder = tmp_path_factory.mktemp("own")
    return run_training(small(folder), folder / "out")


@pytest.mark.release
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "return m.seconds",
            "return m.sensors.servo_velocity",
            r"reward \(my.py:4\), which gives an array .* one num",
        ),
        (
            "return m.seconds",
            "return 1.0 if m.speed > 0 else 0.0",
            r"reward \(my.py:4\), which fails at my.py:5.*jnp",
        ),
        (
            "return m.seconds",
            "return m.sensors.gyros[0]",
            r"my.py:5: AttributeError.*did you mean 'gyro'",
        ),
        (
            "return m.seconds",
            "return m.second",
            r"my.py:5: AttributeError.*did you mean 'seconds'. Moment has before",
        ),
        (
            "return m.seconds",
            "return 0.0 / m.speed",
            r"reward \(my.py:4\), which gives nan for a robot at rest",
        ),
        ("def reward(m):", "def rewards(m):", r"my.py has no 'reward'; did you mean 'rewards'"),
        (
            "return s.gyro",
            "return jnp.outer(s.gyro, s.gyro)",
            r"observe.*seen \(my.py:7\), which gives .*\(3, 3\)",
        ),
        (
            "return s.gyro",
            "return s.gyro / s.gyro",
            r"seen \(my.py:7\), which gives \[nan, nan, nan\] for a robot",
        ),
        (
            "def seen(s):\n    return s.gyro",
            "seen = 3",
            r"my.py:seen', which is int: expected a function",
        ),
        (
            "return s.gyro",
            "return s.giro",
            r"seen \(my.py:7\), which fails at my.py:8.*did you mean 'gyro'",
        ),
        (
            "return s.position[2] < 0.0",
            "return s.position[2]",
            r"terminations.*ends \(my.py:10\).*expected a truth",
        ),
        (
            "return s.position[2] < 0.0",
            "return s.position < 0",
            r"ends \(my.py:10\), which gives an array",
        ),
        (
            '{"command.speed": 0.1}',
            '{"command.sped": 0.1}',
            r"drawn \(my.py:13\), which draws .*did you mean",
        ),
        (
            '{"command.speed": 0.1}',
            '{"command.speed": 3.0}',
            r"drawn \(my.py:13\), where command.speed is 3: allowed",
        ),
        (
            '{"command.speed": 0.1}',
            '{"command.speed": 0.1 + steps}',
            r"gives inf for command.speed at steps of 0 or",
        ),
        (
            '{"command.speed": 0.1}',
            '{"start.yaw": 0.1}',
            r"draws start.yaw, which stands under set or randomize",
        ),
        (
            '{"command.speed": 0.1}',
            '{"terrain.height": 0.1}',
            r"draws 'terrain.height': no parameter here",
        ),
        (
            'return {"command.speed": 0.1}',
            "return 0.1",
            r"gives an array .*: expected values by parameters' names",
        ),
        (
            "import jax.numpy",
            "import jax.nunpy",
            r"my.py': it cannot be imported at my.py:1: ModuleNotFoundError",
        ),
    ],
)
def test_what_is_wrong_with_own_code_is_one_sentence_before_anything_runs(
    tmp_path, monkeypatch, old, new, message
):
    monkeypatch.chdir(tmp_path)
    assert old in RIGHT
    Path("my.py").write_text(RIGHT.replace(old, new))
    message = message.replace("my.py': it", ".*: it")
    with pytest.raises(SpecError, match=message) as refused:
        Training.from_dict({"task": USES})
    assert str(refused.value).count("\n") == 0
    with pytest.raises(ParameterError, match=message):
        Environment(SETUP, worlds=1, task=Task(**USES))


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ({"observe": ["gyros"]}, "did you mean 'gyro'"),
        ({"observe": ["my.py:a b"]}, "is 'my.py:a b': expected FILE.py:NAME"),
        (
            {"observe": ["my.py:seen", "other.py:seen"]},
            r"functions of my.py and other.py: put them in one file",
        ),
        ({"observe": ["my.py:gyro"]}, "but gyro is observed already"),
        ({"terminations": ["tipped"]}, "expected FILE.py:NAME or MODULE:NAME"),
        ({"commands": 3}, "is the number 3: expected FILE.py:NAME or MODULE:NAME"),
        ({"rewards": {"away.py:seen": 1.0}}, r"away.py cannot be read"),
        ({"terminate": ["my.py:ends"]}, "did you mean 'terminations'"),
    ],
)
def test_names_that_are_none_are_refused(tmp_path, monkeypatch, task, message):
    monkeypatch.chdir(tmp_path)
    Path("my.py").write_text(RIGHT.replace("def seen", "def gyro(s):\n    return 1.0\n\ndef seen"))
    with pytest.raises(SpecError, match=message):
        Training.from_dict({"task": task})


def test_functions_without_a_file_cannot_be_trained_with():
    """A directory could not name them."""
    term = Term("height", "m", "of the IMU", lambda m: m.sensors.position[2])
    for task, name in (
        (Task(rewards={term: 1.0}), "Term"),
        (Task(observe=(lambda s: s.gyro[0],)), "lambda"),
    ):
        with pytest.raises(SpecError, match=f"has .*{name}.*: name it as FILE.py:NAME"):
            Training.from_dict({"task": task})


def turning(sensors):
    """About the torso's own axis."""
    return sensors.gyro[2]


def _turned(sensors):
    return sensors.gyro[jnp.array([0, 2])]


#: The same as an object, with labels and a scale.
TURNED = Sensed(_turned, 1.0, ("left", "up"))


def speeds(key, steps):
    return {"command.speed": 0.1 + 0.1 * jnp.clip(steps / 100, 0.0, 1.0), "sensing.delay": 0.015}


@pytest.mark.release
def test_own_functions_give_what_those_of_the_package_give():
    """Beside those of the package that are the same, with their delay; what the sampler draws depends on the steps."""
    task = Task(
        observe=("gyro", "command", turning, TURNED),
        rewards={"alive": 1.0, _time: 3.0},
        commands=speeds,
        episode_length=0.1,
    )
    environment = Environment(SETUP, worlds=3, task=task)
    names = ("gyro_x", "gyro_y", "gyro_z", "turning", "_turned_left", "_turned_up", "command.speed")
    assert environment.observation_names == names
    state = environment.reset(0)
    for _ in range(4):
        state = environment.step(state, np.zeros((3, 9)))
        np.testing.assert_allclose(
            state.observation[:, 3], 3.0 * state.observation[:, 2], rtol=1e-5
        )
        np.testing.assert_allclose(
            state.observation[:, 4:6], 3.0 * state.observation[:, [0, 2]], rtol=1e-5
        )
        np.testing.assert_allclose(state.reward, 4.0 * state.terms["alive"], rtol=1e-5)
    assert np.abs(state.observation[:, 3]).min() > 0
    np.testing.assert_allclose(state.observation[:, 6], 0.1, rtol=1e-6)
    state = environment.reset(0, steps=50)
    for _ in range(12):  # over the begin of the next episode
        np.testing.assert_allclose(state.observation[:, 6], 0.15, rtol=1e-6)
        state = environment.step(state, np.zeros((3, 9)))


def _time(moment):
    return moment.seconds


def rougher(key, steps):
    """Planks that grow."""
    return {"terrain.height": 0.02 * jnp.clip(steps / 100, 0.0, 1.0)}


@pytest.mark.release
def test_a_curriculum_raises_the_ground():
    """What the critic sees of it ahead: nothing at first, planks of one and of two centimetres later."""
    setup = Setup(scene="planks", physics="fast")
    environment = Environment(
        setup, worlds=8, task=Task(commands=rougher, randomize={"start.phase": (0.0, 1.0)})
    )
    ground = [name.startswith("height_scan_") for name in environment.privileged_names]
    highest = []
    for steps in (0, 50, 1e9):
        state = environment.reset(0, steps=steps)
        for _ in range(2):
            state = environment.step(state, np.zeros((8, 9)))
        highest.append(np.abs(state.privileged[:, ground]).max())
    assert highest[0] == 0.0
    assert 0.0 < highest[1] < highest[2]


def always(sensors):
    return sensors.position[2] > -1.0


@pytest.mark.long
@pytest.mark.release
def test_an_own_termination_fails_the_episode_and_the_walk_of_an_evaluation(tmp_path, monkeypatch):
    environment = Environment(
        SETUP, worlds=2, task=Task(terminations=(always,), rewards={"failed": -2.0})
    )
    state = environment.reset(0)
    assert not state.terminated.any()
    for _ in range(2):
        state = environment.step(state, np.zeros((2, 9)))
        assert state.terminated.all()
        assert {SENTENCES[code] for code in state.status} == {Outcome.terminated.value}
        np.testing.assert_array_equal(state.reward, -2.0)
    monkeypatch.chdir(tmp_path)
    Path("my.py").write_text("def always(sensors):\n    return sensors.position[2] > -1.0\n")
    fields = {"physics": "fast", "run": {"duration": 0.2, "warmup": 0.1}}
    training, ending = (
        Training.from_dict(fields | {"task": {"terminations": terminations}})
        for terminations in ([], ["my.py:always"])
    )
    for spec, share in ((training, 1.0), (ending, 0.0)):
        table = PolicyEvaluator(spec, "c")(
            None, draws=BodySample(2, EVALUATION_OFFSET), walkers=("alone",)
        )
        assert table["success"].to_pylist() == [bool(share)] * 2


@pytest.mark.long
@pytest.mark.release
def test_a_training_with_own_code_is_resumed_and_its_directory_can_be_moved(
    tmp_path, monkeypatch, training_result
):
    """Killed in its second section: the same bits. The copy is the code that counts, and changed code is refused."""
    assert set(training_result.history.names) >= {"term.bending", "term.speed"}
    assert 0.05 <= training_result.summary["scenes"]["flat"]["policy"]["speed"] < 1.0

    def kill(progress):
        if progress.done > 2 * 4 * 2:
            raise RuntimeError("killed")

    path, out = small(tmp_path), tmp_path / "out"
    with pytest.raises(RuntimeError, match="killed"):
        run_training(path, out, watch=Watch(progress=kill))
    code = tmp_path / "own_task.py"
    text = code.read_text()
    code.write_text(text.replace("** 2", "** 4"))
    with pytest.raises(
        WrongDirectory, match=r"another task.observe .*task.rewards.bending \w+ .*task.terminations"
    ):
        run_training(path, out)
    code.unlink()
    new_directory = Path(shutil.move(out, tmp_path / "moved"))
    monkeypatch.setattr("nermo_mjx.learn.run._evaluate", lambda *_: None)
    result = run_training(new_directory / "training.yaml", new_directory)
    assert result.iterations_run == 2
    assert bits(result) == bits(training_result)
    speeds = sample_bodies(
        result.training, result.training.task, BodySample(50, EVALUATION_OFFSET)
    )["command.speed"]
    assert 0.15 < speeds.max() <= 0.2, "as at the end of the curriculum"
    assert 0.05 <= speeds.min() < 0.08


@pytest.mark.release
def test_a_policy_with_an_own_observation_says_what_it_needs(tmp_path, training_result):
    """Its file runs no code: whoever wants to use it names the code, and it must be that of the training."""
    code = training_result.out / "own_task.py"
    named_policy = f"{training_result.policy}:{code}"
    with pytest.raises(
        ParameterError,
        match=r"observes lean of own_task.py, code that is run only where you name it",
    ):
        load_policy(training_result.policy)
    for command in ("walk", "drive"):
        result = call(command, "--controller", training_result.policy)
        assert result.exit_code in (1, 2), result.output
        assert "observes lean of own_task.py" in result.stderr
    changed_code = tmp_path / "own_task.py"
    changed_code.write_text(code.read_text() + "\n")
    with pytest.raises(
        ParameterError, match=r"with the digest \w+; that of .* give the file with which"
    ):
        load_policy(training_result.policy, str(changed_code))
    with pytest.raises(ParameterError, match=r"^controller is 'away.py': away.py cannot be read"):
        load_policy(training_result.policy, "away.py")
    plain = SWEEPS.parent / "tests" / "data" / "former_policy.npz"
    with pytest.raises(ParameterError, match=r"observes nothing of one's own: leave 'away.py' out"):
        load_policy(plain, "away.py")
    policy = load_policy(training_result.policy, str(code))
    assert policy.observer.names[-1] != "lean"
    assert "lean" in policy.observer.names
    run = Run(duration=0.1, warmup=0.0)
    walked = [
        Simulator(SETUP, engine="c", controller=loaded)({}, run)["distance"]
        for loaded in (policy, named_policy)
    ]
    assert walked[0] == walked[1]
    from nermo_mjx.sweep import Sweep

    sweep = Sweep.from_dict(
        {"controller": named_policy, "physics": "fast", "vary": {"contact.friction": [0.9, 1.1]}}
    )
    assert Sweep.from_text(sweep.to_yaml()) == sweep


@pytest.mark.release
@pytest.mark.parametrize("module", [False, True])
def test_what_only_reads_runs_no_own_code_of_a_training(
    tmp_path, monkeypatch, training_result, module
):
    """Status, plot and page of a stranger's directory."""
    out = tmp_path / "theirs"
    shutil.copytree(training_result.out, out)
    canary = tmp_path / "run by mistake"
    code = (
        f"import pathlib\npathlib.Path({str(canary)!r}).write_text('run')\n"
        + (out / "own_task.py").read_text()
    )
    (out / "own_task.py").write_text(code)
    (tmp_path / "own_task.py").write_text(code)
    if module:
        (out / "training.yaml").write_text(
            (out / "training.yaml").read_text().replace("own_task.py:", "own_task:")
        )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    protocol._imported.cache_clear()
    for words in (
        ("status", out),
        ("plot", out),
        ("view", out, "--no-open", "--out", tmp_path / "page.html"),
    ):
        result = call(*words)
        assert result.exit_code == 0, result.stderr
        assert not canary.exists(), f"{words[0]} ran it"
    assert "which a command that only reads does not run" in (tmp_path / "page.html").read_text()
    with trust.only_reading(), pytest.raises(ParameterError, match="does not run"):
        Environment(SETUP, worlds=1, task=Training.from_file(out / "training.yaml").task)
    assert not canary.exists()
    with pytest.raises(ParameterError, match="code that is run only where you name it"):
        load_policy(out / "policy.npz")
    assert not canary.exists()
