"""A reward, an observation, a termination and a curriculum of one's own, for train_own.yaml."""

import jax
import jax.numpy as jnp

from nermo_mjx.learn import Term


def _bending(moment):
    return moment.seconds * moment.sensors.servo_velocity[8] ** 2


bending = Term("bending", "rad^2/s", "speed of the spine's servo, squared, over time", _bending)


def lean(sensors):
    """Share of the load on the left feet less that on the right ones."""
    left, right = (
        sensors.foot_force[jnp.array([0, 2])].sum(),
        sensors.foot_force[jnp.array([1, 3])].sum(),
    )
    return (left - right) / jnp.maximum(left + right, 0.1)


def tipped(sensors):
    """The torso leans by more than 45 degrees."""
    _, x, y, _ = sensors.orientation
    return 1.0 - 2.0 * (x**2 + y**2) < 0.7


def faster(key, steps):
    """Up to 0.1 m/s at the beginning, up to 0.2 m/s from the millionth control step on."""
    most = 0.1 + 0.1 * jnp.clip(steps / 1e6, 0.0, 1.0)
    return {"command.speed": jax.random.uniform(key, minval=0.05, maxval=most)}
