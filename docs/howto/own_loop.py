"""Evolution strategies in a loop of one's own: a generation is one compiled program on the engine mjx."""

import functools

import jax
import jax.numpy as jnp

from nermo_mjx import Environment, Setup, Task, compiler_options

PAIRS, STEPS, GENERATIONS, SPREAD, RATE = 2, 20, 3, 0.05, 0.02
environment = Environment(
    Setup(physics="fast"), engine="mjx", worlds=2 * PAIRS, task=Task(episode_length=5.0)
)


def returns(weights, key):
    """The return (n,) of a linear policy (n, o, a) in each world."""

    def step(state, _):
        action = jnp.tanh(jnp.einsum("no,noa->na", state.observation, weights))
        state = environment.step(state, action)
        return state, state.reward

    _, rewards = jax.lax.scan(step, environment.reset(key), length=STEPS)
    return rewards.sum(axis=0)


@functools.partial(jax.jit, compiler_options=compiler_options())
def generation(weights, key):
    """Better weights (o, a), and the mean return: a policy and its mirror image differ by the same noise."""
    drawn, start = jax.random.split(key)
    noise = jax.random.normal(drawn, (PAIRS, *weights.shape))
    found = returns(jnp.concatenate([weights + SPREAD * noise, weights - SPREAD * noise]), start)
    plus, minus = jnp.split(found, 2)
    return weights + RATE * jnp.einsum("p,poa->oa", plus - minus, noise) / (
        2 * PAIRS * SPREAD
    ), found.mean()


weights = jnp.zeros((environment.observation_size, environment.action_size))
for number in range(GENERATIONS):
    weights, mean = generation(weights, jax.random.key(number))
    print(f"generation {number}: return {mean:.4f}")
