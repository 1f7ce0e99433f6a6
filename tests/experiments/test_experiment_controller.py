# Tests of experiments/walks.py, experiments/run.py
"""Policies in the published experiments, in place of the published controller."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path

import jax
import numpy as np
import pytest
from fakes.experiment_fake import Fake

from nermo_mjx import Setup
from nermo_mjx.experiments import plots, walks
from nermo_mjx.experiments.cases import ReplacementPolicy, Settings
from nermo_mjx.experiments.run import EXPERIMENTS, run_experiment
from nermo_mjx.learn import PPO, Environment, Policy, Task
from nermo_mjx.robot import ParameterError

#: Columns that a controller determines.
MEASURED = ("speed", "slip", "pitch_std", "cross_track_peak")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Policy files: untrained, which changes nothing; with weights; and one that observes no path."""
    folder = tmp_path_factory.mktemp("policies")
    blind = tuple(name for name in Task().observe if name != "path")
    for name, task in {"none": Task(), "blind": Task(observe=blind)}.items():
        environment = Environment(Setup(), worlds=2, task=task)
        learned = PPO().begin(environment, 0)
        (folder / f"{name}.npz").write_bytes(Policy.of(environment, learned).content())
        if name == "none":
            *hidden, (weights, bias) = learned.actor.layers
            weights = 0.3 * jax.random.normal(jax.random.key(1), weights.shape)
            actor = dataclasses.replace(learned.actor, layers=(*hidden, (weights, bias)))
            learned = dataclasses.replace(learned, actor=actor)
            (folder / "some.npz").write_bytes(Policy.of(environment, learned).content())
    return {name: str(folder / f"{name}.npz") for name in ("none", "some", "blind")}


def settings(where=None):
    controller = None if where is None else ReplacementPolicy.of(where)
    return Settings(("exact",), repeats=1, quick=True, controller=controller, engine="c")


@pytest.mark.long
@pytest.mark.release
def test_a_policy_that_does_nothing_walks_as_the_published_controller_and_another_does_not(
    files, monkeypatch
):
    """Every case with its own gait, frequency, stride and spine: as without a policy, where its actions are zero."""
    chosen = (walks._line("trot", 0.8, spine=True), walks._line("lateral_walk", 0.5, spine=False))
    monkeypatch.setattr(walks, "line_cases", lambda quick: chosen)
    monkeypatch.setattr(walks, "_record", lambda *_: {})
    monkeypatch.setattr(walks, "gait_cycle", lambda *_: {})
    published, none, some = (
        walks.walk_line(settings(files.get(name))).columns for name in (None, "none", "some")
    )
    assert not np.allclose(published["speed"][0], published["speed"][1], rtol=0.1)
    for name in MEASURED:
        np.testing.assert_allclose(none[name], published[name], rtol=1e-6, err_msg=name)
    assert not np.allclose(some["speed"], published["speed"], rtol=0.02, equal_nan=False)


@pytest.mark.long
@pytest.mark.release
def test_full_lock_is_left_out_for_a_policy_that_needs_a_path(files, monkeypatch):
    """Circles are walked, and full lock by a policy that observes no path."""
    chosen = tuple(walks._turn("trot", 0.67, radius, "leg") for radius in (0.5, walks.FULL_LOCK))
    monkeypatch.setattr(walks, "turn_cases", lambda quick: chosen)
    monkeypatch.setattr(walks, "_record", lambda *_: {})
    monkeypatch.setattr(walks, "_LOCK_CYCLES", 3.0)
    monkeypatch.setattr(walks, "_IN_TIME", 2.0)
    assert walks.walk_turns(settings(files["none"])).columns["radius"].tolist() == [0.5]
    assert walks.walk_turns(settings(files["blind"])).columns["radius"].tolist() == [
        0.5,
        walks.FULL_LOCK,
    ]


@pytest.mark.release
def test_another_controller_is_another_setting_and_its_copy_is_kept(files, tmp_path, monkeypatch):
    for name in ("maze", "balance"):
        walks = EXPERIMENTS[name].walks
        monkeypatch.setitem(
            EXPERIMENTS, name, dataclasses.replace(Fake(name).experiment(), walks=walks)
        )
    monkeypatch.setattr(plots, "figures_of_experiment", lambda outcome, lines: [])
    asked = {"engine": "c", "profiles": ("exact",), "video": False}
    run_experiment("maze", tmp_path, controller=files["some"], **asked)
    (copy,) = tmp_path.glob("some-*.npz")
    assert copy.read_bytes() == Path(files["some"]).read_bytes()
    assert run_experiment("maze", tmp_path, controller=files["some"], **asked).kept
    for other in (None, files["none"]):
        with pytest.raises(ParameterError, match="controller: "):
            run_experiment("maze", tmp_path, controller=other, **asked)
    entry = json.loads((tmp_path / "maze" / "report.json").read_text())
    assert entry["settings"]["controller"].startswith("some.npz ")
    assert "some.npz" in (tmp_path / "report.md").read_text()
    with pytest.raises(
        ParameterError, match=r"does not apply to balance.*straight-line, turning, maze"
    ):
        run_experiment("balance", tmp_path / "balance", controller=files["some"], **asked)
    assert not (tmp_path / "balance").exists()


def test_a_controller_with_parameters_of_its_own_is_refused_in_one_sentence(tmp_path):
    own = tmp_path / "own.py"
    own.write_text("from nermo_mjx import Setup\nOwn = Setup().make_controller()\n")
    with pytest.raises(
        ParameterError, match=r"own\.py:Own', which has parameters of its own: allowed is a policy"
    ):
        ReplacementPolicy.of(f"{own}:Own")


@pytest.mark.release
def test_a_controller_travels_to_other_machines(files):
    """Workers get it with the settings, without its file."""
    there = pickle.loads(pickle.dumps(settings(files["some"])))
    assert there.as_dict() == settings(files["some"]).as_dict()
    assert (
        there.setup("maze", pilot="arc").defaults()
        == settings(files["some"]).setup("maze", pilot="arc").defaults()
    )
