"""Numbers and tables of docs/experiments.md and docs/published_set_up.md, as JSON, from a directory of
`nermo-mjx experiment all`.

    python docs/answers/experiments.py DIR

What `as_built` does on stiff soles is walked here, from one start.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from model import STIFF

from nermo_mjx import Run, Simulator
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES, Case, Settings, worlds
from nermo_mjx.experiments.walks import walk_maze

Line = dict[str, Any]
#: Rows of the first table: title, figures, decimal places.
SHOWN = (
    ("trot, 0.8 Hz, spine held [mm/s]", ["speed of trot, 0.8 Hz, no spine"], 1),
    ("speed, spine over none, 0.8 Hz", ["speed of trot, 0.8 Hz, spine over none"], 2),
    (
        "trot over lateral walk, 0.8 Hz, spine held and free †",
        [
            "speed of trot over lateral walk, 0.8 Hz, no spine",
            "speed of trot with spine over lateral walk, 0.8 Hz",
        ],
        2,
    ),
    (
        "roll std, compensated over not, 0.67 Hz",
        ["roll std of trot, 0.67 Hz, spine, compensated over not"],
        2,
    ),
    (
        "smallest radius, trot, legs and both [m]",
        ["smallest radius of trot, leg-based", "smallest radius of trot, mix-based"],
        3,
    ),
    (
        "rear left foot, lifted, without and with compensation [N]",
        [
            "force of the rear left foot, without compensation",
            "force of the rear left foot, with compensation",
        ],
        2,
    ),
    ("maze: time, spine held and free [s]", ["time without spine", "time with spine"], 1),
    (
        "maze: roll std, spine held and free [°]",
        ["roll std without spine", "roll std with spine"],
        2,
    ),
)
#: The same of the hardware's figures.
BUILT = (
    (
        "trot at 0.67 Hz, spine held and free [mm/s]",
        ["hardware: speed of trot, 0.67 Hz, no spine", "hardware: speed of trot, 0.67 Hz, spine"],
        1,
    ),
    (
        "trot over lateral walk, mean of the frequencies",
        ["hardware: speed of trot over lateral walk, mean of the frequencies"],
        2,
    ),
    ("spine over none, 0.67 Hz", ["hardware: speed of trot, 0.67 Hz, spine over none"], 2),
    (
        "the same at 0.5 and 0.8 Hz, farthest",
        ["hardware: speed of trot, 0.5 and 0.8 Hz, spine over none"],
        2,
    ),
    ("maze: time saved with the spine", ["hardware: time saved with the spine"], 2),
    (
        "quarter circle of 0.5 m, legs, spine, both [s]",
        [
            f"hardware: time for 0.5 m, trot, 0.67 Hz, {way}-based"
            for way in ("leg", "spine", "mix")
        ],
        1,
    ),
)
EXPERIMENTS = {
    "straight line": ["straight-line"],
    "turning": ["turning"],
    "balance": ["balance"],
    "maze": ["maze"],
    "body and test stands": ["body", "leg-stand", "spine-stand"],
}
KINDS = ("predicted", "rewritten", "chosen", "theory")
#: Groups of rules by the name of their count: an outcome is a yes or no, a word or a count.
RULES = {
    "outcomes": ["outcome"],
    "numbers": ["number"],
    "effects": ["effect", "gain"],
    "ranges": ["range", "at_most"],
}
GAITS = ("trot", "walking trot", "lateral walk")
#: Standard deviation of the roll of the author's model in a trot at 0.67 Hz, spine held and free [degrees].
AUTHORS_ROLL = (3.22, 4.45)


def shown(value: float | list[float] | None, places: int) -> str:
    """A number or a range."""
    if value is None:
        return "–"
    ends = value if isinstance(value, list) else [value]
    return " to ".join(f"{each:.{places}f}" for each in dict.fromkeys((min(ends), max(ends))))


def judged(lines: Iterable[Line], **wanted: Any) -> list[Line]:
    return [
        line
        for line in lines
        if line["holds"] is not None and all(line[name] == value for name, value in wanted.items())
    ]


def counts(lines: list[Line]) -> dict[str, str]:
    """How many figures of each experiment hold, by kind."""
    table = [
        "| figures that hold | predicted | rule rewritten | chosen with it in view | theory |",
        "|---|---|---|---|---|",
    ]
    for title, names in EXPERIMENTS.items():
        cells = []
        for kind in KINDS:
            cells.append(
                reproduced(
                    [line for name in names for line in judged(lines, experiment=name, kind=kind)]
                )
            )
        table.append(f"| {title} | {' | '.join(cells)} |")
    predicted = judged(lines, kind="predicted")
    hold = sum(line["holds"] for line in predicted)
    not_judged = sum(line["holds"] is None for line in lines)
    return {
        "published.counts": "\n".join(table),
        "published.hold": f"{hold} of the {len(predicted)}",
        "published.share": f"{100 * hold / len(predicted):.0f} %",
        "published.not_judged": f"{not_judged}",
        "published.chosen": reproduced(judged(lines, kind="chosen")),
        "published.rewritten": reproduced(judged(lines, kind="rewritten")),
    }


def reproduced(lines: list[Line]) -> str:
    """How many of the lines hold."""
    return f"{sum(line['holds'] for line in lines)} of {len(lines)}" if lines else "–"


def by_rule(lines: list[Line]) -> dict[str, str]:
    """How many predicted values of each group of rules hold."""
    return {
        f"published.{name}": reproduced(
            [line for rule in rules for line in judged(lines, kind="predicted", rule=rule)]
        )
        for name, rules in RULES.items()
    }


def figures(rows: Any, heads: dict[str, str], by_name: dict[str, Line]) -> str:
    """A table of figures, one column for each of `heads`, what it is -> how it is called."""
    lines = [f"| figure | {' | '.join(heads.values())} |", "|---" * (1 + len(heads)) + "|"]
    for title, names, places in rows:
        values = [[by_name[name][what] for name in names] for what in heads]
        cells = [
            "–" if of == [None] * len(of) else ", ".join(shown(each, places) for each in of)
            for of in values
        ]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def built() -> dict[str, str]:
    """Of `as_built` on stiff soles: the gain of the spine at a full stride, and the time saved in the maze."""
    settings = Settings(profiles=["as_built"], repeats=1, engine="c")
    simulator = Simulator(settings.setup("straight_line", spine="stride_extension"), engine="c")
    both: list[Case] = []
    for frequency in FREQUENCIES:
        for spine in (0.0, 1.0):
            values = {"frequency": frequency, "spine.amplitude": AMPLITUDE * spine}
            values |= {"pilot.error_gain": 0.0, "pilot.change_gain": 0.0}
            both.append(Case({"frequency": frequency, "spine": spine}, "trot", values=values))
    changed = {name: np.full(len(both), value) for name, value in {**STIFF, "stride": 1.0}.items()}
    values = worlds(both, simulator.setup.defaults(), settings).values | changed
    speed = np.reshape(
        simulator.run(values, Run(cycles=12, warmup_cycles=2)).metrics["speed"], (-1, 2)
    )
    time = walk_maze(Settings(profiles=["as_built"], repeats=1, engine="c", values=STIFF)).columns[
        "time"
    ]
    return {
        "built.both": ", ".join(f"{each:.2f}" for each in speed[:, 1] / speed[:, 0]),
        "built.maze": f"{1 - time[1] / time[0]:.2f}",
    }


def quoted(by_name: dict[str, Line]) -> dict[str, str]:
    """Figures of `as_published` that the text of docs/experiments.md tells."""
    published = {name: line["as_published"] for name, line in by_name.items()}
    tighter = [
        100 * published[f"smallest radius of {gait}, mix-based below leg-based"] for gait in GAITS
    ]
    return {
        "published.slow_gain": f"{published['speed of trot, 0.5 and 0.67 Hz, spine over none']:.2f}",
        "published.over_theory": f"{published['speed of trot over its theory, 0.8 Hz']:.2f}",
        "published.tighter": f"{min(tighter):.0f} to {max(tighter):.0f}",
    }


def set_up(walks: pd.DataFrame) -> dict[str, str]:
    """Of the trot of `as_published`, without a pilot: means of the starts, spine held and free."""
    is_trot = (walks.profile == "as_published") & (walks.gait == "trot")
    trot = walks[is_trot & (walks.stride == 1.0)]
    means = trot[trot.compensated == 0].groupby(["frequency", "spine"]).mean(numeric_only=True)
    gains = [means.speed[each, 1.0] / means.speed[each, 0.0] for each in (0.8, 0.67, 0.5)]
    roll, pitch = (
        np.degrees(means.loc[0.67, f"{name}_std"]).to_numpy() for name in ("roll", "pitch")
    )
    more = sorted(100 * (roll / AUTHORS_ROLL - 1.0))
    return {
        "set_up.gains": ", ".join(f"{each:.2f}" for each in gains),
        "set_up.roll": ", ".join(f"{each:.2f}" for each in roll),
        "set_up.pitch": ", ".join(f"{each:.2f}" for each in pitch),
        "set_up.more_roll": f"{more[0]:.0f} to {more[1]:.0f}",
    }


def circles(turns: pd.DataFrame) -> dict[str, str]:
    """Of the circles of 0.5 m by the spine in `exact`: how many are left in a start, and the mean farthest distance."""
    cases = turns[(turns.profile == "exact") & (turns.strategy == "spine") & (turns.radius == 0.5)]
    each = cases.groupby(["gait", "frequency"]).agg({"followed": "all", "cross_track_peak": "mean"})
    far = 1e3 * each.cross_track_peak
    return {
        "circles.left": f"{(~each.followed.astype(bool)).sum()} of {len(each)}",
        "circles.far": f"{far.min():.0f} to {far.max():.0f}",
    }


if __name__ == "__main__":
    lines = json.loads((Path(sys.argv[1]) / "report.json").read_text())["lines"]
    by_name = {line["figure"]: line for line in lines}
    straight, turns = (
        pd.read_parquet(Path(sys.argv[1]) / name / "results")
        for name in ("straight-line", "turning")
    )
    found = (
        counts(lines)
        | by_rule(lines)
        | built()
        | quoted(by_name)
        | set_up(straight)
        | circles(turns)
    )
    heads = {
        "published": "published",
        "author": "author's model",
        "as_published": "`as_published`",
        "exact": "`exact`",
    }
    found["published.main"] = figures(SHOWN, heads, by_name)
    found["built"] = figures(BUILT, {"published": "hardware", "as_built": "`as_built`"}, by_name)
    print(json.dumps(found, indent=1, ensure_ascii=False))
