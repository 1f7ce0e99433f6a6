# Tests of rollout/loop.py
"""Which sensors a loop reads, and that those alone are computed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import differentiable, make_data, put_model
from nermo_mjx.physics.mjx_engine import read_entries, with_sensors
from nermo_mjx.robot import load_robot
from nermo_mjx.rollout import Setup
from nermo_mjx.rollout.loop import ClosedLoop

SENSORS = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .04"><freejoint/><geom name="ball" size=".05"/>
<site name="s" pos="0.01 0 0"/></body></worldbody>
<sensor><framepos objtype="site" objname="s"/><accelerometer site="s"/><velocimeter site="s"/><touch site="s"/>
<framequat objtype="site" objname="s"/></sensor></mujoco>
"""
PLACES = {
    "position": (0, 3),
    "accelerometer": (3, 6),
    "velocity": (6, 9),
    "touch": (9, 10),
    "orientation": (10, 14),
}


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda _, data: data[..., 2:4].sum(), [2, 3]),
        (
            lambda a, data: (a * data[..., 1:2], jnp.where(a > 0, data[..., 4:], 0.0)[0] * 2),
            [1, 4, 5],
        ),
        (lambda a, data: a, []),
        (lambda a, data: (a, data), range(6)),
        (lambda _, data: data[jnp.array([1, 2])], range(6)),
        (lambda _, data: jnp.stack([data[..., 3:4] * 2, data[..., 4:5] * 3])[0], [3, 4]),
    ],
)
def test_entries_count_that_something_returned_depends_on(function: Any, expected: Any) -> None:
    """What is sliced off and dropped does not; what is not sliced counts as a whole."""
    unused_too = lambda a, data: (data[..., 5:].sum(), function(a, data))[1]  # noqa: E731
    program = jax.make_jaxpr(unused_too)(jnp.ones(()), jnp.zeros(6))
    assert np.flatnonzero(read_entries(program, 6)).tolist() == list(expected)


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    "names", [("position",), ("velocity", "touch"), ("orientation",), (), tuple(PLACES)]
)
def test_sensors_that_are_read_have_their_values_and_places(names: tuple[str, ...]) -> None:
    """After a step with contact, as if all were computed; the others read zero."""
    model = mujoco.MjModel.from_xml_string(SENSORS)
    ours, read = put_model(model), np.zeros(model.nsensordata, bool)
    for name in names:
        read[slice(*PLACES[name])] = True
    reduced_model, data = with_sensors(ours, read), make_data(ours)
    assert reduced_model.nsensor == len(names)
    whole, part = (
        jax.jit(differentiable.forward)(model_variant, data).sensordata
        for model_variant in (ours, reduced_model)
    )
    assert np.abs(np.asarray(whole)).sum() > 9.0
    np.testing.assert_allclose(part, np.where(read, whole, 0.0), rtol=1e-6, atol=1e-6)


@pytest.mark.release
def test_the_walk_does_not_compute_its_accelerometer() -> None:
    """The one sensor of the robot that needs a pass over the tree and back."""
    robot = load_robot()
    setup = Setup(spine="stride_extension")
    loop = ClosedLoop(robot, setup.make_controller())
    from nermo_mjx.rollout import Simulator

    batch = Simulator(setup, "c").prepare({"frequency": np.full(1, 0.8)})
    params = jax.tree.map(lambda leaf: leaf[0], batch.params)
    size = robot.model.nsensordata
    state = loop.init(params, jnp.zeros(size))
    program = jax.make_jaxpr(loop.step)(params, state, jnp.zeros((loop.steps_per_tick, size)))
    sensors = robot.sensors(np.where(read_entries(program, size), 1.0, 0.0))
    assert not sensors.accelerometer.any()
    for name in (
        "position",
        "orientation",
        "linear_velocity",
        "servo_torque",
        "foot_force",
        "tail_force",
    ):
        assert np.all(np.asarray(getattr(sensors, name)) > 0.0), name
