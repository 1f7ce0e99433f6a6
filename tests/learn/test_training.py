# Tests of learn/run.py, learn/spec.py, learn/policy.py, learn/evaluation.py, learn/plots.py
"""A training's directory: rejected inputs, resuming after a kill, and its policy as a controller."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from fakes.explore_data import falling
from fakes.learn_toy import PointMass
from scipy.stats import kstest

from nermo_mjx import ParameterError, Run, Setup, Simulator, show
from nermo_mjx.cli import main
from nermo_mjx.learn import (
    PPO,
    Environment,
    Policy,
    Residual,
    Task,
    Training,
    load_policy,
    run_training,
)
from nermo_mjx.learn.directory import TrainingDirectory, training_status
from nermo_mjx.learn.environment import Mixture, divide_worlds
from nermo_mjx.learn.evaluation import (
    EVALUATION_OFFSET,
    BodySample,
    PolicyEvaluator,
    record_walks,
    sample_bodies,
    summarize_walks,
)
from nermo_mjx.learn.experience import make_collector
from nermo_mjx.learn.policy import export
from nermo_mjx.learn.run import _VALIDATION_OFFSET, BestPolicy, success_shares
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.runs.job import Watch
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.view.trained import trained

SHIPPED = sorted((Path(__file__).parents[2] / "sweeps").glob("train_*.yaml"))
#: Two sections of three iterations, and one of a single one, of a point mass.
SPEC = {
    "worlds": 8,
    "steps": 8 * 4 * 7,
    "checkpoint": 8 * 4 * 3,
    "plots": False,
    "algorithm": {"ppo": {"horizon": 4, "hidden": [8]}},
}
EFFORT = ("environment_cpu", "learner_cpu", "wall_seconds")


def train(out, fields=None, **options):
    return run_training(SPEC | (fields or {}), out, environment=PointMass(8, pure=False), **options)


def lasting(out):
    """The history without the effort, which differs between runs."""
    return pq.read_table(out / "history.parquet").drop_columns([*EFFORT, "code"])


def bits(result):
    """All that was learned."""
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(result.learned)]


@pytest.fixture(scope="module")
def training_result(tmp_path_factory):
    """A finished training."""
    out = tmp_path_factory.mktemp("training") / "out"
    return train(out)


@pytest.fixture(scope="module")
def policy():
    """A policy with weights, and the environment that it is of."""
    environment = Environment(
        Setup(),
        worlds=2,
        task=Task(randomize={"contact.friction": (1.0, 1.2)}, decimation=2, episode_length=0.1),
    )
    learned = PPO().begin(environment, 0)
    *hidden, (weights, bias) = learned.actor.layers
    weights = 0.3 * jax.random.normal(jax.random.key(1), weights.shape)
    actor = dataclasses.replace(learned.actor, layers=(*hidden, (weights, bias)))
    return Policy.of(environment, dataclasses.replace(learned, actor=actor)), environment


@pytest.mark.release
def test_its_page_has_curves_evaluation_and_the_policy_in_3d(
    tmp_path, training_result, monkeypatch
):
    """Of an unfinished training what there is; the directory is only read."""
    out = tmp_path / "walker"
    shutil.copytree(training_result.out, out)
    page = show(out).html
    assert [f'alt="{name}"' in page for name in ("curves", "rewards", "evaluation")] == [
        True,
        True,
        False,
    ]
    assert "<iframe" not in page
    assert ['http-equiv="refresh"' in text for text in (page, trained(out, reload=20.0).html)] == [
        False,
        True,
    ]
    numbers = {"success": 0.98, "speed": 0.1234, "distance": 1.1, "cost_of_transport": 5.43}
    numbers["electrical_cost_of_transport"] = 91.23
    (out / "policy.npz").touch()
    (out / "evaluation.parquet").touch()
    former_names = sorted(path.name for path in out.rglob("*"))
    for name, replacement in {
        "load_policy": None,
        "record_walks": [("flat", falling())],
        "parquet_table": None,
        "summarize_walks": {"flat": {"policy": numbers, "alone": numbers | {"success": 0.5}}},
    }.items():
        monkeypatch.setattr(
            f"nermo_mjx.view.trained.{name}", lambda *_, replacement=replacement: replacement
        )
    monkeypatch.setattr("nermo_mjx.view.trained.training_figures", lambda _: [])
    page = show(out)
    assert "The policy on flat</h2><iframe" in page.html
    row = "".join(
        f"<td>{cell}</td>" for cell in ("flat", "policy", "98", "123.4", "1.10", "5.43", "91.2")
    )
    assert row in page.html
    assert page.samples == 50
    assert sorted(path.name for path in out.rglob("*")) == former_names
    run = CliRunner().invoke(
        main, ["view", str(out), "--out", str(tmp_path / "page.html"), "--no-open", "--json"]
    )
    assert json.loads(run.stdout)["samples"] == 50


@pytest.mark.release
def test_a_killed_training_ends_with_the_same_numbers(tmp_path, training_result):
    """Killed in its first section, and again in its second: weights, moments and history, bit for bit."""
    for stop in (2, 5):

        def kill(progress, stop=stop):
            if progress.done >= stop * 32:
                raise RuntimeError("killed")

        with pytest.raises(RuntimeError, match="killed"):
            train(tmp_path, watch=Watch(progress=kill))
    result = train(tmp_path)
    assert result.iterations_run == 4
    assert bits(result) == bits(training_result)
    np.testing.assert_equal(lasting(tmp_path).to_pydict(), lasting(training_result.out).to_pydict())
    assert result.summary["steps"] == SPEC["steps"]
    # Nothing is left to do: the same call changes nothing.
    assert train(tmp_path).iterations_run == 0


@pytest.mark.release
def test_another_training_is_refused_and_more_steps_are_not(tmp_path, training_result):
    out = Path(shutil.copytree(training_result.out, tmp_path / "copy"))
    with pytest.raises(
        WrongDirectory, match=r"holds another training, with another seed \(0 there, 3 here\)"
    ):
        train(out, {"seed": 3})
    with pytest.raises(WrongDirectory, match=r"another randomize\.start\.phase"):
        train(out, {"randomize": {"start.phase": [0.0, 0.5]}})
    longer = train(out, {"steps": 8 * 4 * 9})
    assert longer.iterations_run == 2
    np.testing.assert_equal(
        lasting(out).slice(0, 7).to_pydict(), lasting(training_result.out).to_pydict()
    )


@pytest.mark.release
def test_a_resolved_file_is_the_same_training():
    """With all defaults written out, in every form."""
    fields = {
        "task": {
            "action": {"modulation": {"ranges": {"frequency": [0.5, 1.2]}}},
            "set": {"command.speed": 0.1},
            "rewards": {"speed": 1.0},
            "distance": 1.0,
            "corridor": 0.3,
        },
        "algorithm": {"ppo": {"hidden": [8]}},
        "set": {"contact.friction": 1.2},
    }
    for training in (Training.from_dict(fields), *map(Training.from_file, SHIPPED)):
        reloaded = Training.from_text(training.to_yaml())
        assert reloaded == training
        assert reloaded.digest() == training.digest()


@pytest.mark.release
def test_a_policy_walks_in_a_simulator_as_in_its_environment(policy):
    """Ten ticks, an action held for two; friction tells the worlds apart. Both round to float32, here and there."""
    policy, environment = policy
    state = environment.reset(3)
    friction = 1.1 + 0.1 * np.asarray(state.privileged)[:, -1]
    while not np.asarray(state.truncated).any():
        state = environment.step(state, np.asarray(policy.act(state.observation)))
    walked = Simulator(engine="c", controller=policy)(
        {"contact.friction": friction}, Run(duration=0.1, warmup=0.0)
    )
    np.testing.assert_allclose(walked["distance"], state.episode["distance"], atol=2e-6)
    np.testing.assert_allclose(walked["servo_work"], state.episode["servo_work"], rtol=1e-4)
    assert walked["servo_work"][0] > 0.2


@pytest.fixture(scope="module")
def evaluated(policy):
    """The evaluation of a policy on two scenes with corridors of their own, and the same without corridors."""
    scenes = [{"scene": "flat"}, {"scene": "planks"}]
    fields = {
        "worlds": 2,
        "run": {"duration": 0.6, "warmup": 0.1},
        "task": {"decimation": 2},
        "randomize": {"start.yaw": [-0.3, 0.3]},
        "evaluate": {"bodies": 8, "distance": 0.0},
    }
    narrow = [scenes[0] | {"corridor": 0.01}, scenes[1]]
    trainings = [
        Training.from_dict(fields | {"scenes": scene_list}) for scene_list in (scenes, narrow)
    ]
    wide_evaluator, narrow_evaluator = (PolicyEvaluator(training, "c") for training in trainings)
    narrow_evaluator._simulators = (
        wide_evaluator._simulators
    )  # a corridor is none of their settings
    return [evaluator(policy[0]).to_pandas() for evaluator in (wide_evaluator, narrow_evaluator)]


def test_an_evaluation_draws_from_ranges_of_its_own():
    """Where a scene has such a parameter; what it sets is not drawn, and the training's draws stay."""
    harder = {
        "scene": "rough",
        "randomize": {"contact.friction": [1.2, 1.6], "terrain.height": [0.009, 0.013]},
    }
    training = Training.from_dict(
        {
            "randomize": {"contact.friction": [0.8, 1.6], "start.yaw": [0.0, 0.1]},
            "scenes": [{"scene": "ramp"}, harder],
            "evaluate": {
                "set": {"start.yaw": 0},
                "randomize": {"contact.friction": [0.8, 1.6], "terrain.side": [0, 0.1]},
            },
        }
    )
    friction = {"contact.friction": (0.8, 1.6)}
    ramp, rough = (task for _, task in training.evaluated())
    assert ramp.randomize == friction
    assert rough.randomize == friction | {
        "terrain.height": (0.009, 0.013),
        "terrain.side": (0.0, 0.1),
    }
    assert ramp.set["start.yaw"] == 0.0
    assert training.scenes[1].task.randomize["contact.friction"] == (1.2, 1.6)
    assert Training.from_text(training.to_yaml()) == training


