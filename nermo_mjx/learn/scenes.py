"""Several scenes in one training: each has its own pilot, values and draws, and some of the worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pydantic import ConfigDict, Field

from nermo_mjx.learn.task import Task
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Setup
from nermo_mjx.specs.fields import Fields, optional
from nermo_mjx.specs.model import plain
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.values import Ends, Finite, Positive
from nermo_mjx.specs.walk import pilot_options, scene_beside
from nermo_mjx.specs.walk_fields import Pilot, SceneField


class SceneFields(Fields):
    """One of the `scenes` of a training file."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    what: ClassVar = "a field of a scene"
    example: ClassVar = "scene: planks"
    scene: SceneField
    """where it walks, as the file's own 'scene'"""
    pilot: Pilot = optional("what steers the robot there, by default the file's own")
    corridor: Positive = optional("distance from the path at which an episode fails there [m]")
    share: Positive = 1.0
    """of the worlds, relative to those of the other scenes"""
    set: dict[str, Finite] = Field({})
    """parameters with one value there"""
    randomize: dict[str, Ends] = Field({})
    """what each episode draws there, in addition to the file's own"""


@dataclasses.dataclass(frozen=True)
class SceneTask:
    """A scene in which a policy learns.

    Attributes:
        setup: what is chosen by name there.
        task: what the policy does there.
        written: as written in a training file.
        share: of the worlds, relative to those of the other scenes.
    """

    setup: Setup
    task: Task
    written: Mapping[str, Any]
    share: float = 1.0


def read_scenes(doc: Document, fields: Sequence[SceneFields], setup: Setup, task: Task) -> tuple[SceneTask, ...]:
    """The scenes of a training file.

    Args:
        doc: the file.
        fields: its section `scenes`.
        setup, task: what all scenes have in common.

    Raises:
        SpecError: a choice that is refused there, or a scene that stands there twice.
        ParameterError: a value that is refused there.
    """
    found: list[SceneTask] = []
    for i, each in enumerate(fields):
        at = ("scenes", i)
        if each.scene in [other.written["scene"] for other in found]:
            doc.fail((*at, "scene"), f"is {each.scene!r} for a second time: leave one out.")
        choices: dict[str, Any] = {"scene": scene_beside(doc, each.scene)}
        values, written = dict(each.set), dict[str, Any](scene=each.scene)
        if each.pilot is not None:
            pilot, options = each.pilot.chosen
            given = pilot_options(doc.data["scenes"][i]["pilot"], pilot, options)
            if "distance" in given:
                doc.fail((*at, "pilot", pilot, "distance"), "has no effect on a scene of several: leave it out.")
            points = tuple(map(tuple, options.points)) if pilot == "waypoints" else None
            choices |= {"pilot": pilot, "waypoints": points}
            values |= {f"pilot.{key}": value for key, value in given.items() if key != "points"}
            written["pilot"] = {pilot: given} if given else pilot
        try:
            there = dataclasses.replace(setup, **choices)
        except ParameterError as error:
            doc.fail(at, f"is refused: {error}")
        drawn = {name: ends for name, ends in task.randomize.items() if name not in values}
        own = dataclasses.replace(
            task, set={**task.set, **values}, randomize=drawn | each.randomize, corridor=each.corridor or task.corridor
        )
        if each.corridor is not None:
            written["corridor"] = each.corridor
        written |= {name: plain(section) for name in ("set", "randomize") if (section := getattr(each, name))}
        written |= {"share": each.share} if each.share != 1.0 else {}
        found.append(SceneTask(there, own, written, each.share))
    return tuple(found)
