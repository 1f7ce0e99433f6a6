# Tests of learn/environment.py, learn/acting.py, learn/observing.py
"""The environment to learn in: against runs of the published controller, against itself in other batches, and MJX."""

from __future__ import annotations

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx import ParameterError, Run, Setup, Simulator
from nermo_mjx.control import published_controller
from nermo_mjx.control.parameters import Pilot
from nermo_mjx.control.path import arc
from nermo_mjx.control.protocol import leg_servos
from nermo_mjx.learn import (
    SENTENCES,
    Environment,
    Modulation,
    Outcome,
    Residual,
    Targets,
    Task,
    Term,
)
from nermo_mjx.learn.acting import ActionController, ActionParameters
from nermo_mjx.learn.observing import SENSED_READINGS, InternalInputs, Observer, Sensing
from nermo_mjx.learn.task import Episodes, select_terms
from nermo_mjx.robot import Sensors
from nermo_mjx.robot.geometry import Geometry

SETUP = Setup(physics="fast")
RANDOMIZED = {"frequency": (0.6, 1.0), "contact.friction": (1.0, 1.6), "mass.front": (0.15, 0.19)}
#: Short episodes, so that worlds start new ones in a test; a custom term.
HEIGHT = Term("height", "m", "of the IMU", lambda m: m.sensors.position[2])
TASK = Task(
    rewards={"progress": 2.0, "work": -1.0, "failed": -1.0, HEIGHT: 0.5},
    randomize=RANDOMIZED,
    episode_length=0.2,
)
STEPS = 30


def actions(step: int, n: int) -> np.ndarray:
    return 0.3 * np.sin(np.arange(9) + 0.3 * step)[None].repeat(n, 0)


def walked(environment: Environment) -> list:
    states = [environment.reset(3)]
    for step in range(STEPS):
        states.append(environment.step(states[-1], actions(step, environment.worlds)))
    return states


@pytest.fixture(scope="module")
def environment():
    """Three worlds on one processor."""
    return Environment(SETUP, worlds=3, task=TASK, threads=1)


@pytest.fixture(scope="module")
def states(environment):
    """What they see, over the end of an episode."""
    return walked(environment)


def sensors(**fields) -> Sensors:
    zero = {field.name: jnp.zeros(()) for field in dataclasses.fields(Sensors)}
    shapes = {
        "position": 3,
        "linear_velocity": 3,
        "gyro": 3,
        "accelerometer": 3,
        "servo_angle": 10,
        "servo_velocity": 10,
        "servo_torque": 10,
        "knee_angle": 4,
        "foot_force": 4,
        "joint_velocity": 12,
    }
    zero |= {name: jnp.zeros(size) for name, size in shapes.items()} | {
        "orientation": jnp.array([1.0, 0, 0, 0])
    }
    return Sensors(**(zero | fields))


@pytest.mark.long
@pytest.mark.release
def test_without_an_action_the_published_controller_walks(environment):
    """As far, and with as much work, as in a run of it: every world with the frequency, friction and mass drawn."""
    state = environment.reset(5)
    samples = state.privileged[:, -3:]
    for _ in range(20):
        state = environment.step(state, np.zeros((3, 9)))
    middle = np.array([sum(ends) / 2 for ends in RANDOMIZED.values()])
    half = np.array([ends[1] - ends[0] for ends in RANDOMIZED.values()]) / 2
    values = dict(zip(RANDOMIZED, (middle + samples * half).T, strict=True))
    run = Simulator(SETUP, engine="c").run(values, Run(duration=0.2))
    np.testing.assert_allclose(state.episode["distance"], run.metrics["distance"], rtol=1e-3)
    np.testing.assert_allclose(state.episode["servo_work"], run.metrics["servo_work"], rtol=1e-3)
    assert state.truncated.all()
    assert len(set(values["frequency"])) == 3


@pytest.mark.release
def test_a_world_does_not_depend_on_the_others_nor_on_the_number_of_threads(states):
    """Bit for bit, over the beginning of a second episode."""
    for small_batch, many_worlds in zip(
        states, walked(Environment(SETUP, worlds=40, task=TASK, threads=2)), strict=True
    ):
        np.testing.assert_array_equal(small_batch.observation, many_worlds.observation[:3])
        np.testing.assert_array_equal(small_batch.privileged, many_worlds.privileged[:3])
        np.testing.assert_array_equal(small_batch.reward, many_worlds.reward[:3])