@pytest.mark.parametrize(
    ("task", "name", "value", "sentence"),
    [
        ({}, "sensing.delay", 0.02, "the policy is not trained with it"),
        ({"sensing.gyro_noise": 0.1}, "sensing.delay", 0.02, "the policy is not trained with it"),
        ({}, "sensing.gyro_noise", 0.02, "the policy is not trained with it"),
        ({}, "command.yaw_rate", 0.2, "the policy is not trained with it"),
        ({"sensing.delay": 0.02}, "sensing.delay", 0.05, "is longer than 0.02 s, the longest that"),
    ],
)
@pytest.mark.parametrize("section", ["set", "randomize"])
def test_an_evaluation_gives_nothing_that_the_policy_is_not_trained_with(
    task, name, value, sentence, section
):
    """It would be left out without a word."""
    evaluation = {section: {name: value if section == "set" else [0.0, value]}}
    with pytest.raises(SpecError, match=rf"evaluate.{section}.{name}.* {sentence}"):
        Training.from_dict({"task": {"set": task}, "evaluate": evaluation})
    Training.from_dict({"task": {"set": task | {name: value}}, "evaluate": evaluation})


def test_an_evaluation_has_physics_of_its_own():
    """The walks of the evaluation and of the validation, not the training's."""
    training = Training.from_dict({"physics": "fast", "evaluate": {"physics": "reference"}})
    ((setup, _),) = training.evaluated()
    assert (training.setup.physics, setup.physics) == ("fast", "reference")
    assert setup.timestep == Setup().timestep < training.setup.timestep
    assert Training.from_dict(training.resolved()).evaluated()[0][0] == setup


