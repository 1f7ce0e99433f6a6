"""Additional results of a finished sweep: the comparison that it requests, and the sensitivity of its metric."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa

from nermo_mjx.plotting.files import Figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.sweep import sensitivity_figure
from nermo_mjx.sweep.comparing import compare
from nermo_mjx.sweep.comparing import figures as comparison_figures
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sensitivity import sensitivity
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.table import LEADING


@dataclasses.dataclass(frozen=True)
class Finding:
    """One of them.

    Attributes:
        name: "comparison" or "sensitivity": of its table's file, and of its part of the summary.
        table: all of it.
        about: what the summary has.
        figures: of it.
    """

    name: str
    table: pa.Table
    about: dict[str, Any]
    figures: Figures


def findings(
    results: Results, sweep: Sweep, metric: str = LEADING, notify: Callable[[str], None] | None = None
) -> Iterator[Finding]:
    """The findings for one metric; a message is issued for what cannot be computed, as from a few runs."""
    for name, find in (("comparison", _comparison), ("sensitivity", _sensitivity)):
        try:
            finding = find(results, sweep, metric)
        except ParameterError as error:
            if notify is not None:
                notify(f"There is no {name}: {error}")
            continue
        if finding is not None:
            yield finding


def _comparison(results: Results, sweep: Sweep, metric: str) -> Finding | None:
    if (asked := sweep.comparison) is None:
        return None
    found = compare(results, by=asked.by, base=asked.base, groups=asked.groups, drawn=(metric,))
    about = found.about(only=found.drawn)
    return Finding("comparison", found.table, about, comparison_figures.figures_of(found.table))


def _sensitivity(results: Results, sweep: Sweep, metric: str) -> Finding | None:
    if sweep.sampler != "saltelli":
        return None
    found = sensitivity(results, metric)
    return Finding("sensitivity", found.table, found.about(), sensitivity_figure.figures_of(found.table))
