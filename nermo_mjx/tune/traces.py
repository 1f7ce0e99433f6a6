"""A tuning's history as arrays over iterations and starts, for figures and summaries."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.plotting.shown import ShownValues, shown
from nermo_mjx.sweep.table import columns_of, meta
from nermo_mjx.tune.objective import Term
from nermo_mjx.tune.sections import Tuned
from nermo_mjx.tune.spec import Tuning

#: Maximum number of starts in a figure, including the best and the given one.
MOST_STARTS: Final = 32


@dataclasses.dataclass(frozen=True)
class Traces:
    """The history of each start.

    Attributes:
        tuning: that was run.
        table: its history, see `nermo_mjx.tune.history`.
    """

    tuning: Tuning
    table: pa.Table

    @classmethod
    def of(cls, tuning: Tuning, table: pa.Table) -> Traces:
        """Of a tuning; of one by generations, the best point of each, as if it were one start."""
        if tuning.method.has_gradient:
            return cls(tuning, table)
        value = table.column("objective").to_numpy(zero_copy_only=False).reshape(-1, tuning.starts)
        best = np.where(np.isfinite(value), value, np.inf).argmin(axis=1) + tuning.starts * np.arange(len(value))
        return cls(dataclasses.replace(tuning, starts=1), table.take(best))

    @property
    def starts(self) -> int:
        """Number of starts."""
        return self.tuning.starts

    @property
    def iterations(self) -> np.ndarray:
        """Number of each evaluation (n,); 0 is that of the first points."""
        return np.arange(self.table.num_rows // self.starts)

    @property
    def metrics(self) -> list[str]:
        """The metrics in the history."""
        return columns_of(self.table, "metric")

    @cached_property
    def ok(self) -> np.ndarray:
        """Whether the robot walked to the end (n, starts)."""
        return self.column("ok").astype(bool)

    @cached_property
    def best(self) -> tuple[int, int]:
        """Iteration and start of the lowest objective; there is one where `best.json` exists."""
        value = self.column("objective")
        iteration, start = np.unravel_index(np.nanargmin(value), value.shape)
        return int(iteration), int(start)

    def column(self, name: str) -> np.ndarray:
        """Values of a column (n, starts), in its own unit."""
        return self.table.column(name).to_numpy(zero_copy_only=False).reshape(-1, self.starts)

    def quantity(self, name: str) -> ShownValues:
        """Values of a column (n, starts) as figures show them; of a metric, only where the robot walked to the end."""
        about = meta(self.table.schema.field(name))
        values = self.column(name)
        if about["role"] == "metric":
            values = np.where(self.ok, values, np.nan)
        return shown(name, about["unit"], values)

    def unwrapped(self, tuned: Tuned) -> np.ndarray:
        """Values of a parameter (n, starts) in its own unit; a periodic one continues beyond its bounds."""
        values = self.column(tuned.name)
        return np.unwrap(values, axis=0, period=tuned.high - tuned.low) if tuned.periodic else values

    def in_shown_unit(self, name: str, value: float | np.ndarray) -> np.ndarray:
        """Values of a parameter or metric as figures show them."""
        return shown(name, meta(self.table.schema.field(name))["unit"], np.asarray(value)).values

    def target(self, term: Term) -> float | None:
        """What a term holds its metric at, as figures show it; None if it does not hold it."""
        return float(self.in_shown_unit(term.metric, term.at)) if term.aim == "hold" else None

    def gradient_norm(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Norm of each gradient and its standard error (n, starts), None from exact gradients.

        Each component counts per whole range of its parameter, so that units do not matter. The error is that of the
        component along the gradient. NaN where there was nothing to estimate from.
        """
        tuned = self.tuning.tuned
        ranges = np.array([each.high - each.low for each in tuned])
        gradient = np.stack([self.column(f"gradient.{each.name}") for each in tuned], axis=-1) * ranges
        norm = np.linalg.norm(gradient, axis=-1)
        norm = np.where(norm > 0, norm, np.nan)
        if not self.tuning.estimator.samples:
            return norm, None
        error = np.stack([self.column(f"gradient_error.{each.name}") for each in tuned], axis=-1) * ranges
        return norm, np.linalg.norm(gradient * error, axis=-1) / norm

    def drawn(self) -> list[int]:
        """The starts that are drawn: all, or the given one, the best, and some between."""
        if self.starts <= MOST_STARTS:
            return list(range(self.starts))
        some = np.linspace(0, self.starts - 1, MOST_STARTS - 1).round().astype(int)
        return sorted({*some.tolist(), self.best[1]})
