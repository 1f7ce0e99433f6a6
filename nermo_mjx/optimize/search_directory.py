"""A search's directory: one part of its table for each batch, written before the next batch is requested.

DIR/search.yaml                   the resolved search, and the size of its batches
DIR/controller.py                 a copy of the file of another controller, if the search names one
DIR/run.json                      which codes made the rows; each session's versions, machine and command
DIR/results/                      the rows, a part for each batch, see `nermo_mjx.runs.rows`
DIR/results.aside/                parts that were damaged, or hold other points, when they are run again
DIR/best.json, DIR/best.yaml, DIR/atlas.parquet, DIR/recordings/, DIR/plots/   made from the table
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.optimize.methods import made_by
from nermo_mjx.optimize.search import CmaMega, Scores, Search, cells_of, elites_of, scores_of
from nermo_mjx.optimize.tuning import sweep_of
from nermo_mjx.rollout.differentiable import cost as gradient_cost
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import engine_of, remove_leftovers
from nermo_mjx.runs.files import (
    DirectoryError,
    WrongDirectory,
    clear_errors,
    create_file,
    parquet_bytes,
    stored_json,
)
from nermo_mjx.runs.rows import RESULTS, Runs, opened, part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.runs.text import to_json
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.reading import SpecError, changes
from nermo_mjx.sweep.replay import SweepRow, recording_file
from nermo_mjx.sweep.sampling import Rows
from nermo_mjx.sweep.simulating import Simulated, SweepSimulator
from nermo_mjx.sweep.store import keys_of_rows
from nermo_mjx.sweep.table import RECORDINGS, Columns, Results, chunk_table, columns_of, meta, read_table

SEARCH: Final = "search.yaml"
#: How far points of a stored batch may be from those that are asked for, as a fraction of the bounds: another machine's
#: eigenvectors differ in their last digits.
APART: Final = 1e-6
#: Column of a gradient: `gradient.METRIC.PARAMETER`; of the objective, METRIC is `quality`.
GRADIENT: Final = "gradient.{}.{}"


class Batches:
    """The batches of one search in a directory that this process holds.

    Attributes:
        search: that they are of, with their size, and with the directory's copies of code.
        runs: what is stored.
    """

    def __init__(
        self, held: RunDirectory, search: Search, size: Callable[[], int], warn: Callable[[str], None]
    ) -> None:
        """Make the directory this search's, or refuse.

        Args:
            size: of a batch, if neither the search nor the directory has one.
            warn: called with a message about what is damaged, and is run again.

        Raises:
            DirectoryError: the directory holds another search, or cannot be written.
        """
        self.directory, self.out, self._warn = held, held.out, warn
        path, folder, begun = self.out / SEARCH, self.out.resolve(), None
        with clear_errors(self.out):
            for made in ("plots", RECORDINGS):
                remove_leftovers(self.out / made)
        if path.exists():
            try:
                begun = Search.from_file(path)
            except SpecError as error:
                unread = f"{self.out} holds a search that cannot be read ({error}); choose another directory."
                raise WrongDirectory(unread) from None
        sweep = dataclasses.replace(search.sweep, setup=with_code_copied(search.setup, folder, held.write))
        batch = search.batch or (begun and begun.batch) or size()
        self.search = search = dataclasses.replace(search, sweep=sweep, batch=batch)
        if begun is None:
            if part_files(self.out):
                raise WrongDirectory(
                    f"{self.out} holds results of an unknown search (it has no {SEARCH}); choose another directory."
                )
            with clear_errors(self.out):
                create_file(path, search.to_yaml(folder).encode())
        elif begun.digest() != search.digest():
            apart = changes(begun.decisive(), search.decisive()) or ["parameters under vary stand in another order"]
            raise WrongDirectory(
                f"{self.out} holds another search, with another {', '.join(apart[:3])}; choose another directory, or "
                f"resume with {path}."
            )
        elif begun.to_yaml(folder) != search.to_yaml(folder):  # another budget, or more recordings
            held.write(SEARCH, search.to_yaml(folder).encode())
        self.runs = Runs(self.out, search.digest(), warn=warn, held=held)
        self._parts = {int(pq.read_metadata(part.path).metadata[b"chunk"]): part for part in self.runs.parts}

    def read(self, batch: int, rows: Rows) -> pa.Table | None:
        """The table of a batch, if it is there with these rows (see `APART`); with others it is moved aside.

        Raises:
            DirectoryError: another version of the library asked for its points, or it cannot be read any more.
        """
        if (part := self._parts.get(batch)) is None:
            return None
        with opened(part.path) as file:
            table = file.read()
        near = table.column("variant").to_pylist() == rows.variant.tolist()
        for axis in self.search.sweep.axes if near else ():
            room = APART * (axis.numbers[1] - axis.numbers[0])
            stored = table.column(axis.name).to_numpy()
            near = near and np.allclose(stored, rows.values[axis.name], rtol=0.0, atol=room)
        if near:
            return table
        before, now = table.schema.metadata.get(b"optimizer", b"").decode(), made_by(self.search.method)
        if before != now:
            raise DirectoryError(
                f"{part.path} holds points that {before} asked for, and {now} asks for others: install {before}, or "
                "choose another directory."
            )
        self.directory.move_aside(part.path.relative_to(self.out), f"{RESULTS}.aside")
        self._warn(
            f"batch {batch} of {self.out} holds other points than those that follow from the batches before it; it is "
            f"kept in {RESULTS}.aside, and run again."
        )
        return None

    def write(
        self, batch: int, rows: Rows, first: int, found: Simulated, stamp: CodeStamp, gradients: np.ndarray | None
    ) -> pa.Table:
        """Store a batch.

        Args:
            rows: its runs, of which `first` is the first one's place in the table.
            found: at least one result a run.
            stamp: of the code that simulated.
            gradients: (g, 1 + m, p) of its first g points, or None.
        """
        count = len(rows)
        about = {
            "engine": stamp.engine,
            "code": stamp.id,
            "chunk": batch,
            "steps": found.steps,
            "wall_seconds": found.seconds,
            "search": self.search.digest(),
            "optimizer": made_by(self.search.method),
        }
        metrics = {name: values[:count] for name, values in found.metrics.items()}
        index = first + np.arange(count)
        table = chunk_table(self.search.sweep, rows, index, metrics, found.status[:count], stamp.id, about)
        about_batch = {"unit": "1", "description": "batch that the run was part of", "role": "index"}
        table = table.add_column(1, pa.field("batch", pa.int64(), metadata=about_batch), pa.array([batch] * count))
        if isinstance(self.search.method, CmaMega):  # NaN where none was asked for
            filled = np.full((count, len(self._differentiated), len(self.search.names)), np.nan)
            if gradients is not None:
                filled[: len(gradients) * self.search.repeats] = np.repeat(gradients, self.search.repeats, axis=0)
            for i, metric in enumerate(self._differentiated):
                for j, name in enumerate(self.search.names):
                    meaning = {"unit": "1", "role": "gradient"}
                    meaning["description"] = f"d {metric} / d share of the bounds of {name}"
                    field = pa.field(GRADIENT.format(metric, name), pa.float64(), metadata=meaning)
                    table = table.append_column(field, pa.array(np.ascontiguousarray(filled[:, i, j])))
        self._parts[batch] = self.runs.add(keys_of_rows(self.search.sweep, rows), table)
        return table

    def gradients(self, table: pa.Table, points: int) -> np.ndarray:
        """The gradients of a batch's first points, from its table: (points, 1 + m, p)."""
        columns = [[GRADIENT.format(metric, name) for name in self.search.names] for metric in self._differentiated]
        rows = slice(0, points * self.search.repeats, self.search.repeats)
        return np.stack([np.stack([table.column(name).to_numpy()[rows] for name in line], -1) for line in columns], 1)

    @property
    def _differentiated(self) -> tuple[str, ...]:
        return ("quality", *(each.metric for each in self.search.aim.measures))