@pytest.mark.long
@pytest.mark.release
def test_a_walk_beside_its_path_is_no_success(evaluated):
    """The corridor of a scene counts there and nowhere else; the walks themselves are the same."""
    wide, narrow = evaluated
    np.testing.assert_array_equal(wide.distance, narrow.distance)
    flat = narrow.scene == "flat"
    inside = narrow.cross_track_peak <= 0.01
    assert inside[flat].any()
    assert (~inside[flat] & wide.success[flat]).any()
    np.testing.assert_array_equal(narrow.success, wide.success & (inside | ~flat))


@pytest.fixture
def choosing(policy, tmp_path):
    """The choice of a directory, policies after some steps, and how often each has walked."""
    shares = {
        0: (0.5, 1.0),
        10: (0.8, 1.0),
        20: (0.8, 1.0),
        30: (0.6, 1.0),
        40: (0.9, 1.0),
        50: (0.85, 0.85),
    }
    walked = []
    policies_by_steps = {
        steps: dataclasses.replace(
            policy[0], about={"trained": {"steps": steps, "training": "0a1b"}}
        )
        for steps in shares
    }

    def walks(policy):
        walked.append(policy.about["trained"]["steps"])
        return dict(zip(("planks", "ramp"), shares[walked[-1]], strict=True))

    with RunDirectory(tmp_path, "training") as directory:
        yield (
            lambda warned=None: BestPolicy(
                directory, walks, ([] if warned is None else warned).append
            ),
            policies_by_steps,
            walked,
        )


