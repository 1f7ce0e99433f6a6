# Tests of dynamics/solver.py, dynamics/rows.py, dynamics/constraint.py
"""The constraint solver against MuJoCo's C, on problems that C makes: walks, falls, impacts, walls."""

from __future__ import annotations

import functools
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import solver
from nermo_mjx.dynamics.differentiable import _newton
from nermo_mjx.dynamics.rows import ConstraintProblem, Layout
from nermo_mjx.physics import Variation
from nermo_mjx.robot import ModelParameters, load_robot
from nermo_mjx.robot.quantity import replace_quantities

#: Ends of the declared ranges of the soles' contact; friction and tail as well.
ENDS = {
    "contact.friction": (0.05, 5.0),
    "contact.tail_friction": (0.05, 5.0),
    "contact.time_constant": (0.004, 0.1),
    "contact.damping_ratio": (0.5, 10.0),
    "contact.impedance": (0.5, 0.9999),
    "contact.width": (1e-5, 0.02),
}
#: Tumbling robots, and the steps of each whose problems are solved.
WORLDS, STEPS = 24, 120
LIMITS, CONTACTS = 6, 16


#: Of the robots at the ends, docs/model.md's identified body, on whose states the share of what converges was measured.
#: Of those of the default body 0.52 % do not.
DAMPED = {"damping.knee": 0.02531, "damping.ankle": 0.02531, "damping.spine": 0.09242}


@functools.cache
def problems(
    kind: str, worlds: int = WORLDS
) -> tuple[Layout, ConstraintProblem, np.ndarray, np.ndarray]:
    """(layout, problems, warm starts, C's solutions) of robots that are thrown onto the ground and move their servos.

    Args:
        kind: `elliptic`, `pyramidal`; `maze`, among its walls; `ends`, with contacts at the ends of their ranges.
        worlds: how many robots.
    """
    robot = load_robot(
        scene="maze" if kind == "maze" else "flat",
        cone="pyramidal" if kind == "pyramidal" else "elliptic",
    )
    random, model = np.random.default_rng(0), robot.physical
    model.opt.tolerance, model.opt.ls_tolerance = 1e-14, 1e-6
    elliptic, edges = kind != "pyramidal", 3 if kind != "pyramidal" else 4
    recorded: list[Any] = []
    variation, default = Variation(robot), ModelParameters()
    for world in range(worlds):
        if kind == "ends":
            values = DAMPED | {name: random.choice(ends) for name, ends in ENDS.items()}
            for name, field in variation.batch(
                replace_quantities(default, values), 1, values
            ).items():
                getattr(model, name)[...] = field[0]
        data = mujoco.MjData(model)
        data.qpos[2] += random.uniform(0.0, 0.15)
        if kind == "maze":
            data.qpos[:2] += random.uniform(-0.5, 1.5, 2)
        if world % 4:
            turn = random.normal(size=4)
            data.qpos[3:7] = turn / np.linalg.norm(turn)
        data.qvel[:] = (
            random.normal(size=model.nv)
            * np.r_[0.5, 0.5, 1.0, 5.0, 5.0, 5.0, np.full(model.nv - 6, 2.0)]
        )
        for step in range(2 * STEPS):
            if step % 40 == 0:
                data.ctrl[:] = random.uniform(-0.8, 0.8, model.nu)
            warm = data.qacc_warmstart.copy()
            mujoco.mj_step(model, data)
            if sum(
                warning.number for warning in data.warning
            ):  # at the ends of the ranges C loses some worlds
                break
            limits = data.nl
            contacts = (data.nefc - limits) // edges
            if step % 2 or limits > LIMITS or contacts > CONTACTS:
                continue
            inertia = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, inertia)
            # C has rows of what touches only: zeros stand for the others.
            rows = np.r_[np.arange(limits), LIMITS + np.arange(contacts * edges)]
            arrays = [
                np.zeros((LIMITS + edges * CONTACTS, *width)) for width in ((model.nv,), (), ())
            ]
            arrays[2][:] = 1.0
            for array, values in zip(
                arrays, (data.efc_J.reshape(-1, model.nv), data.efc_aref, data.efc_D), strict=True
            ):
                array[rows] = values
            cone = np.ones((CONTACTS, 6))
            cone[:contacts] = np.column_stack([data.contact.mu, data.contact.friction])[:contacts]
            jacobian, aref, stiffness = arrays
            problem = ConstraintProblem(
                inertia,
                data.qfrc_smooth.copy(),
                jacobian,
                aref,
                stiffness,
                np.zeros(len(aref)),
                cone[: CONTACTS * elliptic],
            )
            recorded.append((problem, warm, data.qacc.copy()))
    stacked, warm, right = jax.tree.map(lambda *leaves: np.stack(leaves), *recorded)
    return Layout(0, 0, ((3, CONTACTS),) if elliptic else ()), stacked, warm, right


