# Tests of experiments/identification.py
"""Identification from published speeds: the objective, what is free, a search that finds what it is made to find, a
resumable directory."""

import json
import math
import types

import numpy as np
import pytest

from nermo_mjx.experiments import identification
from nermo_mjx.experiments.identification import (
    CASES,
    TARGETS,
    IdentificationSearch,
    PublishedSpeeds,
    deviations,
    figures_of_identification,
    free_parameters,
    identify,
    objective,
    run_identification,
    speed_figures,
)
from nermo_mjx.robot import identified
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import ParameterError, quantities
from nermo_mjx.rollout import Setup
from nermo_mjx.runs import JobFailed, Watch
from nermo_mjx.runs.job import SILENT
from nermo_mjx.runs.workers import LocalWorkers, WorkersLost
from nermo_mjx.sweep import simulating

NAMES = list(TARGETS)


def meets(**others):
    """Figures that meet all targets (1, targets), but for these."""
    met = {name: low if math.isfinite(high) else 1.1 for name, (low, high, *_) in TARGETS.items()}
    return np.array([list((met | others).values())])


def test_a_deviation_counts_tolerances_of_the_logarithm():
    """10 % off is about one; inside an interval it is none; an order is missed by 2 % a unit."""
    for name, figures, expected in (
        ("trot, 0.8 Hz, over lateral walk", (1.27, 1.27 * np.exp(0.1), 1.27 * np.exp(-0.2)), (0.0, 1.0, -2.0)),
        ("trot, 0.8 Hz, over walking trot", (3.0, 1.0, np.exp(-0.02)), (0.0, 0.0, -1.0)),
    ):
        found = [deviations(meets(**{name: each}))[0, NAMES.index(name)] for each in figures]
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_robot_that_walks_as_published_costs_nothing_and_a_fallen_one_the_most():
    fallen, other = meets(**{NAMES[5]: np.nan}), meets(**{NAMES[5]: 1.27 * np.exp(0.1)})
    costs = objective(np.concatenate([meets(), other, fallen, meets(**{NAMES[5]: -1.0})]))
    np.testing.assert_allclose(costs, [0.0, 1 / np.sqrt(len(TARGETS)), np.inf, np.inf], atol=1e-12)


@pytest.mark.parametrize("profile", ["exact", "as_published"])
def test_what_is_free_is_the_bodys_within_allowed_bounds_and_never_the_soles(profile):
    """Frictions are uncertain, about the defaults, but no search bends them to the speeds."""
    known = dict(quantities(ModelParameters))
    for each in free_parameters(profile):
        known[each.name].check(each.name, each.low)
        known[each.name].check(each.name, each.high)
        assert each.low <= each.value <= each.high
        assert each.name.startswith("contact.") == (each.kind == "uncertain")


def test_bodies_that_were_identified_have_the_objective_of_their_walks():
    """Of the ensemble that comes with the package: real walks, as near as last bits of another compiler let them."""
    parameters, bodies = free_parameters("as_published"), identified.bodies()
    wanted = IdentificationSearch(profile="as_published")
    problem = PublishedSpeeds(parameters, wanted, "c", SILENT, LocalWorkers(), lambda compute: compute())
    problem.predict(np.array([bodies.values[each.name][:3] for each in parameters]).T)
    np.testing.assert_allclose(objective(problem.figures), bodies.objective[:3], atol=0.02)


def test_figures_are_ratios_of_the_right_speeds():
    """Speeds that are all different: each figure is checked against a ratio written out here."""
    cases = [tuple(case.labels.values()) for case in CASES]
    speed = {case: 0.05 + 0.01 * i for i, case in enumerate(cases)}
    found = speed_figures(np.array([[speed[case] for case in cases]]))
    expected = {
        "trot, 0.8 Hz, over theory": speed["trot", 0.8, False] / 0.096,
        "trot, 0.5 Hz, spine over none": speed["trot", 0.5, True] / speed["trot", 0.5, False],
        "trot with spine, 0.8 Hz, over lateral walk": speed["trot", 0.8, True] / speed["lateral_walk", 0.8, False],
        "walking trot, 0.5 Hz, over lateral walk": speed["walking_trot", 0.5, False]
        / speed["lateral_walk", 0.5, False],
    }
    assert found.shape == (1, len(TARGETS))
    for name, value in expected.items():
        assert found[0, NAMES.index(name)] == pytest.approx(value)


