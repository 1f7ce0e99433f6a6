"""A policy as a controller: it observes and acts, you can use it like any controller, and it is stored in one file.

The file is an NPZ without pickled objects: the networks' arrays, and a JSON text (`about`) that describes the
observation, the kind of action, the controller under the actions, and versions. `export` writes a policy as ONNX, from
an observation to an action, for programs that do not use this package.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from nermo_mjx.control.controller import with_dtypes_of
from nermo_mjx.control.path import PathPoint
from nermo_mjx.control.protocol import (
    OBJECT_FORM,
    ChecksParameters,
    CompletesValues,
    Ground,
    Source,
)
from nermo_mjx.files import MAX_ARRAY_BYTES, FileError, arrays_of, check_arrays, read_as, read_bytes
from nermo_mjx.learn.acting import (
    ACTIONS,
    ActionController,
    ActionField,
    ActionKind,
    ActionParameters,
    ActionState,
)
from nermo_mjx.learn.environment import Environment
from nermo_mjx.learn.experience import Actor, LearningState, Statistics
from nermo_mjx.learn.observing import FORMER_NAMES, LONGEST_DELAY, Observer, current_name
from nermo_mjx.learn.own import custom_code_file, custom_readings, sample_commands
from nermo_mjx.learn.task import POLICY_PARAMETERS, EpisodeInputs, apply_command
from nermo_mjx.robot import ParameterError, Sensors, ServoAngles
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.parameters import PRESETS
from nermo_mjx.robot.quantity import (
    check_quantities,
    choice,
    flat,
    group,
    parameter_tree,
    quantities,
    replace_quantities,
    require,
)
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.runs.code import versions
from nermo_mjx.runtime import start_jax
from nermo_mjx.shapes import Array, Count, Scalar
from nermo_mjx.specs.model import named_section

#: Kind of file, and the latest version of its format that can be read.
FILE_KIND: Final = "nermo-mjx policy"
FORMAT_VERSION: Final = 1
#: Choices of a setup that determine the controller under the actions.
BASE_CHOICES: Final = (
    "robot",
    "tail",
    "routing",
    "gait",
    "spine",
    "steering",
    "profile",
    "pilot",
    "waypoints",
    "trajectory",
    "head",
    "tail_motion",
)


@parameter_tree
class PolicyParameters:
    """Parameters of a policy: parameters of the controller under its actions, other inputs, and the network.

    Attributes:
        control: Parameters of the controller.
        inputs: Command, and delay and noise of the sensors; empty for a policy that was trained with exact sensors and
            without commands.
        network: Actor, and statistics of the observations. Their values have no names. They are parameters of a program,
            not constants, so that another network needs no new compilation.
    """

    control: Any = flat(tuple)
    inputs: Any = flat(tuple)
    network: Any = group(tuple)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PolicyState:
    """The state of a policy between two ticks.

    Attributes:
        tick: Number of control ticks so far.
        controller: State of the controller under the policy's actions.
        memory: Earlier readings, newest first, as many as the longest delay needs.
        action: Action of the present control step (a,).
    """

    tick: Count
    controller: ActionState
    memory: Array
    action: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A `ControllerLike` that a training made. Its action is the mean of the actor's distribution.

    Attributes:
        actor, statistics: Network, and statistics of the observations.
        kind: Kind of the actions.
        observer: Maker of the observations.
        decimation: Control ticks of a control step, in which the action is constant.
        base: Choices of the setup with the controller under the actions, by name.
        fixed: Parameters that differ from the defaults of this setup, and parameters of `EpisodeInputs`.
        about: Further content of the file: training, physics of the evaluation, versions.
        ground: Function from (x, y) to the height of the ground [m], for observations of the ground; the run loop sets
            it, see `SeesGround`.
    """

    actor: Actor
    statistics: Statistics
    kind: ActionKind
    observer: Observer
    decimation: int
    base: Mapping[str, Any]
    fixed: Mapping[str, float]
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    ground: Ground | None = None

    @classmethod
    def of(
        cls,
        environment: Environment,
        learned: LearningState,
        metadata: Mapping[str, Any] | None = None,
    ) -> Policy:
        """The policy of a learning state in an environment.

        `metadata` is further content of the file: `judged`, for example, contains the physics and time step [s] of the
        evaluation, if they differ from the environment.

        Raises:
            ParameterError: The controller under the actions is not a published one.
        """
        setup, task = environment.setup, environment.task
        if setup.controller is not None or setup.command is not None:
            raise ParameterError(
                "controller is a custom one: a policy file can only store a published one."
            )
        normalized = {
            name: 0.5 * (low + high)
            for name, (low, high) in task.randomize.items()
            if name in POLICY_PARAMETERS
        }
        if task.commands is not None:
            normalized |= {
                name: float(np.median(sample))
                for name, sample in sample_commands(task.commands)[1].items()
                if name in POLICY_PARAMETERS
            }
        code = custom_code_file(task.observe)
        if code:
            source = Source.named("observe has", code, OBJECT_FORM)
            groups = [name for name, _ in environment.loop.observer.custom_groups]
            metadata = {
                **(metadata or {}),
                "own": {"file": Path(code).name, "digest": source.digest(), "groups": groups},
            }
        declarations = dict(quantities(setup.world({}).control))
        fixed = {
            name: float(value)
            for name, value in task.set.items()
            if name in declarations or name in POLICY_PARAMETERS
        }
        return cls(
            learned.actor,
            learned.statistics.take(environment.observation_size),
            task.action,
            environment.loop.observer,
            task.decimation,
            {name: getattr(setup, name) for name in BASE_CHOICES},
            fixed | normalized,
            {
                **(metadata or {}),
                "judged": (metadata or {}).get("judged", evaluation_physics(setup)),
            },
        )

    def upon(self, **choices: Any) -> Policy:
        """The policy with other choices of the setup, see `ActsUpon`; it observes the path of the new pilot."""
        for name in choices:
            choice("choice", name, BASE_CHOICES)
        if self.observer.sees_path and choices.get("pilot") == "open_loop":
            raise ParameterError(
                "pilot is 'open_loop', which has no path, and the policy observes one."
            )
        return dataclasses.replace(self, base={**self.base, **choices})

    def over(self, ground: Ground) -> Policy:
        """The policy with this height of the ground, see `SeesGround`."""
        return dataclasses.replace(self, ground=ground)

    def elsewhere(self, physics: str, timestep: float) -> str:
        """A warning if the physics or time step [s] differ from the evaluation, see `ActsUpon`; otherwise empty."""
        judged = self.about.get("judged")
        if judged is None or (
            judged["physics"] == physics and np.isclose(judged["timestep"], timestep, rtol=1e-6)
        ):
            return ""
        return (
            f"controller is a policy that was judged in physics {judged['physics']} at steps of "
            f"{1e3 * judged['timestep']:.4g} ms and walks in {physics} at {1e3 * timestep:.4g} ms: its numbers are not "
            "those of its evaluation."
        )

    @functools.cached_property
    def setup(self) -> Setup:
        """The setup with the controller under the actions."""
        return Setup(**self.base)

    @functools.cached_property
    def action_controller(self) -> ActionController:
        """The controller under the policy's actions."""
        return ActionController(self.setup.make_controller(), self.kind)

    @property
    def dt(self) -> float:
        return self.action_controller.dt

    @functools.cached_property
    def parameters(self) -> PolicyParameters:
        """See `ControllerLike`; the parameters have the names of the controller's parameters."""
        control = self.setup.world(
            {name: value for name, value in self.fixed.items() if name not in POLICY_PARAMETERS}
        ).control
        network = self.actor, self.statistics
        if not (self.observer.commands or self.observer.delayed or self.observer.noisy):
            return PolicyParameters(control=control, network=network)
        control_given = replace_quantities(
            EpisodeInputs(),
            {name: value for name, value in self.fixed.items() if name in POLICY_PARAMETERS},
        )
        return PolicyParameters(control=control, inputs=control_given, network=network)

    def init(self, params: PolicyParameters, sensors: Sensors, phase: Scalar) -> PolicyState:
        nothing = jnp.zeros(len(self.kind.names))
        state = self.action_controller.init(
            ActionParameters(params.control, nothing), sensors, phase
        )
        memory = self.observer.memory(self.observer.readings(sensors, self.ground))
        return PolicyState(jnp.zeros((), jnp.int32), state, memory, nothing)

    def initial_servo(self, params: PolicyParameters, phase: Scalar) -> ServoAngles:
        return self.action_controller.initial_servo(
            ActionParameters(params.control, jnp.zeros(len(self.kind.names))), phase
        )

    def update(
        self, params: PolicyParameters, state: PolicyState, sensors: Sensors
    ) -> tuple[PolicyState, ServoAngles]:
        observer, command_given, control = (
            self.observer,
            params.inputs or EpisodeInputs(),
            params.control,
        )
        path = self.path(params, state, sensors.position) if observer.path else None
        inputs = observer.collect_inputs(
            command_given.command,
            state.controller.control,
            path,
            state.action,
            geometry_of(control),
        )
        # The noise is the same in every world, so that runs from the same initial state are equal.
        key = jax.random.fold_in(jax.random.key(0), state.tick) if observer.noisy else None
        observation = observer.observe(
            command_given.sensing, state.memory, sensors, inputs, key, self.ground
        )
        due = state.tick % self.decimation == 0
        action = jnp.where(due, self.choose(params, state, observation), state.action)
        if observer.commands:
            control = apply_command(
                self.action_controller.base, observer.commands, control, command_given.command
            )
        controller, servo = self.action_controller.update(
            ActionParameters(control, action), state.controller, sensors
        )
        memory = observer.update_memory(state.memory, observer.readings(sensors, self.ground))
        return with_dtypes_of(state, PolicyState(state.tick + 1, controller, memory, action)), servo

    def choose(self, params: PolicyParameters, state: PolicyState, observation: Array) -> Array:
        """The action (a,) of a control step."""
        actor, statistics = params.network
        return _action(actor, statistics, observation)

    def act(self, observation: Array) -> Array:
        """The action (..., a) at observations (..., o)."""
        return _action(self.actor, self.statistics, observation)

    def cycle_rate(self, params: PolicyParameters) -> Any:
        """See `ControllerLike`; the rate of the controller without a policy, which a modulation may change."""
        return self.action_controller.base.cycle_rate(params.control)

    def path(
        self, params: PolicyParameters, state: PolicyState, position: Array
    ) -> PathPoint | None:
        return self.action_controller.path(
            ActionParameters(params.control, state.action), state.controller, position
        )

    def stance(self, state: PolicyState) -> Any:
        return self.action_controller.stance(state.controller)

    def check(self, params: PolicyParameters) -> None:
        if isinstance(self.action_controller.base, ChecksParameters):
            self.action_controller.base.check(params.control)

    def complete(self, values: dict[str, Any]) -> dict[str, Any]:
        base = self.action_controller.base
        return base.complete(values) if isinstance(base, CompletesValues) else values

    def facts(self) -> dict[str, Any]:
        """The description of the policy and its numbers, in types of JSON."""
        return {
            "action": named_section(self.kind, ACTIONS),
            "actions": list(self.kind.names),
            "observation": list(self.observer.names),
            "observer": {
                name: value
                for name, value in vars(self.observer).items()
                if name != "custom_groups"
            },
            "decimation": self.decimation,
            "step_seconds": self.dt * self.decimation,
            "base": dict(self.base),
            "fixed": dict(self.fixed),
            "versions": versions(),
            **self.about,
        }

    def content(self) -> bytes:
        """The bytes of the policy's file; equal policies have equal bytes.

        Raises:
            ParameterError: The policy observes functions that are not in a file.
        """
        groups = self.about.get("own", {"groups": []})["groups"]
        for name, _ in self.observer.custom_groups:
            if name not in groups:
                raise ParameterError(
                    f"observe has {name}: name it as {OBJECT_FORM}, as a policy's file can."
                )
        metadata = {
            "kind": FILE_KIND,
            "form": FORMAT_VERSION,
            "layers": len(self.actor.layers),
            **self.facts(),
        }
        arrays: dict[str, Any] = {"about": np.frombuffer(json.dumps(metadata).encode(), np.uint8)}
        for i, (weights, bias) in enumerate(self.actor.layers):
            arrays |= {f"weights.{i}": np.asarray(weights), f"bias.{i}": np.asarray(bias)}
        arrays |= {
            "log_std": np.asarray(self.actor.log_std),
            "mean": np.asarray(self.statistics.mean),
            "variance": np.asarray(self.statistics.variance),
        }
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        return stream.getvalue()