def _policy_after(robot, learned):
    """A policy of the robot, after the steps of another environment's training."""
    description = {"trained": {"steps": int(learned.steps), "training": "0a1b"}}
    return Policy.of(robot, PPO().begin(robot, 0), description)


def chosen(policy):
    return policy.about["trained"]["steps"]


def test_the_best_of_all_checkpoints_is_the_policy(choosing, tmp_path):
    """Of equals the earliest; each walks once, also when the training is resumed."""
    begin, policies_by_steps, walked = choosing
    assert [chosen(begin().choose(policies_by_steps[steps])) for steps in (0, 10, 20, 30)] == [
        0,
        10,
        10,
        10,
    ]
    assert (tmp_path / "policy.npz").read_bytes() == policies_by_steps[10].content()
    assert begin().choose(policies_by_steps[30]).content() == policies_by_steps[10].content()
    assert walked == [0, 10, 20, 30]
    table = pq.read_table(tmp_path / "validation.parquet").to_pydict()
    assert table == {"steps": walked, "planks": [0.5, 0.8, 0.8, 0.6], "ramp": [1.0] * 4}
    assert chosen(begin().choose(policies_by_steps[40])) == 40


def test_what_counts_is_success_where_it_fails_most(choosing):
    """As in the summary; the mean decides between equals."""
    begin, policies_by_steps, _ = choosing
    assert [chosen(begin().choose(policies_by_steps[steps])) for steps in (10, 50, 20, 40)] == [
        10,
        50,
        50,
        40,
    ]


def test_a_choice_by_other_rules_stands(choosing, tmp_path):
    """A directory's policy was once the best by the mean: it is kept until a checkpoint is better than it."""
    begin, policies_by_steps, _ = choosing
    warned = []
    for steps in (50, 10):
        begin(warned).choose(policies_by_steps[steps])
    (tmp_path / "policy.npz").write_bytes(policies_by_steps[10].content())
    assert [chosen(begin(warned).choose(policies_by_steps[steps])) for steps in (10, 30, 40)] == [
        10,
        10,
        40,
    ]
    assert not warned


def test_a_choice_that_was_killed_is_made_again(choosing, tmp_path):
    """Between the policy's file and the table: the same policy walks once more. Without its file, it begins anew."""
    begin, policies_by_steps, walked = choosing
    table, warned = tmp_path / "validation.parquet", []
    for steps in (0, 10, 30):
        begin(warned).choose(policies_by_steps[steps])
    table_bytes = table.read_bytes()
    begin(warned).choose(policies_by_steps[40])
    complete_table = table.read_bytes()
    table.write_bytes(table_bytes)
    assert chosen(begin(warned).choose(policies_by_steps[40])) == 40
    assert walked == [0, 10, 30, 40, 40]
    assert table.read_bytes() == complete_table
    assert not warned
    (tmp_path / "policy.npz").unlink()
    assert chosen(begin(warned).choose(policies_by_steps[20])) == 20
    assert "the choice begins anew" in warned[0]


