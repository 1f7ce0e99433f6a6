"""The default body: a landscape without jumps, on soft soles that hold the robot where hard ones would."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import LIMBS, load_robot
from nermo_mjx.rollout import Run, Setup, Simulator

pytestmark = pytest.mark.compiles


def test_the_speed_is_smooth_where_a_tuner_looks():
    """Along the phase of the trot the speed is within a micrometre per second of a parabola, over 1 % of its range.

    With tendons that go taut at an impedance of 0.95 and soles of a width of 0.5 mm it is 5 micrometres per second off.
    """
    steps = np.linspace(-0.005, 0.005, 31)
    with jax.enable_x64(True):
        simulator = Simulator(Setup(gait="trot", spine="stride_extension"), engine="c")
        walks = {"frequency": 0.72, "spine.amplitude": 0.22, "spine.phase": -0.4 + np.pi * steps}
        speed = np.asarray(simulator.run(walks, Run(cycles=4, warmup_cycles=1)).metrics["speed"], float)
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


def test_soft_soles_stand_where_hard_ones_do():
    """A sole's centre is at most 0.1 mm lower than on balls of 2 mm that yield by 0.43 mm."""
    hard = {"geometry.foot.radius": 0.002, "contact.time_constant": 0.008, "contact.damping_ratio": 2.0}
    hard |= {"contact.width": 0.0005, "build.tendon_impedance": 0.95}
    assert standing(hard) == pytest.approx(0.002 - 0.00043, abs=2e-5)
    assert abs(standing({}) - standing(hard)) < 1e-4