class Pretended:
    """A simulator whose trot over theory is off by how far servo gain and sole friction are from 9 N m/rad and 1.4."""

    calls = 0
    dies_after: int | None = None

    def __init__(self, setup=None, engine="auto"):
        self.setup = setup

    def run(self, values, run, **_):
        type(self).calls += 1
        if self.dies_after is not None and type(self).calls > self.dies_after:
            raise KeyboardInterrupt
        away = np.log(values["servo.kp"] / 9.0)
        if "contact.friction" in values:
            away = np.hypot(away, np.log(values["contact.friction"] / 1.4))
        base = {("trot", 0.5): 0.06, ("trot", 0.8): 0.0864, ("walking_trot", 0.5): 0.055, ("walking_trot", 0.8): 0.08}
        base |= {("lateral_walk", 0.5): 0.05, ("lateral_walk", 0.8): 0.0864 / 1.27}
        speed = np.empty(len(away))
        for i in range(len(away)):
            case = CASES[i % len(CASES)].labels
            gain = {0.5: 1.1, 0.8: 1.48 / 1.27}[case["frequency"]] if case["spine"] else 1.0
            speed[i] = base[case["gait"], case["frequency"]] * gain * np.exp(away[i])
        return types.SimpleNamespace(metrics={"speed": speed}, status=np.full(len(away), "ok"), steps=1)


@pytest.fixture
def pretended(monkeypatch):
    class Fresh(Pretended):
        pass

    monkeypatch.setattr(simulating, "Simulator", Fresh)
    monkeypatch.setattr(identification, "figures_of_identification", lambda found: iter(()))
    return Fresh


SMALL = {"samples": 96, "generations": 8, "seed": 3, "engine": "c"}


def test_the_search_finds_a_known_optimum_and_is_the_same_again(pretended):
    found, again = (identify(IdentificationSearch(samples=16, generations=12, seed=3), "c") for _ in range(2))
    assert found.fit.values[0] == pytest.approx(9.0, rel=0.02)
    assert found.objective[0] == found.costs[:-16].min() < found.costs[0]
    np.testing.assert_array_equal(found.costs, again.costs)


def test_the_ensemble_is_the_even_share_of_the_bounds_within_the_tolerance(pretended):
    """The pretended region is a circle in the logarithms of gain and friction, whose share of the bounds is known."""
    found = identify(IdentificationSearch(samples=1024, generations=4, seed=3), "c")
    parameters = dict(zip([each.name for each in found.fit.space.parameters], found.bodies[1:].T, strict=True))
    away = np.hypot(np.log(parameters["servo.kp"] / 9), np.log(parameters["contact.friction"] / 1.4))
    missed = np.log(1.48 / 1.27 / 1.22)  # the one target that no body of the pretended kind can meet
    np.testing.assert_allclose(found.objective[1:], np.sqrt((away**2 + missed**2) / 0.1**2 / len(TARGETS)), atol=1e-6)
    assert found.objective[1:].max() <= 0.5
    circle = math.pi * (0.5**2 * 0.1**2 * len(TARGETS) - missed**2)
    assert len(away) / 1024 == pytest.approx(circle / (math.log(20 / 4.5) * math.log(1.8)), rel=0.1)
    for each, column in zip(found.fit.space.parameters, found.bodies.T, strict=True):
        assert each.low <= column.min() <= column.max() <= each.high
    low, high = found.fit.intervals.T
    np.testing.assert_allclose(low, np.quantile(found.bodies[1:], 0.05, axis=0), rtol=0.02)
    assert math.log(high[1] / low[1]) > 0.8 * math.log(30), "what does not matter is not known"
    assert "servo.kv" in found.sentences()[2], "and is called so"


