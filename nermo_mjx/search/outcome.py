"""Results of a search, from its table alone: best.json for programs, best.yaml, a sweep file, and an atlas's elites."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.rollout.derivative import cost as gradient_cost
from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.runs.text import to_json
from nermo_mjx.search.batches import GRADIENT, Batches
from nermo_mjx.search.scoring import Scores, cells_of, elites_of, scores_of
from nermo_mjx.search.spec import Search
from nermo_mjx.specs.reading import dump
from nermo_mjx.sweep.results import Results, chunk_files
from nermo_mjx.sweep.table import Columns, columns_of, meta

BEST: Final = "best.json"
ATLAS: Final = "atlas.parquet"
#: Runs of best.yaml: from slightly different starts, so that the sweep shows whether the best point is fragile.
REPEATS: Final = 3


@dataclasses.dataclass(frozen=True)
class Evaluations:
    """All points of a search's table, in the order in which they were asked for.

    Attributes:
        search: that made it.
        results: the table, one row per run.
        scores: of the n points.
        batch: which one each was part of, (n,).
    """

    search: Search
    results: Results
    scores: Scores
    batch: np.ndarray

    @classmethod
    def of(cls, search: Search, results: Results) -> Evaluations:
        """Of a table, as far as it goes."""
        columns = dict(results.columns(["batch", *search.aim.metrics]))
        batch = columns.pop("batch")[:: search.repeats].astype(int)
        return cls(search, results, scores_of(search.aim, search.repeats, columns, results.well), batch)

    def means(self, names: list[str], points: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of some points (k,), means over their repeats."""
        repeats = self.search.repeats
        return {name: values.reshape(-1, repeats)[points].mean(axis=1) for name, values in self.results.columns(names)}

    def described(self, points: np.ndarray) -> list[dict[str, Any]]:
        """Row, parameters, objective and metrics of some points (k,)."""
        metrics, parameters = columns_of(self.results, "metric"), list(self.search.names)
        columns = self.means([*parameters, *metrics], points)
        told = []
        for i, point in enumerate(points.tolist()):
            cost = self.scores.cost[point].tolist()
            told.append({
                "parameters": {name: float(columns[name][i]) for name in parameters},
                "objective": cost if self.search.aim.pareto else cost[0],
                "metrics": {name: float(columns[name][i]) for name in metrics},
                "row": point * self.search.repeats,
            })  # fmt: skip
        return told

    @property
    def simulated_seconds(self) -> float:
        """Of all runs, with gradients added at their cost in forward runs [s]."""
        search = self.search
        names = [name for name in search.setup.timing if name in self.results.schema.names]
        values = {name: search.sweep.constants[name] for name in search.setup.timing if name in search.sweep.constants}
        rate = search.setup.cycle_rate(values | dict(self.results.columns(names)))
        seconds = np.broadcast_to(search.run.seconds(rate)[1], self.results.rows)
        slope, times = GRADIENT.format("quality", search.names[0]), np.ones(self.results.rows)
        if slope in self.results.schema.names:
            times += np.isfinite(self.results.column(slope)) * gradient_cost(len(search.names), "forward")
        return float(np.sum(seconds * times))

    def front(self) -> np.ndarray:
        """Allowed points that no other one beats, in order of the first objective (k,)."""
        allowed = np.flatnonzero(self.scores.allowed)
        places = allowed[nondominated(self.scores.cost[allowed])]
        return places[np.argsort(self.scores.cost[places, 0], kind="stable")]

    def best(self) -> int | None:
        """The best allowed point: of a front the one in its middle, nearest to where all objectives would be best."""
        allowed = np.flatnonzero(self.scores.allowed)
        if not len(allowed):
            return None
        if self.search.aim.measures:  # of those that have a cell
            allowed = elites_of(self.search.aim, self.scores)[1]
        elif self.search.aim.pareto:
            allowed = self.front()
        if not len(allowed):
            return None
        cost = self.scores.cost[allowed]
        span = np.ptp(cost, axis=0)
        apart = (cost - cost.min(axis=0)) / np.where(span > 0, span, 1.0)
        return int(allowed[np.argmin((apart**2).sum(axis=1))])


def nondominated(cost: np.ndarray) -> np.ndarray:
    """Places (k,) of the points (n, m) that no other one beats: as good in all costs and better in one."""
    if not len(cost):
        return np.empty(0, int)
    import moocore

    return np.flatnonzero(moocore.is_nondominated(cost))


def hypervolumes(found: Evaluations) -> tuple[np.ndarray, np.ndarray]:
    """The share of a box that the front beats after each batch, (batches,), and the box's worst corner, (m,).

    The box reaches from the best of each objective in the whole table to its worst in the first batch.
    """
    import moocore

    cost, allowed = found.scores.cost, found.scores.allowed
    known = np.flatnonzero(allowed)
    first = known[found.batch[known] == found.batch[known[0]]]
    worst, best = cost[first].max(axis=0), cost[known].min(axis=0)
    box = np.prod(np.where(worst > best, worst - best, 1.0))
    shares, front = [], np.empty((0, cost.shape[1]))
    for batch in range(found.batch.max() + 1):
        front = np.concatenate([front, cost[(found.batch == batch) & allowed]])
        front = front[nondominated(front)]
        inside = front[(front < worst).all(axis=1)]
        shares.append(float(moocore.hypervolume(inside, ref=worst) / box) if len(inside) else 0.0)
    return np.array(shares), worst


