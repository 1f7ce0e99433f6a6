# Tests of shapes.py
"""While tests run, every room from the robot to the rollout refuses arrays of another shape than it names."""

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from nermo_mjx.control.turning import body_speed, leg_radius
from nermo_mjx.dynamics.spatial import rotate
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.kinematics.leg import bracketed_root
from nermo_mjx.robot import load_robot

ONE, TWO, THREE, FOUR = jnp.zeros(()), jnp.zeros(2), jnp.zeros(3), jnp.zeros(4)


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        pytest.param(load_robot().sensors, ("none",), id="robot: readings that are none"),
        pytest.param(
            bracketed_root, (jnp.sin, ONE, ONE, "steep"), id="kinematics: a slope that is no number"
        ),
        pytest.param(body_speed, (ONE, ONE), id="control: a gait that is a number"),
        pytest.param(
            leg_radius, (THREE, TWO, ONE), id="control: worlds that are three here and two there"
        ),
        pytest.param(rotate, (TWO, FOUR), id="physics: a vector with two numbers"),
        pytest.param(attitude, (THREE,), id="rollout: a quaternion with three numbers"),
    ],
)
def test_an_array_of_another_shape_is_refused(function, arguments):
    with pytest.raises(TypeCheckError):
        function(*arguments)


def test_a_residual_is_asked_for_one_point_at_a_time():
    """Of the shape of the bracket's ends: JAX takes no other from 0.12 on."""
    shapes_of_points = set()

    def residual(x):
        shapes_of_points.add(jnp.shape(x))
        return x - 0.5

    assert float(bracketed_root(residual, 0.0, 2.0, 1e-3)) == pytest.approx(0.5)
    assert shapes_of_points == {()}
