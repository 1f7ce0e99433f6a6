"""Identification: the objective, the space, a search that finds what it is made to find, and a resumable ensemble."""

import json
import types

import numpy as np
import pyarrow.parquet as pq
import pytest

from nermo_mjx.experiments import ensemble, identification
from nermo_mjx.experiments.ensemble import ALL, FREE, TOLERANCE, UNCERTAIN, free_names, parameters_of, point_of
from nermo_mjx.experiments.identification import (
    CASES,
    START,
    TARGETS,
    IdentificationSearch,
    identify,
    objective,
    speed_figures,
)
from nermo_mjx.robot.identified import read_ensemble
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import ParameterError, quantities
from nermo_mjx.rollout import Setup
from nermo_mjx.runs import DirectoryError, JobFailed, OtherCode, Watch, codes_of
from nermo_mjx.runs.rows import part_files
from nermo_mjx.runs.workers import WorkersLost
from nermo_mjx.sweep import simulating

pytestmark = pytest.mark.draws


def test_a_residual_counts_tolerances_of_the_logarithm():
    """10 % off is about one; inside an interval it is none; an order is missed by 2 % a unit."""
    value, order = TARGETS["trot, 0.8 Hz, over lateral walk"], TARGETS["trot, 0.8 Hz, over walking trot"]
    assert value.residual(np.array(1.27)) == pytest.approx(0.0)
    assert value.residual(np.array(1.27 * np.exp(0.1))) == pytest.approx(1.0)
    assert value.residual(np.array(1.27 * np.exp(-0.2))) == pytest.approx(-2.0)
    np.testing.assert_allclose(order.residual(np.array([3.0, 1.0, np.exp(-0.02)])), [0.0, 0.0, -1.0], atol=1e-12)


def test_a_robot_that_walks_as_published_costs_nothing_and_a_fallen_one_the_most():
    published = {
        name: np.array([t.low, t.low]) if np.isfinite(t.high) else np.array([1.1, 1.1]) for name, t in TARGETS.items()
    }
    costs = objective(published, np.array([False, True]))
    assert costs[0] == pytest.approx(0.0, abs=1e-12)
    assert costs[1] == 10.0
    published["trot, 0.8 Hz, over lateral walk"] = np.array([np.nan, 1.27 * np.exp(0.1)])
    costs = objective(published, np.array([False, False]))
    assert costs[0] == 10.0
    assert costs[1] == pytest.approx(1 / np.sqrt(len(TARGETS)))


@pytest.mark.parametrize("space", [FREE, ALL])
def test_the_unit_cube_spans_the_bounds_by_logarithm(space):
    """Values have four digits: what is printed is what was simulated."""
    low, high = parameters_of(np.zeros(len(space)), space), parameters_of(np.ones(len(space)), space)
    middle = parameters_of(np.full(len(space), 0.5), space)
    for free in space.values():
        for name in free.names:
            assert (low[name], high[name]) == pytest.approx((free.low, free.high))
            assert middle[name] == pytest.approx(np.sqrt(free.low * free.high), rel=5e-4)
            assert middle[name] == float(f"{middle[name]:.4g}")
    point = np.random.default_rng(0).uniform(size=len(space))
    found = parameters_of(point, space)
    np.testing.assert_allclose(point_of(found, space), point, atol=1e-3)
    assert parameters_of(point_of(found, space), space) == found


def test_the_free_parameters_are_the_bodys_and_their_bounds_are_allowed():
    known = dict(quantities(ModelParameters))
    for free in ALL.values():
        for name in free.names:
            known[name].check(name, free.low)
            known[name].check(name, free.high)


def test_the_contact_of_the_soles_is_not_searched():
    """It is the author's; frictions are uncertain, about the defaults, but no search bends them to the speeds."""
    assert set(START) == set(free_names(FREE))
    assert not [name for name in free_names(FREE) if name.startswith("contact.")]
    defaults = Setup().defaults()
    for free in UNCERTAIN.values():
        assert free.low < defaults[free.names[0]] < free.high


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
    assert set(found) == set(TARGETS)
    for name, value in expected.items():
        assert found[name][0] == pytest.approx(value)


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
    return Fresh


