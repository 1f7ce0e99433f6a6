# Tests of robot/model_parameters.py, robot/equipment.py
"""The default body: a landscape without jumps, on soft soles that hold the robot where hard ones would."""

from __future__ import annotations

import copy
import dataclasses
import runpy
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import LIMBS, ModelParameters, ParameterError, Sensors, load_robot
from nermo_mjx.rollout import Run, Setup, Simulator, electrical


@pytest.mark.release
def test_the_speed_is_smooth_where_a_tuner_looks():
    """Along the phase of the trot the speed is within a micrometre per second of a parabola, over 1 % of its range.

    With tendons that go taut at an impedance of 0.95 and soles of a width of 0.5 mm it is 5 micrometres per second off.
    """
    steps = np.linspace(-0.005, 0.005, 31)
    with jax.enable_x64(True):
        simulator = Simulator(Setup(gait="trot", spine="stride_extension"), engine="c")
        walks = {"frequency": 0.72, "spine.amplitude": 0.22, "spine.phase": -0.4 + np.pi * steps}
        speed = np.asarray(
            simulator.run(walks, Run(cycles=4, warmup_cycles=1)).metrics["speed"], float
        )
    assert (speed - np.polyval(np.polyfit(steps, speed, 2), steps)).std() < 1e-6


def standing(values: dict[str, float]) -> float:
    """Height of the lowest sole's centre under the standing robot [m]."""
    robot = load_robot()
    model = compile_model(robot, values)
    data = mujoco.MjData(model)
    data.qpos[2] -= min(data.geom_xpos[model.geom(f"{limb}_sole").id, 2] for limb in LIMBS)
    for _ in range(round(3.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return min(float(data.geom(f"{limb}_sole").xpos[2]) for limb in LIMBS)


@pytest.mark.release
def test_soft_soles_stand_where_hard_ones_do():
    """A sole's centre is at most 0.1 mm lower than on balls of 2 mm that yield by 0.43 mm."""
    hard = {
        "geometry.foot.radius": 0.002,
        "contact.time_constant": 0.008,
        "contact.damping_ratio": 2.0,
    }
    hard |= {"contact.width": 0.0005, "build.tendon_impedance": 0.95}
    assert standing(hard) == pytest.approx(0.002 - 0.00043, abs=2e-5)
    assert abs(standing({}) - standing(hard)) < 1e-4


@dataclasses.dataclass
class Budget:
    """Where the work of a second of trotting in place goes [J]; the robot is stepped by plain MuJoCo.

    Attributes:
        servos: net work of the servos.
        servo_dampers, other_dampers: taken by the dampers of the servos' joints and of all others.
        contact, tendons: taken by these constraints.
        gained: change of kinetic and potential energy, springs included.
    """

    servos: float = 0.0
    servo_dampers: float = 0.0
    other_dampers: float = 0.0
    contact: float = 0.0
    tendons: float = 0.0
    gained: float = 0.0


def trotting_in_place() -> tuple[Budget, Sensors]:
    """The budget by each force times the mean speed of its step, and the readings of all steps."""
    robot = load_robot()
    model = copy.copy(robot.physical)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data, budget, readings = mujoco.MjData(model), Budget(), []
    of_servo = np.isin(np.arange(model.nv), model.jnt_dofadr[model.actuator_trnid[:, 0]])
    shares = np.array([[0.25, -0.25, -0.25, 0.25, 0.3, -0.3, 0.3, -0.3]]).T * np.sin(
        np.linspace(0, 14, 600) - 0.4
    )
    neutral, energy = data.qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]].copy(), 0.0
    for step in range(600):
        data.ctrl[:] = neutral
        data.ctrl[:8] += shares[:, step]
        initial_velocity = data.qvel.copy()
        mujoco.mj_step(model, data)  # all forces in `data` are those of the state before
        final_velocity, mean = data.qvel.copy(), 0.5 * (initial_velocity + data.qvel)
        if step >= 100:
            pushed = np.zeros(data.nefc)
            mujoco.mj_mulJacVec(model, data, pushed, mean)
            work = -model.opt.timestep * data.efc_force * pushed
            tendon = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
            damped = model.opt.timestep * model.dof_damping * final_velocity * mean
            budget.servos += model.opt.timestep * data.qfrc_actuator @ mean
            budget.servo_dampers += damped[of_servo].sum()
            budget.other_dampers += damped[~of_servo].sum()
            budget.contact += work[~tendon].sum()
            budget.tendons += work[tendon].sum()
            readings.append(data.sensordata.copy())
        elif step == 99:
            energy = energies(model, data)
    budget.gained = energies(model, data) - energy
    return budget, robot.sensors(np.stack(readings))