def test_the_set_up_of_the_tests_is_searched_from_the_authors_values_in_the_publications_clock(pretended):
    """The pretended trot walks at 0.9 of its theory in one clock, and so at 0.36 of it in the other."""
    asked = []
    pretended.run = lambda self, values, run, inherited=pretended.run, **_: (
        asked.append(values),
        inherited(self, values, run),
    )[1]
    found = identify(IdentificationSearch(samples=8, generations=1, profile="as_published"), "c")
    first = {name: float(values[0]) for name, values in asked[0].items()}
    assert (first["servo.kp"], first["damping.spine"], first["stance.rear_z"]) == (60.0, 0.01, -0.042)
    assert (first["tracking.clock_ratio"], first["pilot.error_gain"], first["servo.torque_limit"]) == (0.4, 0.0, 0.4)
    assert all((values["damping.knee"] == values["damping.ankle"]).all() for values in asked)
    assert found.figures[0, NAMES.index("trot, 0.8 Hz, over theory")] == pytest.approx(0.36 * 60 / 9, rel=1e-3)


def test_a_tolerance_that_nothing_meets_leaves_the_best_and_says_so(pretended, tmp_path):
    _, content = run_identification(tmp_path, **SMALL, tolerance=1e-9)
    assert content["ensemble"]["size"] == 0
    assert "These are fewer than 8, too few for intervals" in content["sentences"][-1]
    assert not any(each["determined"] for each in content["parameters"].values())
    bodies = identified.bodies(str(tmp_path))
    assert (len(bodies), bodies.values["servo.kp"][0]) == (1, pytest.approx(content["parameters"]["servo.kp"]["value"]))


def test_a_killed_identification_goes_on_and_ends_the_same(pretended, tmp_path):
    """Killed in the search, and again in the ensemble: the same files as without, nothing simulated twice."""
    run_identification(tmp_path / "whole", **SMALL)
    needed, pretended.calls = pretended.calls, 0
    for pretended.dies_after in (3, needed - 4):
        with pytest.raises(KeyboardInterrupt):
            run_identification(tmp_path / "killed", **SMALL)
        pretended.calls -= 1
    pretended.dies_after = None
    for _ in range(2):
        run_identification(tmp_path / "killed", **SMALL)
    assert pretended.calls == needed
    assert (tmp_path / "killed" / "ensemble.csv").read_text() == (tmp_path / "whole" / "ensemble.csv").read_text()


class Backwards:
    """Workers that compute the last of the tasks at hand first; `lost_after` so many."""

    def __init__(self, lost_after=None):
        self.lost_after, self.done, self.at_hand = lost_after, 0, []

    def begin(self, computer):
        computer.warm()
        self.computer = computer

    def results(self, tasks, tell):
        tasks = list(tasks)
        self.at_hand.append(len(tasks))
        for key, task in reversed(tasks):
            if self.done == self.lost_after:
                raise WorkersLost("no node came within 300 s.")
            self.done += 1
            yield key, self.computer(task)


def test_who_walks_the_candidates_and_when_does_not_matter(pretended, tmp_path):
    """Batches of a generation and of the samples are handed out together; the same files in the end."""
    others = Backwards()
    (_, ours), (_, theirs) = (
        run_identification(tmp_path / name, **SMALL, workers=workers)
        for name, workers in (("one", None), ("others", others))
    )
    for name in ("costs", "parameters", "targets", "ensemble"):
        np.testing.assert_equal(ours[name], theirs[name])
    assert others.at_hand == [1, *[2] * SMALL["generations"], 8]
    assert (tmp_path / "one" / "ensemble.csv").read_bytes() == (tmp_path / "others" / "ensemble.csv").read_bytes()


