"""The robot as an environment for learning: `reset(key)` and `step(state, action)` over a batch of worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.control import Controller
from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.learn.acting import ACTIONS, ActionController
from nermo_mjx.learn.loop import EpisodeLoop, StepResult
from nermo_mjx.learn.task import Episodes, Outcome, Task
from nermo_mjx.physics import Variation, resolve_engine
from nermo_mjx.physics.c_engine import CDriven, CEngine, Threads
from nermo_mjx.physics.lanes import Lanes
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.loop import check_controller
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.runtime import thread_count
from nermo_mjx.shapes import Array, Truth

#: The sentences of `State.status`, by code.
SENTENCES: Final = tuple(outcome.value for outcome in Outcome)


class State(NamedTuple):
    """A batch of n worlds after a control step. Worlds whose episode ended have begun the next one.

    Attributes:
        observation: Observation of the policy (n, o); if an episode ended, the first one of the new episode.
        privileged: Additional input of a critic (n, p).
        reward: Reward of the step (n,).
        terms: Unweighted value of each term of the reward (n,) in its unit, by name.
        terminated: Whether the episode failed (n,) bool.
        truncated: Whether the episode was cut off, because its time is over or its distance walked (n,) bool.
        status: Status of the episode after the step, an index into `SENTENCES` (n,) int.
        final_observation, final_privileged: Observation and privileged input after the step, before new episodes began.
        episode: `distance` [m], `duration` [s] and `servo_work` [J] of the episode that contains the step (n,), and
            `unsolved`, the number of steps whose constraint solver did not converge; always 0 on `c`, which does not
            report it.
        engine: State of the engine.
    """

    observation: Array
    privileged: Array
    reward: Array
    terms: dict[str, Array]
    terminated: Array
    truncated: Array
    status: Array
    final_observation: Array
    final_privileged: Array
    episode: dict[str, Array]
    engine: Any


def _state(observed: StepResult, observation: Any, privileged: Any, engine: Any) -> State:
    """The state after a control step, with observations and privileged inputs of the new episodes."""
    final = {
        "final_observation": observed.observation,
        "final_privileged": observed.privileged,
        "engine": engine,
    }
    now = {**observed._asdict(), "observation": observation, "privileged": privileged}
    return State(**now, **final)


class CWorlds:
    """Worlds of MuJoCo's C engine. The k-th episode of a world depends only on the key, the world and k."""

    def __init__(
        self, loop: EpisodeLoop, episodes: Episodes, worlds: int, staggered: bool, threads: Threads
    ) -> None:
        self.loop, self.episodes, self.worlds = loop, episodes, worlds
        self.engine = CEngine(loop.robot, loop, threads)
        self.variation = Variation(loop.robot)
        self.session: CDriven | None = None
        self.samples: dict[int, tuple[Any, dict[str, np.ndarray], np.ndarray]] = {}
        self.newest: object = None

        def sample_episode(key: Array, world: Array, episode: Array, steps: Array) -> Any:
            world_key = jax.random.fold_in(
                jax.random.fold_in(jax.random.wrap_key_data(key), world), episode
            )
            return episodes(world_key, staggered & (episode == 0), steps)

        self.sample_episode = Lanes(sample_episode)

    def reset(self, key: np.ndarray, steps: float) -> State:
        n, self.steps = self.worlds, steps
        self.key, self.count, self.samples = np.asarray(key), np.zeros(n, int), {}
        params, fields, qpos = self._episode(0, np.arange(n))
        self.session = CDriven(self.engine, params, qpos, fields)
        observed, self.newest = self.session.observe(), object()
        return _state(observed, observed.observation, observed.privileged, self.newest)

    def step(self, state: State, action: Any) -> State:
        if self.session is None or state.engine is not self.newest:
            raise ParameterError(
                "state is not the newest one of this environment: on 'c' worlds cannot go back."
            )
        action = np.asarray(action, np.float32)
        if not np.isfinite(action).all():
            raise ParameterError("action has numbers that are not finite.")
        observed = self.session.drive(action, self.loop.task.decimation)
        ended_worlds = np.flatnonzero(observed.terminated | observed.truncated)
        observation, privileged = observed.observation, observed.privileged
        if len(ended_worlds):
            observation, privileged = observation.copy(), privileged.copy()
            self.count[ended_worlds] += 1
            parts = []
            for k in np.unique(self.count[ended_worlds]):
                worlds = ended_worlds[self.count[ended_worlds] == k]
                parts.append((worlds, self._episode(k, worlds)))
            order = np.argsort(np.concatenate([worlds for worlds, _ in parts]))
            params, fields, qpos = jax.tree.map(
                lambda *leaves: np.concatenate(leaves)[order], *(episode for _, episode in parts)
            )
            first = self.session.restart(ended_worlds, params, qpos, fields)
            observation[ended_worlds], privileged[ended_worlds] = (
                first.observation,
                first.privileged,
            )
        self.newest = object()
        return _state(observed, observation, privileged, self.newest)

    def _episode(self, k: int, worlds: np.ndarray) -> tuple[Any, dict[str, np.ndarray], np.ndarray]:
        """Parameters, model fields and initial positions of the k-th episode of some worlds.

        The episode is sampled for all worlds at once, because this is hardly slower than for one world.
        """
        if k not in self.samples:
            n = self.worlds
            keys = np.broadcast_to(self.key, (n, self.key.shape[-1]))
            places = (
                np.arange(n) if self.key.ndim == 1 else np.zeros(n, int)
            )  # zeros if each world has its own key
            params, model, qpos = self.sample_episode(
                keys, places, np.full(n, k), np.full(n, self.steps)
            )
            fields = self.variation.batch(model, n, self.episodes.changed_names)
            self.samples[k] = params, fields, np.asarray(qpos, float)
            for old in [
                episode for episode in self.samples if episode <= self.count.min() and episode != k
            ]:
                del self.samples[old]
        sampled: tuple[Any, dict[str, np.ndarray], np.ndarray] = jax.tree.map(
            lambda leaf: leaf[worlds], self.samples[k]
        )
        return sampled