def atlas_progress(found: Evaluations) -> tuple[np.ndarray, np.ndarray]:
    """Filled cells and QD score after each batch, (batches,) each.

    The QD score is the sum over the filled cells of how much better their elite is than the worst point of the first
    batch that has a cell (Pugh et al. 2016); nothing counts less than zero.
    """
    aim, scores = found.search.aim, found.scores
    cell = np.where(scores.allowed, cells_of(aim, scores.measures), -1)
    known = np.flatnonzero(cell >= 0)
    floor = float(scores.quality[known[found.batch[known] == found.batch[known[0]]]].min()) if len(known) else 0.0
    best: dict[int, float] = {}
    filled, total = [], []
    for batch in range(int(found.batch.max()) + 1):
        for place in np.flatnonzero((found.batch == batch) & (cell >= 0)).tolist():
            gain = max(float(scores.quality[place]) - floor, 0.0)
            best[int(cell[place])] = max(best.get(int(cell[place]), 0.0), gain)
        filled.append(len(best))
        total.append(sum(best.values()))
    return np.array(filled), np.array(total)


def publish(batches: Batches, *, complete: bool) -> dict[str, Any]:
    """Make best.json, best.yaml and atlas.parquet from the table; the content of best.json, empty without a best.

    `parameters`, `objective`, `metrics` (SI units and radians, means over the repeats) and first `row` of the best
    point; `evaluations`, `failed` of them (a run fell or diverged), `simulated_seconds`; whether the search is
    `complete`. Of a front `front`, with the same of each point, and `hypervolume`; of an atlas `cells`, `filled` and
    `qd_score`.
    """
    results = Results([*chunk_files(batches.out).values()])
    found = Evaluations.of(batches.search, results)
    place = found.best()
    if place is None:
        return {}
    best: dict[str, Any] = found.described(np.array([place]))[0] | {
        "evaluations": len(found.scores), "failed": int((~found.scores.ok).sum()),
        "simulated_seconds": found.simulated_seconds, "complete": complete,
    }  # fmt: skip
    if batches.search.aim.pareto:
        best |= {"front": found.described(found.front()), "hypervolume": float(hypervolumes(found)[0][-1])}
    if batches.search.aim.measures:
        filled, total = atlas_progress(found)
        cells = int(np.prod([each.cells for each in batches.search.aim.measures]))
        best |= {"cells": cells, "filled": int(filled[-1]), "qd_score": float(total[-1])}
        batches.directory.write(ATLAS, parquet_bytes(atlas_table(found)))
    batches.directory.write(BEST, to_json(best))
    batches.directory.write("best.yaml", best_sweep(batches.search, best, batches.out.resolve()).encode())
    return best


def atlas_table(found: Evaluations) -> pa.Table:
    """One row per filled cell, in order: row of the table, cell, parameters, metrics (means over the repeats).

    The schema's metadata `atlas` is JSON: `objective` with metric and direction, `measures` with metric, range, cells.
    """
    aim, schema = found.search.aim, found.results.schema
    cells, points = elites_of(aim, found.scores)
    table = Columns()
    table.add("row", points * found.search.repeats, "index", "1", "first run of the elite, a row of results")
    table.add("cell", cells, "index", "1", "cell of the atlas; the last measure runs fastest")
    for name, values in found.means([*found.search.names, *columns_of(found.results, "metric")], points).items():
        about: dict[str, Any] = meta(schema.field(name))
        table.add(name, values, **about)
    term = aim.objective.terms[0]
    plain = len(aim.objective.terms) == 1 and term.aim != "hold"
    if not plain:
        about = {"unit": "1", "description": "the sum that is minimized"}
        table.add("objective", found.scores.cost[points, 0], "metric", **about)
    objective = dict(zip(("metric", "direction"), (term.metric, term.aim) if plain else ("objective", "minimize"),
                         strict=True))  # fmt: skip
    told = {"objective": objective, "measures": [dataclasses.asdict(each) for each in aim.measures]}
    return table.table({"atlas": json.dumps(told), "search": found.search.digest()})


def best_sweep(search: Search, best: dict[str, Any], folder: Path | None = None) -> str:
    """The text of best.yaml: setup, run and `set` of the best point, run a few times from slightly different starts."""
    data = search.sweep.walk_fields(folder) | {"set": {**search.sweep.fixed, **best["parameters"]}}
    head = f"# Row {best['row']} of a search: objective {best['objective']}.\n"
    return head + dump({**data, "randomize": {"repeats": REPEATS}, "seed": search.sweep.seed, "plots": False})