def _action(actor: Actor, statistics: Statistics, observation: Array) -> Array:
    """See `Policy.act`; in single precision, like the training."""
    actor, statistics = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32), (actor, statistics)
    )
    return jnp.clip(
        actor.mean(statistics.normalize(jnp.asarray(observation, jnp.float32))), -1.0, 1.0
    )


class RandomPolicy(Policy):
    """A policy whose actions are independent uniform samples from [-1, 1]; they are the same in every run."""

    def choose(self, params: PolicyParameters, state: PolicyState, observation: Array) -> Array:
        key = jax.random.fold_in(jax.random.key(1), state.tick)
        return jax.random.uniform(key, state.action.shape, jnp.float32, -1.0, 1.0)


def load_policy(path: str | Path, code: str = "") -> Policy:
    """Load the policy of a file. The object is the same as long as its files do not change.

    Args:
        path: Path of the file, which contains no code.
        code: Python file or module with the custom observations of the policy; this code is run.

    Raises:
        ParameterError: The file does not exist, or this version cannot read it; or the policy has custom observations,
            and `code` is not the file of the training.
    """
    subject = f"controller is '{path}'"
    try:
        policy = _policy(read_bytes(Path(path), MAX_ARRAY_BYTES))
    except OSError as error:
        raise ParameterError(f"{subject}: it cannot be read ({error.strerror}).") from None
    except (FileError, ParameterError) as error:
        reason = str(error).rstrip(".")
        raise ParameterError(
            f"{subject}, which holds no policy of `nermo-mjx train`: {reason}."
        ) from None
    custom_code = policy.about.get("own")
    if custom_code is None and code:
        raise ParameterError(f"{subject}, which observes nothing of one's own: leave {code!r} out.")
    if custom_code is None:
        return policy
    observed = f"which observes {', '.join(custom_code['groups'])} of {custom_code['file']}"
    if not code:
        raise ParameterError(
            f"{subject}, {observed}, code that is run only where you name it: {path}:{custom_code['file']}."
        )
    if (digest := Source.named("controller is", code, OBJECT_FORM).digest()) != custom_code[
        "digest"
    ]:
        raise ParameterError(
            f"{subject}, {observed} with the digest {custom_code['digest']}; that of {code} is {digest}:"
            " give the file with which it was trained."
        )
    return _with_code(policy, code)


