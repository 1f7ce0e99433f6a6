# Tests of control/stepping.py, control/spine_modes.py
"""Gaits with many parameters: where the feet go, that the published gait is one of them, and how files name them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.interpolate import CubicSpline

from nermo_mjx import Setup, servo_table
from nermo_mjx.cli import main
from nermo_mjx.control import (
    ControlParameters,
    Stepping,
    control_parameters,
    leg_servos,
    trajectory,
)
from nermo_mjx.control.pilot import Drive
from nermo_mjx.control.spine_modes import SpineModes, harmonics, stride_extension
from nermo_mjx.control.stepping import FreeStepping, bumps, within
from nermo_mjx.kinematics.leg import LegSolution, four_legs, four_reaches, inverse_kinematics
from nermo_mjx.optimize.search_spec import Search
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.robot import SERVOS
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import servo_range
from nermo_mjx.robot.quantity import ParameterError, quantities, replace_quantities

#: The published robot.
ROBOT = Geometry()

STEPPING = FreeStepping()
FREE_NAMES = [
    name for name, _ in quantities(ControlParameters) if name.split(".")[0] in ("limb", "foot")
]
PHASES = (np.arange(400) + 0.5) / 400
STANDS = "trajectory: free\nspine: harmonics\n"


@jax.jit
def feet_at(
    params: ControlParameters, phases: jax.Array, turn_rate: float | jax.Array
) -> jax.Array:
    """Feet (n, 4, 2) of a steady gait at phases, at a turn rate."""
    drive = Drive(jnp.asarray(1.0), jnp.asarray(turn_rate))
    return jax.vmap(lambda phase: STEPPING.start(params, phase, drive)[1])(phases)


def feet_of(
    params: ControlParameters, phases: np.ndarray = PHASES, turn_rate: float = 0.0
) -> np.ndarray:
    """Feet (n, 4, 2) of a steady gait at phases."""
    return np.asarray(feet_at(params, jnp.asarray(phases), turn_rate))


@jax.jit
def solved(feet: jax.Array) -> LegSolution:
    """Servo angles of feet (n, 4, 2)."""
    return inverse_kinematics(four_legs(ROBOT), feet, "type3")


def gait_with(values: dict[str, Any], gait: str = "trot") -> ControlParameters:
    return control_parameters(gait, frequency=0.8, **values)


def random_gait(seed: int, share: float) -> dict[str, float]:
    """Every number of limbs and feet, anywhere in a share of its range about its default."""
    random, declarations = np.random.default_rng(seed), dict(quantities(ControlParameters))
    return {
        name: float(declarations[name].default)
        + share * random.uniform(declarations[name].low, declarations[name].high)
        if not name.startswith("limb.stride")
        else float(random.uniform(1 - 0.5 * share, 1 + 0.5 * share))
        for name in FREE_NAMES
    }


@pytest.mark.release
def test_the_published_gaits_are_points_of_the_space_bit_for_bit() -> None:
    """With nothing added, each operation gives a batch of worlds the same numbers: feet, control points, spine, servos.

    Operation by operation: how XLA rounds what it fuses into one is its own affair.
    """
    gaits = [gait_with({}, gait) for gait in ("trot", "walking_trot", "lateral_walk")]
    params = jax.tree.map(lambda *leaves: jnp.stack(leaves), *gaits)
    drive, free, published = Drive(jnp.ones(3), jnp.zeros(3)), FreeStepping(), Stepping()
    phase = jnp.full(3, 0.3)
    states = [jax.vmap(stepping.start)(params, phase, drive)[0] for stepping in (published, free)]
    for _ in range(8):
        (plain, feet), (moved, through) = (
            jax.vmap(lambda p, s, d, stepping=stepping: stepping.update(p, s, d, d, 0.16))(
                params, state, drive
            )
            for stepping, state in zip((published, free), states, strict=True)
        )
        np.testing.assert_array_equal(through, feet)
        np.testing.assert_array_equal(moved.points, plain.points)
        states = [plain, moved]
    modes = [SpineModes(modes) for modes in ("stride_extension", "stride_extension+harmonics")]
    spine = [
        jax.vmap(mode)(params, plain.phase, drive.turn_rate, feet, plain.stance) for mode in modes
    ]
    np.testing.assert_array_equal(*spine)
    servos = jax.vmap(leg_servos)(feet, spine[0])
    np.testing.assert_array_equal(
        jax.vmap(free.trim)(params, servos).vector(SERVOS[:10]), servos.vector(SERVOS[:10])
    )


def test_the_foot_goes_through_each_moved_point() -> None:
    """At the quarters of its half-cycle it is where the published foot is, and as far from it as was said."""
    changes = {f"foot.front.y{i}": 1e-4 * i for i in (2, 3, 4, 6, 7, 8)}
    changes |= {f"foot.front_right.z{i}": -1e-3 + 1e-4 * i for i in (2, 3, 4, 6, 7, 8)}
    params, plain = gait_with(changes), gait_with({})
    # The front right limb stands from phase 0 to 0.5.
    phases = np.array([0.125, 0.25, 0.375, 0.625, 0.75, 0.875])
    change = feet_of(params, phases)[:, 1] - feet_of(plain, phases)[:, 1]
    expected = [[1e-4 * i, -1e-3 + 1e-4 * i] for i in (2, 3, 4, 6, 7, 8)]
    np.testing.assert_allclose(change, expected, atol=3e-7)
    # The front left one has its pair's numbers alone, the rear ones have none.
    change = feet_of(params, (phases + 0.5) % 1.0) - feet_of(plain, (phases + 0.5) % 1.0)
    np.testing.assert_allclose(
        change[:, 0], [[1e-4 * i, 0.0] for i in (2, 3, 4, 6, 7, 8)], atol=3e-7
    )
    assert not change[:, 2:].any()


def test_what_is_added_between_the_ends_is_a_clamped_cubic_spline() -> None:
    """The oracle is SciPy's, through zeros at both ends."""
    progress, knots = np.linspace(0.0, 1.0, 101), np.linspace(0.0, 1.0, 5)
    expected = CubicSpline(knots, np.eye(5)[:, 1:-1], bc_type="clamped")(progress)
    np.testing.assert_allclose(bumps(jnp.asarray(progress)), expected, atol=2e-5)