SMALL = {"samples": 16, "generations": 12, "population": 8, "seed": 3}


def test_the_search_finds_a_known_optimum_and_is_the_same_again(pretended):
    found = identify(IdentificationSearch(**SMALL, bodies=0))
    assert found.parameters["servo.kp"] == pytest.approx(9.0, rel=0.02)
    assert found.objective < found.start
    assert found.objective == min(found.costs)
    assert found.bodies is None
    assert identify(IdentificationSearch(**SMALL, bodies=0)).parameters == found.parameters


def test_the_ensemble_is_within_tolerance_and_bounds_and_begins_with_the_best(pretended):
    """The pretended region is known: |(ln kp/9, ln friction/1.4)| is at most what 0.5 allows, whatever the rest."""
    found = identify(IdentificationSearch(**SMALL, bodies=64, sweeps=3))
    bodies, defaults = found.bodies, Setup().defaults()
    assert bodies.tolerance == TOLERANCE == 0.5
    assert len(bodies.objective) == 64
    assert bodies.objective.max() <= TOLERANCE
    assert bodies.weights.sum() == pytest.approx(1.0)
    first = {name: column[0] for name, column in bodies.values.items()}
    assert first == found.parameters | {name: defaults[name] for name in free_names(UNCERTAIN)}
    assert bodies.objective[0] == found.objective
    for free in ALL.values():
        for name in free.names:
            assert free.low <= bodies.values[name].min() <= bodies.values[name].max() <= free.high
    np.testing.assert_array_equal(bodies.values["damping.knee"], bodies.values["damping.ankle"])
    away = np.hypot(np.log(bodies.values["servo.kp"] / 9), np.log(bodies.values["contact.friction"] / 1.4))
    missed = np.log(1.48 / 1.27 / 1.22)  # the one target that no body of the pretended kind can meet
    np.testing.assert_allclose(bodies.objective, np.sqrt((away**2 + missed**2) / 0.1**2 / len(TARGETS)), atol=1e-6)
    assert np.ptp(np.log(bodies.values["servo.kv"])) > 0.8 * np.log(30)  # what does not matter is not known


def test_the_set_up_of_the_tests_is_searched_from_the_authors_values_in_the_publications_clock(pretended):
    """The pretended trot walks at 0.9 of its theory in one clock, and so at 0.36 of it in the other."""
    asked = []
    pretended.run = lambda self, values, run, inherited=pretended.run, **_: (
        asked.append(values),
        inherited(self, values, run),
    )[1]
    found = identify(IdentificationSearch(**SMALL, bodies=0, profile="as_published"))
    first = {name: float(values[0]) for name, values in asked[0].items()}
    assert (first["servo.kp"], first["damping.spine"], first["stance.rear_z"]) == (60.0, 0.01, -0.042)
    assert (first["tracking.clock_ratio"], first["pilot.error_gain"], first["servo.torque_limit"]) == (0.4, 0.0, 0.4)
    assert found.start_figures["trot, 0.8 Hz, over theory"][0] == pytest.approx(0.36 * 60 / 9, rel=1e-3)
    with pytest.raises(ParameterError, match="profile is 'as_built'"):
        IdentificationSearch(profile="as_built")


def test_an_ensemble_of_none_is_told_and_not_written(pretended, tmp_path):
    """A tolerance that nothing meets: the search's result stands, there is no ensemble.csv, and the report says so."""
    content = identification.run_identification(tmp_path, engine="c", **SMALL, bodies=16, sweeps=1, tolerance=1e-9)
    assert content["ensemble"]["size"] == 0
    assert not (tmp_path / "ensemble.csv").exists()
    assert "There is no body to draw" in (tmp_path / "identification.md").read_text()


