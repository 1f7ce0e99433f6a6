# Tests of learn/observing.py
"""The ground's heights as an observation: what they are, and that a walk sees what a training saw."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_environment import sensors

from nermo_mjx import ParameterError, Run, Setup, Simulator
from nermo_mjx.learn import PPO, Environment, Policy, Sensed, Task, load_policy
from nermo_mjx.learn import policy as policies
from nermo_mjx.learn.observing import SCAN_POINTS, SENSED_READINGS, height_scan
from nermo_mjx.live.wire import needed_sensors
from nermo_mjx.rollout.loop import ClosedLoop, LoopState

STAIRS = Setup(scene="stairs", physics="fast")
#: Later than a tick, and noisy; on stairs that are not the compiled ones.
TASK = Task(
    observe=("height_scan", "gyro"),
    set={
        "sensing.delay": 0.013,
        "sensing.height_scan_noise": 0.001,
        "terrain.height": 0.012,
        "terrain.spacing": 0.11,
    },
    episode_length=0.3,
)


@pytest.fixture(scope="module")
def trained():
    """A policy whose every observation moves the legs, and the environment that it is of."""
    environment = Environment(STAIRS, worlds=2, task=TASK)
    learned = PPO().begin(environment, 0)
    *hidden, (weights, bias) = learned.actor.layers
    weights = 0.3 * jax.random.normal(jax.random.key(1), weights.shape)
    actor = dataclasses.replace(learned.actor, layers=(*hidden, (weights, bias)))
    return Policy.of(environment, dataclasses.replace(learned, actor=actor)), environment


def fallen_rays(robot, places: np.ndarray) -> np.ndarray:
    """Heights at which rays from above meet the scene, whose robot is far away."""
    data = mujoco.MjData(robot.model)
    data.qpos[:2] = 50.0
    mujoco.mj_forward(robot.model, data)
    geom, down = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0])
    return np.array(
        [
            1.0
            - mujoco.mj_ray(robot.model, data, np.append(position, 1.0), down, None, 1, -1, geom)
            for position in places
        ]
    )


@pytest.mark.release
@pytest.mark.parametrize("scene", ["flat", "stairs", "planks", "rough", "ramp", "spiral_stairs"])
def test_heights_are_those_that_rays_meet_on_a_grid_that_turns_with_the_torso(scene):
    robot, uneven = Setup(scene=scene).load(), False
    for x, y, yaw in ((0.0, -0.1, 0.0), (0.05, -0.33, 0.4), (-0.1, -0.5, -2.0)):
        lying = np.array(
            [np.cos(yaw / 2), 0.1, -0.05, np.sin(yaw / 2)]
        )  # leans, too: the grid stays level
        sensor_readings = sensors(
            position=jnp.array([x, y, 0.3]), orientation=jnp.asarray(lying / np.linalg.norm(lying))
        )
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.asarray(sensor_readings.orientation, float))
        nose = -turn.reshape(3, 3)[:2, 1] / np.linalg.norm(turn.reshape(3, 3)[:2, 1])
        left_direction = np.array([-nose[1], nose[0]])
        met = fallen_rays(
            robot,
            np.array([[x, y], *([x, y] + a * left_direction + b * nose for a, b in SCAN_POINTS)]),
        )
        heights = height_scan(sensor_readings, robot.terrain.height)
        np.testing.assert_allclose(heights, np.clip(met[1:] - met[0], -0.05, 0.05), atol=2e-6)
        uneven |= bool(np.any(np.abs(heights) > 1e-3))
    assert uneven == (scene != "flat")


def observed_by(monkeypatch, loop, params, readings) -> list[np.ndarray]:
    """What a policy observes in a run's loop, tick by tick, not compiled; it does nothing."""
    observations = []

    def note(actor, statistics, observation):
        observations.append(np.asarray(observation))
        return jnp.zeros(9)

    monkeypatch.setattr(policies, "_action", note)
    state: LoopState = loop.init(params, readings[0][-1])
    for reading in readings:
        state, _ = loop.step(params, state, reading)
    return observations


@pytest.mark.long
@pytest.mark.release
def test_a_walk_observes_bit_for_bit_what_a_training_does(trained, monkeypatch):
    """Late and noisy readings of the same ticks, on stairs of a shape of their own."""
    policy, environment = trained
    episode, loop = environment.loop, ClosedLoop(environment.robot, policy)
    params, _, qpos = environment.episodes(jax.random.key(4))
    places = np.stack([np.array(qpos)] * 4)
    places[:, 1] -= [0.0, 0.03, 0.09, 0.17]
    places[:, 3], places[:, 6] = np.cos([0.0, 0.1, 0.2, 0.3]), np.sin([0.0, 0.1, 0.2, 0.3])
    readings = [
        jnp.tile(
            environment.robot.sensordata_at_rest(jnp.asarray(position)), (episode.steps_per_tick, 1)
        )
        for position in places
    ]
    params = dataclasses.replace(params, seed=jnp.zeros((), jnp.int32))  # the noise of a policy
    state, trainings = episode.init(params, readings[0][-1]), []
    for reading in readings:
        trainings.append(np.asarray(episode.observe(params, state, reading).observation))
        state, _ = episode.step(params, state, reading)
    values = {name: value for name, value in TASK.set.items() if name.startswith("sensing")}
    loop_params = dataclasses.replace(params.loop, control=policy.parameters)
    walks = observed_by(monkeypatch, loop, loop_params, readings)
    assert policy.fixed == values
    assert [observation.astype(np.float32).tobytes() for observation in walks] == [
        observation.tobytes() for observation in trainings
    ]
    heights = np.stack(trainings)[:, : len(SCAN_POINTS)]
    assert np.ptp(heights, axis=0).max() > 0.5
    flat = observed_by(
        monkeypatch, ClosedLoop(Setup(physics="fast").load(), policy), loop_params, readings[-1:]
    )
    assert np.abs(np.stack(flat)[:, : len(SCAN_POINTS)]).max() < 0.6, "no more than noise"


