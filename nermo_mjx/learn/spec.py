"""The specification of a training: the checked content of a training file. All errors are reported before the start."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, NamedTuple

from pydantic import ConfigDict, Field

from nermo_mjx.control.protocol import OBJECT_FORM
from nermo_mjx.learn.acting import ACTIONS, ActionController
from nermo_mjx.learn.algorithms import PPO
from nermo_mjx.learn.environment import Environment, Mixture, check_alike, check_worlds
from nermo_mjx.learn.loop import EpisodeLoop
from nermo_mjx.learn.observing import FORMER_NAMES
from nermo_mjx.learn.own import custom_code_file, custom_name, is_custom
from nermo_mjx.learn.task import (
    DEFAULT_RANDOMIZATION,
    EPISODE_PARAMETERS,
    POLICY_PARAMETERS,
    Task,
    task_parameters,
)
from nermo_mjx.robot.parameters import PRESETS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.robot.terrains import terrain_values
from nermo_mjx.rollout import Setup
from nermo_mjx.rollout.custom_metrics import source_of
from nermo_mjx.rollout.run import too_many
from nermo_mjx.specs.controllers import (
    code_beside,
    code_identity,
    kept_code,
    known_names,
    with_code_copied,
    written_code,
)
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, Refused, optional, read
from nermo_mjx.specs.model import Spec, named_section, one_of, written
from nermo_mjx.specs.reading import Document, SpecError, plain_data
from nermo_mjx.specs.values import BodiesField, Choice, Ends, FiniteInUnits, Positive, Way, Whole
from nermo_mjx.specs.walk import (
    PilotFields,
    SceneField,
    WalkFields,
    WalkSpec,
    in_numbers,
    pilot_options,
    read_walk,
    scene_beside,
)
from nermo_mjx.trust import CODE_EXECUTION


class SceneFields(Fields):
    """One of the `scenes` of a training file."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    what: ClassVar = "a field of a scene"
    example: ClassVar = "scene: planks"
    scene: SceneField
    """where it walks, as the file's own 'scene'"""
    pilot: PilotFields = optional("what steers the robot there, by default the file's own")
    corridor: Way = optional("distance from the path at which an episode fails there [m]")
    set: dict[str, FiniteInUnits] = Field({})
    """parameters with one value there"""
    randomize: dict[str, Ends] = Field({})
    """what each episode draws there, in addition to the file's own"""
    share: Positive = 1.0
    """of the worlds, relative to those of the other scenes"""


class SceneTask(NamedTuple):
    """A scene in which a policy learns.

    Attributes:
        setup, task: Setup and task on this scene.
        fields: Fields of the scene in a training file.
        share: Share of the worlds, relative to the shares of the other scenes.
    """

    setup: Setup
    task: Task
    fields: Mapping[str, Any]
    share: float = 1.0


