"""A policy as a controller: it observes, acts, can be used wherever a controller can, and is one file.

The file is an NPZ without pickled objects: the networks' arrays, and a JSON text (`about`) that describes them:
what is observed, what an action does, which controller is acted on, versions. For programs that do not use this package
a policy is exported as ONNX, from an observation to an action.
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
from nermo_mjx.learn.acting import ACTIONS, Acted, ActedState, Acting, ActionField, ActionKind
from nermo_mjx.learn.environment import Environment
from nermo_mjx.learn.experience import Actor, LearningState, Statistics
from nermo_mjx.learn.observing import FORMER_NAMES, LONGEST_DELAY, Observer, today
from nermo_mjx.learn.own import code_place, drawn_by, own_readings
from nermo_mjx.learn.task import POLICY_PARAMETERS, Given, commanded
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

#: What a file says that it is, and the latest form of it that is read.
FILE_KIND: Final = "nermo-mjx policy"
FORMAT_VERSION: Final = 1
#: Choices of a setup that decide the controller that is acted on.
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
    """A policy's parameters: those of the controller that it acts on, what it is told, and its network.

    Attributes:
        control: of the controller.
        given: what it is commanded, and how late and noisy its sensors are; empty for a policy that was trained with
            exact sensors and without commands.
        network: actor, and statistics of what it observes. They have no names; as parameters, and not constants, of a
            program they can be replaced without compiling it again.
    """

    control: Any = flat(tuple)
    given: Any = flat(tuple)
    network: Any = group(tuple)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PolicyState:
    """What a policy carries from tick to tick.

    Attributes:
        tick: control ticks so far.
        acted: state of the controller under the policy's actions.
        memory: earlier readings, newest first, as far as they are late.
        action: the action that is held.
    """

    tick: Count
    acted: ActedState
    memory: Array
    action: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A `ControllerLike` that a training made. It acts by the mean of its distribution.

    Attributes:
        actor, statistics: network, and of what it observes.
        kind: what an action does.
        observer: what makes observations.
        decimation: control ticks for which an action is held.
        base: choices of the setup whose controller is acted on, by name.
        fixed: parameters that differ from that setup's defaults, and those of `Given`.
        about: what else the file says: how it was trained, in which physics it was judged, versions.
        ground: height of the ground at (x, y) [m], for what it observes of that; the loop gives it, see `SeesGround`.
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
        """What was `learned` in an environment; `about` is further content of the file: the `judged` physics and time
        step [s] where they are not the environment's.

        Raises:
            ParameterError: it acts on a controller that is not a published one.
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
                for name, sample in drawn_by(task.commands)[1].items()
                if name in POLICY_PARAMETERS
            }
        code = code_place(task.observe)
        if code:
            source = Source.named("observe has", code, OBJECT_FORM)
            groups = [name for name, _ in environment.loop.observer.own]
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
            {**(metadata or {}), "judged": (metadata or {}).get("judged", judged_in(setup))},
        )

    def upon(self, **choices: Any) -> Policy:
        """See `ActsUpon`: what it observes of a path is that of the new one."""
        for name in choices:
            choice("choice", name, BASE_CHOICES)
        if self.observer.sees_path and choices.get("pilot") == "open_loop":
            raise ParameterError(
                "pilot is 'open_loop', which has no path, and the policy observes one."
            )
        return dataclasses.replace(self, base={**self.base, **choices})

    def over(self, ground: Ground) -> Policy:
        """See `SeesGround`."""
        return dataclasses.replace(self, ground=ground)

    def elsewhere(self, physics: str, timestep: float) -> str:
        """See `ActsUpon`: a policy has adapted to the physics in which it was chosen."""
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
        """The setup whose controller is acted on."""
        return Setup(**self.base)

    @functools.cached_property
    def acting(self) -> Acting:
        """The controller under the policy's actions."""
        return Acting(self.setup.make_controller(), self.kind)

    @property
    def dt(self) -> float:
        return self.acting.dt

    @functools.cached_property
    def parameters(self) -> PolicyParameters:
        """See `ControllerLike`; they can be named as those of the controller below."""
        control = self.setup.world(
            {name: value for name, value in self.fixed.items() if name not in POLICY_PARAMETERS}
        ).control
        network = self.actor, self.statistics
        if not (self.observer.commands or self.observer.delayed or self.observer.noisy):
            return PolicyParameters(control=control, network=network)
        control_given = replace_quantities(
            Given(),
            {name: value for name, value in self.fixed.items() if name in POLICY_PARAMETERS},
        )
        return PolicyParameters(control=control, given=control_given, network=network)

    def init(self, params: PolicyParameters, sensors: Sensors, phase: Scalar) -> PolicyState:
        nothing = jnp.zeros(len(self.kind.names))
        acted = self.acting.init(Acted(params.control, nothing), sensors, phase)
        memory = self.observer.memory(self.observer.readings(sensors, self.ground))
        return PolicyState(jnp.zeros((), jnp.int32), acted, memory, nothing)

    def initial_servo(self, params: PolicyParameters, phase: Scalar) -> ServoAngles:
        return self.acting.initial_servo(
            Acted(params.control, jnp.zeros(len(self.kind.names))), phase
        )

    def update(
        self, params: PolicyParameters, state: PolicyState, sensors: Sensors
    ) -> tuple[PolicyState, ServoAngles]:
        observer, command_given, control = self.observer, params.given or Given(), params.control
        path = self.path(params, state, sensors.position) if observer.path else None
        informed = observer.informed(
            command_given.command, state.acted.control, path, state.action, geometry_of(control)
        )
        # The same noise in every world: runs from one start are equal.
        key = jax.random.fold_in(jax.random.key(0), state.tick) if observer.noisy else None
        observation = observer.observe(
            command_given.sensing, state.memory, sensors, informed, key, self.ground
        )
        due = state.tick % self.decimation == 0
        action = jnp.where(due, self.choose(params, state, observation), state.action)
        if observer.commands:
            control = commanded(self.acting.base, observer.commands, control, command_given.command)
        acted, servo = self.acting.update(Acted(control, action), state.acted, sensors)
        memory = observer.remembered(state.memory, observer.readings(sensors, self.ground))
        return with_dtypes_of(state, PolicyState(state.tick + 1, acted, memory, action)), servo

    def choose(self, params: PolicyParameters, state: PolicyState, observation: Array) -> Array:
        """The action (a,) of a control step."""
        actor, statistics = params.network
        return _action(actor, statistics, observation)

    def act(self, observation: Array) -> Array:
        """The action (..., a) at observations (..., o)."""
        return _action(self.actor, self.statistics, observation)

    def cycle_rate(self, params: PolicyParameters) -> Any:
        """See `ControllerLike`; that of the controller below, which a modulation may leave."""
        return self.acting.base.cycle_rate(params.control)

    def path(
        self, params: PolicyParameters, state: PolicyState, position: Array
    ) -> PathPoint | None:
        return self.acting.path(Acted(params.control, state.action), state.acted, position)

    def stance(self, state: PolicyState) -> Any:
        return self.acting.stance(state.acted)

    def check(self, params: PolicyParameters) -> None:
        if isinstance(self.acting.base, ChecksParameters):
            self.acting.base.check(params.control)

    def complete(self, values: dict[str, Any]) -> dict[str, Any]:
        base = self.acting.base
        return base.complete(values) if isinstance(base, CompletesValues) else values

    def facts(self) -> dict[str, Any]:
        """What its numbers are, as JSON knows it."""
        return {
            "action": named_section(self.kind, ACTIONS),
            "actions": list(self.kind.names),
            "observation": list(self.observer.names),
            "observer": {
                name: value for name, value in vars(self.observer).items() if name != "own"
            },
            "decimation": self.decimation,
            "step_seconds": self.dt * self.decimation,
            "base": dict(self.base),
            "fixed": dict(self.fixed),
            "versions": versions(),
            **self.about,
        }

    def content(self) -> bytes:
        """The file; the same policy gives the same bytes.

        Raises:
            ParameterError: it observes functions that no file can name.
        """
        groups = self.about.get("own", {"groups": []})["groups"]
        for name, _ in self.observer.own:
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
    """See `Policy.act`; in single precision, as it was learned."""
    actor, statistics = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32), (actor, statistics)
    )
    return jnp.clip(
        actor.mean(statistics.normalize(jnp.asarray(observation, jnp.float32))), -1.0, 1.0
    )