def solve(
    layout: Layout, problem: ConstraintProblem, warm: np.ndarray, real: type
) -> tuple[np.ndarray, np.ndarray]:
    """(solutions, rounds) in a precision, with the last step of `differentiable`."""

    def one(problem: ConstraintProblem, warm: Any) -> Any:
        solution = solver.minimum(layout, problem, warm)
        return _newton(layout, solution.qacc, problem).qacc, solution.needed

    with jax.enable_x64(real is np.float64):
        numbers = jax.tree.map(lambda leaf: np.asarray(leaf, real), (problem, warm))
        qacc, rounds = jax.jit(jax.vmap(one))(*numbers)
    return np.asarray(qacc, float), np.asarray(rounds)


def error(solution: np.ndarray, right: np.ndarray, problem: ConstraintProblem) -> np.ndarray:
    """Size of the difference as a share of the solution's, both weighed by the inertia."""
    size = [
        np.einsum("ni,nij,nj->n", difference, problem.inertia, difference)
        for difference in (solution - right, right)
    ]
    return np.sqrt(size[0] / size[1])


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize(
    "kind", ["elliptic", "pyramidal", "maze", pytest.param("ends", marks=pytest.mark.release)]
)
def test_solutions_are_those_of_c(kind: str, real: type) -> None:
    """In all of thousands of states: to the rounding of float32, and to C's own 1e-8 in float64.

    At the ends of the contacts' ranges some need more rounds than there are, and say so.
    """
    layout, problem, warm, right = problems(kind, 30 if kind == "ends" else WORLDS)
    solution, rounds = solve(layout, problem, warm, real)
    converged = rounds <= solver.MAX_ROUNDS
    assert len(right) > 2000
    assert np.mean(converged) >= (0.995 if kind == "ends" else 1.0)
    assert np.mean(rounds <= solver.ACCELERATOR_ROUNDS) >= (0.97 if kind == "ends" else 0.999)
    assert error(solution, right, problem)[converged].max() < (1e-7 if real is np.float64 else 2e-6)


@pytest.mark.release
def test_the_last_step_leaves_no_solution_that_rounding_put_across_a_border() -> None:
    """From C's solutions, off by a few roundings, which decide whether a row that is on the border slides or sticks."""
    layout, problem, _, right = problems("ends", 30)
    single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), problem)
    last, random = (
        jax.jit(
            jax.vmap(lambda problem_of_world, qacc: _newton(layout, qacc, problem_of_world).qacc)
        ),
        np.random.default_rng(0),
    )
    for _ in range(8):
        qacc = np.asarray(right * (1.0 + 3e-7 * random.normal(size=right.shape)), np.float32)
        assert error(qacc, right, problem).max() < 2e-6
        assert error(np.asarray(last(single, qacc), float), right, problem).max() < 2e-6


def test_a_small_step_out_of_a_contact_is_not_the_last() -> None:
    """A stiff row pushes below an acceleration of 1, and without it the acceleration is 2.

    The first step from just below 1 is as small as rounding, because the row is stiff, and ends just above 1.
    """
    ones = np.ones(1)
    problem = ConstraintProblem(
        np.eye(1), 2.0 * ones, np.eye(1), ones, 1e12 * ones, 0.0 * ones, np.ones((0, 6))
    )
    with jax.enable_x64(True):
        solution = jax.jit(lambda start: solver.minimum(Layout(0, 0, ()), problem, start))(
            ones - 2e-13
        )
    assert solution.converged
    assert solution.qacc == pytest.approx([2.0], rel=1e-12)


@pytest.mark.release
def test_a_solver_that_is_stopped_too_early_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two rounds, what counts as converged is solved; and what is far from the solution is counted as not."""
    layout, problem, warm, right = problems("elliptic")
    monkeypatch.setattr(solver, "MAX_ROUNDS", 2)
    solution, rounds = solve(layout, problem, warm, np.float64)
    wrong = error(solution, right, problem)
    assert set(rounds) == {2, 3}
    assert wrong[rounds == 2].max() < 1e-7
    assert np.sum(wrong > 1e-4) > 100
    assert set(rounds[wrong > 1e-4]) == {3}


@pytest.mark.release
def test_a_world_without_numbers_leaves_the_others_alone() -> None:
    """It takes one round and not all, and the solution beside it is the same to the last bit."""
    layout, problem, warm, _ = problems("elliptic")
    problem, warm = jax.tree.map(lambda leaf: leaf[:4].copy(), (problem, warm))
    reference, _ = solve(layout, problem, warm, np.float32)
    problem.smooth[1] = np.nan
    disturbed, rounds = solve(layout, problem, warm, np.float32)
    others = [0, 2, 3]
    np.testing.assert_array_equal(disturbed[others], reference[others])
    assert np.isnan(disturbed[1]).all()
    assert rounds[1] == 1


@pytest.mark.release
def test_accelerators_know_the_length_of_every_loop() -> None:
    """Only on a CPU is there a loop that ends when all worlds have: XLA's `while` without a number of rounds."""
    layout, problem, warm, _ = problems("elliptic")
    world = jax.tree.map(lambda leaf: np.asarray(leaf[0], np.float32), (problem, warm))
    program = str(jax.make_jaxpr(lambda *arguments: solver.minimum(layout, *arguments))(*world))
    on_cpu, elsewhere = (
        program.count("while["),
        program.count(f"length={solver.ACCELERATOR_ROUNDS}"),
    )
    assert (on_cpu, elsewhere) == (1, 1)
