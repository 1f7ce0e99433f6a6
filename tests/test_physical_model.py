"""Engines step the robot without its visual elements."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from nermo_mjx.robot import load_robot

SCENES = ("flat", "maze", "balance_stand")


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("tail", ["rigid", "articulated"])
def test_it_moves_bit_for_bit_like_the_whole_model(scene: str, tail: str) -> None:
    """Dropped on the ground with restless servos, every sensor read."""
    robot = load_robot(scene=scene, tail=tail)
    states = []
    for model in (robot.model, robot.physical):
        data = mujoco.MjData(model)
        noise = np.random.default_rng(0)
        for _ in range(300):
            data.ctrl[:] = noise.uniform(-0.4, 0.4, model.nu)
            mujoco.mj_step(model, data)
        assert data.ncon > 0
        states.append(np.concatenate([data.qpos, data.qvel, data.sensordata]))
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("scene", SCENES)
def test_ids_that_engines_use_are_those_of_the_whole_model(scene: str) -> None:
    """Bodies, joints, actuators, tendons, sensors and contact pairs."""
    robot = load_robot(scene=scene)
    whole, lean = robot.model, robot.physical
    for kind in ("body", "joint", "actuator", "tendon", "sensor", "pair"):
        count = {"body": "nbody", "joint": "njnt", "actuator": "nu"}.get(kind, f"n{kind}")
        names = [[getattr(m, kind)(i).name for i in range(getattr(m, count))] for m in (whole, lean)]
        assert names[0] == names[1], kind
    assert whole.nu > 0


def test_nothing_that_is_only_drawn_is_left() -> None:
    """Every geom touches something or leads a tendon, and every site is on a tendon or read."""
    robot = load_robot()
    model = robot.physical
    used = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist(), *model.wrap_objid[model.wrap_type == 5].tolist()}
    assert used == set(range(model.ngeom))
    assert model.ngeom < 20 < robot.model.ngeom
    assert (model.ncam, model.nlight) == (0, 0)
    assert {model.site(i).name for i in range(model.nsite)} >= {"imu", "spine_end", "front_left_foot"}
    assert not [
        i for i in range(model.nsite) if model.site(i).name.startswith("tail_") and model.site(i).name != "tail_touch"
    ]
