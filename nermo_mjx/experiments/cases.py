"""Settings, cases, batches of worlds and outcomes, which all experiments use."""

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

#: Profiles of the published simulation; figures show both.
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
    """A part of `experiments.yaml`, for example `catalogue`, `columns` or `maze_course`."""
    return read_file(Path(__file__).with_name("experiments.yaml")).data[part]


@dataclasses.dataclass(frozen=True)
class Column:
    """Unit and meaning of a column of the result table."""

    unit: str
    doc: str


def columns_about(experiment: str) -> dict[str, Column]:
    """Unit and meaning of the columns that an experiment can have: labels, metrics, and its own measurements."""
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
        experiment: Name of the experiment, as on the command line.
        columns: Name -> values (n,). The columns of the cases (`profile`, `gait`, ..., `repeat`) precede the measured
            columns.
        about: Name -> unit and meaning of the column.
        recordings: Name -> recording of a run, for plots and videos.
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
    """A policy that acts on top of the published controller; the cases set the parameters of the latter.

    Attributes:
        acts: Policy.
        name: Name of the file of the policy, and the hash of its content, as in the settings of a run.
        content: Content of the file.
    """

    acts: ActsUpon
    name: str
    content: bytes

    @classmethod
    def of(cls, where: str) -> ReplacementPolicy:
        """The policy in a file.

        Raises:
            ParameterError: The file contains no policy, or the policy does not act on top of the published controller.
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
        """Name of the copy in a directory of experiments; it depends on the content."""
        name, digest = self.name.rsplit(" ", 1)
        return f"{Path(name).stem}-{digest[:8]}{Path(name).suffix}"

    @property
    def needs_path(self) -> bool:
        """Whether the policy requires a path."""
        try:
            self.acts.upon(pilot="open_loop")
        except ParameterError:
            return True
        return False


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an experiment; the first six determine its numbers.

    Attributes:
        profiles: Names from `PROFILES`, in their order.
        repeats: Number of worlds of each case; their initial states differ by random shifts.
        seed: Seed of the shifts.
        quick: Whether fewer cases are run.
        values: Name of a parameter -> its value in all worlds.
        controller: Policy on top of the published controller, or None.
        engine: Engine of the simulations.
        bodies: Name of a parameter -> its values (n,) in n parameter sets, each of which runs all cases. They take
            precedence over `values` and the profile, and no run is recorded.
        progress: Function that receives the completed share.

    Raises:
        ParameterError: A name is unknown, or a number is out of range.
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
        """The setup of a walk in a scene, with choices of the published controller, and the policy on top of it if any.

        Raises:
            ParameterError: The policy does not support these choices.
        """
        if self.controller is None:
            profile: Any = self.profiles[0]
            return Setup(scene=scene, profile=profile, **choices)
        return Setup(scene=scene, **self.robot, controller=self.controller.acts.upon(**choices))

    @property
    def robot(self) -> dict[str, Any]:
        """Choices of the robot in the first profile; see `in_each_robot`."""
        return {name: str(option) for name, option in robot_choices(self.profiles[0]).items()}

    def but(self, **changes: Any) -> Settings:
        """The settings with some changes."""
        return dataclasses.replace(self, **changes)

    @property
    def body_count(self) -> int:
        """Number of parameter sets in `bodies`; 0 without `bodies`."""
        return len(next(iter(self.bodies.values()))) if self.bodies else 0


def check_whole(name: str, value: Any, least: int) -> None:
    """Check that a value is a whole number of at least `least`.

    Raises:
        ParameterError: The value is not such a number.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise ParameterError(f"{name} is {value!r}: allowed is a whole number of at least {least}.")


def in_each_robot(run: Callable[[Settings], CaseRuns], settings: Settings) -> CaseRuns:
    """Run an experiment in all profiles; profiles with different robots are simulated one after the other."""
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
    """One case of an experiment, before repeats.

    Attributes:
        labels: Column -> value that identifies the case.
        gait, steering: Named choices of `published_values`; by default, the profile determines the steering.
        values: Name of a parameter -> its value, which takes precedence over these choices.
        profiles: Profiles in which the case is simulated.
    """

    labels: Mapping[str, Label]
    gait: str
    steering: str | None = None
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    profiles: tuple[str, ...] = PROFILES


@dataclasses.dataclass(frozen=True)
class Worlds:
    """A batch of n worlds.

    Attributes:
        labels: Column of the cases, `profile` or `repeat` -> values (n,).
        values: Name of a parameter -> values (n,).
    """

    labels: dict[str, np.ndarray]
    values: dict[str, np.ndarray]

    def all_values(self, defaults: Mapping[str, float]) -> dict[str, np.ndarray]:
        """`values` and the defaults of all other parameters, (n,) each."""
        n = len(next(iter(self.labels.values())))
        return {name: np.full(n, value) for name, value in defaults.items()} | self.values


def worlds(cases: Sequence[Case], defaults: Mapping[str, float], settings: Settings) -> Worlds:
    """The worlds of all cases in each of their profiles, with `repeats` initial states, for all parameter sets.

    The initial states of the repeats differ by random shifts. The shift of a repeat is the same for all cases, so that
    cases are compared from equal initial states. Each parameter set has its own shift, so that the range over parameter
    sets includes the range over initial states.

    Args:
        cases: Cases with the same labels.
        defaults: Value of every parameter that no case names.
        settings: Settings of the experiment. The column `BODY` numbers several parameter sets from 1.
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
    """Number of the worlds that `worlds` returns."""
    walked = sum(len({*case.profiles} & {*settings.profiles}) for case in cases)
    return max(settings.body_count, 1) * settings.repeats * walked


def settable(cases: Sequence[Case]) -> frozenset[str]:
    """Parameters that can be set for all worlds of an experiment, because neither a case nor a repeat sets them."""
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
    """Recordings of worlds, by name; `names` maps the index of a world to its name."""
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
