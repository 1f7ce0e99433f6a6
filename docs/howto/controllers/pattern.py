"""A central pattern generator: four coupled oscillators, one a leg, that feel the load on their feet.

With the phases p of the legs, in cycles, and the force N on each foot,

    dp_i/dt = f + w sum_j sin(2 pi (p_j - p_i - o_i + o_j)) - s N_i cos(2 pi p_i)

where the offsets o say which gait is meant. The last term is local: a loaded leg waits in its stance [Owaki et al.,
J. R. Soc. Interface 10, 2013].
"""

from typing import Any

import jax.numpy as jnp

from nermo_mjx import LIMBS, leg_servos, parameter_tree, quantity


@parameter_tree
class Parameters:
    frequency: Any = quantity(
        0.8, unit="Hz", low=0.1, high=3.0, doc="intrinsic frequency of the legs"
    )
    coupling: Any = quantity(0.5, unit="Hz", low=0.0, high=10.0, doc="w, strength between two legs")
    feedback: Any = quantity(
        0.2, unit="Hz/N", low=0.0, high=5.0, doc="s, what a newton on the foot slows its leg"
    )
    offset: Any = quantity(
        (0.0, 0.5, 0.5, 0.0), unit="1", low=0.0, high=1.0, labels=LIMBS, doc="o, of a leg's phase"
    )
    reach: Any = quantity(0.05, unit="m", low=0.0, high=0.06, doc="length of a stride")
    lift: Any = quantity(0.01, unit="m", low=0.0, high=0.02, doc="height of a swing")
    bend: Any = quantity(0.2, unit="rad", low=0.0, high=0.4, doc="servo amplitude of the spine")


class PatternGenerator:
    """Its state are the four phases."""

    dt = 0.01
    parameters = Parameters()

    def servos(self, params, phase):
        angle = 2.0 * jnp.pi * phase
        neutral = jnp.array([[-0.005, -0.045], [-0.005, -0.045], [0.0, -0.05], [0.0, -0.05]])
        # The first half of a leg's cycle is its swing, forward (-y) and raised.
        step = jnp.stack(
            [0.5 * params.reach * jnp.cos(angle), params.lift * jnp.maximum(jnp.sin(angle), 0.0)],
            axis=-1,
        )
        return leg_servos(
            neutral + step, spine=0.5 * params.bend * (jnp.cos(angle[1]) - jnp.cos(angle[0]))
        )

    def init(self, params, sensors, phase):
        return phase + params.offset

    def initial_servo(self, params, phase):
        return self.servos(params, phase + params.offset)

    def update(self, params, phase, sensors):
        apart = (phase - params.offset)[None, :] - (phase - params.offset)[:, None]
        pull = jnp.sum(jnp.sin(2.0 * jnp.pi * apart), axis=1)
        waits = jnp.clip(sensors.foot_force, 0.0, 5.0) * jnp.cos(2.0 * jnp.pi * phase)
        rate = params.frequency + params.coupling * pull - params.feedback * waits
        phase = phase + self.dt * rate
        return phase, self.servos(params, phase)

    def cycle_rate(self, params):
        return params.frequency
