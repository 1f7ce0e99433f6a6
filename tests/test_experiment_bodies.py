"""Identified bodies beside the default one: what is run, what is kept, and the interval that they give."""

from __future__ import annotations

import json

import numpy as np
import pytest
from experiment_fake import RUN, Fake

from nermo_mjx.experiments import plots, run
from nermo_mjx.experiments.run import EXPERIMENTS, Directory, run_experiment, run_experiments
from nermo_mjx.robot import ParameterError
from nermo_mjx.runs import JobFailed
from nermo_mjx.runs.workers import WorkersLost

#: A body walks as much faster than 70 mm/s as its friction says (see `experiment_fake`): 80 mm/s are published, so that
#: 60 to 100 hold, as do the three starts of the default body.
FRICTION = np.array([1.0, 1.2, 1.5, 0.7])
HOLD = 5 / 7


def drawn(n, seed=0, **more):
    """The same bodies in all profiles."""
    values = {"contact.friction": np.roll(FRICTION, seed)[:n]} | more
    return dict.fromkeys(("exact", "as_published", "as_built"), values)


@pytest.fixture
def fakes(monkeypatch):
    """Experiments that simulate and draw nothing, and an ensemble of four bodies."""
    made = {name: Fake(name) for name in EXPERIMENTS}
    for name, fake in made.items():
        monkeypatch.setitem(EXPERIMENTS, name, fake.experiment())
    monkeypatch.setattr(plots, "figures_of", lambda outcome, lines: [])
    monkeypatch.setattr(run, "draw", drawn)
    return made


def line_of(result, name="speed at 0.8 Hz"):
    return next(line for line in result.lines if line.figure == name)


def test_a_line_has_the_interval_of_its_bodies_and_starts_and_says_whether_it_covers(fakes, tmp_path):
    result = run_experiment("turning", tmp_path, bodies=4, seed=4, video=False)
    speed = line_of(result)
    assert (speed.low, speed.high) == pytest.approx((49.0, 105.0))
    assert (speed.covered, speed.ensemble) == (True, pytest.approx(HOLD))
    assert line_of(result, "faster | at 0.8 Hz").ensemble == 1.0
    ratio = line_of(result, "ratio of speeds")
    assert (ratio.ensemble, ratio.low, ratio.covered) == (0.0, 1.6, False)
    assert line_of(result, "interval").ensemble is None
    text = (tmp_path / "report.md").read_text()
    assert "| 80 | 84.9 | 71.0 | 81.0 | 61.0 | 49.0 to 105 | yes | yes | 6.2 |" in text
    assert "4 identified bodies, a start each" in text
    assert "**1 of 2 predicted figures hold; 1 of 1 published values lie in the 90 % interval.**" in text
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["experiments"]["turning"]["bodies"] == 4
    assert report["summary"]["covered"] == 1


def test_bodies_walk_once_where_they_are_judged_and_are_kept_beside_the_results(fakes, tmp_path):
    run_experiment("maze", tmp_path, bodies=3, repeats=2, video=False)
    own, of_bodies = fakes["maze"].asked
    assert own.bodies is None
    assert (of_bodies.profiles, of_bodies.repeats) == (("as_published",), 1)
    assert of_bodies.bodies["contact.friction"].tolist() == FRICTION[:3].tolist()
    stored = Directory(tmp_path).load("maze", bodies=True)
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
        assert line_of(result).ensemble == pytest.approx(HOLD)
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
    assert line_of(run_experiment("maze", tmp_path, video=False)).ensemble == pytest.approx(HOLD)
    assert [(asked.bodies is not None) for asked in fakes["maze"].asked] == [False, True, False]
    result.table.write_text("damaged")
    assert line_of(run_experiment("maze", tmp_path, seed=3, video=False)).ensemble is None


def test_bodies_come_in_pieces_and_are_numbered_through(fakes, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "AT_ONCE", 3)
    result = run_experiment("maze", tmp_path, bodies=4, video=False)
    assert line_of(result).ensemble == pytest.approx(HOLD)
    stored = Directory(tmp_path).load("maze", bodies=True)
    assert stored is not None
    assert np.unique(stored.outcome.columns["body"]).tolist() == [1, 2, 3, 4]
    assert list(stored.outcome.columns)[:2] == ["profile", "body"]


def test_parts_are_stored_in_the_order_in_which_they_come(fakes, tmp_path, monkeypatch):
    """Whoever is free simulates: here the last part comes first. Tables and report are those of one process."""
    monkeypatch.setattr(run, "AT_ONCE", 3)

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
        ours, theirs = (Directory(each.out).load(name, bodies=True).outcome.columns for each in (one, other))
        assert list(ours) == list(theirs)
        for column in ours:
            np.testing.assert_array_equal(ours[column], theirs[column])
    # What is run again replaces the bodies, also where they come before what they belong to.
    again = run_experiments(names, tmp_path / "other", bodies=4, again=True, video=False, workers=Backwards())
    assert {line_of(each).ensemble for each in again.results} == {HOLD}


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
    with pytest.raises(JobFailed, match=r"no node came within 300 s\. What is finished is kept in .*same"):
        run_experiments(("maze", "turning"), tmp_path, bodies=4, video=False, workers=Lost())
    assert Directory(tmp_path).load("maze") is not None
    assert Directory(tmp_path).load("maze", bodies=True) is None, "those of other settings are none of these results"


def test_what_is_set_for_all_worlds_is_not_taken_from_the_bodies(fakes, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "draw", lambda n, seed: drawn(n, **{"servo.kp": np.full(4, 5.0)}))
    run_experiment("maze", tmp_path, bodies=4, values={"servo.kp": 9.0}, video=False)
    asked = fakes["maze"].asked[1]
    assert set(asked.bodies) == {"contact.friction"}
    assert asked.values == {"servo.kp": 9.0}


def test_more_bodies_than_there_are_is_refused_before_anything_runs(fakes, tmp_path, monkeypatch):
    monkeypatch.undo()
    with pytest.raises(ParameterError, match="bodies is 1000000: allowed is 1 to"):
        run_experiment("maze", tmp_path, bodies=10**6, video=False)
    assert not list(tmp_path.rglob("*.parquet"))


def test_the_identified_ensembles_give_parameters_of_the_body_in_each_set_up():
    bodies = run.draw(2, 0)
    assert set(bodies) == {"exact", "as_published", "as_built"}
    for values in bodies.values():
        assert all(len(column) == 2 for column in values.values())
        for experiment in EXPERIMENTS.values():
            assert set(values) <= experiment.settable, experiment.name
    assert bodies["as_published"]["servo.kp"].min() > 5.0


def test_bodies_of_each_judged_profile_are_run_and_numbered_alike(fakes, tmp_path, monkeypatch):
    """Simulation is judged as published, the hardware as built: each with the bodies of its own set-up."""
    import dataclasses

    chosen = EXPERIMENTS["maze"]
    figures = (chosen.figures[0], dataclasses.replace(chosen.figures[0], figure="hardware", profile="as_built"))
    monkeypatch.setitem(EXPERIMENTS, "maze", dataclasses.replace(chosen, own_figures=figures))
    result = run_experiment("maze", tmp_path, bodies=4, video=False)
    assert [asked.profiles for asked in fakes["maze"].asked[1:]] == [("as_published",), ("as_built",)]
    stored = Directory(tmp_path).load("maze", bodies=True)
    assert stored is not None
    assert np.unique(stored.outcome.columns["body"]).tolist() == [1, 2, 3, 4]
    assert (result.lines[0].high, result.lines[1].high) == pytest.approx((105.0, 90.0))
