# Tests of robot/assembly.py
"""One leg, or the spine, alone on a test stand without gravity: servo angles against the kinematics' predictions.

A tendon can only pull: near a stretched leg the knee's torsion spring passes its rest angle (50 degrees in front, 75
behind) before the foot arrives, and the tendon goes slack. What follows is claimed for taut tendons only.
"""

from __future__ import annotations

import itertools

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.kinematics import leg, spine
from nermo_mjx.robot import LIMBS, assemble_leg, assemble_spine
from nermo_mjx.robot.equipment import KNEE_REST_RAD
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import FRONT_LEG, REAR_LEG, ROUTINGS, SPINE_GEOMETRY

#: The published robot.
ROBOT = Geometry()

GEOMETRY = {"front": FRONT_LEG, "rear": REAR_LEG}
NEUTRAL = {"front": (-0.005, -0.045), "rear": (0.0, -0.050)}
#: Feet of a full stride, from the neutral one: lifted in swing, on the neutral height, pushed down in stance.
STRIDE, HEIGHTS = np.linspace(-0.03, 0.03, 5), (0.010, 0.0, -0.005)


def settle(
    model: mujoco.MjModel, ctrl: np.ndarray, steps: int, torque: dict[str, float] | None = None
) -> mujoco.MjData:
    """The stand at rest under constant servo targets, and constant torques [N m] on the named joints."""
    data = mujoco.MjData(model)
    data.ctrl[:] = ctrl
    for joint, value in (torque or {}).items():
        data.joint(joint).qfrc_applied = value
    for _ in range(steps):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    assert np.abs(data.qvel).max() < 1e-3
    return data


