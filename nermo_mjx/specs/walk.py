"""A walk as files describe it: its setup, its duration, the fixed parameters, and which section gives which value."""

from __future__ import annotations

import dataclasses
import fnmatch
import math
import os
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, NoReturn

import mujoco
import numpy as np
from pydantic import BeforeValidator, Field, create_model

from nermo_mjx.control.head_and_tail import (
    COUNTER_ROLL,
    COUNTER_YAW,
    GAZE,
    HEAD_NAMES,
    SWING,
    TAIL_MOTIONS,
)
from nermo_mjx.control.parameters import STEERING, robot_choices
from nermo_mjx.control.schedule import Switch
from nermo_mjx.control.spine_modes import SPINES
from nermo_mjx.control.stepping import FREE_TRAJECTORY
from nermo_mjx.robot import GAITS, identified
from nermo_mjx.robot.equipment import MAX_HINGES
from nermo_mjx.robot.parameters import ProfileChoice, ProfileRate
from nermo_mjx.robot.quantity import ParameterError, Quantity, allowed_names
from nermo_mjx.robot.scene import resolve_scene, scenes
from nermo_mjx.robot.terrains import scenes_reading, terrain_values
from nermo_mjx.rollout import Metric, Run, Setup, all_metrics, all_parameters
from nermo_mjx.rollout.loop import check_code
from nermo_mjx.specs.controllers import (
    named_controller,
    named_metrics,
    written_controller,
    written_metrics,
)
from nermo_mjx.specs.fields import Fields, OneOf, Refused, optional, read
from nermo_mjx.specs.reading import Document, FieldPath, describe
from nermo_mjx.specs.values import (
    FILE_PARAMETERS,
    PARAMETERS,
    QUANTITY_SCHEMA,
    ByParameter,
    Finite,
    FiniteInUnits,
    InUnits,
    Metres,
    Positive,
    Seconds,
    Whole,
    check_value,
    number_of,
)

# ---
# Which parameters a setup reads: some have an effect only with one of its choices, or in one scene.


#: Parameters, and groups of them, that are only used with a certain choice of the setup.
_REQUIRED_CHOICES: Final = {
    "spine.amplitude": ("spine", "stride_extension"),
    "spine.phase": ("spine", "stride_extension"),
    **{f"spine.{name}": ("spine", "balance") for name in ("balance_share", "balance_lift")},
    "pilot.turn_rate": ("pilot", "open_loop"),
    "pilot.radius": ("pilot", "arc"),
    "pilot.direction": ("pilot", "arc"),
    "spine.harmonics": ("spine", "harmonics"),
    "head.tilt": ("robot", "nermo_41"),
    **{f"head.{name}": ("head", GAZE) for name in ("gain", "bandwidth", "lead")},
    "tail.angle": ("tail", "articulated"),
    **{
        f"tail.{name}": ("tail_motion", SWING)
        for name in ("swing_amplitude", "swing_gain", "swing_phase")
    },
    **{f"tail.{name}": ("tail_motion", COUNTER_YAW) for name in ("yaw_gain", "bandwidth")},
    "tail.roll_gain": ("tail_motion", COUNTER_ROLL),
    "spine.sagittal_amplitude": ("spine", "sagittal_extension"),
    "spine.sagittal_phase": ("spine", "sagittal_extension"),
    "spine.pitch_gain": ("spine", "pitch_balance"),
    "spine.pitch_damping": ("spine", "pitch_balance"),
    "limb": ("trajectory", FREE_TRAJECTORY),
    "foot": ("trajectory", FREE_TRAJECTORY),
    "trim": ("trajectory", FREE_TRAJECTORY),
}


def unread(setup: Setup, name: str) -> tuple[str, str] | None:
    """The choice that a parameter requires, and its required values; None if the parameter is used."""
    if is_terrain(name) and name not in terrain_values(str(setup.scene)):
        return "scene", scenes_reading(name)[0]
    groups = (
        [name.rsplit(".", up)[0] for up in range(name.count(".") + 1)]
        if setup.controller is None
        else []
    )
    choice, requirement = next(
        (_REQUIRED_CHOICES[group] for group in groups if group in _REQUIRED_CHOICES), ("", "")
    )
    acting = setup.modes.get(choice) or getattr(setup, choice, "").split("+")
    return (choice, requirement) if choice and requirement not in acting else None


