# Tests of learn/playground_door.py
"""The MuJoCo Playground interface: found in its registry, stepped under jit, vmap and scan, reset by its wrappers."""

from __future__ import annotations

import subprocess
import sys

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
    env = registry.load(
        "NermoPlanks", config_overrides={"ctrl_dt": 0.02, "reward_config.scales.work": -0.25}
    )
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
    restarted, restarted_rewards = walk(last.replace(data=first.data, obs=first.obs))
    np.testing.assert_allclose(last.data.time, 0.05, rtol=1e-5)
    assert (np.abs(last.data.qpos - first.data.qpos).max(axis=1) > 1e-4).all()
    np.testing.assert_array_equal(rewards, restarted_rewards)
    np.testing.assert_array_equal(last.data.qpos, restarted.data.qpos)
    on, _ = walk(last)
    assert (np.abs(on.data.qpos - restarted.data.qpos).max(axis=1) > 1e-4).all()


STOCK = """
import jax, numpy as np
from mujoco_playground import registry

env = registry.load("AcrobotSwingup", config_overrides={"impl": "jax"})
act = jax.numpy.full(env.action_size, 0.5)
walk = jax.jit(lambda state: jax.lax.scan(lambda each, _: (env.step(each, act), None), state, None, length=20)[0])
after = walk(jax.jit(env.reset)(jax.random.key(0))).data
print(np.asarray(after.qpos).tolist(), after._impl.ncon)
"""
OURS = """
import nermo_mjx.learn.playground_door
from mujoco_playground import registry
registry.load("NermoFlat")
"""


@pytest.mark.release
def test_playgrounds_environments_keep_their_physics_whichever_module_is_imported_first():
    """An acrobot's capsules have seven contacts in MJX, and eight in this package."""
    ran = [
        subprocess.run([sys.executable, "-c", code], text=True, capture_output=True)
        for code in (STOCK, OURS + STOCK)
    ]
    assert [process.returncode for process in ran] == [0, 0], ran[-1].stderr
    assert ran[0].stdout.splitlines()[-1] == ran[1].stdout.splitlines()[-1]
