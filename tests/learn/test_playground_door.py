# Tests of learn/playground_door.py
"""The MuJoCo Playground interface: found in its registry, stepped under jit, vmap and scan, reset by its wrappers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco_playground")

from mujoco_playground import registry

from nermo_mjx import ParameterError
from nermo_mjx.learn import playground_door


def test_the_registry_has_it_with_what_may_be_overridden():
    config = registry.get_default_config("NermoPlanks")
    assert (config.ctrl_dt, config.episode_length, config.impl) == (0.01, 1000, "jax")
    env = registry.load("NermoPlanks", config_overrides={"ctrl_dt": 0.02, "reward_config.scales.work": -0.25})
    task = env.environment.task
    assert (task.decimation, task.episode_length, task.rewards["work"]) == (2, 20.0, -0.25)
    assert env.n_substeps == 6
    assert env.observation_size["state"] == (env.environment.observation_size,)
    for name, value in (("ctrl_dt", 0.015), ("impl", "warp")):
        with pytest.raises(ParameterError, match=name):
            registry.load("NermoFlat", config_overrides={name: value})
    playground_door.register("NermoMine")
    assert registry.load("NermoMine").environment.setup.physics == "reference"


@pytest.mark.long
def test_it_steps_under_jit_vmap_and_scan_and_begins_again_where_its_first_data_are_put_back():
    env = registry.load("NermoFlat", config_overrides={"episode_length": 100})
    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))

    @jax.jit
    def walk(state):
        def step(state, _):
            state = jax.vmap(env.step)(state, jnp.zeros((2, env.action_size)))
            return state, state.reward

        return jax.lax.scan(step, state, None, length=5)

    last, rewards = walk(first)
    again, same = walk(last.replace(data=first.data, obs=first.obs))
    np.testing.assert_allclose(last.data.time, 0.05, rtol=1e-5)
    assert (np.abs(last.data.qpos - first.data.qpos).max(axis=1) > 1e-4).all()
    np.testing.assert_array_equal(rewards, same)
    np.testing.assert_array_equal(last.data.qpos, again.data.qpos)
    on, _ = walk(last)
    assert (np.abs(on.data.qpos - again.data.qpos).max(axis=1) > 1e-4).all()