def is_terrain(name: str) -> bool:
    """Whether a parameter is one of the terrain's shape."""
    return name.startswith("terrain.")


# ---
# The declared fields of all files that describe a walk: setup, pilot, run and fixed parameters.


def _kept(value: Any) -> Any:
    if not isinstance(value, mujoco.MjSpec):
        return value
    try:
        return resolve_scene(value)
    except ParameterError as error:
        raise Refused(str(error).removeprefix("scene ")) from None


SceneField = Annotated[
    str,
    BeforeValidator(_kept),
    Field(json_schema_extra={"anyOf": [{"enum": [*scenes()]}, {"pattern": r"\.xml$|^\s*<"}]}),
]


def _in_a_file(name: str) -> tuple[Any, Any]:
    """A choice of the setup as a field of a file: one of several names, by default that of `Setup`."""
    field = Setup.__dataclass_fields__[name]
    declaration = field.metadata["doc"]
    allowed = [*(allowed_names(Setup) | {"spine": SPINES}).get(name, ())]
    if name in ("timestep", "control_rate", "controller"):
        return str if name == "controller" else float, optional(declaration)
    if isinstance(field.default, ProfileChoice):  # changes with the profile, which no JSON has
        extra: Any = {"enum": allowed, "default": str(field.default)}
        return str, Field(
            default_factory=lambda: field.default, description=declaration, json_schema_extra=extra
        )
    kind = {"scene": SceneField, "hinges": Annotated[int, Whole(1, MAX_HINGES)]}.get(name, str)
    names: Any = {"json_schema_extra": {"enum": allowed}} if allowed else {}
    return kind, Field(default=field.default, description=declaration, **names)


#: Choices of a setup that are fields of a file; the others stand in sections, or only in Python.
SETUP_FIELDS: Final = tuple(
    field.name
    for field in dataclasses.fields(Setup)
    if field.name not in ("pilot", "waypoints", "command", "metrics", "schedule")
)
_FILE_FIELDS: Final[dict[str, Any]] = {name: _in_a_file(name) for name in SETUP_FIELDS}
SetupFields: Any = create_model("SetupFields", __base__=Fields, **_FILE_FIELDS)


class Straight(Fields):
    what: ClassVar = "an option of the pilot 'straight'"
    distance: Metres = optional("distance at which measuring ends [m]", exclusiveMinimum=0)


class Arc(Fields):
    what: ClassVar = "an option of the pilot 'arc'"
    radius: Annotated[float, InUnits(PARAMETERS["pilot.radius"])] = optional(
        **number_of("pilot.radius")
    )
    direction: float | Literal["left", "right"] = optional(
        "side of the circle; 1 is left, -1 right"
    )


def _rows(value: Any) -> Any:
    for row in value if isinstance(value, list) else [value]:
        if not isinstance(row, list) or len(row) != 2:
            raise Refused(f"has {describe(row)}: expected {Waypoints.example}.")
    return value


class Waypoints(Fields):
    what: ClassVar = "an option of the pilot 'waypoints'"
    example: ClassVar = "points: [[x, y], ...] in metres"
    points: Annotated[list[list[Metres]], BeforeValidator(_rows)] = Field(
        description="(x, y) of each [m]; a smooth curve goes through them",
        json_schema_extra={
            "minItems": 3,
            "items": {"type": "array", "items": QUANTITY_SCHEMA, "minItems": 2, "maxItems": 2},
        },
    )


class OpenLoopFields(Fields):
    what: ClassVar = "an option of the pilot 'open_loop'"
    turn_rate: Annotated[float, InUnits(PARAMETERS["pilot.turn_rate"])] = optional(
        **number_of("pilot.turn_rate")
    )