def test_a_killed_identification_goes_on_and_ends_the_same(pretended, tmp_path):
    """Killed in the search, and again in the ensemble: the same ensemble.csv as without, nothing simulated twice."""
    settings = {**SMALL, "generations": 4, "bodies": 24, "sweeps": 3, "engine": "c"}
    identification.run_identification(tmp_path / "whole", **settings)
    needed, pretended.calls = pretended.calls, 0
    for pretended.dies_after in (3, needed - 4):
        with pytest.raises(KeyboardInterrupt):
            identification.run_identification(tmp_path / "killed", **settings)
        pretended.calls -= 1
    pretended.dies_after = None
    identification.run_identification(tmp_path / "killed", **settings)
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
    """Batches of the even search and of the ensemble are handed out together; the same files in the end."""
    settings, others = {**SMALL, "bodies": 24, "sweeps": 2, "engine": "c"}, Backwards()
    ours, theirs = (
        identification.run_identification(tmp_path / name, **settings, workers=workers)
        for name, workers in (("one", None), ("others", others))
    )
    assert {name: ours[name] for name in ("costs", "parameters", "objective", "targets", "ensemble")} == {
        name: theirs[name] for name in ("costs", "parameters", "objective", "targets", "ensemble")
    }
    assert others.at_hand == [3, *[1] * 12, *[3] * (len(others.at_hand) - 13)]
    assert len(others.at_hand) > 14, "the ensemble sweeps"
    for name in ("one", "others"):
        table = pq.read_table(tmp_path / name / "results")
        assert len(part_files(tmp_path / name)) == sum(others.at_hand)
        assert sorted(table["row"].to_pylist()) == list(range(table.num_rows))
        assert (
            identification.identification_status(tmp_path / name).rows_done
            == table.num_rows // len(CASES)
            > len(ours["costs"])
        )


def test_workers_that_are_lost_leave_what_they_walked(pretended, tmp_path):
    settings = {**SMALL, "bodies": 0, "engine": "c"}
    with pytest.raises(JobFailed, match=r"no node came within 300 s\. What is finished is kept in .*same command"):
        identification.run_identification(tmp_path / "lost", **settings, workers=Backwards(lost_after=2))
    assert pretended.calls == 2
    identification.run_identification(tmp_path / "lost", **settings)
    again, pretended.calls = pretended.calls, 0
    identification.run_identification(tmp_path / "whole", **settings)
    assert again == pretended.calls, "nothing is walked twice"


def test_another_robot_does_not_go_on_with_the_candidates(pretended, tmp_path, monkeypatch):
    settings = {**SMALL, "bodies": 0, "engine": "c"}
    identification.run_identification(tmp_path, **settings)
    (tmp_path / "identification.json").unlink()
    identification.run_identification(tmp_path, **settings)
    (tmp_path / "identification.json").unlink()
    defaults = Setup().defaults() | {"contact.friction": 0.9}
    monkeypatch.setattr(Setup, "defaults", lambda self: defaults)
    with pytest.raises(ParameterError, match="other settings: choose another directory"):
        identification.run_identification(tmp_path, **settings)


def test_candidates_of_an_earlier_version_are_refused(tmp_path):
    (tmp_path / "candidates.jsonl").write_text("{}\n")
    with pytest.raises(DirectoryError, match="holds candidates of an earlier version: choose another directory"):
        identification.run_identification(tmp_path, engine="c")
    assert identification.identification_status(tmp_path).notes == ("Its candidates are of an earlier version.",)