# ---
# Results of a search, from its table alone: best.json for programs, best.yaml, a sweep file, and an atlas's elites.


BEST: Final = "best.json"
ATLAS: Final = "atlas.parquet"


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
    def of(cls, search: Search, results: Results | Path) -> Evaluations:
        """Of a table, or a directory's, as far as it goes."""
        if isinstance(results, Path):
            results = Results(part_files(results))
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
        """Of all runs, with gradients added at their cost in forward runs [s]."""
        schema, names = self.results.schema.names, self.search.names
        timing = [name for name in self.search.setup.timing if name in schema]
        seconds = self.search.seconds(dict(self.results.columns(timing)), self.results.rows)
        slope, times = GRADIENT.format("quality", names[0]), np.ones(self.results.rows)
        if slope in schema:
            times += np.isfinite(self.results.column(slope)) * gradient_cost(len(names), "forward")
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
    found = Evaluations.of(batches.search, batches.out)
    place = found.best()
    if place is None:
        return {}
    best: dict[str, Any] = found.described(np.array([place]))[0]
    best |= {"evaluations": len(found.scores), "failed": int((~found.scores.ok).sum())}
    best |= {"simulated_seconds": found.simulated_seconds, "complete": complete}
    if batches.search.aim.pareto:
        best |= {"front": found.described(found.front()), "hypervolume": float(hypervolumes(found)[0][-1])}
    if batches.search.aim.measures:
        filled, total = atlas_progress(found)
        cells = int(np.prod([each.cells for each in batches.search.aim.measures]))
        best |= {"cells": cells, "filled": int(filled[-1]), "qd_score": float(total[-1])}
        batches.directory.write(ATLAS, parquet_bytes(atlas_table(found)))
    batches.directory.write(BEST, to_json(best))
    head = f"Row {best['row']} of a search: objective {best['objective']}."
    sweep = batches.search.sweep
    best_sweep = sweep_of(sweep, head, best["parameters"], sweep.seed, batches.out.resolve())
    batches.directory.write("best.yaml", best_sweep.encode())
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
    metric, direction = (term.metric, term.aim) if plain else ("objective", "minimize")
    measures = [dataclasses.asdict(each) for each in aim.measures]
    atlas = {"objective": {"metric": metric, "direction": direction}, "measures": measures}
    return table.table({"atlas": json.dumps(atlas), "search": found.search.digest()})


