import jax.numpy as jnp

from nermo_mjx import metric


@metric(unit="rad/s", better="low", reduce="rms")
def yaw_shake(sensors):
    """Turning of the torso about its own axis."""
    return sensors.gyro[2]


@metric(unit="N", better="low", reduce="peak")
def hardest_step(sensors):
    """Largest force on any foot."""
    return jnp.max(sensors.foot_force)


@metric(unit="1")
def flight(sensors):
    """Share of time with no foot on the ground."""
    return jnp.all(sensors.foot_force < 0.02)