@pytest.mark.release
def test_a_training_ends_when_its_validation_is_enough(tmp_path, monkeypatch):
    """At the first checkpoint that is; killed before it was noted, it ends with the same. A rerun learns nothing."""
    shares = {0: 0.0, 96: 0.5, 192: 0.95, 224: 1.0}
    fields = {"validation": 2, "until": {"success": 0.9}}
    monkeypatch.setattr(
        "nermo_mjx.learn.run.success_shares", lambda _, policy: {"flat": shares[chosen(policy)]}
    )
    monkeypatch.setattr("nermo_mjx.learn.run._evaluate", lambda *_: None)
    robot = Environment(Setup(), worlds=2, task=Task(episode_length=0.1))
    point = PointMass(8, pure=False)
    monkeypatch.setattr(
        "nermo_mjx.learn.run._TrainingLoop._policy",
        lambda self, learned: _policy_after(robot, learned),
    )
    complete_result = run_training(SPEC | fields, tmp_path / "whole", environment=point)
    assert (
        complete_result.iterations_run,
        complete_result.summary["policy_steps"],
        complete_result.summary["complete"],
    ) == (
        6,
        192,
        True,
    )
    assert training_status(tmp_path / "whole").complete
    assert run_training(SPEC | fields, tmp_path / "whole", environment=point).iterations_run == 0

    keep = TrainingDirectory.keep

    def stopped(self, learned, curves):
        keep(self, learned, curves)
        if len(curves) >= 6:
            raise KeyboardInterrupt

    with monkeypatch.context() as killed:  # behind the second checkpoint, before its policy walks
        killed.setattr(TrainingDirectory, "keep", stopped)
        with pytest.raises(KeyboardInterrupt):
            run_training(SPEC | fields, tmp_path / "killed", environment=point)
    repeated = run_training(SPEC | fields, tmp_path / "killed", environment=point)
    assert (repeated.iterations_run, bits(repeated)) == (0, bits(complete_result))
    for name in ("policy.npz", "validation.parquet"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.release
def test_a_walk_that_is_too_slow_is_no_success_of_the_validation(policy):
    """With `until`, and only there."""
    fields = {"run": {"duration": 0.3}, "validation": 4, "evaluate": {"bodies": 4}}
    plain = PolicyEvaluator(Training.from_dict(fields))
    speeds = (
        plain(policy[0], draws=BodySample(4, _VALIDATION_OFFSET), walkers=("policy",))
        .to_pandas()
        .sort_values("speed")
    )
    assert success_shares(plain, policy[0]) == {"flat": 1.0}
    limit = float(speeds.speed.iloc[1:3].mean())
    evaluator = PolicyEvaluator(
        Training.from_dict(fields | {"until": {"success": 1.0, "speed": limit}})
    )
    evaluator._simulators = plain._simulators
    assert speeds.success.all()
    assert limit > 0.0
    assert success_shares(evaluator, policy[0]) == {"flat": 0.5}


@pytest.mark.parametrize(
    "key", [EVALUATION_OFFSET, _VALIDATION_OFFSET], ids=["evaluation", "validation"]
)
@pytest.mark.parametrize("identified", [True, False])
def test_more_unseen_walks_begin_with_those_of_fewer(key: int, identified: bool) -> None:
    """So that trainings with other counts are paired, and a page shows a walk of the evaluation."""
    randomize = {"start.yaw": [-0.3, 0.3], "start.x": [0.8, 1.6], "start.phase": [0.0, 1.0]}
    training = Training.from_dict({"randomize": randomize, "task": {"bodies": identified}})
    many_walks, one_walk = (
        sample_bodies(training, training.task, BodySample(count, key)) for count in (200, 1)
    )
    for count in (100, 3, 1):
        smaller_walks = sample_bodies(training, training.task, BodySample(count, key))
        assert smaller_walks.keys() == many_walks.keys()
        for name, column in smaller_walks.items():
            np.testing.assert_array_equal(column, many_walks[name][:count], err_msg=name)
    assert one_walk.keys() == many_walks.keys() >= randomize.keys()
    other_key = sample_bodies(
        training, training.task, BodySample(200, EVALUATION_OFFSET + _VALIDATION_OFFSET - key)
    )
    for name, (low, high) in randomize.items():
        fractions = (many_walks[name] - low) / (high - low)
        assert fractions.min() >= 0.0
        assert fractions.max() <= 1.0
        assert kstest(fractions, "uniform").pvalue > 1e-3
        assert not set(many_walks[name]) & set(other_key[name])
    assert (
        abs(np.corrcoef([many_walks[name] for name in randomize])[np.triu_indices(3, 1)]).max()
        < 0.25
    )


@pytest.mark.release
def test_a_page_shows_the_first_walk_of_the_evaluation(policy):
    """The same start, body and numbers."""
    fields = {
        "run": {"duration": 0.3},
        "randomize": {"start.yaw": [-0.3, 0.3], "contact.friction": [0.8, 1.6]},
        "evaluate": {"bodies": 3, "distance": 0.0, "scenes": ["planks"]},
    }
    training = Training.from_dict(fields)
    table = (
        PolicyEvaluator(training)(policy[0], walkers=("policy",))
        .to_pandas()
        .set_index(["scene", "body"])
    )
    for scene, recording in record_walks(training, policy[0]):
        first = table.loc[scene, 0]
        for name in fields["randomize"]:
            assert recording.metadata["parameters"][name] == pytest.approx(first[name], rel=1e-12)
        for name in ("speed", "distance", "servo_work"):
            assert recording.metadata["metrics"][name] == first[name]


@pytest.mark.long
@pytest.mark.release
def test_a_policy_in_another_physics_than_it_was_judged_in_says_so(policy, tmp_path):
    """In Python, for a walk and for a sweep; nothing is said in its own, or of a file that does not know.

    `walk` takes a policy in place of the published controller.
    """
    policy, path = policy[0], tmp_path / "policy.npz"
    path.write_bytes(policy.content())
    sentence = "judged in physics reference at steps of 2 ms and walks in"
    for setup in (Setup(physics="fast"), Setup(timestep=0.001)):
        with pytest.warns(
            UserWarning, match=f"{sentence} {setup.physics} at {1e3 * setup.timestep:.4g} ms"
        ):
            Simulator(setup, engine="c", controller=str(path))
    old = dataclasses.replace(policy, about={})
    with warnings.catch_warnings(action="error"):
        Simulator(engine="c", controller=str(path))
        Simulator(Setup(timestep=0.002), engine="c", controller=policy)
        Simulator(Setup(physics="fast"), engine="c", controller=old)
    (tmp_path / "swept.yaml").write_text(
        f"physics: fast\ncontroller: {path}\nrun: {{duration: 0.05, warmup: 0.0}}\nvary: {{frequency: [0.6, 0.8]}}\n"
        "plots: false\n"
    )
    walk = ["walk", "--controller", str(path), "--duration", "0.1", "--engine", "c", "--json"]
    sweep = [
        "sweep",
        str(tmp_path / "swept.yaml"),
        "--out",
        str(tmp_path / "swept"),
        "--engine",
        "c",
        "--json",
    ]
    for args, count in ((walk, 0), ([*walk, "--physics", "fast"], 1), (sweep, 1)):
        result = CliRunner().invoke(main, args)
        assert result.exit_code == 0, result.output
        assert result.stderr.count(sentence) == count
        assert "Warning" not in result.stderr
        assert ".py" not in result.stderr
        report = json.loads(result.stdout)
        assert args == sweep or report["metrics"]["servo_work"] > 0.2


@pytest.mark.long
@pytest.mark.release
def test_a_policys_evaluation_is_made_again_from_its_file(tmp_path):
    """In another process, to the last bit, in the physics that the summary names; whatever is loaded first."""
    fields = SPEC | {
        "physics": "fast",
        "worlds": 2,
        "steps": 16,
        "checkpoint": 16,
        "task": {"episode_length": 0.1},
    }
    fields |= {
        "run": {"duration": 0.3},
        "evaluate": {"bodies": 4},
        "randomize": {"contact.friction": [0.8, 1.6]},
    }
    fields["algorithm"] = {"ppo": {"horizon": 4, "hidden": [64]}}
    out = tmp_path / "out"
    result = run_training(fields, out, engine="c")
    assert result.summary["judged"] == {"physics": "fast", "timestep": pytest.approx(0.01 / 3)}
    program = """
import sys, json
from nermo_mjx.learn import load_policy
policy = load_policy(sys.argv[1] + "/policy.npz")
import numpy as np
import pyarrow.parquet as pq
from nermo_mjx import Run, Setup, Simulator
table = pq.read_table(sys.argv[1] + "/evaluation.parquet").to_pandas().query("controller == 'policy'")
judged = json.load(open(sys.argv[1] + "/summary.json"))["judged"]
setup = Setup(physics=judged["physics"], controller=policy)
found = Simulator(setup, engine="c").run({"contact.friction": table["contact.friction"].to_numpy()}, Run(duration=0.3))
for name in ("speed", "distance", "servo_work"):
    np.testing.assert_array_equal(found.metrics[name], table[name].to_numpy(), err_msg=name)
"""
    subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", program, str(out)], check=True
    )