def test_touch_down_and_lift_off_are_moved() -> None:
    values = {
        "foot.rear.y1": -0.004,
        "foot.rear.z1": 0.001,
        "foot.rear.y5": 0.003,
        "limb.stride.rear": 0.5,
    }
    values |= {"limb.lift.rear_left": 0.004, "stance.rear_z": -0.055}
    # The rear left limb touches down at phase 0, and lifts off at 0.5.
    down, off, high = feet_of(gait_with(values), np.array([0.0, 0.4999999, 0.75]))[:, 2]
    np.testing.assert_allclose(down, [-0.015 - 0.004, -0.055 + 0.001], atol=1e-6)
    np.testing.assert_allclose(off, [0.015 + 0.003, -0.055], atol=1e-6)
    assert high[1] == pytest.approx(-0.055 + 0.010 + 0.004, abs=1e-6)


@pytest.mark.release
def test_a_turn_shortens_the_whole_stride_of_a_free_path() -> None:
    """At full turn rate the inner feet step on the spot, at half of their stride they go half as far; the outer ones as
    far as before."""
    changes = {f"foot.{pair}.y{i}": 2e-4 * i for pair in ("front", "rear") for i in range(1, 9)}
    params = gait_with(changes | {"turning.exponent": 1.0})

    def reach(turn_rate: float) -> np.ndarray:
        return np.ptp(feet_of(params, turn_rate=turn_rate)[..., 0], axis=0)

    straight, half, full = reach(0.0), reach(0.5), reach(1.0)
    np.testing.assert_allclose(half[[0, 2]], 0.5 * straight[[0, 2]], atol=1e-6)
    np.testing.assert_allclose(full[[0, 2]], 0.0, atol=1e-6)
    np.testing.assert_array_equal(full[[1, 3]], straight[[1, 3]])


