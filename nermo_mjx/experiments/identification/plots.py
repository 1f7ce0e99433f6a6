"""Figures of an identification: the objective over the search, the residuals of its targets, the ensemble."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.experiments.identification.ensemble_plot import ensemble_figure
from nermo_mjx.experiments.identification.memory import RESULT
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import page
from nermo_mjx.plotting.style import BAND, BEST, LINE, MISSING, MUTED, SHADE
from nermo_mjx.runs.files import DirectoryError

#: Costs above this multiple of the start's are cut off: for candidates that fell, only that fact matters.
_SHOWN: Final = 2.0


def figures_of(content: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """The figures of identification.json's content."""
    yield "identification-search", _search(content)
    yield "identification-residuals", _residuals(content)
    if (ensemble := content.get("ensemble")) and ensemble["size"]:
        yield "identification-ensemble", ensemble_figure(ensemble)


def figures(out: Path) -> Figures:
    """The figures of an identification's directory.

    Raises:
        DirectoryError: its result cannot be read.
    """
    try:
        return figures_of(json.loads((out / RESULT).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        raise DirectoryError(f"{out / RESULT} cannot be read: run the identification again.") from None


def _search(content: Mapping[str, Any]) -> Figure:
    costs, objective = np.asarray(content["costs"], float), content["objective"]
    figure = page("Objective of every candidate, in the order tried", 7.0, 3.6)
    ax = figure.subplots()
    top = _SHOWN * max(objective["start"], objective["end"])
    ax.scatter(np.arange(len(costs)), np.minimum(costs, top), s=9, color=BAND, lw=0, label="candidate")
    ax.step(np.arange(len(costs)), np.minimum.accumulate(costs), where="post", color=LINE, lw=1.6, label="best so far")
    ax.axhline(objective["start"], color=MUTED, lw=0.9, ls="--", label="at the start")
    # The initial Sobol search fills whole batches: its length is the total minus the generations.
    search = content["settings"]
    sampled = len(costs) - search["generations"] * search["population"]
    if 0 < sampled < len(costs):
        ax.axvline(sampled - 0.5, color=MISSING, lw=1)
        ax.annotate("CMA-ES", (sampled, top), xytext=(4, -2), textcoords="offset points", va="top", color=MUTED)
    ax.set(xlabel="candidate [1]", ylabel="objective [1]", ylim=(0, 1.03 * top), xlim=(-1, len(costs)))
    ax.legend(loc="upper right", ncols=3, bbox_to_anchor=(1.0, 1.14))
    return figure


def _residuals(content: Mapping[str, Any]) -> Figure:
    targets = content["targets"]
    figure = page("Deviation from the published speeds", 7.0, 1.5 + 0.3 * len(targets))
    ax = figure.subplots()
    y = np.arange(len(targets))
    before = [target["start_residual"] for target in targets.values()]
    known = all(value is not None for value in before)
    height = 0.36 if known else 0.6
    after = [target["residual"] for target in targets.values()]
    if known:
        ax.barh(y - height / 2, np.asarray(before, float), height, color=BAND, label="at the start")
    ax.barh(y + (height / 2 if known else 0), np.asarray(after, float), height, color=LINE, label="identified")
    ax.axvspan(-1, 1, color=SHADE, lw=0, zorder=-5, label="within the tolerance")
    ax.axvline(0, color=BEST, lw=0.9)
    ax.set_yticks(y, list(targets))
    ax.set(xlabel="residual [tolerances]", ylim=(len(targets) - 0.4, -0.6))
    ax.tick_params(axis="y", length=0)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower right", ncols=3)
    return figure