class RandomPolicy(Policy):
    """A policy whose every action is drawn anew, evenly from [-1, 1]; the same in every run."""

    def choose(self, params: PolicyParameters, state: PolicyState, observation: Array) -> Array:
        key = jax.random.fold_in(jax.random.key(1), state.tick)
        return jax.random.uniform(key, state.action.shape, jnp.float32, -1.0, 1.0)


def load_policy(path: str | Path, code: str = "") -> Policy:
    """The policy of a file; the same object as long as its files stay the same.

    Args:
        path: of the file, which holds no code and runs none.
        code: the Python file or module of what the policy observes of one's own, which is run.

    Raises:
        ParameterError: there is no such file, or it holds no policy that this version can read; or it observes
            something of one's own, and `code` is not the file with which it was trained.
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
    """A policy with the functions that it observes."""
    references = [f"{code}:{name}" for name in policy.about["own"]["groups"]]
    readings = tuple(own_readings(policy.setup.load().config, references).items())
    observer = dataclasses.replace(policy.observer, own=readings)
    if len(observer.names) != len(policy.statistics.mean):
        raise ParameterError(
            f"controller is a policy of {len(policy.statistics.mean)} observations: {code} gives others."
        )
    return dataclasses.replace(policy, observer=observer)


def judged_in(setup: Setup) -> dict[str, Any]:
    """The physics and time step [s] of a setup, as a policy's file remembers them."""
    return {"physics": setup.physics, "timestep": float(setup.timestep)}


