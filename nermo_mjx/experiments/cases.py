"""What experiments share: their settings, the cases that they simulate, the batch of worlds, and its outcome."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.control.parameters import (
    BUILT_PROFILE,
    PROFILES,
    PUBLISHED_CLOCK_RATIO,
    body_values,
    published_values,
    robot_choices,
)
from nermo_mjx.control.protocol import ActsUpon, controller_digest, load_controller
from nermo_mjx.files import MAX_ARRAY_BYTES, read_bytes
from nermo_mjx.recording import Recording, recording_of
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import choice, quantities
from nermo_mjx.rollout import METRICS, RunResult, Setup, Simulator
from nermo_mjx.rollout.setup import WorldParameters
from nermo_mjx.specs.reading import read_file
from nermo_mjx.sweep.spec import START_SPREAD

#: Profiles of the published simulation, which experiments show side by side.
SIMULATED: Final = PROFILES[:2]
#: Published amplitude of the stride extension [rad of spine servo]: 0.1 rad in each joint.
AMPLITUDE: Final = 0.4
FREQUENCIES: Final = (0.5, 0.67, 0.8)
#: Repeats of each case, and of a quick run.
REPEATS, QUICK_REPEATS = 3, 1
#: Column that identifies the body, if an outcome has several: 1, 2, ...
BODY: Final = "body"
Label = str | float | bool


def clock(profile: str) -> float:
    """Simulated seconds per second of the controller's clock."""
    return PUBLISHED_CLOCK_RATIO if profile == "as_published" else 1.0


@functools.cache
def texts(part: str) -> Any:
    """A part of `experiments.yaml`: how each experiment is described, what the columns mean, or the maze's course."""
    return read_file(Path(__file__).with_name("experiments.yaml")).data[part]


@dataclasses.dataclass(frozen=True)
class Column:
    """Unit and meaning of a column of the result table."""

    unit: str
    doc: str


def columns_about(experiment: str) -> dict[str, Column]:
    """Unit and meaning of the columns that an experiment may have: its labels, metrics, and what it measures itself."""
    own_columns, labels = (
        {name: Column(*fields) for name, fields in texts("columns").get(key, {}).items()}
        for key in (experiment, "labels")
    )
    return (
        labels
        | {name: Column(metric.unit, metric.doc) for name, metric in METRICS.items()}
        | own_columns
    )


@dataclasses.dataclass(frozen=True)
class CaseRuns:
    """All worlds of one experiment, all profiles in one table.

    Attributes:
        experiment: its name, as on the command line.
        columns: name -> (n,) values; the cases' columns (`profile`, `gait`, ..., `repeat`) first, then the measured
            ones.
        about: name -> unit and meaning, for every column.
        recordings: runs by name, for plots and videos.
    """

    experiment: str
    columns: Mapping[str, np.ndarray]
    about: Mapping[str, Column]
    recordings: Mapping[str, Recording]

    @classmethod
    def of(
        cls,
        experiment: str,
        columns: Mapping[str, np.ndarray],
        recordings: Mapping[str, Recording] | None = None,
    ) -> CaseRuns:
        """The outcome of a published experiment, whose columns have their known meanings."""
        columns_info = columns_about(experiment)
        return cls(
            experiment, columns, {name: columns_info[name] for name in columns}, recordings or {}
        )

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def where(self, **labels: object) -> np.ndarray:
        """Mask (n,) of the rows whose columns have these values."""
        mask = np.ones(len(self), bool)
        for name, value in labels.items():
            column = self.columns[name]
            mask &= np.isclose(column, value) if isinstance(value, float) else column == value
        return mask

    def mean(self, column: str, **labels: object) -> float:
        """Mean over the rows selected by `where`; NaN if there are none, or no such column."""
        if column not in self.columns:
            return float("nan")
        values = np.asarray(self.columns[column], float)[self.where(**labels)]
        return float(values.mean()) if len(values) else float("nan")

    def only(self, **labels: object) -> CaseRuns:
        """The rows selected by `where`, without recordings."""
        rows = self.where(**labels)
        columns = {name: values[rows] for name, values in self.columns.items()}
        return dataclasses.replace(self, columns=columns, recordings={})


