"""A task: the actions and observations of a policy, its rewards, the end of an episode, and the sampled parameters.

Terms of the reward have a name, a unit and a meaning, and are summed over a control step. The reward of a step is the
sum of the terms, each times its weight in `Task.rewards`. A term is the increment of a step, for example the distance in
metres, not the speed, so that a return does not depend on the length of a control step.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.control import turning
from nermo_mjx.control.controller import Controller
from nermo_mjx.control.pilot import OpenLoop
from nermo_mjx.control.protocol import OBJECT_FORM, ControllerLike, function_place, user_code
from nermo_mjx.learn.acting import (
    ActionController,
    ActionField,
    ActionKind,
    ActionParameters,
    Residual,
)
from nermo_mjx.learn.observing import (
    DEFAULT_OBSERVATION,
    FORMER_NAMES,
    POLICY_INPUTS,
    SENSED_READINGS,
    Sensing,
)
from nermo_mjx.learn.own import custom_name, custom_object, is_custom, sample_commands
from nermo_mjx.robot import ModelParameters, ParameterError, Quantity, Robot, Sensors, identified
from nermo_mjx.robot.model_parameters import is_shaped
from nermo_mjx.robot.quantity import (
    did_you_mean,
    group,
    nearest,
    parameter_tree,
    quantities,
    quantity,
    replace_quantities,
)
from nermo_mjx.robot.terrains import terrain_values
from nermo_mjx.rollout.custom_metrics import described
from nermo_mjx.rollout.loop import PUSH_SECONDS, LoopParameters, Pushes, loop_parameters
from nermo_mjx.rollout.metrics import Ending, MetricState
from nermo_mjx.rollout.run import StartPose
from nermo_mjx.rollout.setup import Setup, Window, all_parameters
from nermo_mjx.shapes import Array, Count, Scalar, Truth
from nermo_mjx.specs.fields import JsonSchema, Refused
from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.values import (
    BodiesField,
    Checked,
    Ends,
    Finite,
    FiniteInUnits,
    OwnOr,
    Seconds,
    Way,
    Whole,
)
from nermo_mjx.trust import CODE_EXECUTION

#: Errors at which the terms that track a command have fallen to 1/e: speed [m/s], yaw rate [rad/s].
SPEED_WIDTH: Final = 0.05
YAW_RATE_WIDTH: Final = 0.3


class Moment(NamedTuple):
    """A control step of one world that has just ended.

    Attributes:
        before, now: Metrics at its start and its end.
        sensors: Sensor readings at its end.
        seconds: Its length [s].
        speed: Speed, smoothed over a gait cycle [m/s].
        command: Commanded values by name: `speed` [m/s] and `yaw_rate` [rad/s].
        action, last_action: Actions of this step and of the previous one (a,), in [-1, 1].
        failed, arrived: Whether the episode ends with this step, by a failure or by its distance.
    """

    before: MetricState
    now: MetricState
    sensors: Sensors
    seconds: Scalar
    speed: Scalar
    command: Mapping[str, Scalar]
    action: Float[Array, " a"]
    last_action: Float[Array, " a"]
    failed: Truth
    arrived: Truth


@dataclasses.dataclass(frozen=True)
class Term:
    """A term of the reward.

    Attributes:
        name: Key in `Task.rewards`, and name of the column.
        unit: Unit of the value.
        doc: Meaning of the term.
        value: Function from a `Moment` to the value, in pure JAX, unbatched.
        needs: Command that the term requires.
    """

    name: str
    unit: str
    doc: str
    value: Callable[[Moment], Scalar]
    needs: str | None = None

    def of(self, moment: Moment) -> Scalar:
        """The value of the term in a control step.

        Raises:
            ParameterError: The function fails, cannot be compiled, or does not return one number.
        """
        with user_code(f"{self.subject}, which fails"):
            value = self.value(moment)
        if (
            not isinstance(value, (int, float, jax.Array))
            or jnp.shape(value)
            or jnp.iscomplexobj(value)
        ):
            raise ParameterError(
                f"{self.subject}, which gives {described(value)}: expected one number."
            )
        return jnp.asarray(value)

    @property
    def subject(self) -> str:
        """The beginning of messages about the term."""
        return f"rewards has {function_place(self.name, self.value)}"


def _kernel(error: Scalar, width: float) -> Scalar:
    return jnp.exp(-((error / width) ** 2))


def _sum_square(values: Array) -> Scalar:
    return jnp.sum(values**2)


_REWARD_TERMS: Final = (
    Term(
        "progress",
        "m",
        "distance along the path, or along the smoothed heading",
        lambda m: m.now.travelled - m.before.travelled,
    ),
    Term(
        "speed",
        "s",
        f"time at the commanded speed: exp(-(error / {SPEED_WIDTH:g} m/s)^2)",
        lambda m: m.seconds * _kernel(m.speed - m.command["speed"], SPEED_WIDTH),
        "speed",
    ),
    Term(
        "headway",
        "s",
        f"time, times tanh(speed / ({SPEED_WIDTH:g} m/s)): being stuck costs more than haste earns",
        lambda m: m.seconds * jnp.tanh(m.speed / SPEED_WIDTH),
    ),
    Term(
        "yaw_rate",
        "s",
        f"time at the commanded yaw rate: exp(-(error / {YAW_RATE_WIDTH:g} rad/s)^2)",
        lambda m: m.seconds * _kernel(m.now.turning - m.command["yaw_rate"], YAW_RATE_WIDTH),
        "yaw_rate",
    ),
    Term(
        "deviation",
        "m s",
        "distance from the path, over time",
        lambda m: m.seconds * jnp.abs(m.now.readings[3]),
    ),
    Term(
        "tilt",
        "rad^2 s",
        "roll and pitch, squared, over time",
        lambda m: m.seconds * _sum_square(m.now.readings[:2]),
    ),
    Term(
        "sway",
        "rad^2/s",
        "angular velocity about roll and pitch, squared, over time",
        lambda m: m.seconds * _sum_square(m.sensors.gyro[:2]),
    ),
    Term(
        "work",
        "J",
        "mechanical work of the servos",
        lambda m: m.now.sums["work"] - m.before.sums["work"],
    ),
    Term(
        "torque",
        "N^2 m^2 s",
        "torques of the servos, squared, over time",
        lambda m: m.seconds * _sum_square(m.sensors.servo_torque),
    ),
    Term(
        "slip",
        "m",
        "distance that loaded feet slide, the sum of all four",
        lambda m: jnp.sum(m.now.sums["slid"] - m.before.sums["slid"]),
    ),
    Term(
        "dragging",
        "s",
        "time in which feet are loaded in their commanded swing, the sum of all four",
        lambda m: jnp.sum(m.now.sums["swing_loaded"] - m.before.sums["swing_loaded"]),
    ),
    Term(
        "tail",
        "s",
        "time in which the tail bears load",
        lambda m: m.now.sums["tail_loaded"] - m.before.sums["tail_loaded"],
    ),
    Term("action", "1", "the action, squared", lambda m: _sum_square(m.action)),
    Term(
        "action_change",
        "1",
        "the action's change since the last step, squared",
        lambda m: _sum_square(m.action - m.last_action),
    ),
    Term("alive", "s", "time", lambda m: jnp.asarray(m.seconds)),
    Term(
        "failed",
        "1",
        "1 where the robot fell, lost its way, or the simulation diverged",
        lambda m: jnp.asarray(m.failed, m.speed.dtype),
    ),
    Term(
        "arrived",
        "1",
        "1 where the robot has walked its distance",
        lambda m: jnp.asarray(m.arrived, m.speed.dtype),
    ),
)
#: All terms, by name.
TERMS: Final[Mapping[str, Term]] = {term.name: term for term in _REWARD_TERMS}


def select_terms(
    weights: Mapping[str | Term, float], commands: tuple[str, ...]
) -> dict[Term, float]:
    """The terms of a task and their weights, given by the names of `TERMS`, as custom terms, or as functions of a
    `Moment`, which FILE.py:NAME can name.

    Raises:
        ParameterError: A term does not exist, it requires a command that is not among the task's `commands`, or its
            weight is not a number.
    """
    terms: dict[Term, float] = {}
    for reference, weight in weights.items():
        term = _custom_term(reference) if is_custom(reference) else TERMS.get(str(reference))
        if term is None:
            near = nearest(str(reference), list(TERMS))
            hint = f"did you mean {near!r}? " if near else ""
            raise ParameterError(
                f"rewards has {reference!r}: {hint}allowed is one of {', '.join(TERMS)}, or {OBJECT_FORM}."
            )
        name = term.name
        if term.needs is not None and term.needs not in commands:
            raise ParameterError(
                f"rewards has {name!r}, and nothing is commanded: name command.{term.needs} under set or randomize."
            )
        if not isinstance(weight, (int, float)) or not jnp.isfinite(weight):
            raise ParameterError(f"rewards.{name} is {weight!r}: expected a number.")
        terms[term] = float(weight)
    if len({term.name for term in terms}) < len(terms):
        raise ParameterError("rewards has two terms of one name: give one of them another.")
    return terms


def _custom_term(reference: Any) -> Term:
    """A custom term; a function has no unit."""
    function = custom_object("rewards", reference)
    if not isinstance(function, Term) and not callable(function):
        raise ParameterError(
            f"rewards has {reference!r}, which is {described(function)}: expected a Term, or a function."
        )
    name, doc = (
        custom_name(reference),
        (inspect.getdoc(function) or "").partition("\n")[0].rstrip("."),
    )
    return function if isinstance(function, Term) else Term(name, "1", doc or name, function)


class Outcome(enum.Enum):
    """Status of an episode: a member's position is its code in `State.status`, and its value is the sentence."""

    walking = "The robot is walking."
    timed_out = "The time of the episode is over."
    arrived = "The robot has walked its distance."
    left = "The robot left the corridor about its path."
    fell = Ending.fell.value
    diverged = Ending.diverged.value
    terminated = "A termination of the task's own ended the episode."


