"""Identified bodies beside the default one: what is run, what is kept, and the share in which a line holds."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from experiment_fake import RUN, Fake

from nermo_mjx.experiments import ensemble
from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.directory import Directory
from nermo_mjx.experiments.plots import figures as plots
from nermo_mjx.experiments.published import shares
from nermo_mjx.experiments.run import ExperimentError, run_experiment, run_experiments
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.robot import ParameterError
from nermo_mjx.runs.workers import WorkersLost

#: A body walks as much faster as its friction says (see `experiment_fake`): 80 mm/s are published, so that those
#: between 0.75 and 1.25 hold.
FRICTION = np.array([1.0, 1.2, 1.3, 0.7])


@pytest.fixture
def fakes(monkeypatch):
    """Experiments that simulate and draw nothing, and an ensemble of four bodies."""
    made = {name: Fake(name) for name in EXPERIMENTS}
    for name, fake in made.items():
        monkeypatch.setitem(EXPERIMENTS, name, fake.experiment())
    monkeypatch.setattr(plots, "figures_of", lambda outcome, lines: [])
    monkeypatch.setattr(ensemble, "draw", lambda n, seed: {"contact.friction": np.roll(FRICTION, seed)[:n]})
    return made


def line_of(result, name="speed at 0.8 Hz"):
    return next(line for line in result.lines if line.figure == name)


def test_a_line_says_in_which_share_of_the_bodies_it_holds(fakes, tmp_path):
    result = run_experiment("turning", tmp_path, bodies=4, seed=4, video=False)
    assert line_of(result).ensemble == 0.5
    assert line_of(result, "faster | at 0.8 Hz").ensemble == 1.0
    assert line_of(result, "ratio of speeds").ensemble == 0.0
    assert line_of(result, "interval").ensemble is None
    assert (
        "| speed at 0.8 Hz [mm/s] | predicted | 80 | 71.0 | 81.0 | 1.01 | yes | 50% | 6.2 |"
        in (tmp_path / "report.md").read_text()
    )
    assert "Ensemble: 4 identified bodies" in (tmp_path / "report.md").read_text()
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["experiments"]["turning"]["bodies"] == 4
    assert report["lines"][0]["ensemble"] == 0.5


def test_bodies_walk_once_in_the_exact_profile_and_are_kept_beside_the_results(fakes, tmp_path):
    run_experiment("maze", tmp_path, bodies=3, repeats=2, video=False)
    own, of_bodies = fakes["maze"].asked
    assert own.bodies is None
    assert (of_bodies.profiles, of_bodies.repeats) == (("exact",), 1)
    assert of_bodies.bodies["contact.friction"].tolist() == FRICTION[:3].tolist()
    stored = Directory(tmp_path).load_bodies("maze")
    assert stored is not None
    assert sorted(set(stored.outcome.columns["body"].tolist())) == [1, 2, 3]
    assert not stored.recordings
    main = Directory(tmp_path).load("maze")
    assert main is not None
    assert "body" not in main.outcome.columns
    assert list(main.outcome.recordings) == [RUN]


def test_kept_bodies_are_not_walked_again_and_a_report_is_remade_from_them(fakes, tmp_path):
    run_experiment("maze", tmp_path, bodies=4, video=False)
    for bodies in (4, None):
        result = run_experiment("maze", tmp_path, bodies=bodies, video=False)
        assert line_of(result).ensemble == 0.5
    assert len(fakes["maze"].asked) == 2
    # Other bodies are walked, and the results of the default body stay.
    assert line_of(run_experiment("maze", tmp_path, bodies=2, video=False)).ensemble == 1.0
    assert [(asked.bodies is not None) for asked in fakes["maze"].asked] == [False, True, True]
    # A fresh run has none.
    assert line_of(run_experiment("maze", tmp_path, again=True, video=False)).ensemble is None
    assert not (tmp_path / "results" / "maze-bodies.parquet").exists()


def test_bodies_outlive_a_damaged_table_of_the_same_settings(fakes, tmp_path):
    """They are hours of work; with other settings they are none of the new results, and are removed."""
    result = run_experiment("maze", tmp_path, bodies=4, video=False)
    result.table.write_text("damaged")
    assert line_of(run_experiment("maze", tmp_path, video=False)).ensemble == 0.5
    assert [(asked.bodies is not None) for asked in fakes["maze"].asked] == [False, True, False]
    result.table.write_text("damaged")
    assert line_of(run_experiment("maze", tmp_path, seed=3, video=False)).ensemble is None


def test_bodies_come_in_pieces_and_are_numbered_through(fakes, tmp_path, monkeypatch):
    monkeypatch.setattr(ensemble, "AT_ONCE", 3)
    result = run_experiment("maze", tmp_path, bodies=4, video=False)
    assert line_of(result).ensemble == 0.5
    stored = Directory(tmp_path).load_bodies("maze")
    assert stored is not None
    assert np.unique(stored.outcome.columns["body"]).tolist() == [1, 2, 3, 4]
    assert list(stored.outcome.columns)[:2] == ["profile", "body"]


def test_parts_are_stored_in_the_order_in_which_they_come(fakes, tmp_path, monkeypatch):
    """Whoever is free simulates: here the last part comes first. Tables and report are those of one process."""
    monkeypatch.setattr(ensemble, "AT_ONCE", 3)

    class Backwards:
        parts = 2

        def begin(self, computer):
            self.computer = computer

        def results(self, tasks, tell):
            for key, task in reversed(list(tasks)):
                yield key, self.computer(task)

    names = ("maze", "turning")
    one = run_experiments(names, tmp_path / "one", bodies=4, video=False)
    other = run_experiments(names, tmp_path / "other", bodies=4, video=False, workers=Backwards())
    assert [each.lines for each in one.results] == [each.lines for each in other.results]
    for name in names:
        ours, theirs = (Directory(each.out).load_bodies(name).outcome.columns for each in (one, other))
        assert list(ours) == list(theirs)
        for column in ours:
            np.testing.assert_array_equal(ours[column], theirs[column])
    # What is run again replaces the bodies, also where they come before what they belong to.
    again = run_experiments(names, tmp_path / "other", bodies=4, again=True, video=False, workers=Backwards())
    assert {line_of(each).ensemble for each in again.results} == {0.5}


def test_workers_that_are_lost_leave_the_experiments_that_are_done(fakes, tmp_path):
    class Lost:
        parts = 1

        def begin(self, computer):
            self.computer = computer

        def results(self, tasks, tell):
            key, task = next(iter(tasks))
            yield key, self.computer(task)
            raise WorkersLost("no node came within 300 s.")

    former = run_experiment("maze", tmp_path, bodies=4, seed=4, video=False)
    former.table.write_text("damaged")
    with pytest.raises(ExperimentError, match=r"no node came within 300 s\. What is finished is kept in .*same"):
        run_experiments(("maze", "turning"), tmp_path, bodies=4, video=False, workers=Lost())
    assert Directory(tmp_path).load("maze") is not None
    assert Directory(tmp_path).load_bodies("maze") is None, "those of other settings are none of these results"


def test_what_is_set_for_all_worlds_is_not_taken_from_the_bodies(fakes, tmp_path, monkeypatch):
    both = {"contact.friction": FRICTION, "servo.kp": np.full(4, 5.0)}
    monkeypatch.setattr(ensemble, "draw", lambda n, seed: both)
    run_experiment("maze", tmp_path, bodies=4, values={"servo.kp": 9.0}, video=False)
    asked = fakes["maze"].asked[1]
    assert set(asked.bodies) == {"contact.friction"}
    assert asked.values == {"servo.kp": 9.0}


def test_more_bodies_than_there_are_is_refused_before_anything_runs(fakes, tmp_path, monkeypatch):
    monkeypatch.undo()
    with pytest.raises(ParameterError, match="bodies is 1000000: allowed is 1 to"):
        run_experiment("maze", tmp_path, bodies=10**6, video=False)
    assert not list(tmp_path.rglob("*.parquet"))


def test_the_identified_ensemble_gives_parameters_of_the_body(tmp_path):
    drawn = ensemble.draw(2, 0)
    assert all(len(values) == 2 for values in drawn.values())
    for experiment in EXPERIMENTS.values():
        assert set(drawn) <= experiment.settable, experiment.name


def test_a_body_that_falls_does_not_hold(fakes):
    figures = fakes["maze"].experiment().figures
    bodies = {"contact.friction": np.array([1.0, np.nan])}
    outcome = fakes["maze"].run(Settings(("exact",), repeats=1, bodies=bodies, progress=lambda _: None))
    found = ensemble.of_outcome(outcome, figures)
    assert (found.bodies, found.shares["speed at 0.8 Hz"], found.shares["interval"]) == (2, 0.5, None)


# --- the shares that ship


def test_shares_are_written_from_a_directory_and_used_for_default_runs_only(fakes, tmp_path, monkeypatch):
    file = tmp_path / "shares.json"
    file.write_text('{"bodies": 0, "shares": {}}')
    run_experiments(tuple(EXPERIMENTS), tmp_path / "all", bodies=4, video=False)
    assert shares.write(tmp_path / "all", file) == 4
    content = json.loads(file.read_text())
    assert content["bodies"] == 4
    assert set(content["shares"]) == set(EXPERIMENTS)
    assert content["shares"]["maze"]["speed at 0.8 Hz"] == 0.5
    monkeypatch.setattr("nermo_mjx.experiments.run.shipped", lambda name: shares.shipped(name, file))
    assert line_of(run_experiment("maze", tmp_path / "plain", video=False)).ensemble == 0.5
    assert line_of(run_experiment("maze", tmp_path / "quick", quick=True)).ensemble is None
    changed = run_experiment("maze", tmp_path / "set", values={"contact.friction": 0.8}, video=False)
    assert line_of(changed).ensemble is None


@pytest.mark.parametrize(
    ("options", "sentence"),
    [({}, "holds no bodies of"), ({"bodies": 2, "quick": True}, "is quick, or has other parameters")],
)
def test_shares_of_anything_else_are_not_written(fakes, tmp_path, options, sentence):
    file = tmp_path / "shares.json"
    run_experiments(tuple(EXPERIMENTS), tmp_path / "all", video=False, **options)
    with pytest.raises(ValueError, match=sentence):
        shares.write(tmp_path / "all", file)
    assert not file.exists()


def test_an_experiment_without_predicted_lines_needs_no_bodies(fakes, tmp_path, monkeypatch):
    chosen = [dataclasses.replace(figure, kind="chosen") for figure in EXPERIMENTS["turning"].figures]
    monkeypatch.setitem(EXPERIMENTS, "turning", dataclasses.replace(EXPERIMENTS["turning"], figures=tuple(chosen)))
    others = tuple(name for name in EXPERIMENTS if name != "turning")
    run_experiments(others, tmp_path / "all", bodies=2, video=False)
    assert shares.write(tmp_path / "all", file := tmp_path / "shares.json") == 2
    assert set(json.loads(file.read_text())["shares"]) == set(others)


def test_the_shares_that_ship_belong_to_lines():
    content = json.loads(shares.FILE.read_text())
    for name, found in content["shares"].items():
        assert set(found) <= {figure.name for figure in EXPERIMENTS[name].figures}
        assert all(share is None or 0.0 <= share <= 1.0 for share in found.values())
