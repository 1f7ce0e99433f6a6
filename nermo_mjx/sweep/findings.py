"""Additional results of a finished sweep: the comparison that it requests, and the sensitivity of its metric."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pyarrow as pa

from nermo_mjx.plotting.files import Figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.sweep import sensitivity_figure
from nermo_mjx.sweep.comparing import compare
from nermo_mjx.sweep.comparing import figures as comparison_figures
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sensitivity import sensitivity
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
    results: Results,
    comparison: Mapping[str, Any] | None,
    metric: str = LEADING,
    notify: Callable[[str], None] | None = None,
) -> Iterator[Finding]:
    """The findings for one metric; a message is issued for what cannot be computed, as from a few runs.

    Args:
        comparison: what the sweep's file compares, as its section `compare` has it.
    """
    for name, find in (("comparison", _comparison), ("sensitivity", _sensitivity)):
        try:
            finding = find(results, comparison, metric)
        except ParameterError as error:
            if notify is not None:
                notify(f"There is no {name}: {error}")
            continue
        if finding is not None:
            yield finding


def _comparison(results: Results, comparison: Mapping[str, Any] | None, metric: str) -> Finding | None:
    if comparison is None:
        return None
    by, base, groups = comparison["by"], comparison.get("base"), comparison.get("for", ())
    found = compare(results, by=by, base=base, groups=groups, drawn=(metric,))
    about = found.about(only=found.drawn)
    return Finding("comparison", found.table, about, comparison_figures.figures_of(found.table))


def _sensitivity(results: Results, comparison: Mapping[str, Any] | None, metric: str) -> Finding | None:
    if (results.schema.metadata or {}).get(b"sampler") != b"saltelli":
        return None
    found = sensitivity(results, metric)
    return Finding("sensitivity", found.table, found.about(), sensitivity_figure.figures_of(found.table))