@functools.lru_cache(maxsize=8)
def _with_code(policy: Policy, code: str) -> Policy:
    """The policy with its custom observations from `code`."""
    references = [f"{code}:{name}" for name in policy.about["own"]["groups"]]
    readings = tuple(custom_readings(policy.setup.load().config, references).items())
    observer = dataclasses.replace(policy.observer, custom_groups=readings)
    if len(observer.names) != len(policy.statistics.mean):
        raise ParameterError(
            f"controller is a policy of {len(policy.statistics.mean)} observations: {code} gives others."
        )
    return dataclasses.replace(policy, observer=observer)


def evaluation_physics(setup: Setup) -> dict[str, Any]:
    """The physics and time step [s] of a setup, in the form of a policy's file."""
    return {"physics": setup.physics, "timestep": float(setup.timestep)}


class _EvaluationPhysics(BaseModel, extra="forbid"):
    physics: Literal[*PRESETS]  # type: ignore[valid-type]
    timestep: Annotated[FiniteFloat, Field(gt=0)]


class _TrainingFacts(BaseModel, extra="forbid"):
    steps: int
    training: str


class _CustomCode(BaseModel, extra="forbid"):
    """Custom observations of a policy: name and digest of their file, and names of the functions."""

    file: str
    digest: str
    groups: tuple[str, ...]