@pytest.mark.long
@pytest.mark.release
def test_a_policy_that_sees_the_stairs_walks_in_a_simulator_as_in_its_environment(
    trained, tmp_path
):
    """From its file, without noise; a flat floor is another walk, so heights count."""
    world_values = {"terrain.height": 0.012, "start.yaw": 0.05}
    task = dataclasses.replace(
        TASK, set=world_values, randomize={"contact.friction": (1.0, 1.2)}, decimation=2
    )
    environment = Environment(STAIRS, worlds=2, task=task)
    loaded_policy = dataclasses.replace(
        trained[0], observer=environment.loop.observer, decimation=2, fixed={}
    )
    (tmp_path / "policy.npz").write_bytes(loaded_policy.content())
    policy = load_policy(tmp_path / "policy.npz")
    assert policy.observer.names[:2] == ("height_scan_-100_40", "height_scan_-100_0")
    state = environment.reset(3)
    world_values = world_values | {
        "contact.friction": 1.1 + 0.1 * np.asarray(state.privileged)[:, -1]
    }
    while not np.asarray(state.truncated).any():
        state = environment.step(state, np.asarray(policy.act(state.observation)))
    simulator, run = Simulator(STAIRS, engine="c", controller=policy), Run(duration=0.3, warmup=0.0)
    walked = simulator(world_values, run)
    np.testing.assert_allclose(walked["servo_work"], state.episode["servo_work"], rtol=1e-4)
    level = simulator(world_values | {"terrain.height": 0.0}, run)
    assert np.abs(level["servo_work"] / walked["servo_work"] - 1.0).min() > 1e-3
    assert {"position", "orientation"} <= needed_sensors(
        dataclasses.replace(STAIRS, controller=policy)
    )


@pytest.mark.release
def test_a_critic_sees_what_the_policy_may(trained):
    _, environment = trained
    state = environment.reset(0)
    exact = [
        environment.privileged_names.index(f"exact.{name}")
        for name in environment.observation_names[:12]
    ]
    ground = [
        i for i, name in enumerate(environment.privileged_names) if name.startswith("height_scan_")
    ]
    np.testing.assert_allclose(state.privileged[:, exact], state.privileged[:, ground], atol=1e-5)


def nearest_step(sensors, ground):
    """Height 50 mm ahead, less 50 mm behind."""
    x, y, _ = sensors.position
    return ground(x, y - 0.05) - ground(x, y + 0.05)


@pytest.mark.release
def test_own_points_of_the_ground_can_be_observed_and_a_loop_without_ground_says_so():
    term = Sensed(nearest_step, 0.01, ground=True)
    environment = Environment(STAIRS, worlds=1, task=Task(observe=(term,)))
    assert environment.observation_names == ("nearest_step",)
    policy = Policy.of(environment, PPO().begin(environment, 0))
    with pytest.raises(
        ParameterError,
        match=r"observes nearest_step, and nothing tells it the ground's height: give",
    ):
        policy.init(policy.parameters, sensors(), jnp.zeros(()))
    with pytest.raises(
        ParameterError, match=r"observe has nearest_step .*fails.*TypeError.*missing.*'ground'"
    ):
        Environment(STAIRS, worlds=1, task=Task(observe=(Sensed(nearest_step),)))
    with pytest.raises(ParameterError, match=r"observe has 'heightscan': allowed is .*height_scan"):
        Environment(STAIRS, worlds=1, task=Task(observe=("heightscan",)))


@pytest.mark.release
def test_a_diverged_world_observes_no_nan(trained):
    """Its readings are zero, which is a place on the ground."""
    _, environment = trained
    data = jnp.full((environment.loop.steps_per_tick, environment.robot.model.nsensordata), jnp.nan)
    params, _, qpos = environment.episodes(jax.random.key(0))
    state = environment.loop.init(params, environment.robot.sensordata_at_rest(qpos))
    info = environment.loop.observe(params, state, data)
    assert np.isfinite(info.observation).all()
    assert np.isfinite(info.privileged).all()
    assert SENSED_READINGS["height_scan"].scale == 0.01
