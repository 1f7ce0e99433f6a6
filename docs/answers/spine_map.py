"""Numbers and figures of docs/does_the_spine_help.md, docs/spine_and_animals.md and the README's first screen.

python docs/answers/spine_map.py file DIR      # writes DIR/as_published.yaml, the map's file in the published set-up
python docs/answers/spine_map.py numbers DIR   # prints JSON, and writes map.png, effects.png and phase.png into DIR, of the
                                               # sweeps DIR/exact and DIR/as_published, and docs/answers/spine_map.csv

All frequencies are those of simulated time. `spine_map.csv` has a row for each profile, gait, frequency and stride, in SI
units: the best amplitude and phase, and means of the fresh runs of the stiff spine and of the best point.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from matplotlib.figure import Figure

from nermo_mjx import Run, Setup, Simulator, read_table
from nermo_mjx.sweep import Sweep
from nermo_mjx.sweep.optimum import optimum_in
from nermo_mjx.sweep.spec import sample
from nermo_mjx.sweep.table import SweepRecord

ROOT = Path(__file__).parents[2]
SPEC = ROOT / "sweeps" / "does_the_spine_help.yaml"
TABLE = ROOT / "docs" / "answers" / "spine_map.csv"
PROFILES = {"exact": "ideal controller (exact)", "as_published": "published (as_published)"}
GAITS = ("trot", "walking_trot", "lateral_walk")
STRIDES = (1.0, 0.6)
#: Metrics of the fresh runs whose means are listed, of the stiff and of the bending spine.
METRICS = ("speed", "duty_factor", "tail_time", "tail_load_share", "slip", "limited_spine")
COSTS = ("cost_of_transport", "electrical_cost_of_transport")
#: The stiff gait stumbles where it advances less than this share of its advance per cycle at the lowest frequency.
STUMBLE_SHARE = 0.9
GRAVITY = 9.81
#: Height of the hips above the ground in the stance [m]: 42 mm above the centres of the rear feet, whose radius is 4 mm.
HIP_HEIGHT = 0.046
#: Fresh pairs of each effect.
PAIRS = 16


def clock_ratio(profile: str) -> float:
    """Simulated seconds per second of the controller's clock."""
    return float(Setup(profile=profile).defaults()["tracking.clock_ratio"])


def published_file(out: Path) -> None:
    """The map's sweep file in the published set-up, with the same frequencies of simulated time."""
    fields = yaml.safe_load(SPEC.read_text())
    frequencies = fields["vary"]["frequency"]
    fields["vary"]["frequency"] = [
        round(frequency * clock_ratio("as_published"), 6) for frequency in frequencies
    ]
    out.mkdir(parents=True, exist_ok=True)
    (out / "as_published.yaml").write_text(
        yaml.safe_dump({"profile": "as_published"} | fields, sort_keys=False)
    )


def map_rows(profile: str, sweep: Path) -> pd.DataFrame:
    """A row for each gait, frequency and stride of a profile."""
    optimum, record = optimum_in(sweep), SweepRecord.of_directory(sweep)
    assert optimum is not None
    assert record is not None
    runs = read_table(sweep).to_pandas()
    is_fresh = (runs["repeat"] >= record.repeats) & (
        runs["repeat"] < record.repeats + optimum.asked.fresh
    )
    runs = runs[is_fresh & (runs["status"] == "ok")]
    rows = []
    for answer in optimum.answers:
        in_group = np.logical_and.reduce(
            [runs[name] == value for name, value in answer.group.items()]
        )
        is_best = np.isclose(runs[list(answer.at)], list(answer.at.values())).all(axis=1)
        sides = {
            "stiff": runs[in_group & (runs["spine"] == "none")],
            "spine": runs[in_group & is_best & (runs["spine"] != "none")],
        }
        row: dict[str, Any] = {"profile": profile, **answer.group, **answer.at}
        row["frequency"] = round(row["frequency"] / clock_ratio(profile), 6)
        line = answer.lines["speed"]
        row |= {"points": int(answer.judged.region.sum()), "pairs": line["pairs"]}
        row |= {f"gain{end}": line[f"relative{end}"] for end in ("", "_low", "_high")}
        row |= {"outliers": line["outliers"], "friction_r2": line.get("r2", math.nan)}
        row |= {
            f"{side}_{name}": float(table[name].mean())
            for side, table in sides.items()
            for name in (*METRICS, *COSTS)
        }
        for name in COSTS:
            row |= {
                f"{name}_gain{end}": answer.lines[name][f"relative{end}"]
                for end in ("", "_low", "_high")
            }
        rows.append(row)
    table = pd.DataFrame(rows)
    table["froude"] = table["spine_speed"] ** 2 / (GRAVITY * HIP_HEIGHT)
    advance = table["stiff_speed"] / table["frequency"]
    slowest = advance.groupby([table["gait"], table["stride"]]).transform("first")
    table["stumbles"] = advance < STUMBLE_SHARE * slowest
    return table


