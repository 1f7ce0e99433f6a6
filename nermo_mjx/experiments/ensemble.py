"""The share of identified bodies for which a line of the report holds.

The identification yields not one body but many that match the published speeds about equally well
(`robot.identified`). A line that holds for all of them does not depend on which of them is the default.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from nermo_mjx.experiments.line import Figure, agrees, measured
from nermo_mjx.experiments.outcome import BODY, Outcome, joined

#: The profile in which bodies are compared.
PROFILE: Final = "exact"
#: Bodies per batch: their recordings in the maze and the balance test take half a gigabyte.
AT_ONCE: Final = 16


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """Results of several bodies.

    Attributes:
        bodies: number of bodies.
        shares: figure's name -> share of them in which its line holds; None for a line without a judgement.
    """

    bodies: int
    shares: Mapping[str, float | None]


def draw(bodies: int, seed: int) -> dict[str, np.ndarray]:
    """Members of the identified ensemble: parameter name -> (bodies,) values.

    Raises:
        ParameterError: there are fewer.
    """
    from nermo_mjx.robot import identified

    return identified.choose(bodies, seed)


def fingerprint(bodies: Mapping[str, np.ndarray]) -> str:
    """Hash of bodies, to identify those in a directory."""
    content = {name: np.asarray(values, float).tolist() for name, values in sorted(bodies.items())}
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def numbered(parts: Mapping[int, Outcome]) -> Outcome:
    """Results of all bodies, from batches keyed by the position of their first body; `BODY` distinguishes them."""
    several = []
    for begin, part in sorted(parts.items()):
        numbers = {BODY: np.asarray(part.columns[BODY]) + begin}
        # Keep the order of the columns: those before `repeat` distinguish the cases.
        columns = {name: numbers.get(name, column) for name, column in part.columns.items()}
        several.append(dataclasses.replace(part, columns=columns, recordings={}))
    return joined(several)


def of_outcome(outcome: Outcome, figures: Sequence[Figure]) -> Ensemble:
    """The shares of an outcome of several bodies."""
    slices = [outcome.of_body(int(body)) for body in np.unique(outcome.columns[BODY])]
    return Ensemble(len(slices), {figure.name: _share(slices, figure) for figure in figures})


def _share(bodies: Iterable[Outcome], figure: Figure) -> float | None:
    """Whether the figure holds; it does not if it could not be measured, because the robot fell or left the path."""
    holds = [agrees(measured(body, figure, PROFILE), figure) for body in bodies]
    return None if all(each is None for each in holds) else sum(each is True for each in holds) / len(holds)