class PilotFields(OneOf):
    alone: ClassVar = ("straight", "arc", "open_loop")
    expected: ClassVar = (
        "straight, arc, waypoints or open_loop as a name or {name: {option: value}}"
    )
    other: ClassVar = "is {name!r}"
    other_name: ClassVar = other
    straight: Straight | None = optional("along the y axis")
    arc: Arc | None = optional("along a circle")
    waypoints: Waypoints = optional("along a course")
    open_loop: OpenLoopFields | None = optional("at a constant turn rate")

    @classmethod
    def written_out(cls, value: Any) -> Any:
        if value == "external" or (isinstance(value, dict) and list(value) == ["external"]):
            raise Refused(
                "is 'external', which takes its command from Python: use rollout.Simulator."
            )
        return super().written_out(value)


class RunFields(Fields):
    what: ClassVar = "a field of a run"
    cycles: float = optional("length in gait cycles, by default 8", exclusiveMinimum=0)
    warmup_cycles: float = optional("of these not measured, by default 2", minimum=0)
    duration: Seconds = optional("length in simulated seconds", exclusiveMinimum=0)
    warmup: Seconds = optional("of these not measured, by default 0", minimum=0)


class SwitchFields(Fields):
    what: ClassVar = "a field of a switch"
    example: ClassVar = "{at: 2.0, gait: lateral_walk}"
    at: Annotated[Seconds, Field(ge=0, allow_inf_nan=False)] = Field(
        description="when it begins [s]"
    )
    blend: Positive = Field(1.0, description="how long it takes, in gait cycles")
    gait: str = optional("the next gait", enum=[*GAITS])
    steering: str = optional("what turns the robot from then on", enum=[*STEERING])
    spine: str = optional("modes of the spine from then on", enum=[*SPINES])
    head: str = optional("what the head does from then on", enum=[*HEAD_NAMES])
    tail_motion: str = optional("what the tail does from then on", enum=[*TAIL_MOTIONS])
    set: dict[str, FiniteInUnits] = Field(
        {}, description="parameters of the controller from then on"
    )


class WalkFields(SetupFields):
    """Fields of a file that describes a walk."""

    sources: ClassVar[str]  #: sections that give parameters their values, for messages
    pilot: PilotFields = Field(PilotFields(straight=None), description="what steers the robot")
    run: RunFields = optional("how long a run lasts")
    set: Annotated[dict[str, float], ByParameter(numbers=True)] = Field(
        {}, description="one value for all runs"
    )
    schedule: list[SwitchFields] = Field([], description="what changes while the robot walks")
    metrics: str | list[str] = optional(
        "custom metrics: FILE.py, from this file's folder, FILE.py:NAME, MODULE or MODULE:NAME, or a list of such"
    )

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in FILE_PARAMETERS.get():
            raise Refused(f"is a parameter, not {cls.what}: put it under {cls.sources}.", key)
        super().refuse(key)

    @classmethod
    def called(cls, path: FieldPath) -> str:
        """Entries of a section by their parameter's name alone, but for what is inside of a tuned parameter."""
        is_parameter = path[:1] in (("set",), ("vary",), ("randomize",)) or (
            path[:1] == ("tune",) and len(path) == 2
        )
        return (
            str(path[1])
            if is_parameter and path[1:] and path[1] not in ("repeats", "from")
            else super().called(path)
        )


class RecordedSetup(SetupFields):
    """The setup of a recording, as `Setup.fields` writes it."""

    what: ClassVar = "a choice of a setup"
    pilot: str = optional()
    waypoints: Annotated[list[list[Finite]], BeforeValidator(_rows)] = optional()

    @classmethod
    def choices(cls, recorded: Mapping[str, Any], *names: str) -> dict[str, Any]:
        """The choices of `Setup` that a recording names, of these or of all; without what may change meanwhile.

        Raises:
            SpecError: one is none, or has another type.
        """
        left_out = ("metrics", "schedule")
        choices = {
            name: value
            for name, value in recorded.items()
            if value is not None and name not in left_out
        }
        choices = {name: choices[name] for name in names or choices if name in choices}
        fields = read(Document("the recording", choices), cls)
        return {name: getattr(fields, name) for name in choices}