@pytest.mark.release
def test_an_evaluation_without_todays_metrics_is_still_summed_up(evaluated):
    """As a directory from before has it."""
    former_table = pa.Table.from_pandas(evaluated[0].drop(columns=["cross_track_peak", "slip"]))
    assert summarize_walks(former_table)["flat"]["alone"]["distance"] > 0.0


@pytest.mark.release
def test_another_policys_weights_compile_nothing(policy, compilations):
    """They are parameters of a program: one policy of a training after the other walks, or several in one batch."""
    policy, run = policy[0], Run(duration=0.1, warmup=0.0)
    layers = tuple((-weights, bias) for weights, bias in policy.actor.layers)
    second_policy = dataclasses.replace(
        policy, actor=dataclasses.replace(policy.actor, layers=layers)
    )
    simulator = Simulator(engine="c", controller=policy)
    first_work = simulator({}, run)["servo_work"]
    compilations.clear()
    two = simulator({}, run, policy=second_policy.parameters)["servo_work"]
    assert compilations == []
    assert abs(two - first_work) > 1e-3 * first_work
    policies = jax.tree.map(
        lambda *leaves: np.stack(leaves), policy.parameters, second_policy.parameters
    )
    np.testing.assert_array_equal(
        simulator({}, run, policy=policies)["servo_work"], np.concatenate([first_work, two])
    )


