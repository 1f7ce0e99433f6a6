"""The identified bodies: an ensemble whose straight-line walks all come about equally close to the published ones.

The publication gives neither servo gain nor damping nor friction. `identified.csv` contains robot instances whose
speeds come within a tolerance of the published ones, in the set-up of the published tests: one per row, the best first.
The damping of the default body lies in the middle of it. The rows were sampled by importance, hence the weights;
robot instances of the same distribution, of equal weight, come from

    python docs/benchmarks/published_speeds.py DIR --profile as_published --samples 64 --generations 3
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from nermo_mjx.files import MAX_JSON_BYTES, FileError, read_bytes
from nermo_mjx.robot.quantity import ParameterError

#: The ensemble that comes with the package.
IDENTIFIED_ENSEMBLE: Final = "identified"
ENSEMBLE_PATH: Final = Path(__file__).with_suffix(".csv")
#: Columns that are not parameters.
_FIT_COLUMNS: Final = ("objective", "weight")


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """An ensemble of n bodies; the first is the best.

    Attributes:
        values: model parameter -> (n,), in the parameter's unit.
        weights: the probability that each body stands for, (n,); their sum is 1.
        objective: distance of each one's speeds from the published ones, (n,) [tolerances, root mean square].
        fingerprint: hash of the content.
    """

    values: dict[str, np.ndarray]
    weights: np.ndarray
    objective: np.ndarray
    fingerprint: str

    def __len__(self) -> int:
        return len(self.weights)

    def at(self, share: np.ndarray) -> np.ndarray:
        """The body at shares in [0, 1) of the weight, (n,) int: even shares draw bodies by weight."""
        return np.searchsorted(np.cumsum(self.weights)[:-1], share, side="right")

    def take(self, index: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters of the bodies at `index`, (n,) int: parameter -> (n,)."""
        return {name: column[index] for name, column in self.values.items()}


@functools.lru_cache
def bodies(source: str = IDENTIFIED_ENSEMBLE) -> Ensemble:
    """The ensemble that comes with the package, or that of an identification's directory, read once.

    Raises:
        ParameterError: the directory has none, or a damaged one.
    """
    path = ENSEMBLE_PATH if source == IDENTIFIED_ENSEMBLE else Path(source) / "ensemble.csv"
    try:
        return read_ensemble(read_bytes(path, MAX_JSON_BYTES).decode().splitlines())
    except (OSError, FileError):
        raise ParameterError(
            f"{source} is no directory of an identification with bodies: {path} cannot be read."
        ) from None
    except (ValueError, KeyError, IndexError):
        raise ParameterError(
            f"{path} is damaged: expected names of columns, and then a body in each line."
        ) from None


def best(source: str) -> dict[str, float]:
    """Parameters of the best body of an identification's directory; raises as `bodies` does."""
    return {name: float(column[0]) for name, column in bodies(source).values.items()}


def choose(n: int, seed: int) -> dict[str, np.ndarray]:
    """Parameters of n different bodies, drawn by weight, of which the first are those that a smaller n draws; all of
    them, in order, if n is the ensemble's size.

    Args:
        n: how many.
        seed: makes the draw repeatable.

    Returns:
        Model parameter -> (n,), in the parameter's unit.

    Raises:
        ParameterError: n is less than 1, or more than the ensemble has.
    """
    ensemble = bodies()
    if not 1 <= n <= len(ensemble):
        raise ParameterError(
            f"bodies is {n}: allowed is 1 to {len(ensemble)}, the size of the identified ensemble."
        )
    if n == len(ensemble):
        return ensemble.take(np.arange(n))
    # Each body's time to the first event at a rate of its weight: the earliest are a draw without replacement.
    times = np.random.default_rng(seed).exponential(size=len(ensemble)) / ensemble.weights
    return ensemble.take(np.argsort(times)[:n])


def read_ensemble(lines: Iterable[str]) -> Ensemble:
    """An ensemble from the lines of a file: comments, the names of the columns, then one body per line."""
    rows = [line.split(",") for line in lines if line.strip() and not line.startswith("#")]
    table = np.array(rows[1:], float)
    table.flags.writeable = False
    columns = dict(zip(rows[0], table.T, strict=True))
    weights = columns["weight"] / columns["weight"].sum()
    weights.flags.writeable = False
    content = hashlib.sha256("\n".join(",".join(row) for row in rows).encode()).hexdigest()[:16]
    values = {name: column for name, column in columns.items() if name not in _FIT_COLUMNS}
    return Ensemble(values, weights, columns["objective"], content)