#: Values of a pilot's option that files give as words.
SIDE_SIGNS: Final = {"left": 1.0, "right": -1.0}


@dataclasses.dataclass(frozen=True)
class WalkSpec:
    """A walk whose parameters can be changed.

    Attributes:
        setup: the static choices: robot, scene, gait, spine mode, pilot.
        run: how long each run lasts, and how much of it is warm-up.
        fixed: parameters set to one value for all runs (`set`).
        pilot: options of the pilot, as given.
    """

    setup: Setup
    run: Run
    fixed: Mapping[str, float]
    pilot: Mapping[str, Any]

    @property
    def constants(self) -> dict[str, float]:
        """Every parameter with one value for all runs: `set` and the pilot's options.

        Of a sweep over scenes, each has those parameters of the terrain that it reads.
        """
        unread_shape = {
            name for name in self.fixed if is_terrain(name) and unread(self.setup, name)
        }
        return {
            name: self.fixed[name] for name in self.fixed if name not in unread_shape
        } | self.pilot_parameters

    @property
    def pilot_parameters(self) -> dict[str, float]:
        """The pilot's options that are parameters, by their names."""
        return {
            f"pilot.{key}": value
            for key, value in self.pilot.items()
            if f"pilot.{key}" in PARAMETERS
        }

    @property
    def parameters(self) -> dict[str, Quantity]:
        """All parameters of this setup, by name."""
        return all_parameters(self.setup)

    @property
    def metrics(self) -> dict[str, Metric]:
        """All metrics of a run of this setup, by name."""
        return all_metrics(self.setup)

    def walk_fields(self, folder: Path | None = None) -> dict[str, Any]:
        """Setup, pilot, run and fixed parameters, as written in a file.

        Args:
            folder: where the file is to stand, resolved: a controller in it is named from there.
        """
        is_custom, fields = self.setup.controller is not None, self.setup.fields()
        data: dict[str, Any] = {
            name: fields[name] for name in SETUP_FIELDS if name in fields and name != "controller"
        }
        for name in ("steering", "control_rate", *robot_choices(self.setup.profile)):
            if isinstance(getattr(self.setup, name), ProfileChoice | ProfileRate):
                data.pop(name, None)  # it follows the profile, which may vary
        data |= {"controller": written_controller(self.setup, folder)} if is_custom else {}
        data["timestep"] = float(self.setup.timestep)
        if not is_custom or self.pilot or self.setup.pilot != Setup.pilot:
            data["pilot"] = {self.setup.pilot: dict(self.pilot)} if self.pilot else self.setup.pilot
        names = (
            ("duration", "warmup") if self.run.duration is not None else ("cycles", "warmup_cycles")
        )
        data["run"] = {name: float(getattr(self.run, name)) for name in names}
        data["set"] = dict(self.fixed)
        data |= {"schedule": fields["schedule"]} if self.setup.schedule else {}
        return data | (
            {"metrics": written_metrics(self.setup, folder)} if self.setup.metrics else {}
        )


