"""The Gymnasium interface: Gymnasium's own checks of a vector environment, and the information at an episode's end."""

from __future__ import annotations

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
pytestmark = pytest.mark.compiles

from nermo_mjx import Setup  # noqa: E402
from nermo_mjx.learn import Environment, Task  # noqa: E402


@pytest.fixture(scope="module")
def door():
    """One world, in episodes of three control steps."""
    from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

    return NermoVectorEnv(Environment(Setup(physics="fast"), worlds=1, task=Task(duration=0.03)))


def test_gymnasium_finds_nothing_to_say_and_an_end_is_told_beside_the_next_beginning():
    from gymnasium.utils.env_checker import data_equivalence
    from gymnasium.vector import AutoresetMode

    from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

    env = NermoVectorEnv(Environment(Setup(physics="fast"), worlds=2, task=Task(duration=0.03)))
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    runs = []
    for _ in range(2):
        rows = [env.reset(seed=4)]
        env.action_space.seed(0)
        for _ in range(4):
            rows.append(env.step(env.action_space.sample()))
        runs.append([(np.array(row[0]), *row[1:]) for row in rows])
    assert data_equivalence(runs[0], runs[1], exact=True)
    for observation, *_ in runs[0]:
        assert observation in env.observation_space
    third = runs[0][3]
    assert third[3].all()
    infos = third[4]
    np.testing.assert_allclose(infos["final_info"]["duration"], 0.03, rtol=1e-5)
    assert set(infos["final_info"]["status"]) == {"The time of the episode is over."}
    assert all((last != first).any() for last, first in zip(infos["final_obs"], third[0], strict=True))
    assert "final_obs" not in runs[0][4][4]
    # Other episodes follow where no seed is given.
    assert (env.reset()[0] != env.reset()[0]).any()
    statistics = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    statistics.reset(seed=0)
    for _ in range(3):
        infos = statistics.step(np.zeros((2, 9), np.float32))[4]
    np.testing.assert_array_equal(infos["episode"]["l"], [3, 3])


class OneWorld(gymnasium.Env):
    """The only world of a vector environment, which ends where an episode does: what Gymnasium's checker takes."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, vector):
        self.vector, self.render_mode = vector, None
        self.observation_space, self.action_space = vector.single_observation_space, vector.single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        observation, infos = self.vector.reset(seed=seed, options=options)
        self._np_random, self._np_random_seed = self.vector._np_random, self.vector._np_random_seed
        return observation[0], infos

    def step(self, action):
        observation, reward, terminated, truncated, infos = self.vector.step(action[None])
        last = infos["final_obs"][0] if terminated[0] or truncated[0] else observation[0]
        return last, float(reward[0]), bool(terminated[0]), bool(truncated[0]), infos


@pytest.mark.filterwarnings("error", "ignore:.*Box observation space m.* value is -?infinity")
def test_the_checker_of_gymnasium_passes_a_world(door):
    from gymnasium.utils.env_checker import check_env

    check_env(OneWorld(door), skip_render_check=True)


def test_stable_baselines_takes_its_form(door):
    """Its own form of an environment: what a trainer reads at an episode's end."""
    pytest.importorskip("stable_baselines3")
    from nermo_mjx.learn.stable_baselines_door import NermoVecEnv

    env = NermoVecEnv(door.environment)
    env.seed(4)
    first, returned = env.reset(), 0.0
    assert env.action_space.shape == (9,)
    for _ in range(3):
        observation, reward, ended, infos = env.step(np.zeros((1, 9), np.float32))
        returned += reward[0]
    assert ended.all()
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["episode"]["r"] == pytest.approx(returned, rel=1e-5)
    assert infos[0]["episode"]["l"] == 3
    assert infos[0]["status"] == "The time of the episode is over."
    assert (infos[0]["terminal_observation"] != observation[0]).any()
    env.seed(4)
    np.testing.assert_array_equal(env.reset(), first)