class _Description(BaseModel, extra="forbid"):
    """The description in a policy's file. Other keys are errors, and no key refers to code that is run."""

    kind: Literal["nermo-mjx policy"]
    form: Annotated[int, Field(ge=1, le=FORMAT_VERSION)]
    layers: Annotated[int, Field(ge=1, le=100)]
    action: ActionField
    actions: tuple[str, ...]
    observation: tuple[str, ...]
    observer: Observer
    decimation: Annotated[int, Field(ge=1, le=10_000)]
    step_seconds: Annotated[FiniteFloat, Field(gt=0)]
    base: dict[str, str | float | tuple[tuple[FiniteFloat, FiniteFloat], ...] | None]
    fixed: dict[str, FiniteFloat]
    versions: dict[str, str]
    trained: _TrainingFacts | None = None
    judged: _EvaluationPhysics | None = None
    own: _CustomCode | None = None


@functools.lru_cache(maxsize=8)
def _policy(content: bytes) -> Policy:
    arrays = arrays_of(content, "the file")
    if arrays.get("about", np.zeros(1)).dtype != np.uint8:
        raise FileError("it has no 'about'")
    metadata: _Description = read_as(arrays.pop("about").tobytes(), _Description, "about")
    for name in metadata.base:
        choice("base", name, BASE_CHOICES)
    if (
        metadata.observer.delayed < 0
        or metadata.observer.delayed * metadata.observer.dt > 2 * LONGEST_DELAY
    ):
        raise FileError(f"its readings are late by {metadata.observer.delayed} ticks")
    observation_count, actions = len(metadata.observation), len(metadata.action.names)
    sizes: list[Any] = [
        observation_count,
        *(f"hidden {i}" for i in range(1, metadata.layers)),
        actions,
    ]
    shapes: dict[str, tuple[str, tuple[Any, ...]]] = {}
    for i, (below, above) in enumerate(itertools.pairwise(sizes)):
        shapes |= {f"weights.{i}": ("f", (below, above)), f"bias.{i}": ("f", (above,))}
    shapes |= {
        "log_std": ("f", (actions,)),
        "mean": ("f", (observation_count,)),
        "variance": ("f", (observation_count,)),
    }
    check_arrays(arrays, shapes, "the file")
    for name in shapes:
        if not np.isfinite(arrays[name]).all() or (
            name == "variance" and not (arrays[name] >= 0).all()
        ):
            raise FileError(f"{name!r} has numbers that are not finite, or a variance below 0")
    start_jax()  # with the settings of the package, because the last bits of walks depend on them
    numbers = {name: jnp.asarray(arrays[name]) for name in shapes}
    policy = Policy(
        Actor(
            tuple((numbers[f"weights.{i}"], numbers[f"bias.{i}"]) for i in range(metadata.layers)),
            numbers["log_std"],
        ),
        Statistics(jnp.ones(()), numbers["mean"], numbers["variance"]),
        metadata.action,
        metadata.observer,
        metadata.decimation,
        metadata.base,
        {FORMER_NAMES.get(name, name): value for name, value in metadata.fixed.items()},
        metadata.model_dump(include={"trained", "judged", "versions", "own"}, exclude_none=True),
    )
    if metadata.own is None and policy.observer.names != tuple(
        map(current_name, metadata.observation)
    ):
        raise ParameterError("this version observes other numbers under these names")
    # The controller under the actions is made here, so that an error in it is reported now.
    check_quantities(policy.parameters)
    return policy


