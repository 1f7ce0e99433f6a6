"""The door for trainers of Gymnasium: its own checks of a vector environment, and what an episode's end says."""

from __future__ import annotations

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
pytestmark = pytest.mark.compiles

from nermo_mjx import Setup  # noqa: E402
from nermo_mjx.learn import Environment, Task  # noqa: E402


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
