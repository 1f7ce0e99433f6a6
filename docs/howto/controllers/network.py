"""A small neural network on the robot's own sensors, which corrects the feet of a trot.

Its parameters are a plain pytree, a list of layers. What it reads is on the real robot, too: the IMU's angular velocity
and where it feels down, the servos' angles, the feet's switches, and the phase of the trot.
"""

import jax
import jax.numpy as jnp

from nermo_mjx import leg_servos

#: What is read and moved: 3 + 3 + 9 + 4 + 2 numbers, and two coordinates of each foot and the spine's servo.
READS, MOVES, HIDDEN = 21, 9, 16
FREQUENCY = 0.8


def layers(key, *sizes):
    """Random weights of a network; the last layer is zero, so that the robot begins with the trot as it is."""
    keys = jax.random.split(key, len(sizes) - 1)
    scales = [1.0 / jnp.sqrt(size) for size in sizes[:-2]] + [0.0]
    shapes = zip(keys, scales, sizes[:-1], sizes[1:], strict=True)
    return [(scale * jax.random.normal(k, (m, n)), jnp.zeros(n)) for k, scale, m, n in shapes]


class Network:
    """Its state is the phase of the trot."""

    dt = 0.01

    def __init__(self, seed=0):
        self.parameters = layers(jax.random.key(seed), READS, HIDDEN, MOVES)

    def reads(self, phase, sensors):
        w, x, y, z = sensors.orientation
        down = jnp.stack(
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]
        )
        clock = jnp.stack([jnp.cos(2.0 * jnp.pi * phase), jnp.sin(2.0 * jnp.pi * phase)])
        touch = jnp.tanh(sensors.foot_force / 0.1)
        return jnp.concatenate([0.1 * sensors.gyro, down, sensors.servo_angle[:9], touch, clock])

    def servos(self, phase, moves):
        angle = 2.0 * jnp.pi * (phase + jnp.array([0.0, 0.5, 0.5, 0.0]))
        neutral = jnp.array([[-0.005, -0.045], [-0.005, -0.045], [0.0, -0.05], [0.0, -0.05]])
        step = jnp.stack([0.025 * jnp.cos(angle), 0.01 * jnp.maximum(jnp.sin(angle), 0.0)], axis=-1)
        return leg_servos(neutral + step + 0.005 * moves[:8].reshape(4, 2), spine=0.3 * moves[8])

    def init(self, params, sensors, phase):
        return phase

    def initial_servo(self, params, phase):
        return self.servos(phase, jnp.zeros(MOVES))

    def update(self, params, phase, sensors):
        phase = (phase + FREQUENCY * self.dt) % 1.0
        signal = self.reads(phase, sensors)
        for weights, bias in params:
            signal = jnp.tanh(signal @ weights + bias)
        return phase, self.servos(phase, signal)

    def cycle_rate(self, params):
        return FREQUENCY