#: Version of the operators; every runtime of the last years reads it.
_OPSET: Final = 17
_IR: Final = 8


def export(policy: Policy) -> bytes:
    """An ONNX model with the input `observation` (n, o) and the output `action` (n, a), both float32.

    Its metadata describe the values as JSON: `observation`, `actions` and `action` (the kind of action).

    Raises:
        ParameterError: The package `onnx` is not installed.
    """
    require("policy.onnx", "onnx", "onnx")
    from onnx import TensorProto, checker, helper

    nodes: list[Any] = []
    constants = {
        "mean": policy.statistics.mean,
        "spread": np.sqrt(np.asarray(policy.statistics.variance) + 1e-6),
        "least": np.float32(-10.0),
        "most": np.float32(10.0),
    }

    def node(kind: str, *inputs: str) -> str:
        name = f"{kind.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [name]))
        return name

    last = node("Clip", node("Div", node("Sub", "observation", "mean"), "spread"), "least", "most")
    for i, (weights, bias) in enumerate(policy.actor.layers):
        constants |= {f"weights.{i}": weights, f"bias.{i}": bias}
        last = node("Tanh", node("Add", node("MatMul", last, f"weights.{i}"), f"bias.{i}"))
    nodes.append(helper.make_node("Identity", [last], ["action"]))
    arrays = {name: np.asarray(value, np.float32) for name, value in constants.items()}
    stored = [
        helper.make_tensor(name, TensorProto.FLOAT, array.shape, array.tobytes(), raw=True)
        for name, array in arrays.items()
    ]
    sizes = {"observation": len(policy.observer.names), "action": len(policy.kind.names)}
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size])
        for name, size in sizes.items()
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], stored)
    version = {"opset_imports": [helper.make_opsetid("", _OPSET)], "ir_version": _IR}
    model = helper.make_model(graph, producer_name="nermo-mjx", **version)
    helper.set_model_props(
        model, {name: json.dumps(value) for name, value in policy.facts().items()}
    )
    checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content