def test_a_policys_file_is_the_policy(policy, tmp_path):
    """Its numbers, its parameters' names, and the same bytes again; nothing in it is code."""
    policy, path = policy[0], tmp_path / "policy.npz"
    path.write_bytes(policy.content())
    loaded = load_policy(path)
    observations = (
        np.random.default_rng(0).normal(size=(5, len(policy.observer.names))).astype(np.float32)
    )
    np.testing.assert_array_equal(loaded.act(observations), policy.act(observations))
    assert loaded.content() == policy.content()
    assert "frequency" in Setup(controller=str(path)).defaults()
    with np.load(path, allow_pickle=False) as file:
        assert json.loads(file["about"].tobytes())["actions"] == list(Residual().names)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ParameterError, match="train`: the file: not an NPZ file, or a damaged one"):
        Setup(controller=str(path))
    with pytest.raises(ParameterError, match=r"cannot be read \(No such file"):
        Setup(controller=str(tmp_path / "none.npz"))


def test_worlds_are_divided_in_shares():
    """All of them, as evenly as NumPy divides an array, or in proportion; no scene is left without."""
    random = np.random.default_rng(0)
    for _ in range(200):
        parts = int(random.integers(2, 9))
        worlds = int(random.integers(parts, 300))
        assert divide_worlds(worlds, [1.0] * parts) == [
            len(split) for split in np.array_split(np.arange(worlds), parts)
        ]
        shares = random.uniform(0.05, 10.0, parts)
        counts = np.array(divide_worlds(worlds, shares.tolist()))
        assert counts.sum() == worlds
        assert counts.min() >= 1
        exact = worlds * shares / shares.sum()
        assert (np.abs(counts - exact) < 1.0).all() or exact.min() < 1.0
    training = Training.from_dict(
        {"worlds": 40, "scenes": [{"scene": "ramp"}, {"scene": "rough", "share": 3}]}
    )
    assert [part.worlds for part in training.environment("c").parts] == [10, 30]
    assert Training.from_text(training.to_yaml()) == training


@pytest.mark.long
def test_a_mixture_is_its_parts_side_by_side():
    """What each would do alone; the critic is told which is which, and zeros of what a part does not know."""
    tasks = [
        Task(episode_length=0.03, randomize={"contact.friction": (1.0, 1.2)}),
        Task(episode_length=0.03, randomize={}),
    ]
    parts = [(Setup(physics="fast"), tasks[0]), (Setup(physics="fast", pilot="arc"), tasks[1])]
    mixture, key = Mixture(parts, worlds=3, threads=2), jax.random.key(5)
    environments = [
        Environment(*part[:1], worlds=n, task=part[1])
        for part, n in zip(parts, (2, 1), strict=True)
    ]
    states = [
        environment.reset(jax.random.fold_in(key, i)) for i, environment in enumerate(environments)
    ]
    state, action = mixture.reset(key), np.linspace(-1, 1, 27).reshape(3, 9).astype(np.float32)
    for _ in range(4):
        state = mixture.step(state, action)
        states = [
            environment.step(part_state, part)
            for environment, part_state, part in zip(
                environments, states, (action[:2], action[2:]), strict=True
            )
        ]
    for name in ("observation", "reward", "truncated", "final_observation", "status"):
        expected = np.concatenate([np.asarray(getattr(part_state, name)) for part_state in states])
        np.testing.assert_array_equal(getattr(state, name), expected)
    privileged = dict(zip(mixture.privileged_names, state.privileged.T, strict=True))
    assert privileged["part.0"].tolist() == [1, 1, 0]
    assert privileged["part.1"].tolist() == [0, 0, 1]
    assert privileged["drawn.contact.friction"].astype(bool).tolist() == [True, True, False]