# --- the page and the README


def percent(value: float) -> str:
    return f"{100 * value:+.0f}" if math.isfinite(value) else "–"


def page_table(table: pd.DataFrame, profile: str) -> str:
    """The rows of a profile as Markdown."""
    heads = (
        *("gait", "Hz", "stride", "amplitude [rad], phase [°]", "stiff, best [mm/s]", "gain [%]"),
        *("mechanical, electrical cost [%]", "Froude number", "duty", "tail [%]", "slip [mm/s]"),
        "spine at its torque limit [%]",
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for _, row in table[table["profile"] == profile].iterrows():
        gain = f"{percent(row['gain'])} ({percent(row['gain_low'])} to {percent(row['gain_high'])})"
        costs = ", ".join(
            percent(row[f"{name}_gain"])
            + ("?" if row[f"{name}_gain_low"] < 0.0 < row[f"{name}_gain_high"] else "")
            for name in COSTS
        )
        cells = (
            row["gait"].replace("_", " "),
            f"{row['frequency']:g}",
            f"{row['stride']:g}",
            f"{row['spine.amplitude']:g}, {math.degrees(row['spine.phase']):.0f}"
            + ("" if row["points"] < 4 else f" ({row['points']:.0f})"),
            f"{1e3 * row['stiff_speed']:.0f}{' s' if row['stumbles'] else ''}, {1e3 * row['spine_speed']:.0f}",
            gain,
            costs,
            f"{row['froude']:.3f}",
            f"{row['spine_duty_factor']:.2f}",
            f"{100 * row['spine_tail_time']:.0f}",
            f"{1e3 * row['spine_slip']:.0f}",
            f"{100 * row['spine_limited_spine']:.0f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def spans(table: pd.DataFrame) -> dict[str, str]:
    """Ranges of the gains, for sentences: of cells in which the stiff gait walks, by profile and stride."""
    numbers = {}
    for profile in PROFILES:
        for stride, label in zip(STRIDES, ("long", "short"), strict=True):
            cells = table[(table["profile"] == profile) & (table["stride"] == stride)]
            sound = cells[~cells["stumbles"]]
            added = 1e3 * (sound["spine_speed"] - sound["stiff_speed"])
            key = f"spine.{profile}.{label}"
            numbers |= {
                f"{key}.gain": f"{100 * sound['gain'].min():.0f} to {100 * sound['gain'].max():.0f} %",
                f"{key}.added": f"{added.min():.0f} to {added.max():.0f} mm/s",
                f"{key}.cells": f"{len(sound)} of {len(cells)}",
                f"{key}.sure": f"{int((cells['gain_low'] > 0.0).sum())} of {len(cells)}",
                f"{key}.mechanical": span(sound["cost_of_transport_gain"]),
                f"{key}.electrical": span(sound["electrical_cost_of_transport_gain"]),
            }
    return numbers


def span(shares: pd.Series) -> str:
    return f"{percent(shares.min())} to {percent(shares.max())} %".replace("-", "−")


def map_figure(table: pd.DataFrame) -> Figure:
    """Speed over frequency, stiff and at the best amplitude and phase, for each profile and gait."""
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    axes = figure.subplots(len(PROFILES), len(GAITS), sharex=True, sharey=True)
    colors = {1.0: "#0b5fa5", 0.6: "#b85c00"}
    frequencies = sorted(set(table["frequency"]))
    for row_axes, (profile, title) in zip(axes, PROFILES.items(), strict=True):
        for ax, gait in zip(row_axes, GAITS, strict=True):
            for stride, color in colors.items():
                cells = table[
                    (table["profile"] == profile)
                    & (table["gait"] == gait)
                    & (table["stride"] == stride)
                ]
                x = cells["frequency"].to_numpy()
                stiff, best = (
                    1e3 * cells[f"{side}_speed"].to_numpy() for side in ("stiff", "spine")
                )
                stumbles = cells["stumbles"].to_numpy()
                ax.plot(x, stiff, "--", color=color, linewidth=1.2)
                ax.plot(x, best, "o-", color=color, linewidth=1.8, markersize=3.5)
                ax.fill_between(x, stiff, best, color=color, alpha=0.15, linewidth=0)
                edges = np.append(stumbles[1:], False) | stumbles
                ax.fill_between(
                    x,
                    stiff,
                    best,
                    where=edges,
                    facecolor="none",
                    edgecolor=color,
                    hatch="////",
                    linewidth=0,
                )
                # Above the long strides, and below the short ones.
                places = np.maximum(stiff, best) if stride == 1.0 else np.minimum(stiff, best)
                for at, place, gain in zip(x, places, cells["gain"], strict=True):
                    ax.annotate(
                        f"{100 * gain:+.0f}".replace("-", "−"),
                        (at, place),
                        (0, 7 if stride == 1.0 else -13),
                        textcoords="offset points",
                        ha="center",
                        fontsize=8,
                        color=color,
                    )
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xticks(frequencies, [f"{value:g}" for value in frequencies])
            ax.set_yticks([25, 50, 100, 200], ["25", "50", "100", "200"])
            ax.minorticks_off()
            ax.margins(y=0.12)
            ax.grid(alpha=0.25)
            ax.spines[["top", "right"]].set_visible(False)
            if profile == "exact":
                ax.set_title(gait.replace("_", " ").capitalize())
        row_axes[0].set_ylabel(f"{title}\nspeed [mm/s]")
    for ax in axes[-1]:
        ax.set_xlabel("stride frequency, simulated time [Hz]")
    first = axes[0, 0]
    for stride, color in colors.items():
        first.plot([], [], "o-", color=color, label=f"spine bends, stride {stride:g}")
        first.plot([], [], "--", color=color, label=f"spine stiff, stride {stride:g}")
    first.fill_between(
        [], [], [], facecolor="none", edgecolor="#666666", hatch="////", label="stiff gait stumbles"
    )
    figure.legend(
        *first.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=5,
        fontsize=8.5,
        frameon=False,
    )
    figure.suptitle(
        "What the best amplitude and phase of the spine add to the speed (numbers: %)", fontsize=11
    )
    return figure


# --- systematic effects


#: Name of a change -> choices of the setup and values that make it; at the points of the README.
EFFECTS: Mapping[str, tuple[Mapping[str, Any], Mapping[str, float]]] = {
    "stride 0.6 instead of 1": ({}, {"stride": 0.6}),
    "friction 0.8": ({}, {"contact.friction": 0.8}),
    "friction 1.4": ({}, {"contact.friction": 1.4}),
    "hard soles": (
        {},
        {"contact.width": 0.0005, "contact.time_constant": 0.008, "contact.damping_ratio": 2.0},
    ),
    "servo gain 60 N m/rad, damping 0.05": ({}, {"servo.kp": 60.0, "servo.kv": 0.05}),
    "servo gain 10 N m/rad": ({}, {"servo.kp": 10.0}),
    "flexible tail": ({"tail": "articulated"}, {}),
    "tail 2 mm lower": ({}, {"geometry.tail.z": -0.0243}),
    "tail 2 mm higher": ({}, {"geometry.tail.z": -0.0203}),
    "time step 1 ms": ({"timestep": 0.001}, {}),
    "no pilot": ({"pilot": "open_loop"}, {}),
}


def effect_points(table: pd.DataFrame) -> list[tuple[str, dict[str, float]]]:
    """Gait, and best amplitude and phase, of the ideal controller at 0.8 Hz with the full stride."""
    cells = table[
        (table["profile"] == "exact") & (table["frequency"] == 0.8) & (table["stride"] == 1.0)
    ]
    return [
        (row["gait"], {name: row[name] for name in ("spine.amplitude", "spine.phase")})
        for _, row in cells.iterrows()
    ]


def pair_samples(randomize: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Stratified samples of `PAIRS` pairs."""
    fields = {"run": {"duration": 1.0}, "randomize": {"repeats": PAIRS, **randomize}}
    rows = sample(Sweep.from_dict(fields | {"vary": {"stride": [1.0]}}))
    return {name: values for name, values in rows.values.items() if name != "stride"}


def gains(
    gait: str, point: Mapping[str, float], choices: Mapping[str, Any], values: Mapping[str, Any]
) -> np.ndarray:
    """Relative gain in speed of each pair."""
    speeds = []
    for spine, bend in (("none", {}), ("stride_extension", point)):
        setup = Setup(
            gait=gait, spine=spine, **({"pilot": "straight", "steering": "leg"} | choices)
        )
        result = Simulator(setup, engine="c").run(
            {"frequency": 0.8, **values, **bend}, Run(cycles=6, warmup_cycles=2)
        )
        speeds.append(np.where(result.status == "ok", result.metrics["speed"], np.nan))
    return speeds[1] / speeds[0] - 1.0


def effects(table: pd.DataFrame) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Gait -> change -> gain without and with the change, and standard error of their difference [%]."""
    base_samples = pair_samples({"contact.friction": {"uniform": [0.8, 1.4]}})
    bodies = pair_samples({"from": "identified"})
    shifts: dict[str, dict[str, tuple[float, float, float]]] = {}
    for gait, point in effect_points(table):
        base = gains(gait, point, {}, base_samples)
        changes = {
            name: gains(gait, point, choices, base_samples | values)
            for name, (choices, values) in EFFECTS.items()
        }
        shifts[gait] = {
            name: (
                100 * np.nanmean(base),
                100 * np.nanmean(changed),
                100 * float(np.nanstd(changed - base, ddof=1)) / math.sqrt(PAIRS),
            )
            for name, changed in changes.items()
        }
        starts = {
            name: column for name, column in base_samples.items() if name.startswith("start.")
        }
        for name, samples in {
            "initial state (2 std)": starts | {"contact.friction": 1.1},
            "identified bodies (2 std)": bodies,
        }.items():
            spread = gains(gait, point, {}, samples)
            shifts[gait][name] = (
                100 * np.nanmean(spread),
                100 * (np.nanmean(spread) + 2 * np.nanstd(spread, ddof=1)),
                0.0,
            )
    return shifts


def effects_figure(shifts: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> Figure:
    """A tornado for each gait: by how much each change shifts the gain [percentage points]."""
    names = sorted(
        next(iter(shifts.values())),
        key=lambda name: max(abs(lines[name][1] - lines[name][0]) for lines in shifts.values()),
    )
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    for ax, (gait, lines) in zip(
        figure.subplots(1, len(shifts), sharey=True), shifts.items(), strict=True
    ):
        for place, name in enumerate(names):
            base, changed, error = lines[name]
            shift, is_spread = changed - base, name.endswith("std)")
            ax.barh(
                place,
                (2 if is_spread else 1) * shift,
                left=-shift if is_spread else 0.0,
                color="#999999" if is_spread else "#0b5fa5" if shift > 0 else "#b5452c",
                height=0.7,
            )
            if error:
                ax.errorbar(shift, place, xerr=2 * error, color="black", linewidth=0.8)
            ax.annotate(
                f"{'±' if is_spread else ''}{shift:{'.1f' if is_spread else '+.1f'}}",
                (max(shift, 0.0), place),
                (5, 0),
                textcoords="offset points",
                va="center",
                fontsize=7.5,
            )
        ax.axvline(0.0, color="black", linewidth=0.8)
        ax.margins(x=0.22)
        ax.set_yticks(range(len(names)), names, fontsize=8)
        ax.set_title(
            f"{gait.replace('_', ' ').capitalize()}: {lines[names[-1]][0]:+.1f} %", fontsize=10
        )
        ax.set_xlabel("shift of the gain [percentage points]", fontsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    figure.suptitle("exact, 0.8 Hz, stride 1: what shifts the gain in speed", fontsize=11)
    return figure


def phase_figure() -> Figure:
    """The robot from above at four phases of a trot with the spine at phase 0: bend of the back, and feet on the ground."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    # Right front and left rear carry in the first half of the cycle, the other two in the second half.
    feet = {
        "front_left": (-1, 1, 1),
        "front_right": (1, 1, 0),
        "rear_left": (-1, -1, 0),
        "rear_right": (1, -1, 1),
    }
    for ax, phase in zip(figure.subplots(1, 4), (0.0, 0.25, 0.5, 0.75), strict=True):
        bend = math.cos(2 * math.pi * phase)
        along = np.linspace(-1.0, 1.0, 41)
        # The ends of the back stand to the left where it bends to the left.
        across = 0.35 * bend * (0.5 - along**2)
        ax.plot(across, along, color="#0b5fa5", linewidth=7, solid_capstyle="round")
        ax.plot(across[-1], along[-1] + 0.28, marker="^", color="#0b5fa5", markersize=11)
        for side, end, pair in feet.values():
            # A foot goes from front to back in its stance, and forward in its swing.
            time = (phase + 0.5 * pair) % 1.0
            is_on_ground = time < 0.5
            swing = 1.0 - 4.0 * time if is_on_ground else 4.0 * time - 3.0
            middle = across[-1 if end > 0 else 0]
            # The girdle is perpendicular to the end of the back: one of its sides is carried forward.
            x, y = middle + 0.45 * side, end + 0.25 * side * end * bend + 0.3 * swing
            ax.plot([middle, x], [end, y], color="#888888", linewidth=2, zorder=0)
            ax.plot(
                x,
                y,
                "o",
                markersize=11,
                markeredgecolor="#b5452c",
                markerfacecolor="#b5452c" if is_on_ground else "white",
            )
        ax.set_title(f"phase {phase:g} of the cycle", fontsize=10)
        ax.set_aspect("equal")
        ax.set_xlim(-1.1, 1.1)
        ax.set_ylim(-1.75, 1.8)
        ax.axis("off")
    figure.suptitle("Trot from above, head up; filled: foot on the ground", fontsize=11)
    return figure


def main(action: str, out: Path) -> None:
    if action == "file":
        published_file(out)
        return
    table = pd.concat([map_rows(profile, out / profile) for profile in PROFILES])
    table.to_csv(TABLE, index=False, float_format="%.6g")
    numbers = {f"spine.table.{profile}": page_table(table, profile) for profile in PROFILES}
    shifts = effects(table)
    texts = {
        f"effects.{gait}": ", ".join(
            f"{name} {changed - base:+.1f}"
            for name, (base, changed, _) in lines.items()
            if not name.endswith("std)")
        )
        for gait, lines in shifts.items()
    }
    figures = {"map": map_figure(table), "effects": effects_figure(shifts), "phase": phase_figure()}
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png", dpi=150)
    print(json.dumps(numbers | spans(table) | texts, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