def slack(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """By how much each tendon is shorter than it may be [m]; 0 or a few hundredths of a millimetre less if it pulls."""
    return model.tendon_range[:, 1] - data.ten_length


def tendon_force(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Pull of each tendon [N], from the constraint solver."""
    force = np.zeros(model.ntendon)
    for row in range(data.nefc):
        if data.efc_type[row] == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON:
            force[data.efc_id[row]] += data.efc_force[row]
    return force


@pytest.mark.release
@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("limb", LIMBS)
def test_servo_angles_put_the_foot_where_the_kinematics_says(limb, routing):
    """Feet of the stance box are met within 1 mm (0.4 mm in fact) wherever the tendon is taut.

    What remains is the servo's sag under the knee's spring, less than 0.02 rad, and 0.06 mm of tendon stretch.
    """
    pair = limb.split("_")[0]
    model, numbers = assemble_leg(limb, routing).compile(), leg.leg_of(GEOMETRY[pair])
    met = 0
    for y, z in itertools.product(STRIDE, HEIGHTS):
        foot = np.add(NEUTRAL[pair], (y, z))
        with jax.enable_x64(True):
            solution = jax.tree.map(np.asarray, leg.inverse_kinematics(numbers, foot, routing))
        servo = solution.servo
        assert solution.reachable
        # The knee's servo must reach the whole box; the hip's may miss its far corners (1.62 rad) by a hair.
        low, high = model.actuator_ctrlrange.T
        assert low[1] <= servo[1] <= high[1], f"the servo of {routing} needs {servo[1]:.3f} rad"
        assert low[0] - 0.02 <= servo[0] <= high[0] + 0.02
        data = settle(model, servo, 1500)
        if solution.knee_angle < KNEE_REST_RAD[pair]:
            assert slack(model, data)[0] > 0.0
            continue
        assert slack(model, data)[0] == pytest.approx(0.0, abs=1e-4)
        reached = data.site(f"{limb}_foot").xpos - data.site(f"{limb}_axis").xpos
        assert np.linalg.norm(reached[1:] - foot) < 1e-3, (tuple(foot), tuple(reached))
        assert reached[0] == pytest.approx(0.0, abs=1e-9)
        met += 1
    assert met >= 14  # of 15: one front corner needs a knee more stretched than its spring's rest


@pytest.mark.parametrize("limb", LIMBS)
@pytest.mark.parametrize("routing", ["type1", "type2", "type3"])
def test_no_pose_leads_a_tendon_to_the_other_side_of_its_pulley(limb, routing):
    """Over the servo's whole range, and hips far beyond a walk's: MuJoCo 3 and 4 choose the side by different rules."""
    model, numbers = assemble_leg(limb, routing).compile(), leg.leg_of(GEOMETRY[limb.split("_")[0]])
    data, draw = mujoco.MjData(model), np.random.default_rng(0)
    with jax.enable_x64(True):
        hips, low, high = draw.uniform(-1.5, 1.5, 1000), *model.actuator_ctrlrange[1]
        minimum, maximum, _ = leg.knee_range(numbers, hips, routing)
        knees = np.asarray(minimum + (maximum - minimum) * draw.uniform(0, 1, hips.shape))
        servos = np.asarray(leg.knee_servo(numbers, hips, knees, routing))
    for hip, knee, servo in zip(hips, knees, servos, strict=True):
        if low < servo < high:
            for joint, angle in (("hip", hip), ("knee", knee), ("pulley", servo)):
                data.joint(f"{limb}_{joint}").qpos[0] = angle
            mujoco.mj_fwdPosition(model, data)
            assert slack(model, data)[0] == pytest.approx(0.0, abs=1e-4), (hip, knee, servo)


@pytest.mark.parametrize("limb", LIMBS)
def test_a_knee_tendon_pulls_only(limb):
    """Its pull flexes the knee against its spring; when it is slack, it has no effect at all."""
    pair = limb.split("_")[0]
    model = assemble_leg(limb).compile()
    low, high = model.actuator_ctrlrange[1]
    knee, servo = f"{limb}_knee", f"{limb}_knee_servo"
    stiffness, rest_angle, (low, high) = (
        model.joint(knee).stiffness[0],
        KNEE_REST_RAD[pair],
        model.actuator_ctrlrange[1],
    )

    taut = settle(model, np.array([0.0, low if pair == "front" else high]), 500)
    force, bend = tendon_force(model, taut)[0], taut.joint(knee).qpos[0]
    assert bend > rest_angle + 0.5
    assert force > 1.0
    # Its pull is the servo's torque over the pulley's radius; it balances the knee's spring, and does not turn the hip.
    torque = {
        name: taut.qfrc_constraint[model.joint(f"{limb}_{name}").dofadr[0]]
        for name in ("hip", "knee", "pulley")
    }
    assert force * GEOMETRY[pair].pulley_radius == pytest.approx(abs(torque["pulley"]), rel=1e-6)
    assert torque["pulley"] == pytest.approx(-taut.actuator(servo).force[0], rel=1e-3)
    assert torque["knee"] == pytest.approx(stiffness * (bend - rest_angle), rel=1e-3)
    assert torque["hip"] == pytest.approx(0.0, abs=1e-6)

    # Bent further by hand, the knee leaves the tendon slack: only the spring resists, and the servo feels nothing.
    loose = settle(model, np.array([0.0, 0.1]), 1000, {knee: 0.25})
    assert slack(model, loose)[0] > 1e-4
    assert tendon_force(model, loose)[0] == 0.0
    assert loose.joint(knee).qpos[0] == pytest.approx(rest_angle + 0.25 / stiffness, abs=1e-3)
    assert loose.actuator(servo).force[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_front_tendon_let_out_is_slack(side):
    """At the end of the front knee's servo range the spring has come to rest before the tendon is straight."""
    limb = f"front_{side}"
    model = assemble_leg(limb).compile()
    data = settle(model, np.array([0.0, model.actuator_ctrlrange[1, 1]]), 1500)
    assert slack(model, data)[0] > 1e-3
    assert tendon_force(model, data)[0] == 0.0
    assert data.joint(f"{limb}_knee").qpos[0] == pytest.approx(KNEE_REST_RAD["front"], abs=1e-3)


@pytest.mark.parametrize("pair", ["front", "rear"])
def test_right_legs_do_what_left_legs_do(pair):
    """The same servo angles give the mirrored pose: hinges about x have one sign convention on both sides."""
    servo = np.array([0.4, 0.3]) if pair == "front" else np.array([-0.5, 0.3])
    left, right = (
        settle(assemble_leg(f"{pair}_{side}").compile(), servo, 500) for side in ("left", "right")
    )
    np.testing.assert_allclose(right.qpos, left.qpos, atol=1e-12)
    for point in ("foot", "attachment", "rim"):
        mirrored = right.site(f"{pair}_right_{point}").xpos * (-1, 1, 1)
        np.testing.assert_allclose(mirrored, left.site(f"{pair}_left_{point}").xpos, atol=1e-12)


#: Spine servo angles that give each joint up to 0.1 rad, both sides.
SPINE_SERVO = [side * float(q) for q in (0.05, 0.1, 0.2, 0.3, 0.38) for side in (1, -1)]


@pytest.mark.parametrize("servo", SPINE_SERVO)
def test_spine_servo_bends_the_spine_as_predicted(servo):
    """The joints bend equally, within 10 % of `joint_angle` (5 to 6 % less in fact), and positive means left.

    The servo sags by 5 % under the four springs, k (r_sp / d_1)^2 / 4 = 0.32 N m/rad against its own 6.3. The rest, up
    to 1.3 %, is between the outer tendon's length, which the formula follows, and the inner one's, which pulls.
    """
    model = assemble_spine().compile()
    data = settle(model, np.array([servo]), 1500)
    joints = np.array([data.joint(f"spine_joint_{i}").qpos[0] for i in range(1, 5)])
    predicted = float(spine.joint_angle(servo, ROBOT))
    assert np.abs(joints).max() <= SPINE_GEOMETRY.max_joint_angle
    assert joints.mean() == pytest.approx(predicted, rel=0.10)
    np.testing.assert_allclose(joints, joints.mean(), rtol=1e-3)
    # Without the servo's sag, the angle that the pulley reached predicts the joints within 1.5 %.
    assert joints.mean() == pytest.approx(
        float(spine.joint_angle(data.joint("spine_pulley").qpos[0], ROBOT)), rel=0.015
    )
    # Left is +x: the hip's end moves there, and the hip yaws to the right against the torso.
    end = data.site("spine_end")
    with jax.enable_x64(True):
        pose = np.asarray(spine.transform(joints.mean(), ROBOT))
    np.testing.assert_allclose(end.xpos, pose[:3, 3], atol=1e-5)
    assert np.sign(end.xpos[0]) == np.sign(servo)
    # One tendon pulls, on the side it bends to; the other is slack by less than 0.05 mm.
    pulling, idle = (0, 1) if servo > 0 else (1, 0)
    assert [model.tendon(i).name for i in (0, 1)] == ["spine_left", "spine_right"]
    force, free = tendon_force(model, data), slack(model, data)
    assert force[pulling] == pytest.approx(
        abs(data.actuator("spine_servo").force[0]) / SPINE_GEOMETRY.pulley_radius, rel=1e-3
    )
    assert force[idle] == 0.0
    assert free[pulling] == pytest.approx(0.0, abs=5e-6)
    assert 0.0 < free[idle] < 5e-5


def test_spine_bends_alike_to_both_sides():
    """Opposite servo angles give opposite joint angles."""
    model = assemble_spine().compile()
    left, right = (settle(model, np.array([servo]), 1000) for servo in (0.3, -0.3))
    np.testing.assert_allclose(right.qpos, -left.qpos, atol=1e-10)
    np.testing.assert_allclose(right.ten_length, left.ten_length[::-1], atol=1e-12)


def test_spine_tendons_are_just_taut_over_the_whole_range():
    """At the angles that (5.26) pairs, the outer tendon is taut to 10 nm and the inner one up to 0.03 mm slack.

    Lengths decide here, so nothing is simulated. The formula is exact for the outer side, which lengthens.
    """
    model = assemble_spine().compile()
    data = mujoco.MjData(model)
    for theta in (0.0, 0.03, 0.06, 0.1):
        with jax.enable_x64(True):
            servo = float(spine.servo_angle(theta, ROBOT))
        for i in range(1, 5):
            data.joint(f"spine_joint_{i}").qpos = theta
        data.joint("spine_pulley").qpos = servo
        mujoco.mj_forward(model, data)
        free = slack(model, data)
        assert free[1] == pytest.approx(0.0, abs=1e-8)
        assert -1e-8 < free[0] < 3.1e-5
