# Tests of physics/servo_play.py, robot/equipment.py
"""Servos as motors on a battery: torque against speed, dead band and backlash, on one joint and on the robot."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from nermo_mjx.control.parameters import BUILT_BODY, BUILT_PROFILE, body_values
from nermo_mjx.physics.servo_play import Play, played
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import load_robot
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.rollout import Run
from nermo_mjx.rollout.setup import WorldParameters

KP, KV, STALL, SPEED, STEP = 10.0, 0.05, 0.15, 12.0, 0.002
#: A servo on a joint that nothing else moves.
JOINT = f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody><body><joint name="out" armature="6.5e-4"/>
<geom size=".005" mass="1e-4"/></body></worldbody><actuator><position joint="out" kp="{KP}" kv="{KV}"
forcerange="-{STALL} {STALL}"/></actuator></mujoco>"""


def moved(target: float, load: float, steps: int, dead_band: float = 0.0, backlash: float = 0.0):
    """Angles of the joint and torques of its servo, step by step, under a constant load [N m]."""
    model = mujoco.MjModel.from_xml_string(JOINT)
    data, motor = mujoco.MjData(model), np.zeros(1)
    play = Play(*(np.array([value]) for value in (dead_band, backlash, KP, KV, STALL, SPEED)))
    data.qfrc_applied[:] = load
    rows = []
    for _ in range(steps):
        data.ctrl[:], motor = played(
            play, motor, np.array([target]), data.qpos, data.qvel, STEP, np
        )
        mujoco.mj_step(model, data)
        rows.append((data.qpos[0], data.actuator_force[0]))
    return np.array(rows).T


@pytest.mark.parametrize(("voltage", "back_emf"), [(6.0, 0.4), (4.8, 0.4), (7.4, 0.2)])
def test_the_torque_falls_linearly_to_zero_at_the_no_load_speed(voltage, back_emf):
    """A servo that is told to go far turns with T V/6 at rest and with nothing at V/k; both grow with the voltage."""
    body = {"servo.supply_voltage": voltage, "servo.back_emf": back_emf, "damping.pulley": 0.0}
    model = compile_model(load_robot(), body)
    data, joint = mujoco.MjData(model), model.joint("neck")
    data.ctrl[model.actuator("neck_servo").id] = 1.0
    stall, fastest = 0.157 * voltage / 6.0, voltage / back_emf
    for share in (0.0, 0.25, 0.5, 1.0):
        data.qvel[joint.dofadr] = share * fastest
        mujoco.mj_forward(model, data)
        torque = data.qfrc_actuator[joint.dofadr] + data.qfrc_passive[joint.dofadr]
        assert torque == pytest.approx(stall * (1.0 - share), abs=1e-9)