class World(NamedTuple):
    """One world of MJX.

    Attributes:
        key: Raw random key of its episode (2,).
        steps: Control steps of the training at the reset.
        params, fields: Parameters of the loop, and the fields of the model that differ between worlds.
        carry: State of the engine.
    """

    key: Array
    steps: Array
    params: Any
    fields: dict[str, Array]
    carry: Any


class MjxWorlds:
    """Worlds of MJX. All methods are pure functions; `begin`, `act` and `observe` are functions of one world."""

    def __init__(self, loop: EpisodeLoop, episodes: Episodes, worlds: int, staggered: bool) -> None:
        from nermo_mjx.physics.mjx_engine import MjxEngine  # MJX takes a second to start

        self.loop, self.episodes, self.worlds, self.staggered = loop, episodes, worlds, staggered
        self.engine = MjxEngine(loop.robot, loop, 1)
        self.variation = Variation(loop.robot)

    @full_precision
    def reset(self, key: Any, steps: Any) -> State:
        keys = (
            key
            if key.ndim == 2
            else jax.random.key_data(jax.random.split(jax.random.wrap_key_data(key), self.worlds))
        )
        world = jax.vmap(functools.partial(self.begin, cut_short=self.staggered, steps=steps))(keys)
        observed = jax.vmap(self.observe)(world)
        return _state(observed, observed.observation, observed.privileged, world)

    @full_precision
    def step(self, state: State, action: Any) -> State:
        world = jax.vmap(self.act)(state.engine, jnp.asarray(action))
        observed = jax.vmap(self.observe)(world)
        is_ended = observed.terminated | observed.truncated

        def next_key(key: Array) -> Array:
            return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), 1))

        def restart_ended() -> World:
            fresh = jax.vmap(self.begin)(jax.vmap(next_key)(world.key), world.steps)
            next_world: World = jax.vmap(select)(is_ended, fresh, world)
            return next_world

        world = jax.lax.cond(is_ended.any(), restart_ended, lambda: world)
        first = jax.vmap(self.observe)(world)
        return _state(observed, first.observation, first.privileged, world)

    @full_precision
    def begin(self, key: Array, steps: Any = 0.0, cut_short: bool = False) -> World:
        """A world at the start of the episode of a random key, see `Episodes`."""
        params, model, qpos = self.episodes(jax.random.wrap_key_data(key), cut_short, steps)
        fields = self.variation.differentiable(model, self.episodes.changed_names)
        at_rest = self.loop.robot.sensordata_at_rest(qpos)
        carry = self.engine.start(
            params, qpos, jnp.zeros((self.engine.model.nv,), qpos.dtype), at_rest
        )
        return World(
            key, jnp.asarray(steps, float), params, fields, self.engine.playing(carry, fields)
        )

    @full_precision
    def act(self, world: World, action: Array) -> World:
        """A world after a control step under an action (a,)."""
        params = self.loop.with_input(world.params, action.astype(world.params.sample.dtype))

        def tick(carry: Any, _: None) -> tuple[Any, None]:
            return self.engine.tick(params, world.fields, carry, record=True)[0], None

        carry, _ = jax.lax.scan(tick, world.carry, None, length=self.loop.task.decimation)
        return world._replace(params=params, carry=carry)

    def observe(self, world: World) -> StepResult:
        """The result of the last control step of a world."""
        observed = self.loop.observe(world.params, world.carry.loop, world.carry.sensordata)
        unsolved = world.carry.unsolved.astype(observed.episode["unsolved"].dtype)
        return observed._replace(episode={**observed.episode, "unsolved": unsolved})