def read_scenes(
    doc: Document, fields: Sequence[SceneFields], setup: Setup, task: Task
) -> tuple[SceneTask, ...]:
    """The scenes of a training file, from its section `scenes`, and the setup and task that all scenes share.

    Raises:
        SpecError: A choice of a scene is invalid, or the section contains a scene twice.
        ParameterError: A value of a scene is invalid.
    """
    scene_tasks: list[SceneTask] = []
    for i, scene_fields in enumerate(fields):
        path = ("scenes", i)
        if scene_fields.scene in [scene_task.fields["scene"] for scene_task in scene_tasks]:
            doc.fail(
                (*path, "scene"), f"is {scene_fields.scene!r} for a second time: leave one out."
            )
        choices: dict[str, Any] = {"scene": scene_beside(doc, scene_fields.scene)}
        values, written_fields = dict(scene_fields.set), dict[str, Any](scene=scene_fields.scene)
        if scene_fields.pilot is not None:
            pilot, options = scene_fields.pilot.chosen
            pilot_choice = pilot_options(doc.data["scenes"][i]["pilot"], pilot, options)
            if "distance" in pilot_choice:
                doc.fail(
                    (*path, "pilot", pilot, "distance"),
                    "has no effect on a scene of several: leave it out.",
                )
            points = tuple(map(tuple, options.points)) if pilot == "waypoints" else None
            choices |= {"pilot": pilot, "waypoints": points}
            values |= {
                f"pilot.{key}": value for key, value in pilot_choice.items() if key != "points"
            }
            written_fields["pilot"] = {pilot: pilot_choice} if pilot_choice else pilot
        try:
            scene_setup = dataclasses.replace(setup, **choices)
        except ParameterError as error:
            doc.fail(path, f"is refused: {error}")
        ranges = {name: ends for name, ends in task.randomize.items() if name not in values}
        scene_only = dataclasses.replace(
            task,
            set={**task.set, **values},
            randomize=ranges | scene_fields.randomize,
            corridor=scene_fields.corridor or task.corridor,
        )
        pilot_choices = {
            name: value
            for name, value in scene_fields
            if value != SceneFields.model_fields[name].default
        }
        written_fields |= plain_data(
            {name: value for name, value in pilot_choices.items() if name != "pilot"}
        )
        scene_tasks.append(SceneTask(scene_setup, scene_only, written_fields, scene_fields.share))
    return tuple(scene_tasks)


#: Fields that do not change the iterations, so that a training can be resumed with other values.
CHANGEABLE_FIELDS: Final = ("steps", "run", "evaluate", "plots")
#: Learning algorithms, by their names in files.
ALGORITHMS: Final[Mapping[str, type[Spec]]] = {"ppo": PPO}


@dataclasses.dataclass(frozen=True)
class EvaluationSpec(Spec):
    """On what a policy is evaluated at the end: unseen bodies and starts, on each of some scenes."""

    what = "a field of the evaluation"
    bodies: Annotated[int, Whole(1, 100_000)] = 100
    """unseen bodies and starts, on each scene"""
    distance: Annotated[float, Field(ge=0)] = 0.0
    """distance required for success [m]"""
    scenes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """where it is evaluated, by default where it learned"""
    set: dict[str, FiniteInUnits] = dataclasses.field(default_factory=dict)
    """parameters that are not drawn there, such as terrain.height, on the scenes that have them"""
    randomize: dict[str, Ends] = dataclasses.field(default_factory=dict)
    """ranges that differ from those of the training's draws"""
    physics: Annotated[str, Choice(tuple(PRESETS))] = None  # type: ignore[assignment]  # none cannot be written
    """physics of its walks and the validation's, with their own time step; by default those of the training"""


@dataclasses.dataclass(frozen=True)
class Until(Spec):
    """When a training ends before its steps are over: at the first checkpoint whose walks are good enough."""

    what = "a field of 'until'"
    expected = "{success: share} or {success: share, speed: m/s}"
    example = "{success: 0.95}"
    success: Annotated[float, Field(gt=0, le=1)]
    """share of the validation's walks that must succeed, on the scene where fewest do"""
    speed: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """speed that a walk must have to count as a success in the validation [m/s]"""


class DrawnFields(Fields):
    """Where bodies are drawn from, and parameters by name: [low, high]."""

    __pydantic_extra__: dict[str, Ends]
    model_config = ConfigDict(extra="allow")
    expected: ClassVar = "a mapping of parameters to their ranges [low, high]"
    bodies: Annotated[str, BodiesField()] = optional("as task.bodies", alias="from")

    @classmethod
    def refuse(cls, key: str) -> None:
        """Accept every key; the task checks the names of the parameters."""