@pytest.mark.parametrize("dead_band", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_loaded_servo_rests_outside_its_dead_band(dead_band, side):
    """It holds the load once the error exceeds the dead band by load / kp."""
    angle, _ = moved(0.1, -0.06 * side, 3000, dead_band)
    assert 0.1 - angle[-1] == pytest.approx(side * (dead_band + 0.06 / KP), abs=1e-6)


def test_a_servo_without_play_is_the_position_actuator():
    """Dead band and backlash of zero change nothing but rounding."""
    model = mujoco.MjModel.from_xml_string(JOINT)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.4
    angle, torque = moved(0.4, 0.02, 200)
    data.qfrc_applied[:] = 0.02
    for step in range(200):
        mujoco.mj_step(model, data)
        assert data.qpos[0] == pytest.approx(angle[step], abs=1e-12)
        assert data.actuator_force[0] == pytest.approx(torque[step], abs=1e-12)


@pytest.mark.parametrize("backlash", [0.03, 0.1, 0.168])
def test_no_torque_passes_until_the_motor_has_crossed_the_play(backlash):
    """At full drive the motor takes b / 2 v from the middle; the step in which it arrives counts with its rest."""
    _, torque = moved(1.0, 0.0, 12, backlash=backlash)
    steps = backlash / 2 / SPEED / STEP
    whole_steps = int(steps)
    np.testing.assert_allclose(torque[:whole_steps], 0.0, atol=1e-12)
    assert torque[whole_steps] == pytest.approx(STALL * (1.0 - (steps - whole_steps)), rel=1e-9)
    np.testing.assert_allclose(torque[whole_steps + 1 :], STALL, rtol=1e-9)


@pytest.mark.release
def test_a_batch_has_servos_with_and_without_play(simulator):
    """A world without play walks as it does without the parameters.

    Servos that do not respond to 3 degrees, or whose battery is low, are slower with the spine and draw less: of
    docs/model.md's identified body. Such a dead band makes the default one faster.
    """
    damped = {"damping.knee": 0.02531, "damping.ankle": 0.02531, "damping.spine": 0.09242}
    sim, run = simulator(spine="stride_extension"), Run(cycles=3, warmup_cycles=1)
    names = {
        "servo.dead_band": [0.0, 0.05, 0.0],
        "servo.backlash": [0.0, 0.0, 0.02],
        "servo.supply_voltage": 6.0,
    }
    play = sim({"frequency": 0.8, **names, **damped}, run)
    motor = {"servo.supply_voltage": [6.0, 4.8], "servo.back_emf": [0.0, 0.4]}
    plain, weak = sim({"frequency": 0.8, **motor, **damped}, run)["speed"]
    assert play["speed"][0] == pytest.approx(
        plain, rel=2e-2
    )  # rounding in float32 grows at contacts
    assert max(play["speed"][1], weak) < 0.98 * plain
    assert play["servo_current"][1] < 0.8 * play["servo_current"][0]


@pytest.mark.release
def test_servos_of_either_end_of_their_ranges_can_be_simulated(simulator):
    """None of them makes the simulation lose its numbers, and charge and times are positive."""
    names = ("supply_voltage", "back_emf", "dead_band", "backlash", "idle_current", "stall_current")
    declarations = dict(quantities(WorldParameters))
    ends = {f"servo.{name}": [] for name in names}
    for target in (*names, "all"):
        for end in ("low", "high"):
            for name, column in ends.items():
                quantity = declarations[name]
                column.append(
                    getattr(quantity, end)
                    if target in ("all", name.split(".")[1])
                    else quantity.default
                )
    result = simulator().run(ends, Run(duration=0.6, warmup=0.0))
    assert "diverged" not in result.status
    assert (result.metrics["battery_time"] > 0.0).all()
    assert (result.metrics["charge"] >= 0.0).all()


@pytest.mark.release
def test_the_battery_changes_nothing_but_its_time(simulator):
    """Run time is its capacity over what servos and electronics draw."""
    run = Run(duration=0.5, warmup=0.0)
    metrics = simulator()(
        {"battery.capacity": [1.0, 0.5], "battery.electronics_current": [0.3, 0.0]}, run
    )
    np.testing.assert_array_equal(*metrics["speed"])
    current = metrics["servo_current"] + [0.3, 0.0]
    np.testing.assert_allclose(
        metrics["battery_time"], 3600.0 * np.array([1.0, 0.5]) / current, rtol=1e-5
    )


@pytest.mark.release
def test_the_profile_as_built_is_its_values_named(simulator):
    """It walks as the default does with the controller's and the body's values named, and values named override it."""
    run = Run(duration=1.0, warmup=0.0)
    built = simulator(profile="as_built", spine="stride_extension")
    explicit_metrics = simulator(spine="stride_extension")(
        {**BUILT_PROFILE, **body_values("as_built")}, run
    )
    metrics = built({"build.spine_slack": [BUILT_BODY["build.spine_slack"], 0.0]}, run)
    for name in ("speed", "roll_std", "servo_work"):
        assert metrics[name][0] == pytest.approx(explicit_metrics[name][0], rel=1e-5)
    assert metrics["speed"][1] != pytest.approx(metrics["speed"][0], rel=1e-3)
    np.testing.assert_array_equal(built({}, run)["speed"][0], metrics["speed"][0])