def energies(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Kinetic and potential energy of the state [J]."""
    now = copy.copy(data)
    mujoco.mj_forward(model, now)
    return float(now.energy.sum())


@pytest.mark.release
def test_energy_is_conserved_and_the_metrics_say_where_it_goes():
    """Servos' work is what dampers, contact and tendons take and what the robot gains; the metrics have its parts."""
    budget, sensors = trotting_in_place()
    work = (
        budget.servo_dampers
        + budget.other_dampers
        + budget.contact
        + budget.tendons
        + budget.gained
    )
    assert budget.servos > 0.1
    assert work == pytest.approx(budget.servos, rel=1e-3)
    body = ModelParameters()
    readings = sensors.servo_torque, sensors.servo_velocity, sensors.joint_velocity
    start, now = (tuple(reading[i] for reading in readings) for i in (0, slice(1, None)))
    spent = electrical.spent(start, now, body.servo)
    sums = {name: 0.998 * np.asarray(value) for name, value in spent.items()}
    expected = electrical.budget(sums, 0.998, electrical.Supply.of(body, load_robot()))
    assert expected["servo_net_work"] == pytest.approx(budget.servos, rel=0.01)
    assert expected["servo_damper_work"] == pytest.approx(budget.servo_dampers, rel=0.01)
    assert expected["joint_damper_work"] == pytest.approx(budget.other_dampers, rel=0.01)
    balance = budget.contact + budget.tendons + budget.gained
    assert expected["constraint_work"] == pytest.approx(balance, abs=0.01 * budget.servos)
    torque = np.abs(np.asarray(sensors.servo_torque[1:]))
    assert expected["limited_rear_knees"] == pytest.approx(
        (torque[:, 6:8] > 0.1569).mean(), abs=1e-6
    )


@pytest.mark.release
@pytest.mark.parametrize(
    "build",
    [{}, pytest.param({"hinges": 2, "tail": "articulated"}, marks=pytest.mark.release)],
    ids=["default", "chains and tail"],
)
def test_the_metrics_of_a_walk_are_the_work_that_plain_mujoco_finds(build: dict[str, Any]):
    """Of each force times the mean speed of its step, in steps that follow the recording of engine c exactly."""
    budget = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "work_budget.py"))["budget"]
    simulator = Simulator(Setup(spine="stride_extension", pilot="open_loop", **build), engine="c")
    body = {"damping.knee": 0.01, "damping.pulley": 0.005}
    result = simulator.run(body | {"frequency": 0.8}, Run(cycles=4, warmup_cycles=1), record=True)
    work = budget(result.recording(0), compile_model(simulator.robot, body), 1 / 0.8)
    servos, servo_dampers, joint_dampers, *_ = work
    assert servos == pytest.approx(work[1:].sum(), rel=2e-4)
    metrics = {name: float(column[0]) for name, column in result.metrics.items()}
    assert metrics["servo_net_work"] == pytest.approx(servos, rel=0.01)
    assert metrics["servo_damper_work"] == pytest.approx(servo_dampers, rel=0.01)
    assert metrics["joint_damper_work"] == pytest.approx(joint_dampers, rel=0.01)
    assert metrics["constraint_work"] == pytest.approx(work[3:].sum(), abs=0.01 * servos)


def test_the_fast_preset_walks_with_the_shortest_time_constant_of_its_step():
    """The default is two of the reference's steps, and two of longer ones; a shorter one is refused."""
    fast = Setup(physics="fast")
    assert fast.defaults()["contact.time_constant"] == pytest.approx(2 * fast.timestep)
    fast.check(fast.world({}))
    with pytest.raises(ParameterError, match=r"contact.time_constant is 0.005: allowed is"):
        fast.check(fast.world({"contact.time_constant": 0.005}))
