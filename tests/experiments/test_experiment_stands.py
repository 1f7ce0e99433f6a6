# Tests of experiments/stands.py
"""The body alone and on test stands, against closed forms, virtual work, the kinematics, and the springs' energy."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.experiments import stands
from nermo_mjx.experiments.cases import Settings, texts
from nermo_mjx.experiments.plots import figures_of_experiment
from nermo_mjx.experiments.published import published_lines
from nermo_mjx.experiments.stands import Stand
from nermo_mjx.kinematics import leg as kinematics
from nermo_mjx.robot import ModelParameters, ParameterError, assemble_leg
from nermo_mjx.robot.equipment import KNEE_REST_RAD
from nermo_mjx.robot.parameters import LEGS, ROUTINGS
from nermo_mjx.robot.quantity import replace_quantities

PAIRS = ("front", "rear")


@pytest.fixture(scope="module")
def body():
    return stands.run_body(Settings())


@pytest.fixture(scope="module")
def of_leg():
    return stands.run_leg(Settings(("exact",)))


@pytest.fixture(scope="module")
def of_spine():
    return stands.run_spine(Settings(("exact",)))


@functools.cache
def slopes(pair: str, routing: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """d(y, z) / d(q1, q2) of the neutral foot, d theta_1 / d(q1, q2), and theta_1, in double precision."""
    numbers, foot = kinematics.leg_of(LEGS[pair]), np.array(LEGS[pair].neutral_foot)
    servo = stands.servo_angles(pair, foot, routing)

    @jax.jit
    def found(servo, foot):
        knee = jax.jacfwd(
            lambda servo: kinematics.forward_kinematics(numbers, servo, routing).knee_angle
        )(servo)
        angle = kinematics.inverse_kinematics(numbers, foot, routing).knee_angle
        return kinematics.jacobian(numbers, servo, routing), knee, angle

    with jax.enable_x64(True):
        return tuple(map(np.asarray, found(jnp.asarray(servo, float), jnp.asarray(foot))))


@pytest.mark.release
@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("pair", PAIRS)
def test_speed_and_coupling_are_those_of_the_kinematics(of_leg, pair, routing):
    """Speed within 3 % (the servo's sag changes with the spring's torque), coupling within 0.02."""
    case = {"pair": pair, "routing": routing, "hinges": 1}
    foot, knee, _ = slopes(pair, routing)
    assert of_leg.mean("speed", **case) == pytest.approx(15.0 * abs(foot[1, 1]), rel=0.03)
    assert of_leg.mean("coupling", **case) == pytest.approx(
        LEGS[pair].knee_direction * knee[0], abs=0.02
    )


@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("pair", PAIRS)
def test_force_is_that_of_virtual_work(pair, routing):
    """With a stiff ankle F dz + k (theta_1 - rest) d theta_1 = tau dq, within 5 %, for the servo that gives first."""
    stiff = replace_quantities(ModelParameters(), {"stiffness.ankle": np.asarray(2.0)})
    limb, foot = f"{pair}_left", np.array(LEGS[pair].neutral_foot)
    servo = stands.servo_angles(pair, foot, routing)
    measured = (
        Stand(assemble_leg(limb, routing, stiff))
        .settle(servo)
        .held(f"{limb}_foot", (0.0, 0.0, -1.0), 20.0)
    )
    jacobian, knee, angle = slopes(pair, routing)
    spring = float(getattr(ModelParameters().stiffness, f"{pair}_knee")) * (
        angle - KNEE_REST_RAD[pair]
    )
    rise, limit = jacobian[1], float(ModelParameters().servo.torque_limit)
    # The knee's servo drives it in the sense in which the foot rises, and the hip's servo carries the rest.
    knee_servo = (limit - spring * knee[1] * np.sign(rise[1])) / abs(rise[1])
    hip_servo = [(side * limit - spring * knee[0]) / rise[0] for side in (1.0, -1.0)]
    assert measured == pytest.approx(
        min(knee_servo, *(each for each in hip_servo if each > 0)), rel=0.05
    )


@pytest.mark.release
def test_work_of_a_bend_is_the_energy_of_the_springs(of_spine):
    """Half of k theta^2 of each joint, and 3 % that damping takes; twice as much in both planes."""
    for plane, joints in (("lateral", 4), ("vertical", 4), ("combined", 8)):
        case = {"robot": "nermo_41", "plane": plane}
        stored = 0.5 * joints * 1.2 * of_spine.mean("joint_angle", **case) ** 2
        assert of_spine.mean("work", **case) == pytest.approx(stored * 1.02, rel=0.02)


@pytest.mark.release
def test_both_planes_move_the_hip_as_each_does(of_spine):
    """Sideways and up are at right angles: range and speed add in squares within 3 %."""
    for column in ("range", "speed"):
        lateral, vertical, both = (
            of_spine.mean(column, robot="nermo_41", plane=plane) for plane in stands.PLANES
        )
        assert both == pytest.approx(np.hypot(lateral, vertical), rel=0.03)


@pytest.mark.release
def test_the_load_case_holds_and_so_does_what_the_thesis_says_of_the_routings(
    body, of_leg, of_spine
):
    """A.1 with chains of hinges; Table 5.2 in words, but for the lever arm of type 2, whose guide was chosen."""
    for outcome in (body, of_leg, of_spine):
        lines = published_lines(outcome)
        assert all(line.exact is not None and line.kind == "chosen" for line in lines)
        failing = [line.figure for line in lines if not line.holds and outcome is not body]
        assert failing in ([], ["routing type 2 has a shorter lever arm on the knee than type 1"])
        assert set(outcome.columns) <= set(outcome.about)


@pytest.mark.release
def test_both_stands_are_drawn(of_leg, of_spine):
    """A bar for each routing of each pair of legs, and for each plane, in four panels."""
    for outcome, bars in ((of_leg, 2 * len(ROUTINGS)), (of_spine, len(stands.PLANES))):
        ((_, figure),) = figures_of_experiment(outcome, ())
        assert [len(ax.patches) for ax in figure.axes] == [bars] * 4


@pytest.mark.parametrize(
    ("measure", "name"),
    [
        (stands.run_body, "frequency"),
        (stands.run_leg, "frequency"),
        (stands.run_leg, "servo.back_emf"),
    ],
)
def test_what_does_not_apply_is_refused(measure, name):
    """What is no parameter of the body, and a motor's back-EMF, which the stand's servos do not have."""
    with pytest.raises(ParameterError, match=name):
        measure(Settings(values={name: 0.5}))


# --- the body alone


@pytest.mark.release
def test_a_row_a_profile_and_the_same_in_both(body):
    assert body.columns["profile"].tolist() == ["exact", "as_published", "as_built"]
    for name in texts("columns")["body"]:
        assert body.columns[name][0] == body.columns[name][1], name


@pytest.mark.release
@pytest.mark.parametrize(
    ("column", "angle"),
    [
        ("bend_front_knee", 0.125 / 0.135),
        ("bend_rear_knee", 0.125 / 0.19),
        ("bend_spine", 4 * 0.125 / 1.2),
    ],
)
def test_springs_bend_by_torque_over_stiffness(body, column, angle):
    """Table A.1: 0.135, 0.19 and four times 1.2 N m/rad in series."""
    assert body.mean(column, profile="exact") == pytest.approx(angle, rel=1e-3)


def test_another_spring_bends_otherwise():
    stiff = stands.run_body(Settings(("exact",), values={"stiffness.front_knee": 0.27}))
    assert stiff.mean("bend_front_knee", profile="exact") == pytest.approx(0.125 / 0.27, rel=1e-3)


def test_a_spine_of_little_damping_is_waited_for():
    """An identified body's spine still swings after the default one's time; the bend under load is the same."""
    soft = stands.run_body(Settings(("exact",), values={"damping.spine": 0.0034}))
    assert soft.mean("bend_spine") == pytest.approx(4 * 0.125 / 1.2, rel=1e-3)


@pytest.mark.release
def test_the_published_dimensions_are_the_robots(body):
    """Nermo-Lite: 270 g and 11 servos; Nermo: 405 x 91 x 90 mm, within a quarter; A.5: 121.9 mm between the axes."""
    assert body.mean("mass", profile="exact") == pytest.approx(0.270, rel=0.01)
    assert body.mean("servos", profile="exact") == 11
    for column, size in (("length", 0.405), ("height", 0.091), ("width", 0.090)):
        assert body.mean(column, profile="exact") == pytest.approx(size, rel=0.25), column
    assert body.mean("scapula_pelvis", profile="exact") == pytest.approx(0.1219, abs=2e-4)


def test_bodies_have_their_own_rows():
    masses = np.array([0.16, 0.17])
    several = stands.run_body(Settings(("exact",), bodies={"mass.front": masses}))
    assert several.columns["body"].tolist() == [1, 2]
    np.testing.assert_allclose(np.diff(several.columns["mass"]), 0.01)
    assert "body" not in stands.run_body(Settings(("exact",))).columns
