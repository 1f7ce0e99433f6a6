# Tests of rollout/simulator.py, rollout/setup.py, rollout/run.py
"""What a simulator is given and says at its edges: shapes of values, time spent on compiling, ends of ranges."""

from __future__ import annotations

import copy
import dataclasses
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
import pytest
from test_physics_presets import standing

from nermo_mjx.physics.variation import Variation, compile_model
from nermo_mjx.robot import ModelParameters, load_robot
from nermo_mjx.robot.equipment import highest_kp, highest_kv
from nermo_mjx.robot.quantity import quantities, replace_quantities
from nermo_mjx.rollout import Run, Setup, Simulator, all_parameters
from nermo_mjx.rollout.setup import without_presettings

#: A servo chatters if its torque jumps by more than this share of its limit from one step to the next, while the robot
#: stands still and nothing is asked of it.
CHATTER = 0.05
#: Of MuJoCo's model: the play of servos is computed beside it, see test_servo_play.py.
BODY = [
    name
    for name, _ in quantities(ModelParameters)
    if name not in ("servo.dead_band", "servo.backlash")
]
PRESETS = ("reference", "fast")


@pytest.mark.release
def test_compile_seconds_are_those_of_compiling() -> None:
    """A new simulator spends some; the same batch once more none, however long it runs."""
    simulator, run = Simulator(Setup(), "c"), Run(duration=1.0, warmup=0.0)
    first, again = (
        simulator.run({"frequency": np.array([0.8, value])}, run) for value in (0.7, 0.6)
    )
    assert 0.1 < first.compile_seconds < first.wall_seconds
    assert again.compile_seconds == 0.0 < again.wall_seconds


def jump(model: mujoco.MjModel, targets: np.ndarray) -> float:
    """Largest change of a servo's torque between two steps, over its limit, in the second half second of standing."""
    data, torques = mujoco.MjData(model), []
    for _ in range(round(1.0 / model.opt.timestep)):
        data.ctrl[:] = targets
        mujoco.mj_step(model, data)
        torques.append(data.actuator_force.copy())
    assert np.isfinite(data.qpos).all()
    return float(
        np.abs(np.diff(torques[len(torques) // 2 :], axis=0)).max()
        / model.actuator_forcerange[0, 1]
    )


def servo_jump(kp: float, kv: float, timestep: float, **damping: float) -> float:
    robot = load_robot(timestep=timestep)
    values = {"servo.kp": kp, "servo.kv": kv} | {
        f"damping.{name}": value for name, value in damping.items()
    }
    return jump(compile_model(robot, values), standing(robot))


@pytest.mark.long
@pytest.mark.release
def test_at_the_ends_of_every_range_of_the_body_no_servo_chatters() -> None:
    """With all else at its default and the longest steps, the robot stands: finite, and no torque alternates.

    But for servos too weak to carry it, whose torque is at its limit: finite.
    """
    physics = "fast"
    robot, declarations = load_robot(physics=physics), all_parameters(Setup(physics=physics))
    ends = [
        (name, end) for name in BODY for end in (declarations[name].low, declarations[name].high)
    ]
    values = {
        name: np.array(
            [
                end if name == varied_name else declarations[name].default
                for varied_name, end in ends
            ]
        )
        for name in BODY
    }
    fields = Variation(robot).batch(replace_quantities(ModelParameters(), values), len(ends), BODY)
    jumps = {}
    for world, where in enumerate(ends):
        model = copy.copy(robot.physical)
        for field, rows in fields.items():
            attrgetter(field)(model)[...] = rows[world]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        jumps[where] = jump(model, standing(robot))
    del jumps["servo.torque_limit", 0.01]
    assert {where: share for where, share in jumps.items() if not share < CHATTER} == {}


@pytest.mark.parametrize("timestep", [0.001, 0.002, 0.01 / 3])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_no_servo_chatters_that_is_allowed_beside_its_damping(
    timestep: float, share: float
) -> None:
    """Along the bound, from all damping to all stiffness."""
    kp = 0.1 + share * (highest_kp(timestep, 0.0) - 0.1)
    assert servo_jump(kp, float(highest_kv(timestep, kp)), timestep) < CHATTER


@pytest.mark.parametrize("timestep", [0.001, 0.002, 0.01 / 3])
@pytest.mark.parametrize("kp", [0.1, 20.0, 100.0])
def test_a_servo_past_the_bound_does(timestep: float, kp: float) -> None:
    """The bound is sharp: a damping 1.3 times the allowed one alternates.

    Of docs/model.md's identified body; the default one, at 10/3 ms and 100 N m/rad, from 1.4 times on.
    """
    damped = {"knee": 0.02531, "ankle": 0.02531, "spine": 0.09242}
    assert servo_jump(kp, 1.3 * float(highest_kv(timestep, kp)), timestep, **damped) > 0.5


@pytest.mark.release
def test_a_world_whose_solver_often_stopped_early_says_so(
    simulator: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In more than one step of a thousand of its own."""
    walking = simulator()
    opened = walking.engine.open

    class Rough:
        """A session whose solver stopped early in so many steps of each world."""

        unsolved = np.array([0, 1, 1000])

        def __init__(self, *arguments: Any) -> None:
            self.session = opened(*arguments)

        def __getattr__(self, name: str) -> Any:
            return getattr(self.session, name)

    monkeypatch.setattr(walking.engine, "open", Rough)
    result = walking.run({"frequency": np.full(3, 0.8)}, Run(cycles=2, warmup_cycles=0))
    assert result.status.tolist() == ["ok", "ok", "unsolved"]


def test_a_profile_chooses_its_robot_unless_one_is_given():
    """Tail and soles change with the profile, in a copy, too; a given tail stays, and programs are shared only where
    robots are alike."""
    published = Setup(profile="as_published")
    assert (published.tail, published.feet) == ("articulated", "capsules")
    assert (Setup().tail, Setup(profile="as_built").feet) == ("rigid", "spheres")
    assert dataclasses.replace(published, profile="exact") == Setup()
    assert dataclasses.replace(Setup(tail="articulated"), profile="as_built").tail == "articulated"
    assert Setup(profile="as_published", tail="rigid").tail == "rigid"
    assert without_presettings(published) != without_presettings(Setup())
    assert without_presettings(Setup(profile="as_built")) == without_presettings(
        Setup(gait="lateral_walk")
    )
    assert type(published.fields()["tail"]) is str
