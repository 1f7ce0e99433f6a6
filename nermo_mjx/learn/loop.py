"""The loop of one world under a policy, between ticks of physics: the run loop, and the reward of a control step.

A control step is `Task.decimation` ticks of the run loop under one action. Each tick is measured once: `observe`
reads the tick that has just ended without accumulating it, and the following `step` accumulates it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.controller import with_dtypes_of
from nermo_mjx.control.protocol import Ground
from nermo_mjx.learn import observing
from nermo_mjx.learn.acting import ActionController
from nermo_mjx.learn.observing import Observer
from nermo_mjx.learn.own import custom_readings, custom_terminations, is_custom
from nermo_mjx.learn.task import TERMS, EpisodeParameters, Moment, Outcome, Task, Term, select_terms
from nermo_mjx.robot import ParameterError, Robot, Sensors
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.rollout import metrics
from nermo_mjx.rollout.custom_metrics import at_rest, numbers_at_rest
from nermo_mjx.rollout.loop import ClosedLoop, LoopState
from nermo_mjx.rollout.metrics import MetricState
from nermo_mjx.shapes import Array, Count, Scalar, Truth


class StepResult(NamedTuple):
    """The result of a control step in one world.

    Attributes:
        observation, privileged: Input of the policy (o,), and additional input of a critic (p,).
        reward: Reward of the step.
        terms: Value of each term of the reward in its unit, by name.
        terminated, truncated: Whether the episode failed, and whether it was cut off.
        status: Index of the member of `Outcome`.
        episode: Totals of the episode so far: `distance` [m], `duration` [s], `servo_work` [J], and `unsolved`, see
            `State`.
    """

    observation: Float[Array, " o"]
    privileged: Float[Array, " p"]
    reward: Scalar
    terms: dict[str, Scalar]
    terminated: Truth
    truncated: Truth
    status: Count
    episode: dict[str, Scalar]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EpisodeState:
    """The state of one world between two ticks.

    Attributes:
        loop: State of the run loop.
        before: Metrics at the start of the control step.
        speed: Speed, smoothed over a gait cycle [m/s].
        memory: Readings of the last ticks, newest first.
        action, last_action: Actions of this control step and of the previous one, in [-1, 1].
    """

    loop: LoopState
    before: MetricState
    speed: Scalar
    memory: Float[Array, "ticks k"]
    action: Float[Array, " a"]
    last_action: Float[Array, " a"]


class EpisodeLoop:
    """The run loop of a robot under a task, a `physics.engine.DrivenLoop`."""

    def __init__(
        self, robot: Robot, controller: ActionController, task: Task, sampled_names: tuple[str, ...]
    ) -> None:
        """
        Args:
            robot, controller: Robot, and its controller under the actions.
            task: Observations, rewards and ends of episodes.
            sampled_names: Names of the parameters that differ between episodes.

        Raises:
            ParameterError: A group of observations or a term of the reward does not exist, or `corridor` is given and
                the controller does not follow a path.
        """
        self.robot, self.task, self.controller = robot, task, controller
        self.run = ClosedLoop(robot, controller)
        self.dt = controller.dt
        self.terms: dict[Term, float] = select_terms(task.rewards, task.commanded)
        self.terminations = custom_terminations(robot.config, task.terminations)
        for name in task.sampled:
            if name in {*task.set, *task.randomize}:
                raise ParameterError(
                    f"commands draws {name}, which stands under set or randomize: leave one out."
                )

        def first(data: Array) -> tuple[Any, Any]:
            """The phase of the gait and the point of the path; None if the controller does not have it."""
            params, sensors = controller.parameters, robot.sensors(data)
            state = controller.init(params, sensors, jnp.zeros(()))
            return getattr(state.control, "phase", None), controller.path(
                params, state, sensors.position
            )

        data = jax.ShapeDtypeStruct((robot.model.nsensordata,), jnp.zeros(()).dtype)
        self.has_phase, self.has_path = (form is not None for form in jax.eval_shape(first, data))
        if task.corridor is not None and not self.has_path:
            raise ParameterError("corridor is given, and the pilot follows no path: leave it out.")
        names = {*task.set, *task.randomize, *task.sampled}
        _, delay = task.randomize.get(
            "sensing.delay", (0.0, float(task.set.get("sensing.delay", 0.0)))
        )
        self.observer = Observer(
            groups=tuple(group for group in task.observe if not is_custom(group)),
            commands=task.commanded,
            actions=controller.kind.names,
            phase=self.has_phase,
            path=self.has_path,
            delayed=math.ceil(delay / self.dt - 1e-6),
            noisy=any(name.startswith("sensing.") and name.endswith("_noise") for name in names),
            dt=self.dt,
            custom_groups=tuple(custom_readings(robot.config, task.observe).items()),
        )
        for term in self.terms:
            if term not in TERMS.values():
                numbers_at_rest(term.subject, term.of, self._moment_at_rest())
        self.observation_names = self.observer.names
        self.privileged_names = observing.privileged_names(
            self.observer.names, sampled_names, self.has_path
        )

    @property
    def steps_per_tick(self) -> int:
        return self.run.steps_per_tick

    def input(self, params: EpisodeParameters) -> Float[Array, " a"]:
        """The action; see `DrivenLoop`."""
        return params.loop.control.action

    def with_input(
        self, params: EpisodeParameters, action: Float[Array, " a"]
    ) -> EpisodeParameters:
        """The parameters with another action."""
        control = dataclasses.replace(params.loop.control, action=action)
        return dataclasses.replace(params, loop=dataclasses.replace(params.loop, control=control))

    def init(self, params: EpisodeParameters, sensordata: Float[Array, " n"]) -> EpisodeState:
        loop = self.run.init(params.loop, sensordata)
        sensors = self.robot.sensors(jnp.where(jnp.isfinite(sensordata), sensordata, 0.0))
        nothing = jnp.zeros_like(self.input(params))
        memory = self.observer.memory(self.observer.readings(sensors, self._ground(params)))
        return EpisodeState(loop, loop.metrics, jnp.zeros(()), memory, nothing, nothing)

    def step(
        self, params: EpisodeParameters, state: EpisodeState, sensordata: Float[Array, "steps n"]
    ) -> tuple[EpisodeState, Float[Array, " n_servos"]]:
        begins = state.loop.tick % self.task.decimation == 0
        speed = self._speed(params, state, self.run.measure(params.loop, state.loop, sensordata))
        loop, ctrl = self.run.step(params.loop, state.loop, sensordata)
        sensors = self.run.last_reading(loop.metrics, sensordata)
        first = {
            "before": loop.metrics,
            "action": jnp.clip(self.input(params), -1.0, 1.0),
            "last_action": state.action,
        }
        current = {name: getattr(state, name) for name in first}
        fields = jax.tree.map(functools.partial(jnp.where, begins), first, current)
        memory = self.observer.update_memory(
            state.memory, self.observer.readings(sensors, self._ground(params))
        )
        following = EpisodeState(loop=loop, speed=speed, memory=memory, **fields)
        return with_dtypes_of(state, following), ctrl

    def observe(
        self, params: EpisodeParameters, state: EpisodeState, sensordata: Float[Array, "steps n"]
    ) -> StepResult:
        """The result of the control step that has just ended, or of the start of an episode; see `DrivenLoop.observe`."""
        now = self.run.measure(params.loop, state.loop, sensordata)
        speed = self._speed(params, state, now)
        sensors = self.run.last_reading(now, sensordata)
        status, failed = self._status(params, state, now, sensors)
        moment = Moment(
            before=state.before,
            now=now,
            sensors=sensors,
            seconds=jnp.asarray(self.dt * self.task.decimation),
            speed=speed,
            command={name: getattr(params.inputs.command, name) for name in self.task.commanded},
            action=state.action,
            last_action=state.last_action,
            failed=failed,
            arrived=status == _code(Outcome.arrived),
        )
        reward, values = self._reward(moment, state.loop.tick > 0)
        control, geometry = params.loop.control, geometry_of(params.loop.control.control)
        path = self.controller.path(control, state.loop.control, sensors.position)
        inputs = self.observer.collect_inputs(
            params.inputs.command, state.loop.control.control, path, state.action, geometry
        )
        key = (
            jax.random.fold_in(jax.random.key(params.seed), state.loop.tick)
            if self.observer.noisy
            else None
        )
        ground = self._ground(params)
        observation = self.observer.observe(
            params.inputs.sensing, state.memory, sensors, inputs, key, ground
        )
        exact = jnp.concatenate(
            [self.observer.readings(sensors, ground), self.observer.input_values(inputs, sensors)]
        )
        remaining = (params.ticks - state.loop.tick) / self.task.ticks(self.dt)
        privileged_values = observing.privileged(
            exact, sensors, ground, now.readings[2], remaining, params.sample, self.has_path
        )
        cut = (status == _code(Outcome.timed_out)) | (status == _code(Outcome.arrived))
        return StepResult(
            observation=observation.astype(jnp.float32),
            privileged=privileged_values.astype(jnp.float32),
            reward=reward,
            terms=values,
            terminated=failed,
            truncated=cut,
            status=status,
            episode={
                "distance": now.travelled,
                "duration": state.loop.time,
                "servo_work": now.sums["work"],
                "unsolved": jnp.zeros(()),  # the engine replaces this value
            },
        )

    def _reward(self, moment: Moment, begun: Truth) -> tuple[Scalar, dict[str, Scalar]]:
        """The reward of a control step, and the values of its terms; zero before the first step."""
        values = {term.name: jnp.where(begun, term.of(moment), 0.0) for term in self.terms}
        # A world that diverged has no finite values; it is restarted.
        values = {
            name: jnp.where(moment.now.lost & (name != "failed"), 0.0, value)
            for name, value in values.items()
        }
        weighted = (weight * values[term.name] for term, weight in self.terms.items())
        return sum(weighted, jnp.zeros(())), values

    def _ground(self, params: EpisodeParameters) -> Ground:
        return functools.partial(self.robot.terrain.height, shape=params.loop.terrain)

    def _moment_at_rest(self) -> Moment:
        """The control step of a robot that has not moved."""
        sensors, zero = at_rest(self.robot.config), jnp.zeros(())
        with jax.ensure_compile_time_eval():
            still, no = metrics.init(sensors), jnp.zeros((), bool)
        action = jnp.zeros(len(self.controller.kind.names))
        command = dict.fromkeys(self.task.commanded, zero)
        step = jnp.asarray(self.dt * self.task.decimation)
        return Moment(still, still, sensors, step, zero, command, action, action, no, no)

    def _status(
        self, params: EpisodeParameters, state: EpisodeState, now: MetricState, sensors: Sensors
    ) -> tuple[Count, Truth]:
        """Index of the episode's outcome, and whether the episode failed."""
        task, no = self.task, jnp.zeros((), bool)
        ended = functools.reduce(
            jnp.logical_or, (ends(sensors) for ends in self.terminations.values()), no
        )
        ended = ended & (state.loop.tick > 0)
        left = no if task.corridor is None else jnp.abs(now.readings[3]) > task.corridor
        flags = {
            Outcome.diverged: now.lost,
            Outcome.fell: now.fell,
            Outcome.left: left,
            Outcome.terminated: ended,
            Outcome.arrived: no if task.distance is None else now.travelled >= task.distance,
            Outcome.timed_out: state.loop.tick >= params.ticks,
        }
        codes = [jnp.asarray(_code(outcome), jnp.int32) for outcome in flags]
        status = jnp.select(
            list(flags.values()), codes, jnp.asarray(_code(Outcome.walking), jnp.int32)
        )
        return status, now.lost | now.fell | left | ended

    def _speed(self, params: EpisodeParameters, state: EpisodeState, now: MetricState) -> Scalar:
        """The smoothed speed after the tick that has just ended."""
        share = jnp.clip(self.dt * self.controller.cycle_rate(params.loop.control), 0.0, 1.0)
        walked = (now.travelled - state.loop.metrics.travelled) / self.dt
        return jnp.where(state.loop.tick > 0, state.speed + share * (walked - state.speed), 0.0)


def _code(outcome: Outcome) -> int:
    return list(Outcome).index(outcome)