def test_candidates_of_other_code_are_refused_until_they_are_accepted(pretended, tmp_path, monkeypatch):
    """Each row says which code walked it, and none is walked twice, unless its part is damaged."""
    settings = {**SMALL, "generations": 4, "bodies": 0}
    pretended.dies_after = 3
    with pytest.raises(KeyboardInterrupt):
        identification.run_identification(tmp_path, **settings, engine="mjx")
    pretended.dies_after, pretended.calls = None, 0
    before = {path: path.read_bytes() for path in part_files(tmp_path)}
    monkeypatch.setattr("nermo_mjx.runs.code.__version__", "9.9.9")
    with pytest.raises(OtherCode, match=r"made by other code: nermo-mjx .*, not 9\.9\.9; .*--accept-new-code"):
        identification.run_identification(tmp_path, **settings, engine="mjx")
    assert not pretended.calls
    content = identification.run_identification(tmp_path, **settings, accept_new_code=True)
    assert content["engine"] == "mjx", "that with which it was begun"
    assert {path: path.read_bytes() for path in before} == before, "what was there stays as it was"
    former, new = codes_of(tmp_path)
    codes = {path: set(pq.read_table(path)["code"].to_pylist()) for path in part_files(tmp_path)}
    assert [codes.pop(path) for path in before] == [{former}] * 3
    assert list(codes.values()) == [{new}] * pretended.calls
    (tmp_path / "identification.json").unlink()
    next(iter(codes)).write_bytes(b"damaged")
    pretended.calls = 0
    again = identification.run_identification(tmp_path, **settings, accept_new_code=True)
    assert (again["costs"], pretended.calls) == (content["costs"], 1)
    assert content["codes"] == [former, new]
    assert f"code {former}, {new};" in (tmp_path / "identification.md").read_text()


def test_the_files_of_an_ensemble_agree(pretended, tmp_path):
    """identification.json, ensemble.csv and the report: the same bodies, quantiles in order, a picture; a user's files
    in the way are moved aside."""
    said, mine = [], [tmp_path / name for name in ("identification.md", "ensemble.csv")]
    for path in mine:
        path.write_text("a user's")
    identification.run_identification(tmp_path, engine="c", **SMALL, bodies=32, sweeps=5, watch=Watch(warn=said.append))
    assert [path.with_name(f"{path.name}.aside-1").read_text() for path in mine] == ["a user's"] * 2
    assert said == [
        "Files in the way were not as this program wrote them: moved aside in "
        f"{tmp_path}, to ensemble.csv.aside-1 and 1 more."
    ]
    content = json.loads((tmp_path / "identification.json").read_text())["ensemble"]
    lines = (tmp_path / "ensemble.csv").read_text().splitlines()
    stored = read_ensemble(lines)
    assert len(stored) == content["size"] == 32
    assert str(tmp_path) not in "\n".join(lines)
    for name, column in stored.values.items():
        np.testing.assert_array_equal(column, content["bodies"][name])
    np.testing.assert_allclose(stored.objective, content["bodies"]["objective"], atol=5e-5)
    for name, about in content["parameters"].items():
        low, middle, high = about["quantiles"]
        assert about["low"] <= low <= middle <= high <= about["high"]
        assert content["correlations"][name][name] == pytest.approx(1.0)
    assert [each["candidates"] for each in content["sweeps"]] == [32] * len(content["sweeps"])
    text = (tmp_path / "identification.md").read_text()
    assert "contact.tail_friction" in text
    assert (tmp_path / "plots" / "identification-ensemble.png").stat().st_size > 0
    assert "plots/identification-ensemble.png" in text


def test_quantiles_and_correlations_are_weighted():
    """A body of weight 3 counts as three bodies."""
    random = np.random.default_rng(0)
    values, weights = random.uniform(1, 2, 400), random.integers(1, 4, 400)
    np.testing.assert_allclose(
        ensemble.quantiles(values, weights), np.quantile(np.repeat(values, weights), [0.05, 0.5, 0.95]), atol=0.01
    )
    other = values * random.uniform(1, 2, 400)
    found = ensemble.correlations({"a": values, "b": other}, weights)
    repeated = np.log([np.repeat(values, weights), np.repeat(other, weights)])
    assert found["a"]["b"] == pytest.approx(np.corrcoef(repeated)[0, 1])


@pytest.mark.parametrize(
    ("name", "least"), [("samples", 1), ("generations", 1), ("population", 4), ("bodies", 8), ("sweeps", 1)]
)
def test_a_search_too_small_is_refused(name, least):
    with pytest.raises(ParameterError, match=f"{name} is {least - 1 or -1}: allowed is {least} or more"):
        IdentificationSearch(**{name: least - 1 or -1})
    with pytest.raises(ParameterError, match="tolerance is 0: allowed is more than 0"):
        IdentificationSearch(tolerance=0.0)