@pytest.mark.release
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_any_path_is_closed_continuous_and_in_the_workspace(seed: int) -> None:
    """Steps shrink as the time between them does, across every switch; every knee servo is within its range."""
    params = gait_with(random_gait(seed, 0.9))
    coarse, fine = (feet_of(params, np.arange(n) / n) for n in (500, 5000))
    longest = [
        np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=-1).max() for path in (coarse, fine)
    ]
    assert longest[1] < 0.2 * longest[0]
    solution = solved(fine)
    assert solution.reachable.all()
    for limb, servo in enumerate(SERVOS[4:8]):
        low, high = servo_range(servo)
        assert low - 1e-4 <= float(solution.servo[:, limb, 1].min())
        assert float(solution.servo[:, limb, 1].max()) <= high + 1e-4


@pytest.mark.release
def test_a_foot_beyond_the_workspace_is_led_back_by_its_derivative() -> None:
    near, far = four_reaches(ROBOT, "type3")
    foot = jnp.asarray([[0.001, -0.002], [0.03, -0.0621], [0.0, -0.0405], [0.05, -0.06]])
    positions = within(near, far, foot)
    distance = np.linalg.norm(positions, axis=-1)
    assert (distance >= near).all()
    assert (distance <= far).all()
    np.testing.assert_array_equal(positions[2], foot[2])
    with jax.enable_x64(True):
        exact = [jnp.asarray(np.asarray(argument), float) for argument in (near, far, foot)]
        slope = jax.jvp(
            lambda s: jnp.linalg.norm(within(exact[0], exact[1], s * exact[2]), axis=-1),
            (1.0,),
            (1.0,),
        )[1]
        ends = [
            jnp.linalg.norm(within(exact[0], exact[1], s * exact[2]), axis=-1)
            for s in (1 + 1e-6, 1 - 1e-6)
        ]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-4)
    assert (np.asarray(slope) > 0.0).all()


def test_duty_and_phase_of_a_limb() -> None:
    params = gait_with(
        {"limb.duty.front": 0.1, "limb.duty.front_left": 0.05, "limb.phase.rear_right": -0.25},
        "lateral_walk",
    )
    stance = np.asarray(STEPPING.limbs(params, jnp.asarray(PHASES)).stance)
    np.testing.assert_allclose(stance.mean(axis=0), [0.83, 0.78, 0.68, 0.68], atol=2 / 400)
    plain = np.asarray(trajectory.limb_states(params.gait, jnp.asarray(PHASES)).stance)
    np.testing.assert_array_equal(stance[:, 3], np.roll(plain[:, 3], -100))
    with pytest.raises(
        ParameterError,
        match=r"limb\.duty\.front_left gives the limb a duty factor of 1\.08: allowed",
    ):
        Setup(trajectory="free").check(
            Setup(gait="lateral_walk").world({"limb.duty.front_left": 0.4})
        )


def test_the_spines_series_holds_the_published_wave_and_has_a_derivative_at_zero() -> None:
    amplitude, psi = 0.3, 0.7
    values = {
        "spine.harmonics.cos1": amplitude * np.cos(psi),
        "spine.harmonics.sin1": -amplitude * np.sin(psi),
    }
    spine = gait_with({"spine.amplitude": amplitude, "spine.phase": psi, **values}).spine
    np.testing.assert_allclose(harmonics(spine, PHASES), stride_extension(spine, PHASES), atol=1e-6)
    third = replace_quantities(gait_with({}), {"spine.harmonics.sin3": 0.1}).spine
    np.testing.assert_allclose(
        harmonics(third, PHASES), 0.1 * np.sin(6 * np.pi * PHASES), atol=1e-6
    )
    at_zero = gait_with({}).spine.harmonics
    slope = jax.grad(
        lambda c: harmonics(replace_quantities(spine, {}).__class__(harmonics=c), 0.1)
    )(jnp.asarray(at_zero))
    waves = [wave(2 * np.pi * k * 0.1) for k in range(1, 7) for wave in (np.cos, np.sin)]
    np.testing.assert_allclose(slope, waves, atol=1e-6)