def select(choice: Truth, if_true: Any, if_false: Any) -> Any:
    """One of two pytrees with the same structure."""
    return jax.tree.map(functools.partial(jnp.where, choice), if_true, if_false)


class Environment:
    """A batch of worlds in which a policy drives the robot.

    >>> environment = Environment(worlds=2, task=Task(episode_length=0.05))
    >>> state = environment.reset(0)
    >>> state = environment.step(state, np.zeros((2, environment.action_size)))
    >>> state.observation.shape == (2, environment.observation_size), environment.step_seconds
    (True, 0.01)

    On the engine `mjx`, `reset` and `step` are pure functions of arrays, for `jax.jit`, `jax.vmap`, `jax.lax.scan` and
    `jax.grad`, with the derivatives of `dynamics.step`. On `c` they run on the processors of this machine, the arrays
    of the state are NumPy arrays, and only the latest state can be stepped. Equal keys and actions give equal numbers,
    on `c` bit for bit, whatever the number of threads.

    Attributes:
        setup, engine, worlds, task, seed: Arguments of the environment.
        pure: Whether `reset` and `step` are pure functions, which can be traced.
        observation_names, privileged_names, action_names: Labels of the values that a policy observes, such as
            `gyro_x`, of the additional values that a critic receives, and of the values of an action.
        observation_size, privileged_size, action_size: Numbers of these values, o, p and a.
        step_seconds: Simulated seconds of a control step.
    """

    def __init__(
        self,
        setup: Setup | None = None,
        *,
        engine: str = "c",
        worlds: int = 128,
        task: Task | None = None,
        seed: int = 0,
        staggered: bool = False,
        threads: Threads = None,
    ) -> None:
        """
        Args:
            setup: Robot, scene, gait, pilot, physics and other choices by name.
            engine: `c`, `mjx`, or `auto`.
            worlds: Number of worlds n.
            task: Task of the policy.
            seed: Seed of `reset()` without a key.
            staggered: Whether the first episode of each world ends after a random share of the task's length, so that
                the episodes of all worlds do not end together.
            threads: Processors that `c` uses, or a pool that several environments share; None for
                `$NERMO_MJX_THREADS`, or all of them.

        Raises:
            ParameterError: The engine is unknown or cannot be driven, there is no world, or the task does not fit.
        """
        name = resolve_engine(engine)
        if name not in ("c", "mjx"):
            raise ParameterError(f"engine is {engine!r}: an environment runs on c or mjx.")
        if not (isinstance(worlds, int) and worlds >= 1):
            raise ParameterError(f"worlds is {worlds!r}: allowed is a whole number from 1 on.")
        self.setup = setup or Setup()
        self.task = task or Task()
        self.worlds = worlds
        self.seed = seed
        self.task.check(self.setup)
        self.robot = self.setup.load()
        self.controller = ActionController(self.setup.make_controller(), self.task.action)
        if not (
            isinstance(self.controller.base, Controller)
            and type(self.task.action) in ACTIONS.values()
        ):
            check_controller(
                self.robot, self.controller
            )  # tests check the controllers and actions of the package
        self.episodes = Episodes(self.setup, self.robot, self.controller, self.task)
        self.loop = EpisodeLoop(self.robot, self.controller, self.task, self.episodes.sampled_names)
        self.engine = name
        shared = self.loop, self.episodes, worlds, staggered
        self._worlds: Any = CWorlds(*shared, threads) if name == "c" else MjxWorlds(*shared)
        self.pure = name == "mjx"
        self.observation_names = self.loop.observation_names
        self.privileged_names = self.loop.privileged_names
        self.action_names = self.task.action.names
        self.observation_size = len(self.observation_names)
        self.privileged_size = len(self.privileged_names)
        self.action_size = len(self.action_names)
        self.step_seconds = self.controller.dt * self.task.decimation

    def reset(self, key: Any = None, steps: Any = 0.0) -> State:
        """Begin an episode in every world.

        Args:
            key: A `jax.random.key`, a raw key (2,), or a whole number; by default the seed of the environment. A list
                contains a whole number for each world; then the episodes of a world depend only on its number, not on
                the index of the world.
            steps: Control steps of a training so far, which the task's `commands` receive until the next reset.
        """
        if isinstance(key, (list, tuple)):
            if len(key) != self.worlds:
                raise ParameterError(
                    f"seed has {len(key)} entries: expected one number, or {self.worlds}, a world each."
                )
            key = jnp.stack([_raw_key(world_key) for world_key in key])
        state: State = self._worlds.reset(_raw_key(self.seed if key is None else key), steps)
        return state

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "an environment holds worlds of MuJoCo and compiled programs, which cannot be pickled or copied: make one "
            "from its arguments in each process."
        )

    def step(self, state: State, action: Any) -> State:
        """Simulate one control step of all worlds.

        Args:
            state: Latest state.
            action: Actions (n, a), clipped to [-1, 1].

        Raises:
            ParameterError: The action has another shape; on `c` also if it is not finite, or if the state is old.
        """
        if np.shape(action) != (self.worlds, self.action_size):
            raise ParameterError(
                f"action has shape {np.shape(action)}: expected {(self.worlds, self.action_size)}, a row per world."
            )
        after: State = self._worlds.step(state, action)
        return after