@dataclasses.dataclass(frozen=True)
class ReplacementPolicy:
    """A policy in place of the published controller, upon which it acts; the cases set that one's parameters.

    Attributes:
        acts: the policy.
        name: of its file, and the hash of its content, as in the settings of a run.
        content: of its file.
    """

    acts: ActsUpon
    name: str
    content: bytes

    @classmethod
    def of(cls, where: str) -> ReplacementPolicy:
        """The controller that a text names.

        Raises:
            ParameterError: there is none, or it does not act upon the published controller.
        """
        acts = load_controller(where)
        if not isinstance(acts, ActsUpon):
            raise ParameterError(
                f"controller is {where!r}, which has parameters of its own: allowed is a policy FILE.npz, since the "
                "cases of an experiment set those of the published controller."
            )
        return cls(
            acts,
            f"{Path(where).name} {controller_digest(where)}",
            read_bytes(Path(where), MAX_ARRAY_BYTES),
        )

    @property
    def file(self) -> str:
        """Name of its copy in a directory of experiments, another for each content."""
        name, digest = self.name.rsplit(" ", 1)
        return f"{Path(name).stem}-{digest[:8]}{Path(name).suffix}"

    @property
    def needs_path(self) -> bool:
        """Whether it cannot walk without a path."""
        try:
            self.acts.upon(pilot="open_loop")
        except ParameterError:
            return True
        return False


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an experiment; the first six determine its numbers.

    Attributes:
        profiles: of `PROFILES`, in their order.
        repeats: worlds of each case, from starts that differ by a seeded shift.
        seed: of the shifts.
        quick: fewer cases.
        values: parameters for all worlds, by name.
        controller: what walks instead of the published controller; None is that.
        engine: of the simulations.
        bodies: parameter name -> (n,) values of n bodies, each of which runs all cases; they override `values` and the
            profile's, and no run is recorded.
        progress: called with the share done.

    Raises:
        ParameterError: an unknown name, or a number out of range.
    """

    profiles: Sequence[str] = PROFILES
    repeats: int = REPEATS
    seed: int = 0
    quick: bool = False
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    controller: ReplacementPolicy | None = None
    engine: str = "auto"
    bodies: Mapping[str, np.ndarray] | None = None
    progress: Callable[[float], None] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.profiles, str) or not self.profiles:
            raise ParameterError(
                f"profiles is {self.profiles!r}: allowed is a list of {', '.join(PROFILES)}."
            )
        profile_names = {choice("profile", profile, PROFILES) for profile in self.profiles}
        check_whole("repeats", self.repeats, 1)
        check_whole("seed", self.seed, 0)
        declarations = dict(quantities(WorldParameters))
        for name, value in self.values.items():
            if isinstance(value, str) or np.ndim(value):
                raise ParameterError(f"{name} is {value!r}: allowed is one number for all cases.")
            declarations[choice("parameter", name, declarations)].check(name, value)
        object.__setattr__(
            self, "profiles", tuple(name for name in PROFILES if name in profile_names)
        )
        object.__setattr__(
            self, "values", {name: float(value) for name, value in sorted(self.values.items())}
        )

    def as_dict(self) -> dict[str, Any]:
        """The settings that determine the numbers, as written to files."""
        settings = {name: getattr(self, name) for name in ("repeats", "seed", "quick")}
        controller_entry = {} if self.controller is None else {"controller": self.controller.name}
        return {
            "profiles": list(self.profiles),
            **settings,
            "values": dict(self.values),
            **controller_entry,
        }

    def setup(self, scene: str, **choices: Any) -> Setup:
        """The setup of a walk in a scene, with choices of the published controller, upon which another may act.

        Raises:
            ParameterError: the controller cannot act upon such a one.
        """
        if self.controller is None:
            profile: Any = self.profiles[0]
            return Setup(scene=scene, profile=profile, **choices)
        return Setup(scene=scene, **self.robot, controller=self.controller.acts.upon(**choices))

    @property
    def robot(self) -> dict[str, Any]:
        """Robot that the first profile has; see `in_each_robot`."""
        return {name: str(option) for name, option in robot_choices(self.profiles[0]).items()}

    def but(self, **changes: Any) -> Settings:
        """The same, except for what is named."""
        return dataclasses.replace(self, **changes)

    @property
    def body_count(self) -> int:
        """Number of bodies; 0 if there is only the default one."""
        return len(next(iter(self.bodies.values()))) if self.bodies else 0


def check_whole(name: str, value: Any, least: int) -> None:
    """Reject what is not a whole number of at least `least`.

    Raises:
        ParameterError: it is not.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise ParameterError(f"{name} is {value!r}: allowed is a whole number of at least {least}.")


def in_each_robot(run: Callable[[Settings], CaseRuns], settings: Settings) -> CaseRuns:
    """An experiment in all profiles; those that have different robots are simulated one after the other."""
    alike: dict[str, list[str]] = {}
    for profile in settings.profiles:
        alike.setdefault(str(robot_choices(profile)), []).append(profile)
    parts: list[CaseRuns] = []
    for profiles in alike.values():

        def tell(done: float, before: int = len(parts)) -> None:
            settings.progress((before + done) / len(alike)) if settings.progress else None

        parts.append(run(settings.but(profiles=profiles, progress=tell)))
    columns = {
        name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns
    }
    order = np.argsort([PROFILES.index(profile) for profile in columns["profile"]], kind="stable")
    columns = {
        name: column[order] if len(parts) > 1 else column for name, column in columns.items()
    }
    recordings = {
        name: recording for part in reversed(parts) for name, recording in part.recordings.items()
    }
    return CaseRuns.of(parts[0].experiment, columns, recordings)