class _Judged(BaseModel, extra="forbid"):
    physics: Literal[*PRESETS]  # type: ignore[valid-type]
    timestep: Annotated[FiniteFloat, Field(gt=0)]


class _Trained(BaseModel, extra="forbid"):
    steps: int
    training: str


class _Own(BaseModel, extra="forbid"):
    """What a policy observes of one's own: the name and the digest of the file, and the functions in it."""

    file: str
    digest: str
    groups: tuple[str, ...]


class _About(BaseModel, extra="forbid"):
    """What a file says; there are no other keys, and none of them names code."""

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
    trained: _Trained | None = None
    judged: _Judged | None = None
    own: _Own | None = None


@functools.lru_cache(maxsize=8)
def _policy(content: bytes) -> Policy:
    arrays = arrays_of(content, "the file")
    if arrays.get("about", np.zeros(1)).dtype != np.uint8:
        raise FileError("it has no 'about'")
    metadata: _About = read_as(arrays.pop("about").tobytes(), _About, "about")
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
    start_jax()  # with its own settings, on which the last bits of walks depend
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
    if metadata.own is None and policy.observer.names != tuple(map(today, metadata.observation)):
        raise ParameterError("this version observes other numbers under these names")
    # What it acts on is made now, so that nothing is wrong with it later.
    check_quantities(policy.parameters)
    return policy


#: Operators and file format that every runtime of the last years reads.
_OPSET: Final = 17
_IR: Final = 8


def export(policy: Policy) -> bytes:
    """An ONNX model with the input `observation` (n, o) and the output `action` (n, a), both float32.

    Its metadata describe the values: `observation`, `actions` and `action` (what an action does) as JSON.

    Raises:
        ParameterError: the package `onnx` is not installed.
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
