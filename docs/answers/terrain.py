"""Numbers and table of docs/spine_on_terrain.md and docs/terrain.md, as JSON, of what search_gait.py measured."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "howto" / "terrain"))
from search_gait import HERE, compared

#: The spines of the table, the free one first, with which the others are compared.
SPINES = ("free", "stiff", "passive")
#: Metric -> its title, its scale and places in the table, and places of a difference.
COLUMNS = {
    "success": ("success [%]", 100, 0, 1),
    "speed": ("speed [mm/s]", 1e3, 0, 0),
    "cost_of_transport": ("mechanical cost", 1, 1, 1),
    "electrical_cost_of_transport": ("electrical cost", 1, 0, 0),
}


def signed(value: float, places: int) -> str:
    return f"{value:+.{places}f}".replace("-", "−")


def apart(row: pd.Series, other: str, scale: float, places: int) -> str:
    """How far the free spine is above the other, with half of the 95 % interval."""
    half = f"{scale * row[f'+- {other}']:.{places}f}"
    return f"{signed(scale * row[f'free - {other}'], places)} ± {half}"


def cell(row: pd.Series, scale: float, places: int) -> str:
    """Means of the spines, in bold those whose interval excludes zero."""
    told = [f"{scale * row[spine]:.{places}f}" for spine in SPINES]
    sure = [False, *(abs(row[f"free - {other}"]) > row[f"+- {other}"] for other in SPINES[1:])]
    return ", ".join(f"**{each}**" if bold else each for each, bold in zip(told, sure, strict=True))


def main() -> dict[str, str]:
    seeds = pd.read_csv(HERE / "seeds.csv", dtype={"seed": str})
    means = compared(seeds)
    scenes = list(dict.fromkeys(seeds.scene))
    lines = [
        f"| scene | {' | '.join(title for title, *_ in COLUMNS.values())} |",
        "|---|---|---|---|---|",
    ]
    for scene in (*scenes, "all"):
        cells = [
            cell(means.loc[(name, scene)], scale, places)
            for name, (_, scale, places, _) in COLUMNS.items()
        ]
        lines.append(f"| {scene if scene == 'all' else f'`{scene}`'} | {' | '.join(cells)} |")
    found = {"terrain.table": "\n".join(lines)}
    for name, (_, scale, places, finer) in COLUMNS.items():
        short = {
            "cost_of_transport": "mechanical",
            "electrical_cost_of_transport": "electrical",
        }.get(name, name)
        for scene in ("all", "spiral_stairs", "planks"):
            row = means.loc[(name, scene)]
            found[f"terrain.{scene}_{short}"] = apart(row, "stiff", scale, finer)
            found[f"terrain.{scene}_{short}_stiff"] = f"{scale * row['stiff']:.{places}f}"
    found["terrain.all_speed_passive"] = apart(means.loc[("speed", "all")], "passive", 1e3, 0)
    success = means.loc["success", list(SPINES)].drop("all") * 100
    found["terrain.range"] = f"{success.min().min():.0f} to {success.max().max():.0f}"
    seeds["share"] = 100 * seeds.successes / seeds.walks
    searched = seeds[seeds.seed.str.isdigit()].groupby(["scene", "spine"])["share"]
    for spine in SPINES:
        found[f"terrain.spiral_median_{spine}"] = f"{searched.median()['spiral_stairs', spine]:.0f}"
        low, high = (each["planks", spine] for each in (searched.min(), searched.max()))
        found[f"terrain.planks_range_{spine}"] = f"{low:.0f} to {high:.0f}"
    begun = seeds[(seeds.seed == "begin") & (seeds.spine == "passive")].set_index("scene")
    for scene, short in (("spiral_stairs", "spiral"), ("slalom", "slalom")):
        found[f"terrain.begun_{short}"] = f"{begun.successes[scene]} of {begun.walks[scene]}"
    return found


if __name__ == "__main__":
    print(json.dumps(main(), indent=1, ensure_ascii=False))