@pytest.mark.long
@pytest.mark.release
def test_parts_that_do_not_wait_for_each_other_step_as_together():
    """What a policy collects in a mixture, against its steps of all worlds at once; episodes end in between."""
    task = Task(episode_length=0.02, observe=("gyro", "action"), randomize={})
    other_task = dataclasses.replace(task, randomize={"contact.friction": (1.0, 1.2)})
    mixture = Mixture(
        [(Setup(physics="fast"), task), (Setup(physics="fast"), other_task)], worlds=3, threads=2
    )
    learned, key, steps = PPO(std=0.5).begin(mixture, 0), jax.random.key(7), 3
    final_state, experience = make_collector(mixture, steps)(
        learned.actor, learned.statistics, mixture.reset(4), key
    )
    state = mixture.reset(4)
    noise = np.asarray(jax.random.normal(key, (steps, 3, 9), np.float32))
    for t in range(steps):
        observations = np.concatenate([state.observation, state.privileged], axis=1)
        np.testing.assert_array_equal(experience.critic_input[t], observations)
        # An untrained policy's mean is zero.
        np.testing.assert_allclose(experience.action[t], 0.5 * noise[t], rtol=1e-6)
        state = mixture.step(state, experience.action[t])
        np.testing.assert_array_equal(experience.reward[t], state.reward)
        np.testing.assert_array_equal(experience.truncated[t], state.truncated)
        final_observations = np.concatenate(
            [state.final_observation, state.final_privileged], axis=1
        )
        np.testing.assert_array_equal(experience.next_critic_input[t], final_observations)
    assert experience.truncated.any()
    np.testing.assert_array_equal(final_state.privileged, state.privileged)


def test_a_policy_follows_another_path(policy, tmp_path):
    path = tmp_path / "policy.npz"
    path.write_bytes(policy[0].content())
    setup = Setup(controller=str(path), pilot="arc")
    assert setup.make_controller().setup.pilot == "arc"
    assert setup.fields()["pilot"] == "arc"
    assert "pilot" not in Setup(controller=str(path)).fields()
    with pytest.raises(
        ParameterError, match="pilot is 'open_loop', which has no path, and the policy observes one"
    ):
        Setup(controller=str(path), pilot="open_loop")


@pytest.mark.extra
def test_onnx_acts_as_the_policy_does(policy):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(export(policy[0]), providers=["CPUExecutionProvider"])
    observations = (
        np.random.default_rng(0).normal(size=(5, len(policy[0].observer.names))).astype(np.float32)
    )
    (action,) = session.run(None, {"observation": observations})
    np.testing.assert_allclose(action, policy[0].act(observations), atol=1e-5)
    facts = session.get_modelmeta().custom_metadata_map
    assert json.loads(facts["observation"]) == list(policy[0].observer.names)


def test_a_dry_run_says_what_it_would_take_and_writes_nothing(tmp_path):
    """On MJX: there is no pace before the program is compiled."""
    spec, out = tmp_path / "spec.yaml", tmp_path / "out"
    spec.write_text("worlds: 4\nsteps: 1000\ntask: {decimation: 2}\n")
    ran = CliRunner().invoke(
        main, ["train", str(spec), "--out", str(out), "--dry-run", "--engine", "mjx"]
    )
    assert ran.exit_code == 0, ran.output
    assert re.search("16 iterations, 64 steps per iteration, 1,024 steps; ", ran.stdout)
    assert not out.exists()


#: On the robot itself: two scenes, four sections of two iterations.
ROBOT = """
scenes: [{scene: planks}, {scene: ramp}]
physics: fast
run: {duration: 0.3}
task: {episode_length: 0.1}
algorithm: {ppo: {horizon: 4, hidden: [8]}}
worlds: 8
steps: 256
checkpoint: 64
validation: 2
evaluate: {bodies: 2}
plots: false
"""


@pytest.mark.long
def test_a_training_of_the_robot_survives_a_kill_of_the_command(tmp_path):
    """SIGKILL behind the first checkpoint; then the same bits as without, and the same policy's file."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(ROBOT)

    def command(out):
        return [
            sys.executable,
            "-m",
            "nermo_mjx",
            "train",
            str(spec),
            "--out",
            str(tmp_path / out),
            "--quiet",
        ]

    subprocess.run(command("whole"), check=True)
    killed = subprocess.Popen(command("killed"))
    while not (tmp_path / "killed" / "history.parquet").exists():
        assert killed.poll() is None, "it ended before it could be killed"
        time.sleep(0.002)
    killed.kill()
    assert killed.wait() == -signal.SIGKILL
    iterations = pq.read_table(tmp_path / "killed" / "history.parquet").num_rows
    assert iterations < 8
    subprocess.run(command("killed"), check=True)
    np.testing.assert_equal(
        lasting(tmp_path / "killed").to_pydict(), lasting(tmp_path / "whole").to_pydict()
    )
    complete_policy, resumed_policy = (
        load_policy(tmp_path / out / "policy.npz") for out in ("whole", "killed")
    )
    assert complete_policy.content() == resumed_policy.content()
    tables = [
        pq.read_table(tmp_path / out / "validation.parquet").to_pydict()
        for out in ("whole", "killed")
    ]
    assert tables[0] == tables[1]
    assert tables[0]["steps"] == [0, 64, 128, 192, 256]