@pytest.mark.release
def test_the_derivative_by_every_number_equals_differences() -> None:
    """Of what the servos are told at 40 phases, along four random directions of 120 numbers, in double precision."""
    names = FREE_NAMES
    with jax.enable_x64(True):
        base = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), gait_with(random_gait(3, 0.1)))
        drive = Drive(jnp.asarray(1.0), jnp.asarray(0.0))
        values = jnp.asarray([random_gait(3, 0.1)[name] for name in names])

        def servos(values: jax.Array) -> jax.Array:
            params = replace_quantities(base, dict(zip(names, values, strict=True)))
            feet = jax.vmap(lambda phase: STEPPING.start(params, phase, drive)[1])(
                jnp.arange(40) / 40 + 0.0123
            )
            return inverse_kinematics(four_legs(ROBOT), feet, "type3").servo

        along = jax.jit(
            lambda direction: (
                jax.jvp(servos, (values,), (direction,))[1],
                (servos(values + 1e-6 * direction) - servos(values - 1e-6 * direction)) / 2e-6,
            )
        )
        for seed in range(4):
            exact, secant = along(
                jnp.asarray(np.random.default_rng(seed).normal(size=len(names)) * 1e-2)
            )
            np.testing.assert_allclose(exact, secant, rtol=1e-5, atol=1e-7)


@pytest.mark.release
def test_a_servo_table_has_trims_and_the_moved_path() -> None:
    setup = Setup(trajectory="free")
    plain = servo_table(setup, {"frequency": 0.8}, rate=40.0)
    values = {
        "frequency": 0.8,
        "trim.hip.front": 0.1,
        "trim.hip.front_left": 0.05,
        "trim.spine": -0.1,
    }
    table = servo_table(setup, values, rate=40.0)
    change = np.radians(table.angles - plain.angles)
    expected = dict.fromkeys(SERVOS[:10], 0.0) | {
        "front_left_hip": 0.15,
        "front_right_hip": 0.1,
        "spine": -0.1,
    }
    np.testing.assert_allclose(
        change, np.tile(list(expected.values()), (len(change), 1)), atol=1e-6
    )
    changed_table = servo_table(setup, {"frequency": 0.8, "foot.rear.y7": 0.003}, rate=40.0)
    assert (np.abs(changed_table.angles - plain.angles).max(axis=0) > 0.5).tolist() == (
        [False] * 2 + [True] * 2
    ) * 2 + [False] * 2


# --- in files and on the command line


def test_a_pattern_stands_for_all_names_that_it_matches() -> None:
    file = (
        STANDS
        + "vary:\n  foot.front.y[1-8]: {uniform: [-0.003, 0.003]}\n  foot.front.y3: {uniform: [0, 0.001]}\n"
        "set: {spine.harmonics.*: 0.1}\nobjective: {maximize: speed}\n"
    )
    search = Search.from_text(file)
    assert search.names == tuple(f"foot.front.y{i}" for i in (1, 2, 4, 5, 6, 7, 8, 3))
    assert [axis.numbers for axis in search.sweep.axes][-2:] == [(-0.003, 0.003), (0.0, 0.001)]
    assert set(search.sweep.fixed) == {
        f"spine.harmonics.{wave}{k}" for k in range(1, 7) for wave in ("cos", "sin")
    }
    assert Search.from_dict(search.resolved()).digest() == search.digest()
    pattern = "method: local_gradient\ntune:\n  foot.*_*.*: {bounds: [-0.003, 0.003]}\nobjective: [{maximize: speed}]\n"
    assert len(Tuning.from_text(STANDS + pattern).names) == 64


@pytest.mark.release
def test_patterns_on_the_command_line(tmp_path: Path) -> None:
    words = [
        "servos",
        "--trajectory",
        "free",
        "--set",
        "trim.hip.front_*=0.1",
        "--out",
        str(tmp_path / "gait.csv"),
    ]
    assert CliRunner().invoke(main, words).exit_code == 0
    comment = (tmp_path / "gait.csv").read_text().splitlines()[0]
    assert "trim.hip.front_left 0.1, trim.hip.front_right 0.1" in comment
    wrong = CliRunner().invoke(main, ["walk", "--set", "foot.*x*=1"])
    assert wrong.exit_code == 2
    assert "foot.*x* matches no parameter" in wrong.output
