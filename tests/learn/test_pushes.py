# Tests of learn/task.py, learn/loop.py
"""Pushes in a training: when they come, what they do to the body on both engines, and in the evaluation."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx import ParameterError, Run, Setup, Simulator
from nermo_mjx.learn import PPO, Environment, Policy, Task, Training
from nermo_mjx.learn.evaluation import PolicyEvaluator, played_task
from nermo_mjx.live.driving import Driving
from nermo_mjx.rollout.loop import Pushes

pytestmark = pytest.mark.usefixtures("shared_simulators")
SETUP = Setup(physics="fast")
#: From the same start, once in each 0.3 s.
STILL = Task(set={"push.force": 2.0, "push.interval": 0.3}, randomize={}, episode_length=0.6)
TRAINING = {
    "physics": "fast",
    "run": {"duration": 1.0, "warmup": 0.1},
    "task": {"set": {"push.force": 2.0}},
    "randomize": {"push.interval": [0.3, 0.6]},
    "worlds": 2,
    "algorithm": {"ppo": {"horizon": 4, "hidden": [4]}},
    "evaluate": {"bodies": 4},
}


def test_there_is_one_push_in_each_interval_at_a_random_moment_in_a_random_direction():
    def forces(seed):
        pushes = Pushes(jnp.float32(2.0), jnp.float32(0.3), seed)
        return jax.vmap(lambda tick: pushes.at(tick, 0.01))(jnp.arange(60))

    push_forces = np.asarray(jax.jit(jax.vmap(forces))(jnp.arange(500))).reshape(1000, 30, 2)
    acts = np.linalg.norm(push_forces, axis=-1) > 0
    begin = acts.argmax(axis=1)
    np.testing.assert_array_equal(acts, (np.arange(30) - begin[:, None]) // 10 == 0)
    np.testing.assert_array_equal(np.bincount(begin) > 20, [True] * 21)
    first_forces = push_forces[np.arange(1000), begin]
    np.testing.assert_allclose(np.linalg.norm(first_forces, axis=1), 2.0, rtol=1e-6)
    np.testing.assert_allclose(
        push_forces[acts].reshape(1000, 10, 2), first_forces[:, None].repeat(10, axis=1)
    )
    turns = np.bincount(
        ((np.arctan2(first_forces[:, 1], first_forces[:, 0]) / (2 * np.pi)) % 1 * 8).astype(int)
    )
    assert turns.min() > 90, "of 125 in each eighth of the circle"
    assert abs(np.corrcoef(begin[::2], begin[1::2])[0, 1]) < 0.15, "of one interval and the next"


@pytest.mark.long
@pytest.mark.release
def test_a_push_moves_the_robot_as_the_same_push_does_in_a_drive():
    environment = Environment(SETUP, worlds=2, task=STILL, threads=1)
    state, worlds_of_steps = environment.reset(4), []
    block = environment._worlds.session._blocks[0]
    forces, torso = block.batch.bind("xfrc_applied"), environment.robot.model.body("torso").id
    ticks = jnp.arange(40)
    push_forces = np.asarray(
        jax.jit(jax.vmap(lambda push: jax.vmap(lambda tick: push.at(tick, 0.01))(ticks)))(
            environment._worlds.samples[0][0].loop.push
        )
    )
    drives = [Driving(SETUP), Driving(SETUP)]
    for tick in range(40):
        for world, drive in enumerate(drives):
            now, previous = push_forces[world, [tick, tick - 1]]
            if now.any() and not (tick and (now == previous).all()):
                drive.push(torso, (*now.tolist(), 0.0), 0.1)
                worlds_of_steps.append(world)
            drive.tick()
        state = environment.step(state, np.zeros((2, environment.action_size)))
        assert not np.delete(forces.reshape(2, -1), [6 * torso, 6 * torso + 1], axis=1).any()
    assert {0, 1} == set(worlds_of_steps)
    calm = Driving(SETUP)
    for _ in range(40):
        calm.tick()
    for world, drive in enumerate(drives):
        pushed, unpushed = drive.rows[-1][0], calm.rows[-1][0]
        assert np.linalg.norm(np.ravel(pushed)[:2] - np.ravel(unpushed)[:2]) > 0.003
        np.testing.assert_allclose(block.qpos[world], np.ravel(pushed), atol=1e-4)


@pytest.mark.long
@pytest.mark.release
def test_a_pushed_world_does_not_depend_on_the_others_nor_on_the_number_of_threads():
    """Bit for bit, over the beginning of a second episode, with forces and intervals of its own."""
    ranges = {"push.force": (0.5, 2.0), "push.interval": (0.2, 0.4), "contact.friction": (1.0, 1.6)}
    task = Task(randomize=ranges, episode_length=0.4)

    def walked(environment, seed=3):
        states, worlds = [environment.reset(seed)], environment.worlds
        for step in range(50):
            action = 0.3 * np.sin(np.arange(9) + 0.3 * step)[None].repeat(worlds, 0)
            states.append(environment.step(states[-1], action))
        return np.stack([state.privileged[:3] for state in states])

    small, large = (
        Environment(SETUP, worlds=worlds, task=task, threads=threads)
        for worlds, threads in ((3, 1), (20, 2))
    )
    small_batch = walked(small)
    np.testing.assert_array_equal(small_batch, walked(large))
    np.testing.assert_array_equal(small_batch, walked(small))
    assert (small_batch != walked(small, seed=4)).any()


@pytest.mark.long
@pytest.mark.release
def test_a_push_is_the_same_on_mjx():
    by = {}
    for engine in ("c", "mjx"):
        simulator = Simulator(SETUP, engine=engine)
        batch = simulator.prepare({"start.phase": [0.0, 0.5, 0.0, 0.5]}, Run(duration=0.3))
        real = batch.params.window.begin.dtype
        pushes = Pushes(
            np.array([0.0, 0.0, 3.0, 3.0], real),
            np.full(4, 0.2, real),
            np.array([3, 4, 3, 4], np.int32),
        )
        pushed_batch = dataclasses.replace(
            batch, params=dataclasses.replace(batch.params, push=pushes)
        )
        calm, pushed = (
            simulator.run_batch(pushed_batch, record=True).trace.qpos[:, 29].reshape(2, 2, -1)
        )
        by[engine] = pushed - calm
    assert (np.linalg.norm(by["c"][:, :2], axis=1) > 0.003).all()
    np.testing.assert_allclose(by["mjx"][:, :2], by["c"][:, :2], atol=1e-5)


@pytest.mark.long
@pytest.mark.release
def test_an_evaluation_pushes_policy_and_controller_alike_unless_it_says_otherwise():
    environment = Training.from_dict(TRAINING).environment("c")
    untrained = Policy.of(environment, PPO().begin(environment, 0))

    simulators = {}  # of the same settings in all three evaluations

    def table(**changed):
        evaluator = PolicyEvaluator(Training.from_dict(TRAINING | changed), "c")
        evaluator._simulators = simulators
        return evaluator(untrained).to_pandas()

    pushed, calm = table(), table(evaluate={"bodies": 4, "set": {"push.force": 0.0}})
    never = table(task={}, randomize={})
    # An untrained policy leaves the controller as it is.
    policy, controller_distances = (
        pushed[pushed.controller == controller].distance.to_numpy()
        for controller in ("policy", "alone")
    )
    np.testing.assert_allclose(policy, controller_distances, atol=2e-4)
    assert (np.abs(pushed.distance - never.distance) > 1e-3).all()
    np.testing.assert_allclose(calm.distance, never.distance, atol=1e-5)
    np.testing.assert_array_equal(pushed["push.interval"][:4], pushed["push.interval"][4:])
    assert pushed["push.interval"].between(0.3, 0.6).all()


def test_pushes_out_of_range_and_of_walks_that_are_not_pushed_are_refused():
    for task, message in (
        ({"push.force": 11.0}, "push.force is 11"),
        ({"push.force": 1.0, "push.interval": 0.1}, "push.interval is 0.1"),
        ({"push.speed": 1.0}, "push.speed"),
    ):
        with pytest.raises(ParameterError, match=message):
            Environment(SETUP, worlds=1, task=Task(set=task))
    with pytest.raises(ParameterError, match="a walk that is played is not pushed"):
        played_task(Training.from_dict(TRAINING), "zero", values={"push.force": 1.0})