@pytest.mark.release
def test_an_episode_is_cut_off_when_its_time_is_over_and_the_next_one_begins(states):
    cut = [step for step, state in enumerate(states) if state.truncated.any()]
    assert cut == [20]
    end = states[20]
    assert [SENTENCES[code] for code in end.status] == [Outcome.timed_out.value] * 3
    assert not end.terminated.any()
    np.testing.assert_allclose(end.episode["duration"], 0.2, rtol=1e-6)
    np.testing.assert_allclose(states[21].episode["duration"], 0.01, rtol=1e-6)
    # The next one has another body and another gait, and has not acted yet.
    assert (end.privileged[:, -3:] != end.final_privileged[:, -3:]).all()
    assert not end.observation[:, -9:].any()
    np.testing.assert_allclose(end.final_observation[:, -9:], actions(19, 3), rtol=1e-6)


def test_episodes_begin_with_a_gait_whose_feet_and_limbs_have_parameters():
    """As every controller's, they are arrays: what neither file nor draw changes were plain numbers, and refused."""
    setup = Setup(physics="fast", trajectory="free", spine="stride_extension+harmonics")
    robot, controller = setup.load(), ActionController(setup.make_controller(), Residual())
    draw = Episodes(
        setup, robot, controller, Task(set={"foot.rear.z3": 0.01, "limb.duty.rear": 0.05})
    )
    parameters, _, qpos = jax.eval_shape(draw, jax.random.key(0))
    assert parameters.loop.control.control.gait.duty.shape == ()
    assert qpos.shape == (robot.model.nq,)


@pytest.mark.release
def test_staggered_worlds_do_not_end_their_episodes_together():
    """The first ends after a share of the duration that differs between worlds, and all later ones last it out."""
    environment = Environment(SETUP, worlds=12, task=TASK, staggered=True)
    state, ends = environment.reset(3), []
    for _ in range(40):
        state = environment.step(state, np.zeros((12, 9)))
        ends.append(state.truncated)
    first = np.argmax(ends, axis=0) + 1
    assert len(set(first)) > 6
    assert 1 <= first.min() < 8 < 14 < first.max() <= 20
    np.testing.assert_array_equal(np.array(ends)[first + 19, np.arange(12)], True)
    np.testing.assert_array_equal(np.sum(ends, axis=0), 2)


@pytest.mark.release
@pytest.mark.parametrize("staggered", [True, False])
def test_mjx_staggers_the_first_episodes_and_no_later_ones(staggered):
    """How long they are to last; steps that wait for their ends would compile physics for a minute."""
    environment = Environment(SETUP, engine="mjx", worlds=12, task=TASK, staggered=staggered)
    whole_episode = round(TASK.episode_length / 0.01)

    @jax.jit
    def lengths():
        """Ticks of the first episodes, and of those that follow, of the same keys."""
        first = environment.reset(3).engine
        return first.params.ticks, jax.vmap(environment._worlds.begin)(first.key).params.ticks

    first, later = map(np.asarray, lengths())
    np.testing.assert_array_equal(later, whole_episode)
    if staggered:
        assert len(set(first)) > 6
        assert 1 <= first.min() < 8 < 14 < first.max() <= whole_episode
    else:
        np.testing.assert_array_equal(first, whole_episode)


@pytest.mark.release
def test_rewards_are_the_weighted_terms_and_terms_sum_to_what_an_episode_measures(states):
    episode = states[1:21]
    for name, measured in (("progress", "distance"), ("work", "servo_work")):
        total = sum(state.terms[name] for state in episode)
        np.testing.assert_allclose(total, episode[-1].episode[measured], rtol=1e-4)
    state = episode[7]
    weighted = 2.0 * state.terms["progress"] - state.terms["work"] + 0.5 * state.terms["height"]
    np.testing.assert_allclose(state.reward, weighted, rtol=1e-5)
    assert (state.terms["height"] > 0.04).all()