@dataclasses.dataclass(frozen=True)
class Case:
    """One case before repeats: a named row of an experiment's design.

    Attributes:
        labels: what distinguishes it from the others, by column.
        gait, steering: named choices of `published_values`; by default the steering is the profile's.
        values: parameters by name, on top of those.
        profiles: in which it is walked.
    """

    labels: Mapping[str, Label]
    gait: str
    steering: str | None = None
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    profiles: tuple[str, ...] = PROFILES


@dataclasses.dataclass(frozen=True)
class Worlds:
    """A batch of n worlds: the cases' columns with `profile` and `repeat`, and parameter name -> (n,)."""

    labels: dict[str, np.ndarray]
    values: dict[str, np.ndarray]

    def all_values(self, defaults: Mapping[str, float]) -> dict[str, np.ndarray]:
        """`values`, completed with the defaults of all other parameters, (n,) each."""
        n = len(next(iter(self.labels.values())))
        return {name: np.full(n, value) for name, value in defaults.items()} | self.values


def worlds(cases: Sequence[Case], defaults: Mapping[str, float], settings: Settings) -> Worlds:
    """Every case in each of its profiles, `repeats` times from starts that differ by a seeded shift, for every body.

    The shift of a repeat is the same for all cases, so that cases are compared from equal starts; the first repeat is
    shifted, too. Each body has a start of its own, so that their spread contains that of the starts.

    Args:
        cases: all with the same labels.
        defaults: value of every parameter that no case names.
        settings: of the experiment; of several bodies, the column `BODY` numbers them from 1.
    """

    def shift(repeat: int) -> dict[str, float]:
        random = np.random.default_rng((settings.seed, repeat))
        return {name: float(random.uniform(-width, width)) for name, width in START_SPREAD.items()}

    labels: list[dict[str, Label]] = []
    rows: list[dict[str, float]] = []
    for body in range(max(settings.body_count, 1)):
        drawn = {name: float(values[body]) for name, values in (settings.bodies or {}).items()}
        numbered: dict[str, Label] = {BODY: body + 1} if settings.body_count else {}
        shifts = [shift(body + repeat) for repeat in range(settings.repeats)]
        for profile in settings.profiles:
            built = BUILT_PROFILE if profile == "as_built" else {}
            for case in cases:
                if profile not in case.profiles:
                    continue
                named = published_values(case.gait, steering=case.steering, profile=profile)
                given = {
                    **body_values(profile),
                    **named,
                    **settings.values,
                    **drawn,
                    **case.values,
                    **built,
                }
                for repeat, start in enumerate(shifts):
                    labels.append({"profile": profile, **numbered, **case.labels, "repeat": repeat})
                    rows.append({**start, **given})
    names = dict.fromkeys(name for row in rows for name in row)
    values = {name: np.array([row.get(name, defaults[name]) for row in rows]) for name in names}
    return Worlds({name: np.array([row[name] for row in labels]) for name in labels[0]}, values)


def world_count(cases: Sequence[Case], settings: Settings) -> int:
    """How many worlds `worlds` has."""
    walked = sum(len({*case.profiles} & {*settings.profiles}) for case in cases)
    return max(settings.body_count, 1) * settings.repeats * walked


def settable(cases: Sequence[Case]) -> frozenset[str]:
    """Parameters that may be set for all worlds of an experiment: those that neither a case nor a repeat sets."""
    decided = set(START_SPREAD)
    for case in cases:
        decided |= {*published_values(case.gait, profile="exact"), *case.values}
    return frozenset(name for name, _ in quantities(WorldParameters)) - decided


def measured(batch: Worlds, result: RunResult) -> dict[str, np.ndarray]:
    """Labels, metrics and status of each world."""
    return {**batch.labels, **result.metrics, "status": result.status}


def recordings_of(
    simulator: Simulator, batch: Worlds, result: RunResult, names: Mapping[int, str]
) -> dict[str, Recording]:
    """The recordings of the worlds whose name is given."""
    recordings = {}
    for world, name in names.items():
        metrics = {key: float(column[world]) for key, column in result.metrics.items()}
        metadata = {
            "case": name,
            "setup": {
                name: getattr(simulator.setup, name) for name in ("scene", "tail", "feet", "spine")
            },
            "labels": {key: column[world].item() for key, column in batch.labels.items()},
            "parameters": {key: float(column[world]) for key, column in batch.values.items()},
            "metrics": metrics | {"status": str(result.status[world])},
            "engine": result.engine,
        }
        recordings[name] = recording_of(
            result.trace, simulator.robot.model, world=world, metadata=metadata
        )
    return recordings
