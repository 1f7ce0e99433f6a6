"""The declared fields of all files that describe a walk: setup, pilot, run and fixed parameters."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final, Literal

import mujoco
from pydantic import BeforeValidator, Field

from nermo_mjx.control.free_stepping import FREE
from nermo_mjx.control.fusion import SPINES
from nermo_mjx.control.head import HEADS
from nermo_mjx.control.published import PROFILES, STEERING
from nermo_mjx.control.tail import TAIL_MOTIONS
from nermo_mjx.control.trajectory import FORMS
from nermo_mjx.robot import GAITS
from nermo_mjx.robot.assembly import CONES, ROBOTS, TAILS
from nermo_mjx.robot.flexure import MOST_HINGES
from nermo_mjx.robot.parameters import ROUTINGS
from nermo_mjx.robot.presets import PRESETS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.robot.scene import resolve_scene, scenes
from nermo_mjx.rollout import Setup
from nermo_mjx.specs.fields import Fields, OneOf, Refused, chosen, optional
from nermo_mjx.specs.reading import FieldPath, describe
from nermo_mjx.specs.values import NAMES, ByParameter, Whole, number_of


def _kept(given: Any) -> Any:
    if not isinstance(given, mujoco.MjSpec):
        return given
    try:
        return resolve_scene(given)
    except ParameterError as error:
        raise Refused(str(error).removeprefix("scene ")) from None


SceneField = Annotated[
    str, BeforeValidator(_kept),
    Field(json_schema_extra={"anyOf": [{"enum": [*scenes()]}, {"pattern": r"\.xml$|^\s*<"}]}),
]  # fmt: skip


class SetupFields(Fields):
    """The static choices; `Setup` says which names there are, and their defaults."""

    robot: str = chosen(Setup.robot, ROBOTS, "which robot")
    scene: SceneField = Field(
        str(Setup.scene),
        description="a scene of mjcf/scenes, or a custom one as the path of an MJCF file or as MJCF itself",
    )
    tail: str = chosen(Setup.tail, TAILS, "rigid is a third faster")
    routing: str = chosen(Setup.routing, ROUTINGS, "of the knee's tendon")
    cone: str = chosen(Setup.cone, CONES, "friction cone")
    physics: str = chosen(Setup.physics, PRESETS, "time step and contact pairs")
    timestep: float = optional("physics step [s]: the control period 0.01 s divided by a whole number; "
                            "takes precedence over that of physics")  # fmt: skip
    hinges: Annotated[int, Whole(1, MOST_HINGES)] = Field(
        Setup.hinges, description="of each compliant joint of legs and spine"
    )
    gait: str = chosen(Setup.gait, GAITS, "defaults of duty, offsets and gait factor")
    spine: str = chosen(Setup.spine, SPINES, "its modes")
    steering: str = Field(
        default_factory=lambda: Setup.steering,  # which changes with the profile, and no JSON has
        description="what turns the robot; in the profile as_published by default spine",
        json_schema_extra={"enum": [*STEERING], "default": str(Setup.steering)},
    )
    profile: str = chosen(Setup.profile, PROFILES, "as_published is the published simulation, as_built the robot")
    trajectory: str = chosen(
        Setup.trajectory, (*FORMS, FREE), "form of the foot path; free: cubic, with movable points and numbers of limbs"
    )
    head: str = chosen(Setup.head, HEADS, "gaze keeps its direction in the world")
    tail_motion: str = chosen(Setup.tail_motion, TAIL_MOTIONS, "what the articulated tail does")
    controller: str = optional("another controller: FILE.py:NAME or FILE.npz, from this file's folder, or MODULE:NAME")


SETUP_FIELDS: Final = tuple(SetupFields.model_fields)


class Straight(Fields):
    what: ClassVar = "an option of the pilot 'straight'"
    distance: float = optional("distance at which measuring ends [m]", exclusiveMinimum=0)


class Arc(Fields):
    what: ClassVar = "an option of the pilot 'arc'"
    radius: float = optional(**number_of("pilot.radius"))
    direction: float | Literal["left", "right"] = optional("side of the circle; 1 is left, -1 right")


def _rows(given: Any) -> Any:
    for row in given if isinstance(given, list) else [given]:
        if not isinstance(row, list) or len(row) != 2:
            raise Refused(f"has {describe(row)}: expected {Waypoints.example}.")
    return given


class Waypoints(Fields):
    what: ClassVar = "an option of the pilot 'waypoints'"
    example: ClassVar = "points: [[x, y], ...] in metres"
    points: Annotated[list[list[float]], BeforeValidator(_rows)] = Field(
        description="(x, y) of each [m]; a smooth curve goes through them",
        json_schema_extra={"minItems": 3, "items": {"type": "array", "items": {"type": "number"}, "minItems": 2,
                                                    "maxItems": 2}},
    )  # fmt: skip


class OpenLoop(Fields):
    what: ClassVar = "an option of the pilot 'open_loop'"
    turn_rate: float = optional(**number_of("pilot.turn_rate"))


class Pilot(OneOf):
    alone: ClassVar = ("straight", "arc", "open_loop")
    expected: ClassVar = "straight, arc, waypoints or open_loop as a name or {name: {option: value}}"
    other: ClassVar = "is {name!r}"
    other_name: ClassVar = other
    straight: Straight | None = optional("along the y axis")
    arc: Arc | None = optional("along a circle")
    waypoints: Waypoints = optional("along a course")
    open_loop: OpenLoop | None = optional("at a constant turn rate")

    @classmethod
    def written_out(cls, given: Any) -> Any:
        if given == "external" or (isinstance(given, dict) and list(given) == ["external"]):
            raise Refused("is 'external', which takes its command from Python: use rollout.Simulator.")
        return super().written_out(given)


class RunFields(Fields):
    what: ClassVar = "a field of a run"
    cycles: float = optional("length in gait cycles, by default 8", exclusiveMinimum=0)
    warmup_cycles: float = optional("of these not measured, by default 2", minimum=0)
    duration: float = optional("length in simulated seconds", exclusiveMinimum=0)
    warmup: float = optional("of these not measured, by default 0", minimum=0)


class WalkFields(SetupFields):
    """Fields of a file that describes a walk."""

    sources: ClassVar[str]  #: sections that give parameters their values, for messages
    pilot: Pilot = Field(Pilot(straight=None), description="what steers the robot")
    run: RunFields = optional("how long a run lasts")
    set: Annotated[dict[str, float], ByParameter(numbers=True)] = Field({}, description="one value for all runs")
    metrics: str | list[str] = optional("custom metrics: FILE.py, from this file's folder, FILE.py:NAME, MODULE "
                                        "or MODULE:NAME, or a list of such")  # fmt: skip

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in NAMES.get():
            raise Refused(f"is a parameter, not {cls.what}: put it under {cls.sources}.", key)
        super().refuse(key)

    @classmethod
    def called(cls, path: FieldPath) -> str:
        """Entries of a section by their parameter's name alone, but for what is inside of a tuned parameter."""
        named = path[:1] in (("set",), ("vary",), ("randomize",)) or (path[:1] == ("tune",) and len(path) == 2)
        return str(path[1]) if named and path[1:] and path[1] not in ("repeats", "from") else super().called(path)