@pytest.mark.release
def test_what_falls_ends_its_episode_with_that_sentence_and_stands_up_again(environment):
    """A robot that is laid on its side, between two that walk."""
    height = environment.privileged_names.index("height")
    start = environment.reset(9)
    block = environment._worlds.session._blocks[0]
    block.qpos[1, 3:7] = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]
    state = environment.step(start, np.zeros((3, 9)))
    assert [SENTENCES[code] for code in state.status] == [
        SENTENCES[0],
        "The robot fell.",
        SENTENCES[0],
    ]
    np.testing.assert_array_equal(state.terminated, [False, True, False])
    np.testing.assert_array_equal(state.terms["failed"], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(state.privileged[:, height], start.privileged[:, height], rtol=0.05)
    next_state = environment.step(state, np.zeros((3, 9)))
    assert not next_state.terminated.any()
    np.testing.assert_allclose(next_state.episode["duration"], [0.02, 0.01, 0.02], rtol=1e-5)


def test_a_policy_sees_the_servos_currents():
    """By the data sheet: 8 mA at rest, 0.8 A at the stall torque of 0.157 N m, whichever way it acts."""
    observer = Observer(("motor_current",), (), (), False, False, delayed=0, noisy=False, dt=0.01)
    torque = jnp.zeros(10).at[:3].set(jnp.asarray([0.157, -0.157, 0.0785]))
    currents = (
        observer.readings(sensors(servo_torque=torque)) * SENSED_READINGS["motor_current"].scale
    )
    np.testing.assert_allclose(
        currents, [0.8, 0.8, 0.404, *[0.008] * (len(currents) - 3)], rtol=1e-5
    )
    assert all(name.endswith("_motor_current") for name in observer.names)


def test_readings_come_late_and_with_noise_of_the_given_size():
    """Three ticks late, and a quarter of a tick more: straight between the readings of those two ticks."""
    observer = Observer(
        ("gyro", "action"), (), ("a",), False, False, delayed=4, noisy=False, dt=0.01
    )
    channel_spec = InternalInputs(None, jnp.zeros(0), None, jnp.array([7.0]), Geometry())
    memory = observer.memory(jnp.zeros(3))
    for tick in range(1, 5):
        memory = observer.update_memory(
            memory, observer.readings(sensors(gyro=jnp.full(3, float(tick))))
        )
    observation = observer.observe(
        Sensing(delay=0.0325), memory, sensors(gyro=jnp.full(3, 5.0)), channel_spec, None
    )
    np.testing.assert_allclose(observation, [*[1.75 / 3.0] * 3, 7.0], rtol=1e-6)
    noisy = dataclasses.replace(observer, delayed=0, noisy=True)
    keys = jax.random.split(jax.random.key(0), 2000)
    observations = jax.vmap(
        lambda key: noisy.observe(Sensing(gyro_noise=0.6), memory, sensors(), channel_spec, key)
    )(keys)
    np.testing.assert_allclose(observations[:, :3].std(axis=0), 0.2, rtol=0.05)
    np.testing.assert_array_equal(observations[:, 3], 7.0)


def test_a_policy_can_be_told_how_its_path_bends():
    """Times 0.5 m: 1 on a circle of that radius to the left, and nothing without a path."""
    for side in (1.0, -1.0):
        circle = arc(Pilot(radius=0.5, direction=side), jnp.array([0.1, -0.2, 0.0]))
        channel_spec = InternalInputs(
            phase=None, command=jnp.zeros(0), path=circle, action=jnp.zeros(0), geometry=Geometry()
        )
        observer = Observer(
            ("curvature",), (), (), phase=False, path=True, delayed=0, noisy=False, dt=0.01
        )
        assert observer.names == ("curvature.path",)
        np.testing.assert_allclose(
            observer.input_values(channel_spec, sensors()), [side], rtol=1e-6
        )
    nowhere = dataclasses.replace(observer, path=False)
    assert nowhere.names == ()
    assert nowhere.input_values(channel_spec._replace(path=None), sensors()).shape == (0,)


@pytest.mark.release
def test_actions_move_servo_targets_or_parameters_by_their_ranges():
    base = published_controller("stride_extension", "open_loop")
    servo, home = (
        leg_servos(jnp.array([[0.0, -0.045]] * 4)),
        leg_servos(jnp.array([[0.01, -0.04]] * 4)),
    )
    action = jnp.array([0.1, 0.2, 0.3, 0.4, -0.5, 0.0, 0.0, 1.0, -1.0])
    commanded_servo = Residual(hip=0.3, knee=0.2, spine=0.1).servo(servo, home, action)
    np.testing.assert_allclose(commanded_servo.hip - servo.hip, [0.03, 0.06, 0.09, 0.12], atol=1e-6)
    np.testing.assert_allclose(commanded_servo.knee - servo.knee, [-0.1, 0.0, 0.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(commanded_servo.spine, -0.1)
    np.testing.assert_allclose(Targets(knee=0.0).servo(servo, home, action[:5]).knee, home.knee)
    ranges = {"frequency": (0.4, 1.67), "pilot.turn_rate": (-1.0, 0.5)}
    action_controller = ActionController(base, Modulation(ranges))
    under = action_controller.kind.parameters(base.parameters, jnp.array([0.5, -1.0]))
    assert float(under.gait.frequency) == pytest.approx(0.67 + 0.5 * (1.67 - 0.67))
    assert float(under.pilot.turn_rate) == -1.0
    # In a batch, as runs ask it.
    batch = ActionParameters(
        jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * 2), base.parameters),
        jnp.array([[0.0, 0], [1, 0]]),
    )
    np.testing.assert_allclose(action_controller.cycle_rate(batch), [0.67, 1.67], rtol=1e-6)


@pytest.mark.release
def test_a_step_refuses_actions_of_another_shape_and_states_that_are_gone(environment):
    old = environment.reset(0)
    with pytest.raises(ParameterError, match=r"expected \(3, 9\)"):
        environment.step(old, np.zeros((3, 8)))
    with pytest.raises(ParameterError, match="not finite"):
        environment.step(old, np.full((3, 9), np.nan))
    environment.step(old, np.zeros((3, 9)))
    with pytest.raises(ParameterError, match="not the newest one"):
        environment.step(old, np.zeros((3, 9)))


@pytest.mark.release
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            lambda m: m.sensors.servo_velocity,
            r"has own \(test_environment.py:\d+\), which gives an array of shape \(\d+,\): expected one number",
        ),
        (
            lambda m: m.sensors.servo_speed[8],
            r"own \(test_environment.py:\d+\), which fails at .*: AttributeError.* Sensors are position",
        ),
        (
            lambda m: 1.0 if m.speed > 0.1 else 0.0,
            r"own \(.*\), which fails at .*: it cannot be compiled",
        ),
        (lambda m: None, r"own \(.*\), which gives NoneType: expected one number"),
    ],
)
def test_a_term_that_gives_no_number_is_refused_before_anything_runs(value, message):
    """An array of ten would make the reward one, in silence."""
    with pytest.raises(ParameterError, match=message):
        Environment(
            SETUP, worlds=1, task=Task(rewards={Term("own", "1", "a mistake", value): 1.0})
        ).reset(0)