@parameter_tree
class Command:
    """Commands of an episode; only the commands that a task names take effect."""

    speed: Any = quantity(0.1, unit="m/s", low=0.0, high=1.0, doc="wanted speed")
    yaw_rate: Any = quantity(
        0.0, unit="rad/s", low=-3.0, high=3.0, doc="wanted yaw rate, positive left"
    )


@parameter_tree
class EpisodeInputs:
    """Parameters of an episode in addition to those of a run."""

    sensing: Sensing = group(Sensing)
    command: Command = group(Command)


#: Default ranges of the parameters that differ between episodes.
DEFAULT_RANDOMIZATION: Final[Mapping[str, tuple[float, float]]] = {
    "start.phase": (0.0, 1.0),
    "start.yaw": (-0.05, 0.05),
}
#: Default rewards: walk forward, stay on the path, use little energy, stay upright.
DEFAULT_REWARDS: Final[Mapping[str | Term, float]] = {
    "progress": 20.0,
    "deviation": -2.0,
    "tilt": -1.0,
    "work": -0.5,
    "action_change": -0.002,
    "failed": -2.0,
}


class _Rewards(Checked):
    """A field with weights by the names of the reward's terms."""

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(
            _terms, handler.generate_schema(dict[str, Finite])
        )

    def schema(self, base: JsonSchema) -> JsonSchema:
        properties = {
            name: {"type": "number", "description": f"{term.doc} [{term.unit}]"}
            for name, term in TERMS.items()
        }
        base = {":": {"type": "number", "description": f"a term of one's own: {OBJECT_FORM}"}}
        return {
            "type": "object",
            "properties": properties,
            "patternProperties": base,
            "additionalProperties": False,
        }


