"""The sections of a training file that other files do not have: task, algorithm, evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final

from pydantic import BeforeValidator, Field

from nermo_mjx.learn.acting import ActionKind
from nermo_mjx.learn.observing import OBSERVED, SENSED, TOLD
from nermo_mjx.learn.policy import ACTIONS, action_fields
from nermo_mjx.learn.ppo import PPO
from nermo_mjx.learn.rewards import TERMS
from nermo_mjx.learn.short_horizon import ShortHorizon
from nermo_mjx.specs.fields import Fields, OneOf, Refused, optional
from nermo_mjx.specs.values import Choice, Finite, Numbers, Positive, Whole
from nermo_mjx.specs.walk_fields import Pilot, SceneField

#: Ways of learning, by the name in files.
ALGORITHMS: Final[dict[str, Any]] = {"ppo": PPO, "short_horizon": ShortHorizon}
Algorithm = PPO | ShortHorizon
_Share = Annotated[float, Field(ge=0, le=1)]
_Unit = Annotated[list[float], Numbers("[low, high]", 2, 2)]


class ServoRange(Fields):
    what: ClassVar = "a group of servos"
    expected: ClassVar = "{hip: rad, knee: rad, spine: rad}"
    hip: Annotated[float, Field(ge=0, le=1.6)] = optional("largest change of a hip's servo [rad]")
    knee: Annotated[float, Field(ge=0, le=1.6)] = optional("largest change of a knee's servo [rad]")
    spine: Annotated[float, Field(ge=0, le=1.6)] = optional("largest change of the spine's servo [rad]")


class ModulationFields(Fields):
    what: ClassVar = "an option of 'modulation'"
    expected: ClassVar = "{ranges: {parameter: [low, high]}}"
    ranges: dict[str, _Unit] = optional("parameters of the controller, and their ranges")


class ActionFields(OneOf):
    alone: ClassVar = ("residual", "modulation", "targets")
    expected: ClassVar = "residual, modulation or targets as a name, or {name: {option: value}}"
    other: ClassVar = "is not what an action does"
    other_name: ClassVar = "is {name!r}"
    residual: ServoRange | None = optional("corrections of the controller's servo targets")
    modulation: ModulationFields | None = optional("changes of the controller's parameters")
    targets: ServoRange | None = optional("servo targets around the standing robot's")

    def kind(self) -> ActionKind:
        """What an action does."""
        name, options = self.chosen
        given = {} if options is None else options.model_dump(exclude_unset=True)
        if name == "modulation" and "ranges" in given:
            given["ranges"] = {key: tuple(value) for key, value in given["ranges"].items()}
        made: ActionKind = ACTIONS[name](**given)
        return made


def _named(given: Any) -> Any:
    for name in given if isinstance(given, dict) else ():
        if name not in TERMS:
            raise Refused(f"is no term of the reward; allowed are {', '.join(TERMS)}.", name)
    return given


class TaskFields(Fields):
    what: ClassVar = "a field of a task"
    action: ActionFields = Field(ActionFields(residual=None), description="what an action does")
    observe: list[Annotated[str, Choice((*SENSED, *TOLD))]] = Field([*OBSERVED], description="what a policy observes")
    rewards: Annotated[dict[str, Finite], BeforeValidator(_named)] = optional(
        "weights of the reward's terms",
        properties={
            name: {"type": "number", "description": f"{term.doc} [{term.unit}]"} for name, term in TERMS.items()
        },
        additionalProperties=False,
    )
    set: dict[str, Finite] = Field({}, description="commands and sensors: command.speed, sensing.delay, ...")
    bodies: bool = Field(False, description="whether each episode draws one of the identified bodies")
    decimation: Annotated[int, Whole(1, 100)] = Field(1, description="control ticks for which an action is held")
    duration: Positive = Field(10.0, description="length of an episode [s]")
    distance: Positive = optional("distance at which an episode ends [m]")
    corridor: Positive = optional("distance from the path at which an episode fails [m]")


class PpoFields(Fields):
    what: ClassVar = "an option of 'ppo'"
    horizon: Annotated[int, Whole(1, 10_000)] = optional("control steps of each world in an iteration, by default 16")
    discount: _Share = optional("of the next control step's reward, by default 0.97")
    trace: _Share = optional("lambda of the advantages, by default 0.95")
    epochs: Annotated[int, Whole(1, 1_000)] = optional("passes over an iteration's steps, by default 4")
    minibatches: Annotated[int, Whole(1, 10_000)] = optional("parts of a pass, by default 4")
    clip: Positive = optional("how far the probability ratio may move, by default 0.2")
    rate: Positive = optional("learning rate, by default 0.001")
    kl: float | None = optional("change of the policy that the rate follows [nat], by default 0.01; null: none")
    entropy: Annotated[float, Field(ge=0)] = optional("weight of the policy's entropy, by default 0.001")
    std: Positive = optional("initial standard deviation of the actions, by default 0.3")
    hidden: list[Annotated[int, Whole(1, 4096)]] = optional("units of each hidden layer, by default [64, 64]")


class ShortHorizonFields(Fields):
    what: ClassVar = "an option of 'short_horizon'"
    horizon: Annotated[int, Whole(1, 10_000)] = optional("control steps under a derivative, by default 16")
    discount: _Share = optional("of the next control step's reward, by default 0.97")
    trace: _Share = optional("lambda of the critic's targets, by default 0.95")
    epochs: Annotated[int, Whole(1, 1_000)] = optional("passes of the critic over an iteration's steps, by default 16")
    minibatches: Annotated[int, Whole(1, 10_000)] = optional("parts of a pass, by default 4")
    rate: Positive = optional("learning rate of the actor, by default 0.0005")
    critic_rate: Positive = optional("learning rate of the critic, by default 0.001")
    follow: _Share = optional("fraction by which the slow copy moves to the critic, by default 0.3")
    entropy: Annotated[float, Field(ge=0)] = optional("weight of the policy's entropy, by default 0")
    std: Positive = optional("initial standard deviation of the actions, by default 0.1")
    hidden: list[Annotated[int, Whole(1, 4096)]] = optional("units of each hidden layer, by default [64, 64]")


class AlgorithmFields(OneOf):
    alone: ClassVar = ("ppo", "short_horizon")
    expected: ClassVar = "ppo or short_horizon as a name, or {name: {option: value}}"
    other: ClassVar = "is not a way of learning"
    other_name: ClassVar = "is {name!r}"
    ppo: PpoFields | None = optional("proximal policy optimization, on MuJoCo C")
    short_horizon: ShortHorizonFields | None = optional("the policy's exact gradient over short horizons, on MJX")

    def algorithm(self) -> Algorithm:
        """The way of learning."""
        name, options = self.chosen
        given = {} if options is None else options.model_dump(exclude_unset=True)
        if "hidden" in given:
            given["hidden"] = tuple(given["hidden"])
        made: Algorithm = ALGORITHMS[name](**given)
        return made


class EvaluationFields(Fields):
    what: ClassVar = "a field of the evaluation"
    bodies: Annotated[int, Whole(1, 100_000)] = Field(100, description="unseen bodies and starts, on each scene")
    scenes: list[str] = optional("where it is evaluated, by default where it learned")
    distance: Annotated[float, Field(ge=0)] = Field(0.0, description="distance required for success [m]")
    set: dict[str, Finite] = Field({}, description="parameters that are not drawn there, such as terrain.height")
    randomize: dict[str, _Unit] = Field({}, description="ranges that differ from those of the training's draws")


class SceneFields(Fields):
    what: ClassVar = "a field of a scene"
    example: ClassVar = "scene: planks"
    scene: SceneField = Field(description="where it walks, as the file's own 'scene'")
    pilot: Pilot = optional("what steers the robot there, by default the file's own")
    corridor: Positive = optional("distance from the path at which an episode fails there [m]")
    share: Positive = Field(1.0, description="of the worlds, relative to those of the other scenes")
    set: dict[str, Finite] = Field({}, description="parameters with one value there")
    randomize: dict[str, _Unit] = Field({}, description="what each episode draws there, in addition to the file's own")


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """How a policy is evaluated: on a number of unseen bodies and starts, on each of these scenes.

    Attributes:
        bodies: on each scene.
        scenes: by name, or MJCF; empty for the training's own.
        distance: required for success [m].
        set: parameters that are not drawn, on the scenes that have them.
        randomize: ranges there, instead of those of the training.
    """

    bodies: int = 100
    scenes: tuple[str, ...] = ()
    distance: float = 0.0
    set: Mapping[str, float] = dataclasses.field(default_factory=dict)
    randomize: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)


def algorithm_fields(algorithm: Algorithm) -> dict[str, dict[str, Any]]:
    """As it stands in a training file."""
    name = next(name for name, each in ALGORITHMS.items() if isinstance(algorithm, each))
    return {name: {key: list(value) if isinstance(value, tuple) else value
                   for key, value in dataclasses.asdict(algorithm).items()}}  # fmt: skip


def written_action(kind: ActionKind) -> dict[str, Any]:
    """What an action does, as it stands in a training file."""
    name, options = action_fields(kind)
    if name == "modulation":
        options = {"ranges": {key: list(value) for key, value in options["ranges"].items()}}
    return {name: options}
