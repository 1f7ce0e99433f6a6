# Tests of learn/gymnasium_door.py, learn/stable_baselines_door.py
"""The Gymnasium interface: Gymnasium's own checks of a vector environment, and the information at an episode's end."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
from command import refused

gymnasium = pytest.importorskip("gymnasium")
from nermo_mjx import ParameterError, Setup  # noqa: E402
from nermo_mjx.learn import Environment, Task  # noqa: E402

pytestmark = pytest.mark.extra


@pytest.fixture(scope="module")
def door():
    """One world, in episodes of three control steps."""
    from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

    return NermoVectorEnv(
        Environment(Setup(physics="fast"), worlds=1, task=Task(episode_length=0.03))
    )


@pytest.mark.release
def test_gymnasium_finds_nothing_to_say_and_an_end_is_told_beside_the_next_beginning():
    from gymnasium.utils.env_checker import data_equivalence
    from gymnasium.vector import AutoresetMode

    from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

    env = NermoVectorEnv(
        Environment(Setup(physics="fast"), worlds=2, task=Task(episode_length=0.03))
    )
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
    assert all(
        (last != first).any() for last, first in zip(infos["final_obs"], third[0], strict=True)
    )
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
        self.observation_space, self.action_space = (
            vector.single_observation_space,
            vector.single_action_space,
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        observation, infos = self.vector.reset(seed=seed, options=options)
        self._np_random, self._np_random_seed = self.vector._np_random, self.vector._np_random_seed
        return observation[0], infos

    def step(self, action):
        observation, reward, terminated, truncated, infos = self.vector.step(action[None])
        last = infos["final_obs"][0] if terminated[0] or truncated[0] else observation[0]
        return last, float(reward[0]), bool(terminated[0]), bool(truncated[0]), infos


@pytest.mark.release
@pytest.mark.filterwarnings("error", "ignore:.*Box observation space m.* value is -?infinity")
def test_the_checker_of_gymnasium_passes_a_world(door):
    from gymnasium.utils.env_checker import check_env

    check_env(OneWorld(door), skip_render_check=True)


@pytest.fixture(scope="module")
def three():
    """Three worlds whose starts differ, in episodes of three control steps."""
    from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

    task = Task(
        episode_length=0.03,
        randomize={"start.phase": (0.0, 1.0)},
        observe=("phase", "servo_angle", "action"),
    )
    return NermoVectorEnv(setup=Setup(physics="fast"), worlds=3, task=task)


@pytest.mark.release
def test_each_world_has_its_seed(three):
    """Of a list, a tuple or an array, wherever it stands there, and in all episodes that follow."""

    def episodes(seed):
        rows = [three.reset(seed=seed)[0]]
        rows += [three.step(np.zeros((3, 9), np.float32))[0] for _ in range(4)]
        return np.stack(rows)

    first = episodes([1, 2, 3])
    assert len(np.unique(first[0], axis=0)) == 3
    np.testing.assert_array_equal(first, episodes(np.array([1, 2, 3])))
    np.testing.assert_array_equal(first[:, [1, 0, 2]], episodes((2, 1, 3)))
    permuted = episodes([1, 9, 1])
    np.testing.assert_array_equal(permuted[:, [0, 2]], first[:, [0, 0]])
    assert (permuted[0, 1] != first[0, 1]).any()
    np.testing.assert_array_equal(episodes([1, None, None])[:, 0], first[:, 0])
    assert (episodes(1)[0] != first[0]).any()
    np.testing.assert_array_equal(episodes(1), episodes(np.int64(1)))


@pytest.mark.parametrize("seed", [[], [1], [1, 2], np.arange(4), (1, 2, 3, 4)], ids=str)
def test_another_number_of_seeds_is_refused(three, seed):
    with pytest.raises(
        ParameterError,
        match=rf"seed has {len(seed)} entries: expected one number, or 3, a world each",
    ):
        three.reset(seed=seed)


@pytest.mark.parametrize(
    "seed", [[1, 2.5, 3], [1, -1, 3], "abc", [1, "a", 3], [[1], 2, 3], 1.5], ids=str
)
def test_a_seed_that_is_no_whole_number_is_refused(three, seed):
    with pytest.raises(ParameterError, match="allowed is a whole number from 0 to 2\\^64 - 1"):
        three.reset(seed=seed)


@pytest.mark.release
@pytest.mark.parametrize("beyond", [50.0, -3.0])
def test_an_action_beyond_its_range_is_its_end_in_all_that_follows(three, beyond):
    """In what is observed, in the reward and in the physics."""
    rows = []
    for action in (beyond, np.sign(beyond)):
        three.reset(seed=5)
        rows.append([three.step(np.full((3, 9), action, np.float32))[:2] for _ in range(2)])
    for (observation, reward), (expected, expected_reward) in zip(*rows, strict=True):
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_array_equal(reward, expected_reward)


def test_what_gymnasium_cannot_do_with_it_is_said(three):
    """Copies, and wrappers for another way of beginning episodes."""
    for copied in (pickle.dumps, copy.deepcopy):
        for environment in (three, three.environment):
            with pytest.raises(
                TypeError, match="cannot be pickled or copied: make one from its arguments"
            ):
                copied(environment)
    with pytest.raises(ValueError, match="NEXT_STEP"):
        gymnasium.wrappers.vector.NormalizeObservation(three)
    page = Path(__file__).parents[2] / "docs" / "howto" / "environment.md"
    assert "NormalizeObservation" in page.read_text(encoding="utf-8")


def test_stable_baselines_takes_its_form(door):
    """Its own form of an environment: what a trainer reads at an episode's end."""
    pytest.importorskip("stable_baselines3")
    from nermo_mjx.learn.stable_baselines_door import NermoVecEnv

    env = NermoVecEnv(door.environment)
    env.seed(4)
    first, returned = env.reset(), 0.0
    assert env.action_space.shape == (9,)
    for _ in range(3):
        observation, reward, is_end, infos = env.step(np.zeros((1, 9), np.float32))
        returned += reward[0]
    assert is_end.all()
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["episode"]["r"] == pytest.approx(returned, rel=1e-5)
    assert infos[0]["episode"]["l"] == 3
    assert infos[0]["status"] == "The time of the episode is over."
    assert (infos[0]["terminal_observation"] != observation[0]).any()
    env.seed(4)
    np.testing.assert_array_equal(env.reset(), first)


@pytest.mark.release
def test_seeds_beyond_32_bits_are_others_and_masks_are_refused(three) -> None:
    first, second = (three.reset(seed=seed)[0] for seed in (0, 2**32))
    assert (first != second).any()
    np.testing.assert_array_equal(first, three.reset(seed=np.int64(0))[0])
    for seed in (2**64, -1, 0.5, "1", [], [-1]):
        refused(
            lambda value=seed: three.reset(seed=value), "seed (is .*from 0 to 2.64|has [01] entr)"
        )
    refused(
        lambda: three.reset(options={"reset_mask": np.array([True, False, False])}),
        "options has reset_mask: none are known",
    )