def check_sources(
    doc: Document,
    walk: WalkSpec,
    sections: Mapping[str, list[str]],
    bodies: Collection[str] = (),
    setups: Collection[Setup] = (),
) -> None:
    """Fail if a parameter has two sources, or no effect.

    Args:
        sections: names of the parameters that each section of the file changes.
        bodies: names of the parameters that `randomize.from` draws together.
        setups: where a parameter has to be read by one of several, these; else the walk's own.
    """
    parameters, pilot = walk.parameters, walk.setup.pilot
    sources = dict.fromkeys(bodies, "drawn by 'randomize.from'")
    for name in walk.fixed:
        if name in sources:
            doc.fail(
                ("set", name), f"is under 'set' and also {sources[name]}: give it one source.", name
            )
    sources |= dict.fromkeys(walk.constants, f"set by 'pilot.{pilot}'")
    sources |= dict.fromkeys(walk.fixed, "fixed under 'set'")

    def check_effect(section: str, name: str) -> None:
        lacks = [unread(setup, name) for setup in setups or [walk.setup]]
        if lacks[0] is not None and all(lacks):
            choice, requirement = lacks[0]
            choices = " or ".join(
                dict.fromkeys(getattr(setup, choice) for setup in setups or [walk.setup])
            )
            doc.fail(
                (section, name),
                f"has no effect: it is read only with {choice}: {requirement}, and {choice} is {choices}.",
                name,
            )

    for name in filter(is_terrain, walk.fixed):
        check_effect("set", name)
    for section, names in sections.items():
        for name in names:
            if name in sources:
                doc.fail(
                    (section, name),
                    f"is under '{section}' and also {sources[name]}: give it one source.",
                    name,
                )
            sources[name] = f"under '{section}'"
            check_effect(section, name)
    for name, value in walk.pilot_parameters.items():
        key = name.removeprefix("pilot.")
        if name in walk.fixed:
            doc.fail(
                ("set", name),
                f"is under 'set' and also set by 'pilot.{pilot}.{key}': give it one source.",
                name,
            )
        check_value(doc, ("pilot", pilot, key), name, parameters[name], value)


def read_walk(doc: Document, fields: WalkFields) -> dict[str, Any]:
    """The arguments of a `WalkSpec`; raises a `SpecError` where setup or run say that something cannot be."""
    pilot_value = doc.data.get("pilot", Setup.pilot)
    pilot, options = fields.pilot.chosen
    choices = {name: getattr(fields, name) for name in SETUP_FIELDS if name in doc.data} | {
        "pilot": pilot
    }
    if "scene" in choices:
        choices["scene"] = scene_beside(doc, choices["scene"])
    if pilot == "waypoints":
        choices["waypoints"] = tuple(map(tuple, options.points))
    if fields.controller is not None:
        choices["controller"] = named_controller(doc)
    choices["metrics"] = named_metrics(doc)
    choices["schedule"] = read_schedule(doc, fields.schedule)
    try:
        setup = Setup(**choices)
        check_code(setup)
    except ParameterError as error:  # about the field that it names
        field, _, reason = str(error).partition(" ")
        if field.startswith("schedule"):
            doc.fail(("schedule", *(int(part) - 1 for part in field.split(".")[1:])), reason)
        if field not in choices:
            doc.fail(("pilot", "waypoints", "points"), f"is refused: {error}")
        doc.fail((field,), reason)
    values = pilot_options(pilot_value, pilot, options)
    parameters = all_parameters(setup)
    for name, value in fields.set.items():
        check_value(doc, ("set", name), name, parameters[name], value)
    length = {name: getattr(fields.run, name) for name in doc.data.get("run", ())}
    try:
        run = Run(
            **length, distance=values.get("distance")
        )  # the pilot's distance is one of its ends
    except ParameterError as error:
        subject, _, message = str(error).partition(" ")
        key = subject.removeprefix("run.")
        doc.fail(("pilot", "straight", key) if key == "distance" else ("run", key), message)
    # Defaults are written out: for a run at 1 Hz, seconds equal cycles.
    warmup, end = (float(duration) for duration in run.seconds(1.0))
    names = ("duration", "warmup") if run.duration is not None else ("cycles", "warmup_cycles")
    run = dataclasses.replace(run, **dict(zip(names, (end, warmup), strict=True)))
    return {"setup": setup, "run": run, "fixed": fields.set, "pilot": values}


def read_schedule(doc: Document, entries: list[SwitchFields]) -> tuple[Switch, ...]:
    """The switches of a file."""
    switches = []
    for number, entry in enumerate(entries):
        try:
            switches.append(Switch(values=entry.set, **entry.model_dump(exclude={"set"})))
        except ParameterError as error:
            field, _, message = str(error).partition(" ")
            doc.fail(
                ("schedule", number) if field == "switch" else ("schedule", number, field), message
            )
    return tuple(switches)


def scene_beside(doc: Document, scene: str) -> str:
    """The scene, or the user's file of that name beside the document."""
    path = Path(doc.source).parent / scene
    return str(path) if path.suffix == ".xml" and os.path.isfile(path) else scene


