"""Figures of a training: its curves over the control steps, and the evaluation with and without the policy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from nermo_mjx.learn.directory import EVALUATION_FILE, SPEC_FILE, Curves, read_curves
from nermo_mjx.learn.evaluation import BASELINE, POLICY, summarize_walks
from nermo_mjx.learn.spec import Training
from nermo_mjx.plotting.charts import blank_page, draw_horizontal_grid
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.style import BAND_COLOUR, LINE_COLOUR, MUTED_INK, SERIES
from nermo_mjx.robot.scene import scene_name
from nermo_mjx.runs.files import DirectoryError, content_of, parquet_table

#: Columns of the curves, with the labels of their axes.
PANELS: Final = {
    "reward": "mean reward\nof a step [1]",
    "return": "return of an\nepisode [1]",
    "length": "length of an\nepisode [s]",
    "lasted": "episodes that\nlasted [%]",
    "kl": "change of the\npolicy [nat]",
    "std": "standard deviation\nof actions [1]",
    "explained": "variance that the\ncritic explains [%]",
}
#: Iterations over which a curve is smoothed, as a fraction of all.
_SMOOTHING_FRACTION: Final = 0.02


def figures_of_training(
    training: Training, curves: Curves, table: pa.Table | None
) -> Iterator[tuple[str, Figure]]:
    """The figures by name: `curves`, `rewards`, and `evaluation` if there is a `table`."""
    yield "curves", curves_figure(training, curves)
    yield "rewards", rewards_figure(training, curves)
    if table is not None:
        yield "evaluation", evaluation_figure(training, table)


def training_figures(out: Path) -> Figures:
    """The figures of a training's directory up to its latest checkpoint.

    Raises:
        SpecError: training.yaml cannot be read.
        DirectoryError: The history is empty, or cannot be read.
    """
    training, history = Training.from_file(out / SPEC_FILE), read_curves(out)
    if not history.num_rows:
        raise DirectoryError(f"there is nothing to draw of {out}: no section of it is finished.")
    names = tuple(name for name in history.column_names if name not in ("iteration", "code"))
    rows = np.stack([np.asarray(history.column(name), float) for name in names], axis=1)
    return figures_of_training(
        training, Curves(names, rows), parquet_table(content_of(out / EVALUATION_FILE) or b"")
    )


def curves_figure(training: Training, curves: Curves) -> Figure:
    """The curves of the training over control steps."""
    panels = {name: label for name, label in PANELS.items() if name in curves.names}
    figure = blank_page(
        "Training", 7.2, 1.1 + 1.5 * len(panels), f"{_subtitle(training)}; pale: single iterations"
    )
    axes = list(figure.subplots(len(panels), 1, sharex=True))
    factor = {"length": training.step_seconds, "lasted": 100.0, "explained": 100.0}
    for ax, (name, label) in zip(axes, panels.items(), strict=True):
        values = curves.column(name) * factor.get(name, 1.0)
        fine = np.isfinite(values)
        if 2 * fine.sum() < len(values):  # episodes that end together
            ax.plot(_million_steps(curves)[fine], values[fine], "o-", color=LINE_COLOUR, ms=3.5)
        else:
            ax.plot(_million_steps(curves), values, color=BAND_COLOUR, lw=0.7)
            ax.plot(_million_steps(curves), _smooth(values), color=LINE_COLOUR)
        draw_horizontal_grid(ax)
        ax.set_ylabel(label)
        if name in ("lasted", "explained"):
            ax.set_ylim(-3, 103)
    axes[-1].set_xlabel("control steps of all worlds [million]")
    return figure


def rewards_figure(training: Training, curves: Curves) -> Figure:
    """The weighted terms of the reward per simulated second, over control steps."""
    weights = {str(name): weight for name, weight in training.task.rewards.items()}
    terms = [name for name in curves.names if name.startswith("term.")]
    figure = blank_page(
        "Reward by its terms", 7.2, 3.6, f"{_subtitle(training)}; each term times its weight"
    )
    ax = figure.subplots()
    for i, name in enumerate(terms):
        term = name.removeprefix("term.")
        value = curves.column(name) * weights.get(term, 1.0) / training.step_seconds
        colour, style = SERIES[i % len(SERIES)], "-" if i < len(SERIES) else "--"
        ax.plot(_million_steps(curves), _smooth(value), color=colour, ls=style, label=term)
    ax.set_ylabel("reward in a second [1/s]")
    ax.set_xlabel("control steps of all worlds [million]")
    ax.legend(ncols=3, loc="best")
    draw_horizontal_grid(ax)
    return figure


def evaluation_figure(training: Training, table: pa.Table) -> Figure:
    """Success and speed on unseen bodies on each scene, with and without the policy."""
    summary = summarize_walks(table)
    count = table.num_rows // (2 * len(summary))
    note = f"{_subtitle(training)}; {count:,} bodies and starts on each scene, none seen in training; whiskers: quartiles"
    figure = blank_page("Evaluation", 7.2, 3.4, note)
    axes = figure.subplots(1, 2)
    for i, (walker, colour) in enumerate(((POLICY, LINE_COLOUR), (BASELINE, MUTED_INK))):
        label = "policy" if walker == POLICY else "controller alone"
        positions = np.arange(len(summary)) + (i - 0.5) * 0.36
        axes[0].bar(
            positions,
            [100.0 * statistics[walker]["success"] for statistics in summary.values()],
            0.34,
            color=colour,
            label=label,
        )
        low, middle, high = (
            1e3 * np.array([_speed_quartiles(table, scene, walker) for scene in summary]).T
        )
        axes[1].bar(positions, middle, 0.34, color=colour)
        axes[1].errorbar(
            positions,
            middle,
            [middle - low, high - middle],
            fmt="none",
            ecolor="black",
            lw=0.9,
            capsize=2,
        )
    for ax, label in zip(axes, ("walks that succeeded [%]", "speed, median [mm/s]"), strict=True):
        ax.set_xticks(np.arange(len(summary)), list(summary))
        ax.set_ylabel(label)
        draw_horizontal_grid(ax)
    axes[0].set_ylim(0, 103)
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=2, loc="upper right")
    return figure


def _speed_quartiles(table: pa.Table, scene: str, who: str) -> Any:
    scenes, names = (np.asarray(table.column(name).to_pylist()) for name in ("scene", "controller"))
    speed = np.asarray(table.column("speed"), float)[(scenes == scene) & (names == who)]
    return np.nanpercentile(speed, (25, 50, 75)) if np.isfinite(speed).any() else np.full(3, np.nan)


def _million_steps(curves: Curves) -> np.ndarray:
    return curves.column("steps") * 1e-6


def _smooth(values: np.ndarray) -> np.ndarray:
    """Moving mean over the finite values; NaN if there are none nearby."""
    width = min(max(1, round(_SMOOTHING_FRACTION * len(values))), (len(values) - 1) // 2)
    kernel, fine = np.ones(2 * width + 1), np.isfinite(values)
    total = np.convolve(np.where(fine, values, 0.0), kernel, "same")
    count = np.convolve(fine.astype(float), kernel, "same")
    return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def _subtitle(training: Training) -> str:
    setup, several = training.setup, training.scenes
    where = f"{len(several)} scenes" if several else f"scene {scene_name(str(setup.scene))}"
    return f"{setup.robot}, {where}, profile {setup.profile}, seed {training.seed}, {training.worlds:,} worlds"