def _terms(value: Any) -> Any:
    for name in value if isinstance(value, dict) else ():
        if name not in TERMS and ":" not in str(name):
            raise Refused(
                f"is no term of the reward; allowed are {', '.join(TERMS)}, or {OBJECT_FORM}.", name
            )
    return value or dict(DEFAULT_REWARDS)


@dataclasses.dataclass(frozen=True)
class Task(Spec):
    """The task of an `Environment`.

    >>> Task(randomize={"contact.friction": (1.0, 1.6)}, distance=1.0).decimation
    1

    A command is set like any parameter. With `command.speed` or `command.yaw_rate` under `set` or `randomize`, the
    policy observes the command, and the published controller follows it as far as possible (the yaw rate with the pilot
    `open_loop`). With a pilot that follows a path, the path is the command.
    """

    what = "a field of a task"
    elsewhere = ("randomize",)
    action: ActionField = dataclasses.field(default_factory=Residual)
    """what an action does: `Residual`, `Modulation` or `Targets`"""
    observe: Annotated[
        tuple[Annotated[Any, OwnOr((*SENSED_READINGS, *POLICY_INPUTS), FORMER_NAMES)], ...],
        Field(strict=False),
    ] = DEFAULT_OBSERVATION
    """what a policy observes: groups of `observing.SENSED_READINGS` and `POLICY_INPUTS`, and functions of the sensors as
    FILE.py:NAME"""
    rewards: Annotated[Mapping[Any, float], _Rewards()] = dataclasses.field(
        default_factory=lambda: dict(DEFAULT_REWARDS)
    )
    """weights of the reward's terms, see `rewards.TERMS`, and of functions of a `Moment` as FILE.py:NAME; in Python
    also of a custom `Term`"""
    terminations: Annotated[tuple[Annotated[Any, OwnOr(())], ...], Field(strict=False)] = ()
    """functions of the sensors, as FILE.py:NAME; an episode fails after a control step in which one is true"""
    commands: Annotated[Any, OwnOr(())] = None
    """a function, as FILE.py:NAME, from a random key and the training's control steps so far to values of parameters
    and commands, by name, of an episode, as a sampler or a curriculum; an evaluation has infinitely many steps"""
    set: dict[str, FiniteInUnits] = dataclasses.field(default_factory=dict)
    """value in all episodes of parameters, commands and sensors, such as command.speed or sensing.delay"""
    randomize: dict[str, Ends] = dataclasses.field(
        default_factory=lambda: dict(DEFAULT_RANDOMIZATION)
    )
    """range (low, high) of each parameter that is drawn, uniformly, for each episode"""
    bodies: Annotated[str | bool, BodiesField()] = ""
    """identified or true, or the directory of an identification: each episode draws one of its bodies"""
    decimation: Annotated[int, Whole(1, 100)] = 1
    """control ticks for which an action is held. The residual learners on this robot act at each one, and a policy
    costs a tenth of a tick's physics"""
    episode_length: Annotated[Seconds, Field(gt=0, allow_inf_nan=False)] = 10.0
    """length of an episode [s]"""
    distance: Way = None  # type: ignore[assignment]  # none cannot be written in a file
    """distance at which an episode ends [m]; by default it ends at none"""
    corridor: Way = None  # type: ignore[assignment]
    """distance from the path at which an episode fails [m]; by default it fails at none"""

    @classmethod
    def _known(cls, fields: Any) -> Any:
        if (
            isinstance(fields, dict) and "duration" in fields and "episode_length" not in fields
        ):  # the former name of episode_length
            fields = {
                "episode_length" if key == "duration" else key: value
                for key, value in fields.items()
            }
        return super()._known(fields)

    def __post_init__(self) -> None:
        if not isinstance(self.action, ActionKind):
            raise ParameterError(
                f"action is {self.action!r}: expected Residual, Modulation or Targets."
            )
        if not (isinstance(self.decimation, int) and self.decimation >= 1):
            raise ParameterError(
                f"decimation is {self.decimation!r}: allowed is a whole number from 1 on."
            )
        for name, unit in (("episode_length", "s"), ("distance", "m"), ("corridor", "m")):
            value = getattr(self, name)
            if isinstance(value, str):
                value = Quantity(10.0, unit, 0.0, np.inf, "of an episode").numbers(name, value)
                object.__setattr__(self, name, value)
            if value is not None and not 0.0 < value < np.inf:
                raise ParameterError(f"{name} is {value!r}: allowed is (0, inf).")
        object.__setattr__(self, "terminations", tuple(self.terminations))
        observe = (
            group if is_custom(group) else FORMER_NAMES.get(group, group) for group in self.observe
        )
        object.__setattr__(self, "observe", tuple(observe))
        for section in ("set", "randomize"):
            declared = {
                FORMER_NAMES.get(name, name): value
                for name, value in getattr(self, section).items()
            }
            object.__setattr__(self, section, declared)
        if isinstance(self.bodies, bool):
            object.__setattr__(
                self, "bodies", identified.IDENTIFIED_ENSEMBLE if self.bodies else ""
            )

    @property
    def commanded(self) -> tuple[str, ...]:
        """Names of the fields of `Command` that the task sets or samples."""
        named = {*self.set, *self.randomize, *self.sampled}
        return tuple(name for name in ("speed", "yaw_rate") if f"command.{name}" in named)

    @property
    def sampled(self) -> tuple[str, ...]:
        """Names of the parameters and commands that the function `commands` samples."""
        return () if self.commands is None else tuple(sample_commands(self.commands)[1])

    def sample(self, key: Any, steps: Any) -> dict[str, Any]:
        """Values that the function `commands` samples, by name; pure JAX."""
        return (
            {}
            if self.commands is None
            else dict(custom_object("commands", self.commands)(key, steps))
        )

    def replace_custom(self, change: Callable[[Any], Any]) -> Task:
        """The task with the result of `change` instead of each custom entry."""

        def replace_entry(reference: Any) -> Any:
            return (
                change(reference) if reference is not None and is_custom(reference) else reference
            )

        return dataclasses.replace(
            self,
            observe=tuple(map(replace_entry, self.observe)),
            rewards={replace_entry(name): weight for name, weight in self.rewards.items()},
            terminations=tuple(map(replace_entry, self.terminations)),
            commands=replace_entry(self.commands),
        )

    @property
    def has_custom_code(self) -> bool:
        """Whether the task has custom code."""
        return (
            any(map(is_custom, (*self.observe, *self.rewards, *self.terminations)))
            or self.commands is not None
        )

    def ticks(self, dt: float) -> int:
        """Number of control ticks of `dt` [s] in an episode, a multiple of `decimation`."""
        return max(1, round(self.episode_length / dt / self.decimation)) * self.decimation

    def check(self, setup: Setup) -> None:
        """Check that names are known, values are in their ranges, and each parameter has one source.

        Raises:
            ParameterError: A check fails; the message contains the field, the value and the allowed values.
        """
        if setup.schedule:
            raise ParameterError(
                "schedule is of a walk, not of a training: vary what a policy should cope with."
            )
        allowed = task_parameters(setup)
        body = set(identified.bodies(self.bodies).values) if self.bodies else set()
        for section in ("set", "randomize"):
            for name in getattr(self, section):
                if name not in allowed:
                    raise ParameterError(
                        f"{section} has {name!r}, which is no parameter{did_you_mean(name, allowed)}"
                    )
                if name.startswith("terrain.") and name not in terrain_values(str(setup.scene)):
                    raise ParameterError(
                        f"{section} has {name!r}, which the scene {setup.scene!r} has not: leave it out."
                    )
                if name in body:
                    raise ParameterError(
                        f"{section} has {name!r}, which the identified bodies bring: leave one out."
                    )
        for name in self.randomize:
            if name in self.set:
                raise ParameterError(f"{name} stands under set and under randomize: leave one out.")
            try:
                low, high = self.randomize[name]
            except (TypeError, ValueError):
                raise ParameterError(
                    f"randomize.{name} is {self.randomize[name]!r}: expected (low, high)."
                ) from None
            if not low < high:
                raise ParameterError(
                    f"randomize.{name} is ({low:g}, {high:g}): the low end is not below the high one."
                )
            allowed[name].check(f"randomize.{name}", [low, high])
        for name, value in self.set.items():
            allowed[name].check(f"set.{name}", value)
        self.check_commands(setup)
        setup.check(
            setup.world(
                {name: value for name, value in self.set.items() if name not in EPISODE_PARAMETERS}
            )
        )

    def check_commands(self, setup: Setup) -> None:
        """Check that `commands` runs, and samples known parameters within their ranges; skipped if no code may be run.

        Raises:
            ParameterError: A check fails; the message contains the file and the line.
        """
        if self.commands is None or not CODE_EXECUTION.get():
            return
        allowed, (subject, sampled) = task_parameters(setup), sample_commands(self.commands)
        for name, values in sampled.items():
            if name not in allowed or (
                name.startswith("terrain.") and name not in terrain_values(str(setup.scene))
            ):
                raise ParameterError(
                    f"{subject}, which draws {name!r}: no parameter here{did_you_mean(name, allowed)}"
                )
            if self.bodies and name in identified.bodies(self.bodies).values:
                raise ParameterError(
                    f"{subject}, which draws {name!r}, which the identified bodies bring."
                )
            allowed[name].check(f"{subject}, where {name}", values)