def test_headway_saturates_so_that_being_stuck_costs_more_than_haste_earns():
    """Of a second: nothing at rest, nearly all of it at 0.15 m/s, and a loss of the same size backward."""
    (term,) = select_terms({"headway": 1.0}, ())
    standstill, slow, fast, back = (
        float(term.value(types.SimpleNamespace(seconds=1.0, speed=speed)))
        for speed in (0.0, 0.05, 0.15, -0.05)
    )
    assert (standstill, back) == (0.0, -slow)
    np.testing.assert_allclose(
        [slow, fast], [0.76159, 0.99505], atol=1e-4
    )  # tanh(1) and tanh(3), from tables


@pytest.mark.long
def test_mjx_gives_what_c_gives_and_its_rewards_have_derivatives():
    """From equal starts, within what float32 leaves; and a derivative that is the quotient of differences."""
    task = dataclasses.replace(TASK, randomize={"start.phase": (0.3, 0.3001)}, episode_length=0.2)
    ours, theirs = (
        Environment(SETUP, engine=engine, worlds=2, task=task) for engine in ("c", "mjx")
    )
    a, b = ours.reset(0), jax.jit(theirs.reset)(0)
    step = jax.jit(theirs.step)
    for i in range(15):
        a, b = ours.step(a, actions(i, 2)), step(b, actions(i, 2))
    np.testing.assert_allclose(a.observation, b.observation, atol=2e-2)
    np.testing.assert_allclose(a.episode["distance"], b.episode["distance"], atol=1e-4)
    # The solver's verdict, of the episode.
    np.testing.assert_array_equal(b.episode["unsolved"], 0)
    modified = b.engine._replace(carry=b.engine.carry._replace(unsolved=jnp.array([7, 0])))
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(theirs._worlds.observe))(modified).episode["unsolved"], [7, 0]
    )

    with jax.enable_x64(True):
        theirs = Environment(SETUP, engine="mjx", worlds=1, task=task)
        start = theirs.reset(0)
        direction = jnp.asarray(actions(0, 1), float)

        def total(size):
            def go(state, _):
                state = theirs.step(state, size * direction)
                return state, state.reward[0]

            return jax.lax.scan(go, start, None, length=4)[1].sum()

        value, slope = jax.jit(jax.value_and_grad(total))(0.1)
        totals = jax.jit(jax.vmap(total))(jnp.array([0.1 - 1e-4, 0.1 + 1e-4]))
        assert jnp.isfinite(value)
        assert float(slope) == pytest.approx(float(totals[1] - totals[0]) / 2e-4, rel=1e-3)
