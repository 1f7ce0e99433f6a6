# Tests of __init__.py
"""A wrong type ends in one sentence with the argument's name, its value and what is allowed, wherever users call."""

from __future__ import annotations

from typing import Any

import pytest
import shapes

import nermo_mjx
from nermo_mjx import ParameterError, Rollout, Run, Setup, Simulator, Sweep, Tuning
from nermo_mjx.learn import Task

NAMES = (
    "gait",
    "spine",
    "steering",
    "profile",
    "pilot",
    "trajectory",
    "head",
    "tail_motion",
    "physics",
    "robot",
)
NUMBERS = ("cycles", "warmup_cycles", "duration", "warmup", "distance")
SWEEP = {"vary": {"frequency": [0.8, 0.9]}}

#: Callable, how it is called with a wrong value, and the argument's name.
CALLS: dict[str, tuple[Any, str]] = {
    "sweep": (lambda value: nermo_mjx.run_sweep(value, "out"), "sweep"),
    "tuning": (lambda value: nermo_mjx.run_tuning(value, "out"), "tuning"),
    "search": (lambda value: nermo_mjx.run_search(value, "out"), "search"),
    "out": (lambda value: nermo_mjx.run_sweep(SWEEP, value), "out"),
    "experiment": (lambda value: nermo_mjx.run_experiment(value, "out"), "experiment"),
    "Simulator": (Simulator, "setup"),
    "Simulator.engine": (lambda value: Simulator(engine=value), "engine"),
    "Simulator.metrics": (lambda value: Simulator(metrics=value), "metrics"),
    "Rollout": (Rollout, "setup"),
    "Rollout.run": (lambda value: Rollout(None, value), "run"),
    "Rollout.slowest": (lambda value: Rollout(slowest=[value]), "slowest"),
    "servo_table": (nermo_mjx.servo_table, "setup"),
    "servo_table.rate": (lambda value: nermo_mjx.servo_table(rate=[value]), "rate"),
    "servo_table.cycles": (lambda value: nermo_mjx.servo_table(cycles=[value]), "cycles"),
    "servo_table.channels": (lambda value: nermo_mjx.servo_table(channels=value), "channels"),
    "servo_table.values": (lambda value: nermo_mjx.servo_table(None, [value]), "values"),
    "all_parameters": (nermo_mjx.all_parameters, "setup"),
    "all_metrics": (nermo_mjx.all_metrics, "setup"),
    "read_table": (nermo_mjx.read_table, "out"),
    "read_history": (nermo_mjx.read_history, "out"),
    "compare": (lambda value: nermo_mjx.compare(value, "other"), "source"),
    "sensitivity": (nermo_mjx.sensitivity, "source"),
    "merge_sweeps": (lambda value: nermo_mjx.merge_sweeps(value, "out"), "sources"),
    "merge_sweeps.one": (lambda value: nermo_mjx.merge_sweeps([value], "out"), "sources"),
    "show": (nermo_mjx.show, "recording"),
    "Recording.load": (nermo_mjx.Recording.load, "path"),
    "Sweep.from_file": (Sweep.from_file, "path"),
    "Sweep.from_text": (Sweep.from_text, "text"),
    "Tuning.from_file": (Tuning.from_file, "path"),
    "published_controller": (nermo_mjx.published_controller, "spine"),
    "control_parameters": (nermo_mjx.control_parameters, "gait"),
    "Setup.timestep": (lambda value: Setup(timestep=[value]), "timestep"),
    "Setup.metrics": (lambda value: Setup(metrics=value), "metrics"),
    "Setup.metrics.one": (lambda value: Setup(metrics=(value,)), "metrics"),
    "Setup.schedule": (lambda value: Setup(schedule=value), "schedule"),
    "Setup.schedule.one": (lambda value: Setup(schedule=[value]), "schedule"),
    **{f"Setup.{name}": (lambda value, name=name: Setup(**{name: value}), name) for name in NAMES},
    **{
        f"Setup.{name}s": (lambda value, name=name: Setup(**{name: [value]}), name)
        for name in NAMES
    },
    **{
        f"Run.{name}": (lambda value, name=name: Run(**{name: f"{value} kg"}), f"run.{name}")
        for name in NUMBERS
    },
}


@pytest.fixture(autouse=True)
def _as_a_user_has_it(monkeypatch):
    """Without the type checker of the tests."""
    monkeypatch.setattr(shapes, "MOST", -1)


@pytest.mark.parametrize("value", [3, True, 2.5])
@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_type_is_refused_in_a_sentence(name, value, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    call, argument = CALLS[name]
    with pytest.raises(
        (ParameterError, TypeError), match=rf"^{argument} (is|has) .*({value}).*\.$"
    ) as refused:
        call(value)
    assert "\n" not in str(refused.value)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("value", [3, "no", [1], True, object()])
@pytest.mark.parametrize("argument", ["values", "run", "save"])
def test_a_walk_refuses_wrong_types(simulator, argument, value):
    arguments = {"values": {}, "run": Run(duration=0.1), "save": None} | {argument: value}
    with pytest.raises(ParameterError, match=rf"^{argument} is .*: expected .*\.$"):
        simulator("c").run(**arguments)


def test_modes_of_the_spine_are_one_name() -> None:
    """A list of right names would be kept as it is, and make a setup that cannot be hashed."""
    with pytest.raises(ParameterError, match=r"^spine is \['balance'\]: expected a name\.$"):
        Setup(spine=["balance"])


def test_names_of_parameters_are_texts(simulator):
    with pytest.raises(
        ParameterError, match=r"^values is 3: expected names of parameters as keys\.$"
    ):
        simulator("c").run({3: 1.0})


@pytest.mark.parametrize("value", [True, {}, object(), [None]])
@pytest.mark.parametrize("name", NUMBERS)
def test_a_run_is_of_numbers(name, value):
    with pytest.raises(
        ParameterError, match=rf"^run\.{name} is .*: expected a number, or an array of such\.$"
    ):
        Run(**{name: value})


def test_a_length_of_a_run_may_have_a_unit():
    assert Run(duration="8 s", warmup="500 ms") == Run(duration=8.0, warmup=0.5)
    assert Run(cycles=3, distance="30 cm").distance == pytest.approx(0.3)
    assert Run(duration=["2 s", 3]).duration == [2.0, 3.0]
    for name, equivalent in (("cycles", "duration"), ("warmup_cycles", "warmup")):
        with pytest.raises(
            ParameterError, match=rf"^run.{name} is '8 s': .* such; seconds are run.{equivalent}\.$"
        ):
            Run(**{name: "8 s"})
    with pytest.raises(
        ParameterError,
        match=r"^run.duration is '8 min': expected a number in s or ms, such as 8 s\.$",
    ):
        Run(duration="8 min")


def test_an_episode_may_have_units():
    task = Task(episode_length="8 s", distance="500 mm", corridor="10 cm")
    assert (task.episode_length, task.distance, task.corridor) == (8.0, 0.5, 0.1)
    with pytest.raises(
        ParameterError, match=r"^corridor is '3 kg': expected a number in m, mm or cm, such as"
    ):
        Task(corridor="3 kg")