#: Parameters of a policy's episodes that runs do not have; the policy's file contains them, too.
POLICY_PARAMETERS: Final[dict[str, Quantity]] = dict(quantities(EpisodeInputs))
#: Parameters of the pushes in episodes.
PUSH_PARAMETERS: Final[dict[str, Quantity]] = {
    "push.force": Quantity(
        1.0, "N", 0.0, 10.0, f"on the torso for {PUSH_SECONDS:g} s, in any horizontal direction"
    ),
    "push.interval": Quantity(
        2.0, "s", 0.2, 100.0, "in each of which there is one push, at a random moment"
    ),
}
#: All parameters of episodes that runs do not have.
EPISODE_PARAMETERS: Final[dict[str, Quantity]] = POLICY_PARAMETERS | PUSH_PARAMETERS


def task_parameters(setup: Setup) -> dict[str, Quantity]:
    """Every parameter that a task may name under `set` and `randomize`."""
    return all_parameters(setup) | EPISODE_PARAMETERS


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EpisodeParameters:
    """Parameters of one world in one episode.

    Attributes:
        loop: Parameters of the run loop; the action is in `loop.control.action`.
        inputs: Delay and noise of the sensors, and the command.
        sample: Sampled parameters, scaled from their ranges to [-1, 1] (r,).
        seed: Seed of the noise, a whole number below 2^24.
        ticks: Control ticks until the time of the episode is over.
    """

    loop: LoopParameters
    inputs: EpisodeInputs
    sample: Float[Array, " r"]
    seed: Count
    ticks: Count


