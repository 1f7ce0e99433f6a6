"""A walk as files describe it: its setup, its duration, the fixed parameters, and which section gives which value."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

from nermo_mjx.control.published import ProfileSteering
from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import Metric, Run, Setup, all_metrics, all_parameters
from nermo_mjx.specs.controllers import named_controller, named_metrics, written_controller, written_metrics
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.unread import is_terrain, unread
from nermo_mjx.specs.values import PARAMETERS, check_value
from nermo_mjx.specs.walk_fields import SETUP_FIELDS, RunFields, WalkFields

#: Values of a pilot's option that files give as words.
_SIDES: Final = {"left": 1.0, "right": -1.0}


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
        unread_shape = {name for name in self.fixed if is_terrain(name) and unread(self.setup, name)}
        return {name: self.fixed[name] for name in self.fixed if name not in unread_shape} | self.pilot_parameters

    @property
    def pilot_parameters(self) -> dict[str, float]:
        """The pilot's options that are parameters, by their names."""
        return {f"pilot.{key}": value for key, value in self.pilot.items() if f"pilot.{key}" in PARAMETERS}

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
        own, given = self.setup.controller is not None, self.setup.fields()
        data: dict[str, Any] = {name: given[name] for name in SETUP_FIELDS if name in given and name != "controller"}
        if isinstance(self.setup.steering, ProfileSteering):
            data.pop("steering", None)  # it follows the profile, which may vary
        data |= {"controller": written_controller(self.setup, folder)} if own else {}
        data["timestep"] = float(self.setup.timestep)
        if not own or self.pilot or self.setup.pilot != Setup.pilot:
            data["pilot"] = {self.setup.pilot: dict(self.pilot)} if self.pilot else self.setup.pilot
        names = ("duration", "warmup") if self.run.duration is not None else ("cycles", "warmup_cycles")
        data["run"] = {name: float(getattr(self.run, name)) for name in names}
        data["set"] = dict(self.fixed)
        return data | ({"metrics": written_metrics(self.setup, folder)} if self.setup.metrics else {})


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
            doc.fail(("set", name), f"is under 'set' and also {sources[name]}: give it one source.", name)
    sources |= dict.fromkeys(walk.constants, f"set by 'pilot.{pilot}'")
    sources |= dict.fromkeys(walk.fixed, "fixed under 'set'")

    def check_effect(section: str, name: str) -> None:
        lacks = [unread(setup, name) for setup in setups or [walk.setup]]
        if lacks[0] is not None and all(lacks):
            choice, wanted = lacks[0]
            chosen = " or ".join(dict.fromkeys(getattr(setup, choice) for setup in setups or [walk.setup]))
            doc.fail((section, name), f"has no effect: it is read only with {choice}: {wanted}, and {choice} is "
                                      f"{chosen}.", name)  # fmt: skip

    for name in filter(is_terrain, walk.fixed):
        check_effect("set", name)
    for section, names in sections.items():
        for name in names:
            if name in sources:
                doc.fail((section, name), f"is under '{section}' and also {sources[name]}: give it one source.", name)
            sources[name] = f"under '{section}'"
            check_effect(section, name)
    for name, value in walk.pilot_parameters.items():
        key = name.removeprefix("pilot.")
        if name in walk.fixed:
            doc.fail(("set", name), f"is under 'set' and also set by 'pilot.{pilot}.{key}': give it one source.", name)
        check_value(doc, ("pilot", pilot, key), name, parameters[name], value)


def read_walk(doc: Document, fields: WalkFields) -> dict[str, Any]:
    """The arguments of a `WalkSpec`; raises a `SpecError` where setup or run say that something cannot be."""
    given = doc.data.get("pilot", Setup.pilot)
    pilot, options = fields.pilot.chosen
    choices = {name: getattr(fields, name) for name in SETUP_FIELDS if name in doc.data} | {"pilot": pilot}
    if "scene" in choices:
        choices["scene"] = scene_beside(doc, choices["scene"])
    if pilot == "waypoints":
        choices["waypoints"] = tuple(map(tuple, options.points))
    if fields.controller is not None:
        choices["controller"] = named_controller(doc)
    choices["metrics"] = named_metrics(doc)
    try:
        setup = Setup(**choices)
    except ParameterError as error:
        _refuse_setup(doc, choices, str(error))
    values = pilot_options(given, pilot, options)
    parameters = all_parameters(setup)
    for name, value in fields.set.items():
        check_value(doc, ("set", name), name, parameters[name], value)
    return {"setup": setup, "run": _read_run(doc, fields.run, values), "fixed": fields.set, "pilot": values}


def scene_beside(doc: Document, scene: str) -> str:
    """The scene, or the user's file of that name beside the document."""
    beside = Path(doc.source).parent / scene
    return str(beside) if beside.suffix == ".xml" and os.path.isfile(beside) else scene


def pilot_options(given: Any, pilot: str, options: Any) -> dict[str, Any]:
    """The options of a pilot, in the order of the file: what a directory holds is known by it."""
    values = {key: getattr(options, key) for key in given[pilot] or ()} if isinstance(given, dict) else {}
    return values | {key: _SIDES[side] for key, side in values.items() if isinstance(side, str)}


def _refuse_setup(doc: Document, choices: Mapping[str, Any], message: str) -> NoReturn:
    """Report a setup's errors for the field that they name."""
    field, _, rest = message.partition(" ")
    if field not in choices:
        doc.fail(("pilot", "waypoints", "points"), f"is refused: {message}")
    allowed = re.findall(r"'([^']+)'", rest.partition("allowed")[2])
    hint = "" if "did you mean" in rest else did_you_mean(str(choices[field]), allowed)
    doc.fail((field,), rest.rstrip(".") + (hint or "."))


def _read_run(doc: Document, fields: RunFields | None, pilot: Mapping[str, Any]) -> Run:
    """Length and warm-up of each run; the pilot's distance is one of its ends."""
    values = {name: getattr(fields, name) for name in doc.data.get("run", ())}
    try:
        run = Run(**values, distance=pilot.get("distance"))
    except ParameterError as error:
        subject, _, message = str(error).partition(" ")
        key = subject.removeprefix("run.")
        doc.fail(("pilot", "straight", key) if key == "distance" else ("run", key), message)
    # Defaults are written out: for a run at 1 Hz, seconds equal cycles.
    warmup, length = (float(each) for each in run.seconds(1.0))
    names = ("duration", "warmup") if run.duration is not None else ("cycles", "warmup_cycles")
    return dataclasses.replace(run, **dict(zip(names, (length, warmup), strict=True)))
