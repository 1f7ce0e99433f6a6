"""What a sweep stores beside its table, as written in a file: time series (`save`) and recordings (`keep`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final

from pydantic import BeforeValidator, Field

from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Metric, Saving, Setup
from nermo_mjx.rollout.saving import Keeper
from nermo_mjx.specs.fields import Fields
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.values import Positive, Whole
from nermo_mjx.sweep.sides import sides_of

#: Maximum number of recorded rows of one kind; each takes about half a megabyte.
MOST_KEPT: Final = 10_000


@dataclasses.dataclass(frozen=True)
class Keep:
    """Which rows are recorded when the table is complete: the number of each kind, the best by a metric."""

    best: int = 0
    metric: str = "speed"
    fell: int = 0
    diverged: int = 0
    unsolved: int = 0


def _listed(given: Any) -> Any:
    return [given] if isinstance(given, str) else given


class SaveFields(Fields):
    """What is kept of each run over time."""

    what: ClassVar = "a field of what is saved"
    expected: ClassVar = "{sensors: [gyro, foot_force], rate: 50}"
    example: ClassVar = expected
    sensors: Annotated[list[str], BeforeValidator(_listed)] = Field(
        description="signals, sensors or groups of them; qpos, qvel, ctrl, attitude, speed",
        json_schema_extra={"type": ["array", "string"], "minItems": 1},
    )
    rate: Positive = Field(
        Saving.rate,
        description="samples per simulated second [Hz]: the control rate, or that divided by a whole number",
    )


class KeepFields(Fields):
    """Rows that are recorded when the table is complete."""

    what: ClassVar = "a field of what is kept"
    expected: ClassVar = "{best: 3, fell: 3, diverged: 3}"
    best: Annotated[int, Whole(0, MOST_KEPT)] = Field(0, description="number of the best, at most one per variant")
    metric: str = Field(Keep.metric, description="by which the best are chosen: one that has a better direction")
    fell: Annotated[int, Whole(0, MOST_KEPT)] = Field(0, description="number that fell, the first in the table")
    diverged: Annotated[int, Whole(0, MOST_KEPT)] = Field(0, description="number that diverged")
    unsolved: Annotated[int, Whole(0, MOST_KEPT)] = Field(0, description="number for which the solver did not converge")


def read_saving(doc: Document, given: SaveFields | None, setup: Setup) -> Saving | None:
    """What is saved, of signals that the robot has, at a rate that its controller has."""
    if given is None:
        return None
    if not given.sensors:
        doc.fail(("save", "sensors"), "is an empty list: name sensors, such as [gyro, foot_force].")
    saving = Saving(tuple(given.sensors), float(given.rate))
    try:
        Keeper(saving, setup.load(), setup.make_controller().dt)
    except ParameterError as error:
        field, _, message = str(error).partition(" ")
        doc.fail(("save", field), message)
    return saving


def check_keep(doc: Document, keep: Keep | None, metrics: Mapping[str, Metric]) -> None:
    """Fail if the best would be chosen by a metric without a better direction, or by an unknown one."""
    sides = sides_of(metrics)
    if keep is not None and keep.metric not in sides:
        doc.fail(("keep", "metric"), f"is '{keep.metric}': allowed is a metric with a better direction, "
                                     f"{', '.join(sides)}{did_you_mean(keep.metric, sides)}")  # fmt: skip