@dataclasses.dataclass(frozen=True, eq=False)
class Episodes:
    """Samples episodes: parameters, body and initial position of one world from a random key, in pure JAX."""

    setup: Setup
    robot: Robot
    controller: ActionController
    task: Task

    @property
    def sampled_names(self) -> tuple[str, ...]:
        """Names of the parameters that differ between episodes."""
        return (
            *self.task.randomize,
            *(identified.bodies(self.task.bodies).values if self.task.bodies else ()),
        )

    @property
    def changed_names(self) -> tuple[str, ...]:
        """Names of the parameters that differ from the defaults of the setup."""
        return (*self.setup.body, *self.task.set, *self.task.sampled, *self.sampled_names)

    def __call__(
        self, key: Any, cut_short: Any = False, steps: Any = 0.0
    ) -> tuple[EpisodeParameters, ModelParameters, Float[Array, " nq"]]:
        """Parameters, body and initial position (nq,) of the episode of a random key.

        With `cut_short`, the time of the episode is over after a random share of the task's length. `steps` is the
        number of control steps of the training so far, an argument of the task's `commands`.
        """
        seed, draw, body = jax.random.split(key, 3)
        values: dict[str, Any] = dict(self.task.set)
        shares = jax.random.uniform(draw, (len(self.task.randomize),), minval=-1.0, maxval=1.0)
        for share, (name, (low, high)) in zip(shares, self.task.randomize.items(), strict=True):
            values[name] = 0.5 * (low + high) + 0.5 * share * (high - low)
        values |= self.task.sample(jax.random.fold_in(draw, 1), steps)
        if self.task.bodies:
            ensemble = identified.bodies(self.task.bodies)
            instance = jax.random.choice(
                body, len(ensemble), p=jnp.asarray(ensemble.weights, float)
            )
            members = {name: jnp.asarray(column, float) for name, column in ensemble.values.items()}
            values |= {name: column[instance] for name, column in members.items()}
            spread = [
                (column[instance] - column.mean()) / (3.0 * column.std() + 1e-12)
                for column in members.values()
            ]
            shares = jnp.concatenate([shares, jnp.clip(jnp.stack(spread), -1.0, 1.0)])
        sampled = replace_quantities(
            EpisodeInputs(),
            {name: value for name, value in values.items() if name in POLICY_PARAMETERS},
        )
        world = self.setup.world(
            {name: value for name, value in values.items() if name not in EPISODE_PARAMETERS}
        )
        command_values = apply_command(
            self.controller.base, self.task.commanded, world.control, sampled.command
        )
        control = jax.tree.map(
            _as_float, ActionParameters(command_values, self.controller.parameters.action)
        )
        window = Window(begin=0.0, end=1e6, distance=1e6)
        world = dataclasses.replace(world, control=control)
        loop = loop_parameters(self.robot, world, window, values)
        pusher = jax.random.randint(jax.random.fold_in(seed, 2), (), 0, 1 << 24)
        loop = dataclasses.replace(loop, push=make_pushes(values, pusher))
        shape = world.model if is_shaped(values) else None
        first = StartPose(self.robot, self.controller).qpos(
            control, world.start, loop.terrain, shape
        )
        number = jax.random.randint(seed, (), 0, 1 << 24)
        ticks, part = self.task.ticks(self.controller.dt), self.task.decimation
        short = part * jax.random.randint(jax.random.fold_in(seed, 1), (), 1, ticks // part + 1)
        length = jnp.where(cut_short, short, ticks)
        parameters = jax.tree.map(
            _as_float, EpisodeParameters(loop, sampled, shares, number, length)
        )
        return parameters, jax.tree.map(_as_float, world.model), first


def make_pushes(values: Mapping[str, Any], seed: Any) -> Pushes | None:
    """The pushes of a world with these values, by name; None if none of `PUSH_PARAMETERS` is among them."""
    force, interval = (
        values.get(name, declaration.default) for name, declaration in PUSH_PARAMETERS.items()
    )
    return Pushes(force, interval, seed) if PUSH_PARAMETERS.keys() & values.keys() else None


def apply_command(
    base: ControllerLike, commands: Collection[str], control: Any, command: Command
) -> Any:
    """The parameters `control` of the published controller `base` with the commanded speed and turn rate.

    `commands` are the names of the commands, and `command` contains their values. Other controllers do not follow commands.
    """
    if not isinstance(base, Controller):
        return control
    gait, clock_ratio = control.gait, control.tracking.clock_ratio
    if "speed" in commands:
        speed = command.speed * clock_ratio / jnp.maximum(gait.stride, 1e-3)
        control = replace_quantities(control, {"commanded_speed": speed})
    if "yaw_rate" in commands and isinstance(base.pilot, OpenLoop):
        stride = turning.stride_length(control.gait, control.stance, control.gait.commanded_speed)
        speed = turning.body_speed(control.gait, stride) / clock_ratio
        curvature = jnp.asarray(command.yaw_rate / jnp.maximum(speed, 1e-3), float)
        rate = turning.turn_rate_for(control, curvature / control.pilot.grip)
        control = replace_quantities(control, {"pilot.turn_rate": rate})
    return control


def _as_float(leaf: Any) -> Array:
    """An array in JAX's default precision; whole numbers do not change."""
    array = jnp.asarray(leaf)
    return array.astype(float) if jnp.issubdtype(array.dtype, jnp.floating) else array