def _raw_key(key: Any) -> Any:
    """The data of a random key, (2,) uint32."""
    if isinstance(key, (int, np.integer)):
        # `jax.random.key` would cut the number to 32 bits.
        if not 0 <= key < 1 << 64:
            raise ParameterError(f"seed is {key}: allowed is a whole number from 0 to 2^64 - 1.")
        return jnp.asarray([int(key) >> 32, int(key) & 0xFFFFFFFF], jnp.uint32)
    array = jnp.asarray(key)
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(array)
    return (
        array if array.ndim else jax.random.key_data(jax.random.key(array))
    )  # a traced whole number


class Mixture:
    """Worlds of several setups, with the interface of one `Environment`; `State.engine` contains the states of the parts.

    Every part has the same observation and the same action. The critic's input differs: it is the union of the parts'
    inputs, with zeros where a part lacks them, and the index of the part.

    >>> parts = [(Setup(), Task(episode_length=1.0)), (Setup(pilot="arc"), Task(episode_length=1.0))]
    >>> [part.worlds for part in Mixture(parts, worlds=5).parts]
    [3, 2]

    Attributes:
        parts: Environments of the setups; the worlds of the first environment come first.
    """

    def __init__(
        self,
        parts: Sequence[tuple[Setup, Task]],
        *,
        engine: str = "c",
        worlds: int = 256,
        shares: Sequence[float] | None = None,
        staggered: bool = False,
        threads: int | None = None,
    ) -> None:
        """
        Args:
            parts: Setup and task of each environment.
            engine: `c`, `mjx`, or `auto`.
            worlds: Number of worlds of all parts together.
            shares: Relative numbers of worlds of the parts; None for equal numbers.
            staggered: See `Environment`.
            threads: Processors that `c` uses; None for `$NERMO_MJX_THREADS`, or all of them.

        Raises:
            ParameterError: There are fewer worlds than parts, the parts differ in observations, actions or step
                lengths, or `Environment` rejects a part.
        """
        check_worlds(worlds, len(parts))
        counts = divide_worlds(worlds, [1.0] * len(parts) if shares is None else shares)
        # The blocks of all parts share the processors: a single part may have too few worlds for all of them.
        processors = ThreadPoolExecutor(thread_count(threads), thread_name_prefix="nermo_mjx")
        self.parts = tuple(
            Environment(
                setup,
                engine=engine,
                worlds=count,
                task=task,
                staggered=staggered,
                threads=processors,
            )
            for (setup, task), count in zip(parts, counts, strict=True)
        )
        check_alike({str(part.setup.scene): part.loop for part in self.parts})
        self.worlds = worlds
        self._bounds = np.cumsum(counts)[:-1]
        privileged_columns = dict.fromkeys(
            name for part in self.parts for name in part.privileged_names
        )
        self.privileged_names = (
            *privileged_columns,
            *(f"part.{i}" for i in range(len(self.parts))),
        )
        self._columns = [
            np.array([self.privileged_names.index(name) for name in part.privileged_names])
            for part in self.parts
        ]
        first_part = self.parts[0]
        self.pure = first_part.pure
        self.observation_size = first_part.observation_size
        self.action_size = first_part.action_size
        self.step_seconds, self.privileged_size = (
            first_part.step_seconds,
            len(self.privileged_names),
        )
        self._waiting = ThreadPoolExecutor(len(parts), thread_name_prefix="nermo_mjx_part")

    def reset(self, key: Any, steps: Any = 0.0) -> State:
        """Begin an episode in every world; each part has its own random key."""
        key = jax.random.key(key) if isinstance(key, int) else key
        keys = [jax.random.fold_in(key, i) for i in range(len(self.parts))]
        return self.join(
            [part.reset(part_key, steps) for part, part_key in zip(self.parts, keys, strict=True)]
        )

    def step(self, state: State, action: Any) -> State:
        """Simulate one control step of all worlds; see `Environment.step`."""
        part_inputs = zip(self.parts, state.engine, self.split(action), strict=True)
        calls = [
            functools.partial(part.step, engine_state, part_action)
            for part, engine_state, part_action in part_inputs
        ]
        return self.join([call() for call in calls] if self.pure else self.run_in_threads(calls))

    def split(self, values: Any, axis: int = 0) -> list[Any]:
        """Split an array along its axis of all worlds into the arrays of the parts."""
        return (jnp if self.pure else np).split(values, self._bounds, axis)

    def run_in_threads(self, calls: Sequence[Callable[[], Any]]) -> list[Any]:
        """Run one call for each part, each in its own thread, and return the results; the largest part begins."""
        order = sorted(range(len(calls)), key=lambda i: -self.parts[i].worlds)
        started = {i: self._waiting.submit(calls[i]) for i in order}
        return [started[i].result() for i in range(len(calls))]

    def join(self, states: Sequence[State]) -> State:
        """The state of all worlds from the states of the parts."""
        numbers = jnp if self.pure else np
        fields = {
            name: [getattr(state, name) for state in states]
            for name in State._fields
            if name != "engine"
        }
        for name in ("privileged", "final_privileged"):
            fields[name] = [self.widen(i, values) for i, values in enumerate(fields[name])]
        joined_fields = {
            name: jax.tree.map(lambda *leaves: numbers.concatenate(leaves), *values)
            for name, values in fields.items()
        }
        return State(**joined_fields, engine=tuple(states))

    def widen(self, i: int, observation: Any) -> Any:
        """Put the privileged input of part i into the columns of all parts (..., p)."""
        column = len(self.privileged_names) - len(self.parts) + i
        shape = *observation.shape[:-1], self.privileged_size
        if not self.pure:
            extended = np.zeros(shape, np.float32)
            extended[..., self._columns[i]], extended[..., column] = observation, 1.0
            return extended
        return (
            jnp.zeros(shape, jnp.float32)
            .at[..., self._columns[i]]
            .set(observation)
            .at[..., column]
            .set(1.0)
        )


