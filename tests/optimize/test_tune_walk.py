# Tests of optimize/problems.py
"""Tuning the robot itself: a tenth of a second of a walk, as the notebook's quick pass tunes it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from nermo_mjx.optimize import read_history, run_tuning
from nermo_mjx.optimize.problems import Reference, WalkProblem
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.rollout import Run
from nermo_mjx.runs import Watch

#: The same program as the one in notebooks/03_gradient_tuning.ipynb, so that one of them finds it compiled.
SPEC = {
    "gait": "trot",
    "spine": "stride_extension",
    "run": {"duration": 0.1, "warmup": 0.02},
    "set": {"frequency": 0.8},
    "tune": {
        "spine.amplitude": {"bounds": [0.0, 0.4], "start": 0.05},
        "spine.phase": {"bounds": [-3.1416, 3.1416], "start": 1.5, "periodic": True},
    },
    "objective": [{"maximize": "speed", "scale": 0.1}],
    "optimizer": {"name": "adam", "learning_rate": 0.15},
    "iterations": 4,
    "plots": False,
}
DURATION = Run(duration=0.1, warmup=0.02)


class _Stopped(Exception):
    pass


@pytest.fixture(scope="module")
def problem():
    return WalkProblem(Tuning.from_dict(SPEC))


@pytest.fixture(scope="module")
def tuned(problem, tmp_path_factory):
    out = tmp_path_factory.mktemp("tuned")
    return run_tuning(SPEC, out, problem=problem), read_history(out)


def test_a_problem_travels_without_the_file_that_it_compares_with(problem):
    """A worker on another machine has no recording, and gets its numbers."""
    poses = np.ones((10, problem.rollout.robot.model.nq))
    copied = pickle.loads(pickle.dumps(WalkProblem(problem.tuning, Reference(poses, poses[0]))))
    assert (copied.names, copied.tuning) == (problem.names, problem.tuning)
    assert copied.simulated_seconds == problem.simulated_seconds
    np.testing.assert_array_equal(copied.reference.qpos, poses)


@pytest.mark.release
def test_the_robot_ends_faster_than_it_began(tuned):
    """After four steps of Adam along the gradient of a tenth of a second."""
    _, history = tuned
    speed = history["speed"].to_numpy()
    assert speed[-1] > speed[0] + 2e-4


@pytest.mark.release
def test_the_objective_is_the_speed_that_a_sweep_measures(tuned, simulator):
    """The C engine walks the best point at the same speed."""
    result, _ = tuned
    walked = simulator(spine="stride_extension").run(
        {"frequency": 0.8, **result.best["parameters"]}, DURATION
    )
    assert result.best["metrics"]["speed"] == pytest.approx(walked.metrics["speed"][0], abs=2e-5)
    assert result.best["objective"] == pytest.approx(
        -10 * result.best["metrics"]["speed"], rel=1e-6
    )


@pytest.mark.release
def test_the_gradient_at_the_start_is_that_of_the_c_engine(tuned, simulator):
    """Of C's walks 0.02 rad apart, which leaves 0.1 % of curvature."""
    _, history = tuned
    ends = 0.01 * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    values = {
        name: bounds["start"] + ends[i] for i, (name, bounds) in enumerate(SPEC["tune"].items())
    }
    walked = (
        simulator(spine="stride_extension")
        .run({"frequency": 0.8, **values}, DURATION)
        .metrics["speed"]
    )
    slopes = -10 * (walked[::2] - walked[1::2]) / 0.02
    gradient = [history[f"gradient.{name}"][0].as_py() for name in SPEC["tune"]]
    assert gradient == pytest.approx(slopes, rel=0.1)


@pytest.mark.release
@pytest.mark.parametrize("after", [1, 3])
def test_a_tuning_that_was_stopped_ends_as_one_that_was_not(tuned, problem, tmp_path, after):
    """Bit for bit, gradients included."""

    def stop(progress):
        if progress.done == after + 1 and progress.numbers:
            raise _Stopped

    with pytest.raises(_Stopped):
        run_tuning(SPEC, tmp_path, problem=problem, watch=Watch(stop))
    run_tuning(SPEC, tmp_path, problem=problem)
    _, whole = tuned
    again = read_history(tmp_path)
    for name in whole.column_names:
        if name != "wall_seconds":
            np.testing.assert_array_equal(
                again[name].to_numpy(), whole[name].to_numpy(), err_msg=name
            )