def test_workers_that_are_lost_leave_what_they_walked(pretended, tmp_path):
    """What is walked out of order waits for what comes before it: only that is kept."""
    with pytest.raises(JobFailed, match=r"no node came within 300 s\. What is finished is kept in .*same command"):
        run_identification(tmp_path / "lost", **SMALL, workers=Backwards(lost_after=3))
    assert pretended.calls == 3
    run_identification(tmp_path / "lost", **SMALL)
    again, pretended.calls = pretended.calls, 0
    run_identification(tmp_path / "whole", **SMALL)
    assert again == pretended.calls, "nothing is walked twice"


@pytest.mark.parametrize("other", ["settings", "code", "robot"])
def test_a_directory_goes_on_only_with_what_began_it(pretended, tmp_path, monkeypatch, other):
    run_identification(tmp_path, **SMALL)
    calls, settings = pretended.calls, dict(SMALL)
    if other == "settings":
        settings["samples"] += 1
    elif other == "code":
        monkeypatch.setattr("nermo_mjx.runs.code.__version__", "9.9.9")
    else:
        defaults = Setup().defaults() | {"contact.friction": 1.3}
        monkeypatch.setattr(Setup, "defaults", lambda self: defaults)
    with pytest.raises(ParameterError, match="with other settings or by other code: choose another directory"):
        run_identification(tmp_path, **settings)
    (tmp_path / "steps.json").unlink()  # as of an earlier version
    with pytest.raises(ParameterError, match="with other settings or by other code: choose another directory"):
        run_identification(tmp_path, **SMALL)
    assert pretended.calls == calls


def test_the_files_of_an_ensemble_agree(pretended, tmp_path, monkeypatch):
    """identification.json, ensemble.csv and the report; a user's files in the way are moved aside."""
    monkeypatch.setattr(identification, "figures_of_identification", figures_of_identification)
    said, mine = [], [tmp_path / name for name in ("report.html", "ensemble.csv")]
    for path in mine:
        path.write_text("a user's")
    found, content = run_identification(tmp_path, **SMALL | {"samples": 256}, watch=Watch(warn=said.append))
    assert [path.with_name(f"{path.name}.aside-1").read_text() for path in mine] == ["a user's"] * 2
    assert said == [
        "Files in the way were not as this program wrote them: moved aside in "
        f"{tmp_path}, to ensemble.csv.aside-1 and 1 more."
    ]
    stored, bodies = json.loads((tmp_path / "identification.json").read_text()), identified.bodies(str(tmp_path))
    assert stored["sentences"] == content["sentences"]
    assert len(bodies) == stored["ensemble"]["size"] + 1 > 8
    assert str(tmp_path) not in (tmp_path / "ensemble.csv").read_text()
    np.testing.assert_array_equal(bodies.values["damping.knee"], bodies.values["damping.ankle"])
    for each, column in zip(found.fit.space.parameters, found.bodies.T, strict=True):
        np.testing.assert_array_equal(bodies.values[each.name], column)
    np.testing.assert_allclose(bodies.objective, found.objective, rtol=1e-5)
    assert {each.name for each in (tmp_path / "plots").glob("*.png")} == {"intervals.png", "ensemble.png"}
    text = (tmp_path / "report.html").read_text()
    assert "contact.tail_friction" in text
    assert "trot, 0.8 Hz, over lateral walk" in text
    assert 'src="http' not in text


def test_a_search_too_small_is_refused():
    for name, least in (("samples", 8), ("generations", 1)):
        with pytest.raises(ParameterError, match=f"{name} is {least - 1}: allowed is {least} or more"):
            IdentificationSearch(**{name: least - 1})
    with pytest.raises(ParameterError, match="tolerance is 0: allowed is more than 0"):
        IdentificationSearch(tolerance=0.0)
    with pytest.raises(ParameterError, match="profile is 'as_built'"):
        IdentificationSearch(profile="as_built")