def pilot_options(value: Any, pilot: str, options: Any) -> dict[str, Any]:
    """The options of a pilot, in the order of the file: what a directory holds is known by it."""
    values = (
        {key: getattr(options, key) for key in value[pilot] or ()}
        if isinstance(value, dict)
        else {}
    )
    return values | {key: SIDE_SIGNS[side] for key, side in values.items() if isinstance(side, str)}


# ---
# Values that are refused together, or by what is derived from them, are refused with the file's line.


#: Combinations of values tried in all.
_MAX_COMBINATIONS: Final = 50_000
#: Parameters of the published robot that are checked together; those of a custom controller may be.
_COUPLED_PARAMETERS: Final = ("stride", "stance.*", "limb.*", "geometry.*", "servo.kp", "servo.kv")


def check_reach(
    doc: Document,
    setup: Setup,
    fixed: Mapping[str, float],
    tried: Mapping[str, Mapping[str, np.ndarray]],
) -> None:
    """Fail at the field whose values `Setup.check` refuses, by themselves or combined: what is derived from them is out
    of range, the controller refuses them, or a foot leaves its leg's workspace.

    Args:
        setup: static choices; the leg's routing decides what it reaches.
        fixed: parameters with one value.
        tried: values to try of the others, by the section of the file and by name.
    """
    parameters = all_parameters(setup)
    parts = {"set": {name: np.array([value]) for name, value in fixed.items()}, **tried}
    sections = {
        name: section
        for section, names in parts.items()
        for name in names
        if not unread(setup, name)
    }
    values: dict[str, np.ndarray] = {}
    for name, section in sections.items():
        column, declaration = np.unique(parts[section][name]), parameters[name]
        # An open bound is only approached.
        on_bound = (declaration.open_low & (column <= declaration.low)) | (
            declaration.open_high & (column >= declaration.high)
        )
        values |= {name: column[~on_bound]} if not on_bound.all() else {}
    constant = {name: column[0] for name, column in values.items() if len(column) == 1}

    def refuse(error: ParameterError, name: str, values: np.ndarray) -> NoReturn:
        """Fail at the parameter that the error is about, or else at this one, with the value of it."""
        subject, _, message = str(error).partition(" ")
        message = message if subject in sections else f"is {values[0]:g}, with which {error}"
        name = subject if subject in sections else name
        doc.fail((sections[name], name), message, name)

    def refusal(selection: Mapping[str, np.ndarray]) -> ParameterError | None:
        try:
            setup.check(setup.world({**constant, **selection}))
        except ParameterError as error:
            return error
        return None

    several = {name: column for name, column in values.items() if len(column) > 1}
    for name, column in (*list(values.items())[:1], *several.items()):
        if (error := refusal({name: column} if name in several else {})) is not None:
            while (
                len(column) > 1 and str(error).partition(" ")[0] not in sections
            ):  # halve until one is left
                first, remainder = np.array_split(column, 2)
                column = first if refusal({name: first}) else remainder
                error = refusal({name: column}) or error
            refuse(error, name, column)
    groups = _COUPLED_PARAMETERS if setup.controller is None else ("*",)
    mesh = {
        name: column
        for name, column in values.items()
        if any(fnmatch.fnmatchcase(name, p) for p in groups)
    }
    while math.prod(map(len, mesh.values())) > _MAX_COMBINATIONS:
        longest = max(mesh, key=lambda name: len(mesh[name]))
        mesh[longest] = mesh[longest][
            np.linspace(0, len(mesh[longest]) - 1, len(mesh[longest]) // 2).astype(int)
        ]
    combined = [grid.reshape(-1) for grid in np.meshgrid(*mesh.values(), indexing="ij")]
    if len(mesh) > 1 and (error := refusal(dict(zip(mesh, combined, strict=True)))) is not None:
        name = next(iter(mesh))
        refuse(error, name, mesh[name])


# ---
# Patterns in place of parameter names, so that 64 parameters take one line: `foot.*_left.y?`, `spine.harmonics.*`.
#
# Shell-style patterns: `*` matches anything, `?` one character, `[1-4]` one of these. A pattern means every
# parameter whose name it matches, as if each were listed with the given value.


#: Sections of files whose keys are names of parameters.
_SECTIONS: Final = ("set", "vary", "tune", "randomize")


def matches(pattern: str, names: Iterable[str]) -> list[str]:
    """The names that a pattern matches, in their order.

    >>> matches("spine.*e", ["spine.amplitude", "spine.harmonics.cos1", "stance.front_y"])
    ['spine.amplitude']
    """
    return [name for name in names if fnmatch.fnmatchcase(name, pattern)]


def is_pattern(key: str) -> bool:
    """Whether a key is a pattern rather than a name."""
    return any(mark in key for mark in "*?[")


def written_out(doc: Document) -> Document:
    """The document with its patterns expanded to the names that they match.

    A name given explicitly takes precedence over patterns.

    Raises:
        SpecError: a pattern matches nothing, or two patterns match one name.
    """
    data, lines = dict(doc.data), dict(doc.lines)
    for section in _SECTIONS:
        entries = data.get(section)
        if not (isinstance(entries, dict) and any(map(is_pattern, entries))):
            continue
        origin: dict[str, str] = {}  # of each name, the key of the file that it has its value from
        for key in entries:
            names = matches(key, FILE_PARAMETERS.get()) if is_pattern(key) else [key]
            if not names:
                doc.fail(
                    (section, key),
                    "matches no parameter (nermo-mjx sweep --list-parameters prints all).",
                    key,
                )
            for name in names if is_pattern(key) else ():
                if name in origin and name not in entries:
                    doc.fail(
                        (section, key),
                        f"and '{origin[name]}' both match {name}: give it one source.",
                        key,
                    )
            origin |= {name: key for name in names if name == key or name not in entries}
        data[section] = {name: entries[key] for name, key in origin.items()}
        below: dict[str, list[FieldPath]] = {}
        for path in doc.lines:
            if len(path) > 1 and path[0] == section:
                below.setdefault(str(path[1]), []).append(path)
        for name, key in origin.items():
            lines |= {(section, name, *path[2:]): doc.lines[path] for path in below.get(key, ())}
    return in_numbers(dataclasses.replace(doc, data=data, lines=lines))


def with_body(doc: Document, source: str | None) -> Document:
    """The document with the best body of an identification's directory under `set`, but for what the file names.

    Raises:
        ParameterError: the directory has no bodies.
    """
    fixed = doc.data.get("set") or {}
    if source is None or not isinstance(fixed, dict):
        return doc
    best = identified.best(source)
    sections = [
        entries for section in _SECTIONS if isinstance(entries := doc.data.get(section), dict)
    ]
    keys = {key for section in sections for key in section}
    names = {name for key in keys for name in (matches(key, best) if is_pattern(key) else [key])}
    body = {name: value for name, value in best.items() if name not in names}
    return dataclasses.replace(doc, data=doc.data | {"set": body | fixed})


def in_numbers(doc: Document, additional: Mapping[str, Quantity] | None = None) -> Document:
    """The document with SI numbers in the place of texts such as `-45 deg`, wherever a parameter's name stands before,
    or one of `more`.

    Raises:
        SpecError: a text has a unit that does not convert.
    """
    declarations = {**FILE_PARAMETERS.get(), **(additional or {})}

    def number(field_value: Any, path: FieldPath, name: str) -> Any:
        if isinstance(field_value, dict):
            return {
                key: number(value, (*path, key), key if key in declarations else name)
                for key, value in field_value.items()
            }
        if isinstance(field_value, list):
            return [number(value, (*path, i), name) for i, value in enumerate(field_value)]
        if not (
            name
            and isinstance(field_value, str)
            and re.match(QUANTITY_SCHEMA["pattern"], field_value)
        ):
            return field_value
        if (converted := declarations[name].number(field_value)) is None:
            doc.fail(
                path,
                f"is {describe(field_value)}: {declarations[name].expected}",
                WalkFields.called(path),
            )
        return converted

    return dataclasses.replace(doc, data=number(doc.data, (), ""))
