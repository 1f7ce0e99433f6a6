"""The test stands: force, speed, work and bend against virtual work, the kinematics, and the springs' energy."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.experiments import stands
from nermo_mjx.experiments.cases import Settings
from nermo_mjx.experiments.plots import figures_of
from nermo_mjx.experiments.published import compare
from nermo_mjx.experiments.stands import Stand
from nermo_mjx.kinematics import leg as kinematics
from nermo_mjx.robot import ModelParameters, ParameterError, assemble_leg
from nermo_mjx.robot.equipment import KNEE_REST
from nermo_mjx.robot.parameters import LEGS, ROUTINGS
from nermo_mjx.robot.quantity import replace_quantities

PAIRS = ("front", "rear")


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
        knee = jax.jacfwd(lambda servo: kinematics.forward(numbers, servo, routing).knee_angle)(servo)
        angle = kinematics.inverse(numbers, foot, routing).knee_angle
        return kinematics.jacobian(numbers, servo, routing), knee, angle

    with jax.enable_x64(True):
        return tuple(map(np.asarray, found(jnp.asarray(servo, float), jnp.asarray(foot))))


@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("pair", PAIRS)
def test_speed_and_coupling_are_those_of_the_kinematics(of_leg, pair, routing):
    """Speed within 3 % (the servo's sag changes with the spring's torque), coupling within 0.02."""
    case = {"pair": pair, "routing": routing, "hinges": 1}
    foot, knee, _ = slopes(pair, routing)
    assert of_leg.mean("speed", **case) == pytest.approx(15.0 * abs(foot[1, 1]), rel=0.03)
    assert of_leg.mean("coupling", **case) == pytest.approx(LEGS[pair].knee_direction * knee[0], abs=0.02)


@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("pair", PAIRS)
def test_force_is_that_of_virtual_work(pair, routing):
    """With a stiff ankle F dz + k (theta_1 - rest) d theta_1 = tau dq, within 5 %, for the servo that gives first."""
    stiff = replace_quantities(ModelParameters(), {"stiffness.ankle": np.asarray(2.0)})
    limb, foot = f"{pair}_left", np.array(LEGS[pair].neutral_foot)
    servo = stands.servo_angles(pair, foot, routing)
    measured = Stand(assemble_leg(limb, routing, stiff)).settle(servo).held(f"{limb}_foot", (0.0, 0.0, -1.0), 20.0)
    jacobian, knee, angle = slopes(pair, routing)
    spring = float(getattr(ModelParameters().stiffness, f"{pair}_knee")) * (angle - KNEE_REST[pair])
    rise, limit = jacobian[1], float(ModelParameters().servo.torque_limit)
    # The knee's servo drives it in the sense in which the foot rises, and the hip's servo carries the rest.
    knee_servo = (limit - spring * knee[1] * np.sign(rise[1])) / abs(rise[1])
    hip_servo = [(side * limit - spring * knee[0]) / rise[0] for side in (1.0, -1.0)]
    assert measured == pytest.approx(min(knee_servo, *(each for each in hip_servo if each > 0)), rel=0.05)


def test_work_of_a_bend_is_the_energy_of_the_springs(of_spine):
    """Half of k theta^2 of each joint, and 3 % that damping takes; twice as much in both planes."""
    for plane, joints in (("lateral", 4), ("vertical", 4), ("combined", 8)):
        case = {"robot": "nermo_41", "plane": plane}
        stored = 0.5 * joints * 1.2 * of_spine.mean("joint_angle", **case) ** 2
        assert of_spine.mean("work", **case) == pytest.approx(stored * 1.02, rel=0.02)


def test_both_planes_move_the_hip_as_each_does(of_spine):
    """Sideways and up are at right angles: range and speed add in squares within 3 %."""
    for column in ("range", "speed"):
        lateral, vertical, both = (of_spine.mean(column, robot="nermo_41", plane=plane) for plane in stands.PLANES)
        assert both == pytest.approx(np.hypot(lateral, vertical), rel=0.03)


def test_the_load_case_holds_and_so_does_what_the_thesis_says_of_the_routings(of_leg, of_spine):
    """A.1 with chains of hinges; Table 5.2 in words, but for the lever arm of type 2, whose guide was chosen."""
    for outcome in (of_leg, of_spine):
        lines = compare(outcome)
        assert all(line.exact is not None and line.kind == "chosen" for line in lines)
        failing = [line.figure for line in lines if not line.holds]
        assert failing in ([], ["routing type 2 has a shorter lever arm on the knee than type 1"])
        assert set(outcome.columns) <= set(outcome.about)


@pytest.mark.draws
def test_both_stands_are_drawn(of_leg, of_spine):
    """A bar for each routing of each pair of legs, and for each plane, in four panels."""
    for outcome, bars in ((of_leg, 2 * len(ROUTINGS)), (of_spine, len(stands.PLANES))):
        ((_, figure),) = figures_of(outcome, ())
        assert [len(ax.patches) for ax in figure.axes] == [bars] * 4


def test_what_a_stand_does_not_have_is_refused():
    """What is no parameter of the body, and a motor's back-EMF, which the stand's servos do not have."""
    for name in ("frequency", "servo.back_emf"):
        with pytest.raises(ParameterError, match=name):
            stands.run_leg(Settings(values={name: 0.5}))