class TrainingFile(WalkFields):
    """A file for `nermo-mjx train`."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    what: ClassVar = "a field of a training"
    sources: ClassVar = "'randomize' or 'set'"
    task: Task = Field(default_factory=Task)
    """what a policy does, and what it is rewarded for"""
    randomize: DrawnFields = Field(
        DrawnFields.model_validate({name: [*ends] for name, ends in DEFAULT_RANDOMIZATION.items()})
    )
    """what each episode draws: a parameter, and its range [low, high]; with from: DIR whole bodies"""
    scenes: list[SceneFields] = optional(
        "instead of 'scene': several, on which one policy learns, the worlds divided among them"
    )
    algorithm: Annotated[
        PPO,
        one_of(
            "Algorithm",
            "is not a way of learning",
            ALGORITHMS,
            {"short_horizon": "which was removed: use ppo"},
        ),
    ] = Field(default_factory=PPO)
    """how a policy is learned"""
    worlds: Annotated[int, Whole(1, 1_000_000)] = 256
    """number of parallel worlds"""
    steps: Annotated[int, Whole(1, 10**12)] = 2_000_000
    """control steps of all worlds together, rounded up to whole iterations"""
    checkpoint: Annotated[int, Whole(1, 10**12)] = 200_000
    """control steps between two checkpoints, after each of which new episodes begin"""
    seed: Annotated[int, Whole(0, 2**32 - 1)] = 0
    """of all that is drawn"""
    validation: Annotated[int, Whole(0, 100_000)] = 0
    """walks on each scene of the evaluation by which the best of all checkpoints becomes the policy; 0: the last one
    does. The best one succeeds most on the scene where it succeeds least"""
    until: Until = optional(
        "when the training ends before its steps are over: at the first checkpoint that the "
        "validation finds good enough"
    )
    evaluate: EvaluationSpec = Field(default_factory=EvaluationSpec)
    """on what the policy is evaluated at the end"""
    plots: bool = True
    """whether figures are made at the end"""

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in ("vary", "tune", "sample"):
            raise Refused(
                "is no field of a training: what differs between episodes stands under 'randomize'.",
                key,
            )
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Training(WalkSpec, Described):
    """A checked training. Build it with `from_file`, `from_text` or `from_dict`.

    >>> Training.from_dict({"worlds": 64, "steps": 10_000}).iterations
    10

    `TrainingFile` documents the fields from `task` on. `run` is the run of the evaluation. A training with `scenes`
    learns on these scenes instead of the setup's scene.
    """

    kind: ClassVar = "training"
    task: Task
    scenes: tuple[SceneTask, ...]
    algorithm: PPO
    worlds: int
    steps: int
    checkpoint: int
    seed: int
    validation: int
    until: Until | None
    evaluation: EvaluationSpec
    plots: bool

    @classmethod
    def of_document(cls, doc: Document) -> Training:
        return _read(doc)

    @property
    def steps_per_iteration(self) -> int:
        """Control steps of all worlds in an iteration."""
        return self.worlds * self.algorithm.horizon

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return -(-self.steps // self.steps_per_iteration)

    @property
    def section(self) -> int:
        """Number of iterations between two checkpoints."""
        return max(1, round(self.checkpoint / self.steps_per_iteration))

    @functools.cached_property
    def step_seconds(self) -> float:
        """Simulated seconds of a control step."""
        return self.setup.make_controller().dt * self.task.decimation

    def environment(self, engine: str) -> Environment | Mixture:
        """The worlds of the training, on the engine `c` or `mjx`."""
        if not self.scenes:
            return Environment(
                self.setup, engine=engine, worlds=self.worlds, task=self.task, staggered=True
            )
        parts = [(scene.setup, scene.task) for scene in self.scenes]
        shares = [scene.share for scene in self.scenes]
        return Mixture(parts, engine=engine, worlds=self.worlds, shares=shares, staggered=True)

    def evaluated(self) -> list[tuple[Setup, Task]]:
        """Setup and task of each scene of the evaluation; values that the evaluation sets are not sampled."""
        pairs_here = [(scene_task.setup, scene_task.task) for scene_task in self.scenes] or [
            (self.setup, self.task)
        ]
        pairs_by_scene = {str(setup.scene): (setup, task) for setup, task in pairs_here}
        pairs = [
            pairs_by_scene.get(scene, (dataclasses.replace(self.setup, scene=scene), self.task))
            for scene in self.evaluation.scenes
        ] or pairs_here
        if (physics := self.evaluation.physics) is not None:
            changes: dict[str, Any] = {"physics": physics, "timestep": PRESETS[physics].timestep}
            pairs = [(dataclasses.replace(setup, **changes), task) for setup, task in pairs]
        return [(setup, _evaluation_task(setup, task, self.evaluation)) for setup, task in pairs]

    def check_division(self) -> None:
        """Raise `ParameterError` if worlds and steps cannot be divided among scenes and minibatches."""
        check_worlds(self.worlds, len(self.scenes))
        parts, size = self.algorithm.minibatches, self.steps_per_iteration
        if size % parts:
            raise ParameterError(
                f"algorithm has {parts} minibatches, and an iteration is {self.worlds} worlds of "
                f"{self.algorithm.horizon} steps: choose a number that divides {size:,}."
            )

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = self.walk_fields(folder)
        task = self.task.replace_custom(lambda reference: written_code(reference, folder))
        data["task"] = written(task) | {"action": named_section(task.action, ACTIONS)}
        data["task"]["rewards"] = {
            str(name): float(weight) for name, weight in task.rewards.items()
        }
        if not task.terminations:
            del data["task"]["terminations"]
        data["task"]["set"] = {
            name: value for name, value in self.task.set.items() if name not in self.constants
        }
        data["randomize"] = {
            name: [float(low), float(high)] for name, (low, high) in self.task.randomize.items()
        }
        if self.scenes:
            data["scenes"] = [dict(scene.fields) for scene in self.scenes]
            del data["scene"]
        data["algorithm"] = named_section(self.algorithm, ALGORITHMS)
        data |= {name: getattr(self, name) for name in ("worlds", "steps", "checkpoint", "seed")}
        data |= {"validation": self.validation} if self.validation else {}
        data |= {} if self.until is None else {"until": written(self.until)}
        data["evaluate"] = {
            name: value
            for name, value in written(self.evaluation).items()
            if value not in ([], {}, None)
        }
        return data | {"plots": self.plots}

    def decisive(self) -> dict[str, Any]:
        """The fields that a resumed training may not change; a controller is identified by its content."""
        data = {
            key: value for key, value in self.resolved().items() if key not in CHANGEABLE_FIELDS
        }
        task_fields = written(self.task.replace_custom(_code_identity))
        data["task"] |= {
            name: task_fields[name]
            for name in ("observe", "rewards", "terminations", "commands")
            if task_fields.get(name)
        }
        return data | code_identity(self.setup)

    def with_code_copied(self, folder: Path, write: Callable[[str, bytes], Any]) -> Training:
        """The training with copies of its custom code in a directory, so that this directory can be moved.

        See `specs.controllers.with_code_copied`.
        """

        def copy_code(task: Task) -> Task:
            return task.replace_custom(
                lambda where: kept_code(where, Path(source_of(where).place).name, folder, write)
            )

        setup = with_code_copied(self.setup, folder, write)
        scenes = tuple(scene._replace(task=copy_code(scene.task)) for scene in self.scenes)
        return dataclasses.replace(self, setup=setup, task=copy_code(self.task), scenes=scenes)

    def identity(self) -> dict[str, Any]:
        """All inputs of an iteration: `fields`, and `defaults` of the fields that a file does not set."""
        return {
            "fields": self.decisive(),
            "defaults": {
                name: declaration.default for name, declaration in self.parameters.items()
            },
        }

    def digest(self) -> str:
        """A hash of the `identity`."""
        return digest_of(*self.identity().values())


def changed(training: Training, **values: Any) -> Training:
    """The training with other steps, worlds, seed or plots; raises `SpecError`."""
    candidate = dataclasses.replace(training, **values)
    candidate.check_division()
    return candidate


def _read(doc: Document) -> Training:
    with known_names(doc):
        doc = in_numbers(
            doc,
            EPISODE_PARAMETERS
            | {
                old: EPISODE_PARAMETERS[new]
                for old, new in FORMER_NAMES.items()
                if new in EPISODE_PARAMETERS
            },
        )
        file = read(doc, TrainingFile)
    if wrong := too_many(file.worlds):
        doc.fail(("worlds",), f"is {file.worlds:,}: {wrong}")
    walk = read_walk(doc, file)
    setup = walk["setup"]
    if setup.controller is not None:
        doc.fail(
            ("controller",),
            "is a custom controller: a policy file can only store a published one; "
            "learn in Python, by nermo_mjx.learn.Environment.",
        )
    task = _read_task(doc, file, walk)
    scenes = _read_scenes(doc, file, setup, task)
    with _report_errors(doc, "evaluate", "scenes"):
        for scene in file.evaluate.scenes:
            dataclasses.replace(setup, scene=scene)
    names = ("algorithm", "worlds", "steps", "checkpoint", "seed", "validation", "until", "plots")
    same = {name: getattr(file, name) for name in names}
    training = Training(**walk, task=task, scenes=scenes, evaluation=file.evaluate, **same)
    with _report_errors(doc):
        training.check_division()
    if file.until is not None and not file.validation:
        doc.fail(
            ("until",),
            "stands without 'validation', the number of walks that decide: add one, such as 60.",
        )
    _check_evaluation(doc, file.evaluate, training)
    return training


def _read_task(doc: Document, file: TrainingFile, walk: Mapping[str, Any]) -> Task:
    """The task of the file, checked in the scene of the walk."""
    setup = walk["setup"]
    fixed = {
        **walk["fixed"],
        **{
            f"pilot.{key}": value
            for key, value in walk["pilot"].items()
            if f"pilot.{key}" in setup.defaults()
        },
    }
    task = dataclasses.replace(
        file.task, set={**fixed, **file.task.set}, randomize=file.randomize.model_extra or {}
    )
    if file.randomize.bodies is not None:
        if task.bodies:
            doc.fail(("randomize", "from"), "stands beside 'task.bodies': leave one of them out.")
        task = dataclasses.replace(task, bodies=file.randomize.bodies)
    with _report_errors(doc, "task"):
        for field in ("observe", "rewards", "terminations"):
            for reference in filter(is_custom, getattr(task, field)):
                if not isinstance(reference, str):
                    raise ParameterError(
                        f"{field} has {custom_name(reference)}: name it as {OBJECT_FORM}, as a file can."
                    )
        task = task.replace_custom(functools.partial(code_beside, doc))
        custom_code_file(task.observe)
        task.check_commands(setup)
    with _report_errors(doc):
        task.check(setup)
    with _report_errors(doc, "task"):
        _try_out(setup, task)
    return task


def _read_scenes(
    doc: Document, file: TrainingFile, setup: Setup, task: Task
) -> tuple[SceneTask, ...]:
    """The scenes of the file, if it has several; the scenes are checked one by one and together."""
    if file.scenes and "scene" in doc.data:
        doc.fail(("scene",), "stands beside 'scenes': leave one of them out.")
    with _report_errors(doc, "scenes"):
        scenes = read_scenes(doc, file.scenes or (), setup, task)
    if file.scenes is not None and len(scenes) < 2:
        doc.fail(("scenes",), f"has {len(scenes)}: expected two or more; one alone is 'scene'.")
    loops = {}
    for i, scene_fields in enumerate(scenes):
        with _report_errors(doc, "scenes", i):
            scene_fields.task.check(scene_fields.setup)
            loops[str(scene_fields.setup.scene)] = _try_out(scene_fields.setup, scene_fields.task)
    if scenes:
        with _report_errors(doc):
            check_alike({name: loop for name, loop in loops.items() if loop is not None})
    return scenes


def _check_evaluation(doc: Document, evaluation: EvaluationSpec, training: Training) -> None:
    """Report values and ranges of an evaluation that its scenes lack, or that are not part of the training."""
    pairs = training.evaluated()
    late, tasks = "sensing.delay", [scene.task for scene in training.scenes] or [training.task]
    taught = {name for scene in tasks for name in (*scene.set, *scene.randomize)}
    if CODE_EXECUTION.get() or not any(scene.has_custom_code for scene in tasks):
        taught |= {name for scene in tasks for name in scene.sampled}
    else:  # custom code that is not run may sample any command
        taught |= {name for name in POLICY_PARAMETERS if name.startswith("command.")}
    taught |= {
        name
        for name in POLICY_PARAMETERS
        if name.endswith("_noise") and any(scene.endswith("_noise") for scene in taught)
    }
    longest = max(
        max(scene.set.get(late, 0.0), *scene.randomize.get(late, (0.0, 0.0))) for scene in tasks
    )
    for section, section_values in (("set", evaluation.set), ("randomize", evaluation.randomize)):
        for name, value in section_values.items():
            if name in POLICY_PARAMETERS and name not in taught:
                doc.fail(
                    ("evaluate", section, name),
                    "is given, and the policy is not trained with it: leave it out.",
                )
            if name == late and (max(value) if isinstance(value, tuple) else value) > longest:
                sentence = (
                    f"is longer than {longest:g} s, the longest that the policy is trained with."
                )
                doc.fail(("evaluate", section, name), sentence)
            if any(name in getattr(task, section) for _, task in pairs):
                continue
            if section == "randomize" and name in evaluation.set:
                doc.fail(("evaluate", section, name), "stands under set, too: leave one out.")
            doc.fail(
                ("evaluate", section, name),
                "is no parameter of the evaluation's scenes: leave it out.",
            )
    with _report_errors(doc, "evaluate"):
        for setup, task in pairs:
            task.check(setup)


def _evaluation_task(setup: Setup, task: Task, evaluation: EvaluationSpec) -> Task:
    """The task of an evaluation on one scene, with the values and ranges of the parameters that the setup has."""
    declared = terrain_values(str(setup.scene)), task_parameters(setup)

    def select_supported(values: Mapping[str, Any]) -> dict[str, Any]:
        return {
            name: value
            for name, value in values.items()
            if name in declared[not name.startswith("terrain.")]
        }

    values, ranges = (
        select_supported(evaluation.set),
        select_supported({**task.randomize, **evaluation.randomize}),
    )
    remaining_ranges = {name: ends for name, ends in ranges.items() if name not in values}
    fixed = {name: value for name, value in task.set.items() if name not in remaining_ranges}
    return dataclasses.replace(task, set={**fixed, **values}, randomize=remaining_ranges)


def _code_identity(where: str) -> str:
    """Custom code by its name and the content of its file, independent of the file's folder."""
    source = source_of(where)
    return f"{source.name} {source.digest()}"


def _try_out(setup: Setup, task: Task) -> EpisodeLoop | None:
    """Make the loop to catch errors that would otherwise occur later; None if custom code is not run."""
    if task.has_custom_code and not CODE_EXECUTION.get():
        return None
    return EpisodeLoop(
        setup.load(), ActionController(setup.make_controller(), task.action), task, ()
    )


@contextlib.contextmanager
def _report_errors(doc: Document, *path: str | int) -> Iterator[None]:
    """Report errors of a section at the line of their field."""
    try:
        yield
    except SpecError:
        raise
    except ParameterError as error:
        field, _, message = str(error).partition(" ")
        candidates = [(*path, *field.split(".", 1)), (*path, field), path]
        location = next((candidate for candidate in candidates if candidate in doc.lines), path)
        doc.fail(location, message, ".".join(map(str, (*path, field))))