def divide_worlds(worlds: int, shares: Sequence[float]) -> list[int]:
    """Divide worlds among parts in proportion to shares, at least one each; the largest remainders get the last worlds.

    >>> divide_worlds(10, [1.0, 1.0, 2.0])
    [3, 2, 5]
    """
    exact = worlds * np.asarray(shares, float) / np.sum(shares)
    counts = np.maximum(np.floor(exact + 1e-9).astype(int), 1)
    while counts.sum() != worlds:
        remainders = exact - counts
        largest = (
            int(np.argmax(remainders))
            if counts.sum() < worlds
            else int(np.argmin(np.where(counts > 1, remainders, np.inf)))
        )
        counts[largest] += 1 if counts.sum() < worlds else -1
    return counts.tolist()


def check_worlds(worlds: int, parts: int) -> None:
    """Raise `ParameterError` if there are fewer worlds than parts."""
    if worlds < parts:
        raise ParameterError(f"worlds is {worlds}: {parts} scenes need at least one world each.")


def check_alike(loops: Mapping[str, EpisodeLoop]) -> None:
    """Raise `ParameterError` if one policy cannot learn in all of these loops, which are given by the names of scenes."""
    (name, first), *others = loops.items()
    for other_name, loop in others:
        names = set(loop.observation_names) ^ set(first.observation_names)
        is_alike = (loop.observer, loop.controller.kind, loop.dt * loop.task.decimation) == (
            first.observer,
            first.controller.kind,
            first.dt * first.task.decimation,
        )
        if not is_alike:
            differs = f" ({', '.join(sorted(names))})" if names else ""
            raise ParameterError(
                f"scenes has {other_name!r}, where a policy observes or does something else than on {name!r}{differs}: one "
                "policy needs the same on all."
            )
