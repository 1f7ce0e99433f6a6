"""The evaluated points of a search, read from its table: the best point, the front, and the atlas."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.search_methods import Scores, find_cells, find_elites, score_points
from nermo_mjx.optimize.search_spec import Search
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep.table import Columns, Results, columns_of, meta

# ---
# Results of a search from its table: best.json for programs, best.yaml, which is a sweep file, and the elites of an atlas.


@dataclasses.dataclass(frozen=True)
class Evaluations:
    """All points of a search's table, in the order of the requests.

    Attributes:
        search: Search that made the table.
        results: Table with one row per run.
        scores: Scores of the n points.
        batch: Number of the batch of each point (n,).
    """

    search: Search
    results: Results
    scores: Scores
    batch: np.ndarray

    @classmethod
    def of(cls, search: Search, results: Results | Path) -> Evaluations:
        """The points of a table, or of the table of a directory so far."""
        if isinstance(results, Path):
            results = Results(part_files(results))
        columns = dict(results.columns(["batch", *search.aim.metrics]))
        batch = columns.pop("batch")[:: search.repeats].astype(int)
        return cls(
            search, results, score_points(search.aim, search.repeats, columns, results.well), batch
        )

    def means(self, names: list[str], points: np.ndarray) -> dict[str, np.ndarray]:
        """Columns (k,) of some points (k,) by name, as means over the repeats."""
        repeats = self.search.repeats
        return {
            name: values.reshape(-1, repeats)[points].mean(axis=1)
            for name, values in self.results.columns(names)
        }

    def describe(self, points: np.ndarray) -> list[dict[str, Any]]:
        """Row, parameters, objective and metrics of some points (k,)."""
        metrics, parameters = columns_of(self.results, "metric"), list(self.search.names)
        columns = self.means([*parameters, *metrics], points)
        cost = self.scores.cost[points].tolist()
        return [
            {
                "parameters": {name: float(columns[name][i]) for name in parameters},
                "objective": cost[i] if self.search.aim.pareto else cost[i][0],
                "metrics": {name: float(columns[name][i]) for name in metrics},
                "row": point * self.search.repeats,
            }
            for i, point in enumerate(points.tolist())
        ]

    @property
    def simulated_seconds(self) -> float:
        """Simulated time of all runs [s]."""
        timing = [name for name in self.search.setup.timing if name in self.results.schema.names]
        seconds = self.search.seconds(dict(self.results.columns(timing)), self.results.rows)
        return float(np.sum(seconds))

    def front(self) -> np.ndarray:
        """Allowed points that no other point dominates, in the order of the first objective (k,)."""
        allowed = np.flatnonzero(self.scores.is_allowed)
        places = allowed[find_nondominated(self.scores.cost[allowed])]
        return places[np.argsort(self.scores.cost[places, 0], kind="stable")]

    def best(self) -> int | None:
        """The best allowed point; for a front, the point nearest to the best values of all objectives."""
        allowed = np.flatnonzero(self.scores.is_allowed)
        if not len(allowed):
            return None
        if self.search.aim.measures:  # only points in a cell
            allowed = find_elites(self.search.aim, self.scores)[1]
        elif self.search.aim.pareto:
            allowed = self.front()
        if not len(allowed):
            return None
        cost = self.scores.cost[allowed]
        span = np.ptp(cost, axis=0)
        apart = (cost - cost.min(axis=0)) / np.where(span > 0, span, 1.0)
        return int(allowed[np.argmin((apart**2).sum(axis=1))])


def find_nondominated(cost: np.ndarray) -> np.ndarray:
    """Indices (k,) of the points (n, m) that no other point dominates, with equal or lower costs and one lower cost."""
    if not len(cost):
        return np.empty(0, int)
    import moocore

    return np.flatnonzero(moocore.is_nondominated(cost))


def hypervolumes(evaluations: Evaluations) -> tuple[np.ndarray, np.ndarray]:
    """The share of a box that the front dominates after each batch (batches,), and the box's worst corner (m,).

    The box extends from the best value of each objective in the whole table to its worst value in the first batch.
    """
    import moocore

    cost, allowed = evaluations.scores.cost, evaluations.scores.is_allowed
    allowed_points = np.flatnonzero(allowed)
    first = allowed_points[
        evaluations.batch[allowed_points] == evaluations.batch[allowed_points[0]]
    ]
    worst, best = cost[first].max(axis=0), cost[allowed_points].min(axis=0)
    box = np.prod(np.where(worst > best, worst - best, 1.0))
    shares, front = [], np.empty((0, cost.shape[1]))
    for batch in range(evaluations.batch.max() + 1):
        front = np.concatenate([front, cost[(evaluations.batch == batch) & allowed]])
        front = front[find_nondominated(front)]
        inside = front[(front < worst).all(axis=1)]
        shares.append(float(moocore.hypervolume(inside, ref=worst) / box) if len(inside) else 0.0)
    return np.array(shares), worst


def atlas_progress(evaluations: Evaluations) -> tuple[np.ndarray, np.ndarray]:
    """The number of filled cells and the QD score after each batch (batches,).

    The QD score (Pugh et al. 2016) is a sum over the filled cells. Each cell adds the gain of its elite compared with the
    worst point of the first batch that has points in cells, but at least zero.
    """
    aim, scores = evaluations.search.aim, evaluations.scores
    cell = np.where(scores.is_allowed, find_cells(aim, scores.measures), -1)
    points_in_cells = np.flatnonzero(cell >= 0)
    floor = (
        float(
            scores.quality[
                points_in_cells[
                    evaluations.batch[points_in_cells] == evaluations.batch[points_in_cells[0]]
                ]
            ].min()
        )
        if len(points_in_cells)
        else 0.0
    )
    best: dict[int, float] = {}
    filled, total = [], []
    for batch in range(int(evaluations.batch.max()) + 1):
        for point in np.flatnonzero((evaluations.batch == batch) & (cell >= 0)).tolist():
            gain = max(float(scores.quality[point]) - floor, 0.0)
            best[int(cell[point])] = max(best.get(int(cell[point]), 0.0), gain)
        filled.append(len(best))
        total.append(sum(best.values()))
    return np.array(filled), np.array(total)


def atlas_table(evaluations: Evaluations) -> pa.Table:
    """A table with one row per filled cell, in order: row of the search's table, cell, parameters, mean metrics.

    The metadata `atlas` of the schema is JSON: `objective` with metric and direction, `measures` with metric, range and
    cells.
    """
    aim, schema = evaluations.search.aim, evaluations.results.schema
    cells, points = find_elites(aim, evaluations.scores)
    table = Columns()
    table.add(
        "row",
        points * evaluations.search.repeats,
        "index",
        "1",
        "first run of the elite, a row of results",
    )
    table.add("cell", cells, "index", "1", "cell of the atlas; the last measure runs fastest")
    for name, values in evaluations.means(
        [*evaluations.search.names, *columns_of(evaluations.results, "metric")], points
    ).items():
        metadata: dict[str, Any] = meta(schema.field(name))
        table.add(name, values, **metadata)
    term = aim.objective.terms[0]
    plain = len(aim.objective.terms) == 1 and term.aim != "hold"
    if not plain:
        metadata = {"unit": "1", "description": "the sum that is minimized"}
        table.add("objective", evaluations.scores.cost[points, 0], "metric", **metadata)
    metric, direction = (term.metric, term.aim) if plain else ("objective", "minimize")
    measures = [dataclasses.asdict(measure) for measure in aim.measures]
    atlas = {"objective": {"metric": metric, "direction": direction}, "measures": measures}
    return table.table({"atlas": json.dumps(atlas), "search": evaluations.search.digest()})
