"""Walks the grid that the author's model walked (tests/data/author_model_grid.csv), and draws both side by side.

    python docs/author_grid.py DIR

Writes DIR/author_grid.png and prints the numbers of docs/published_set_up.md as JSON, in about eight minutes of
processor time.
His model ran in MuJoCo 3.17.0; in MuJoCo 4 it walks differently.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.control.parameters import published_values
from nermo_mjx.robot.parameters import FRONT_LEG, REAR_LEG

ROOT = Path(__file__).parents[1]
#: Columns of his table, and how they are called.
MEASURES = {
    "speed_mm_s": "speed [mm/s]",
    "roll_std_deg": "roll std [°]",
    "pitch_std_deg": "pitch std [°]",
    "yaw_std_deg": "yaw std, spine [°]",
    "front_share": "front share",
}
TABLE_A7 = dict(
    zip(
        ("stance.front_y", "stance.front_z", "stance.rear_y", "stance.rear_z"),
        (*FRONT_LEG.neutral_foot, *REAR_LEG.neutral_foot),
        strict=True,
    )
)


def walk(rows: pd.DataFrame, changed: dict[str, float] | None = None, **setup: Any) -> pd.DataFrame:
    """The same measures of this twin, with his settings; no pilot.

    Args:
        changed: parameters of the body that are not those of the profile.
        setup: the same of the structure.
    """
    each = [
        published_values(row.gait, profile="as_published")
        | (TABLE_A7 if row.stance == "A.7" else {})
        | {"tracking.clock_ratio": row.clock, "frequency": row.frequency, "stride": row.stride}
        | {"spine.amplitude": 0.4 * row.spine}
        for row in rows.itertuples()
    ]
    values = {name: np.array([row[name] for row in each]) for name in each[0]}
    values |= {name: np.full(len(rows), each) for name, each in (changed or {}).items()}
    set_up = Setup(profile="as_published", pilot="open_loop", spine="stride_extension", **setup)
    found = Simulator(set_up, engine="c").run(values, Run(cycles=11.0, warmup_cycles=4.0)).metrics
    return pd.DataFrame(
        {
            "speed_mm_s": 1e3 * np.asarray(found["speed"]) * rows["clock"].to_numpy(),
            **{
                f"{axis}_std_deg": np.degrees(found[f"{axis}_std"])
                for axis in ("roll", "pitch", "yaw")
            },
            "front_share": np.asarray(found["front_load_share"]),
        },
        index=rows.index,
    )


def ordered(a: pd.Series, b: pd.Series, spine: pd.Series) -> str:
    """r within each setting of the spine, without and with."""
    return ", ".join(
        f"{np.corrcoef(a[spine == on], b[spine == on])[0, 1]:.2f}" for on in sorted(set(spine))
    )


def table(his: pd.DataFrame, ours: pd.DataFrame) -> str:
    """Agreement in the set-up of the tests, in Markdown: a median alone hides walks that are ordered wrongly."""
    lines = [
        "| measure | r | r without, with the spine | median ratio | median deviation | within 10 % |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, title in MEASURES.items():
        of = his[his["spine"] == 1] if name == "yaw_std_deg" else his
        a, b = of[name], ours.loc[of.index, name]
        error = np.abs(b / a - 1)
        lines.append(
            f"| {title} | {np.corrcoef(a, b)[0, 1]:.3f} | {ordered(a, b, of['spine'])} | {np.median(b / a):.2f} | "
            f"{100 * np.median(error):.1f} % | {100 * np.mean(error <= 0.1):.0f} % |"
        )
    return "\n".join(lines)


def told(his: pd.DataFrame, ours: pd.DataFrame) -> dict[str, str]:
    """The table, median ratios at all stances and clocks, and what decides the order of the roll."""
    tests = his[(his["stance"] == "tests") & (his["clock"] == 0.4)]
    ratio = {
        name: (ours[name] / his[name]).groupby([his["stance"], his["clock"]]).median()
        for name in MEASURES
    }
    roll = 100 * (ratio["roll_std_deg"] - 1)
    still = tests[tests["spine"] == 0]
    exact = Setup().defaults()["servo.knee_range"]
    spheres = walk(still, {"servo.knee_range": exact}, feet="spheres")
    knees = walk(still, {"servo.knee_range": exact})
    order = {
        name: np.corrcoef(still["roll_std_deg"], each.loc[still.index, "roll_std_deg"])[0, 1]
        for name, each in (("his", ours), ("knees", knees), ("spheres", spheres))
    }
    return {
        "grid": table(tests, ours),
        "grid.roll": f"{roll.min():.0f} to {roll.max():.0f} %",
        **{
            f"grid.{name}": ", ".join(
                f"{ratio[column][stance, 1]:.2f}" for stance in ("tests", "A.7")
            )
            for name, column in (("speed", "speed_mm_s"), ("front", "front_share"))
        },
        **{f"grid.order_{name}": f"{each:.2f}" for name, each in order.items()},
    }


def draw(his: pd.DataFrame, ours: pd.DataFrame, folder: Path) -> None:
    """Values against each other, and Bland-Altman plots, at the clock of the tests and at one clock."""
    fig, axes = plt.subplots(2, 4, figsize=(12, 5.6), layout="constrained")
    shown = [name for name in MEASURES if name != "front_share"]
    for column, name in enumerate(shown):
        above, below = axes[:, column]
        for (stance, clock), rows in his.groupby(["stance", "clock"], sort=False):
            of = rows[rows["spine"] == 1] if name == "yaw_std_deg" else rows
            a, b = of[name], ours.loc[of.index, name]
            look = {"s": 12, "marker": "o" if clock == 0.4 else "^", "alpha": 0.7, "linewidths": 0}
            look |= {
                "c": "#0072b2" if stance == "tests" else "#d55e00",
                "label": f"stance {stance}, clock {clock:g}",
            }
            above.scatter(a, b, **look)
            below.scatter((a + b) / 2, b - a, **look)
        ends = [
            min(above.get_xlim()[0], above.get_ylim()[0]),
            max(above.get_xlim()[1], above.get_ylim()[1]),
        ]
        above.plot(ends, ends, color="0.6", lw=0.8, zorder=0)
        below.axhline(0.0, color="0.6", lw=0.8, zorder=0)
        above.set(
            title=MEASURES[name],
            xlabel="author's model, MuJoCo 3.17",
            ylabel="this twin" if column == 0 else "",
        )
        below.set(xlabel="mean of both", ylabel="twin − author's model" if column == 0 else "")
    axes[0, 0].legend(fontsize=7, frameon=False)
    fig.savefig(folder / "author_grid.png", dpi=110)


if __name__ == "__main__":
    his = pd.read_csv(ROOT / "tests/data/author_model_grid.csv", comment="#")
    ours = walk(his)
    print(json.dumps(told(his, ours), indent=1, ensure_ascii=False))
    draw(his, ours, Path(sys.argv[1]))