# ---
# Rerunning a search's results: the recordings that it keeps, and a row of its table for `replay`.


#: Worlds recorded at once: a walk of ten seconds is 1.5 MB.
_AT_ONCE: Final = 32


def kept_rows(found: Evaluations, best: int) -> list[int]:
    """First rows of the points to record: the best ones, or evenly along the front or over the cells of an atlas.

    Args:
        best: the best point, which is always among them.
    """
    search, count = found.search, found.search.keep
    if not count:
        return []
    if search.aim.kind == "objective":
        order = np.argsort(np.where(found.scores.allowed, found.scores.cost[:, 0], np.inf), kind="stable")
        points = order[: min(count, int(found.scores.allowed.sum()))]
    else:
        points = elites_of(search.aim, found.scores)[1] if search.aim.measures else found.front()
        points = points[np.unique(np.linspace(0, len(points) - 1, count).round().astype(int))]
        if best not in points:
            points[np.abs(found.scores.cost[points, 0] - found.scores.cost[best, 0]).argmin()] = best
    return (np.sort(points) * search.repeats).tolist()


def keep_recordings(batches: Batches, best: dict[str, Any], computer: SweepSimulator) -> list[Path]:
    """Record what `keep` asks for, as DIR/recordings/row-000123.npz; what is there already stays.

    Raises:
        RecordingError, DirectoryError: one cannot be written.
    """
    search, found = batches.search, Evaluations.of(batches.search, batches.out)
    rows = kept_rows(found, best["row"] // search.repeats)
    files = {row: recording_file(batches.out, row) for row in rows}
    missing = [row for row, path in files.items() if not path.exists()]
    if missing:
        with clear_errors(batches.out):
            (batches.out / RECORDINGS).mkdir(exist_ok=True)
    drawn = columns_of(found.results, "varied", "randomized")
    for first in range(0, len(missing), _AT_ONCE):
        part = missing[first : first + _AT_ONCE]
        values = {name: np.full(len(part), value) for name, value in search.sweep.constants.items()}
        values |= {name: column[part] for name, column in found.results.columns(drawn)}
        result = computer.simulator().run(values, search.run, record=True)
        for world, (row, end) in enumerate(zip(part, search.seconds(values, len(part)).tolist(), strict=True)):
            result.recording(world).between(0.0, end).save(files[row])
    return list(files.values())


def find_evaluation(out: str | os.PathLike[str], row: int) -> SweepRow:
    """A row of a search's table, for `replay_row`; nothing is written, so the search may be at work there.

    Raises:
        SpecError: no search is there that can be read, or no such row.
        DirectoryError: it has no results yet.
    """
    out = Path(out)
    search = Search.from_file(out / SEARCH)
    table = read_table(out)
    if not 0 <= row < table.num_rows:
        raise SpecError(f"row is {row}: allowed is 0 to {table.num_rows - 1}, as far as the search has come.")
    stored = table.slice(row, 1).to_pylist()[0]
    values = {name: np.array([stored[name]]) for name in columns_of(table, "varied", "randomized")}
    index = {name: np.array([stored[name]]) for name in ("variant", "repeat", "seed")}
    line = Rows(**index, values=values, structure=np.zeros(1, int))
    engine = pq.read_schema(part_files(out)[0]).metadata[b"engine"].decode()
    return SweepRow(out, search.sweep, row, line, engine, stored)


# ---
# How far a search's directory is.


def status(out: Path) -> Status:
    """How many points of its search a directory holds."""
    notes, search, runs = list[str](), None, 0
    try:
        search = Search.from_file(out / SEARCH)
    except (SpecError, OSError) as error:
        notes.append(f"Its search cannot be read: {error}")
    for path in part_files(out):
        if about := metadata_of(path, notes, "it will be run again."):
            runs += about.num_rows
    done, budget = runs // (1 if search is None else search.repeats), None if search is None else search.evaluations
    reached = False
    try:
        best = stored_json(out / BEST) or {}
        spent = 0.0 if search is None else search.reached(best["evaluations"], best["simulated_seconds"])
        reached = bool(best["complete"]) and spent >= 1.0 and best["evaluations"] == done
    except (TypeError, KeyError):
        pass
    return status_of(
        "evaluations", out, done, budget, reached, command="search", spec=SEARCH, engine=engine_of(out), notes=notes
    )
