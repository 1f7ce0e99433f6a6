"""Rows of a complete sweep that are kept as recordings: each is replayed and recorded once."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Setup, Simulator
from nermo_mjx.runs.text import plain
from nermo_mjx.sweep.beside import Keep
from nermo_mjx.sweep.replay import engine_for, find_row, replay_row, report_of
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sides import cost, sides_in
from nermo_mjx.sweep.store import RECORDINGS, Store

#: Kinds of rows that are kept by their outcome.
_STATUSES: Final = ("fell", "diverged", "unsolved")


def recording_file(out: Path, row: int) -> Path:
    """Where a row of a directory is recorded, if it is kept."""
    return out / RECORDINGS / f"row-{row:06d}.npz"


def kept_rows(results: Results, keep: Keep) -> dict[int, str]:
    """The rows of a complete table that are kept, and why.

    The best come first, each of a different variant; then those with another outcome, the first ones in the table.
    """
    kept: dict[int, str] = {}
    if keep.best:
        price = cost(sides_in(results.schema)[keep.metric], results.column(keep.metric))
        price = np.where(results.well & np.isfinite(price), price, np.inf)
        order = np.argsort(price, kind="stable")
        order = order[np.isfinite(price[order])]
        _, first = np.unique(results.column("variant")[order], return_index=True)
        best = order[np.sort(first)[: keep.best]]
        kept |= {int(row): f"number {i} by {keep.metric}" for i, row in enumerate(best, 1)}
    status = results.column("status")
    for word in _STATUSES:
        for row in np.flatnonzero(status == word)[: getattr(keep, word)]:
            kept.setdefault(int(row), word)
    return kept


def record_rows(
    store: Store,
    results: Results,
    keep: Keep,
    used: Any = None,
    check: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] | None = None,
) -> list[Path]:
    """Record the rows to keep that are not recorded yet; returns the files of all of them, in the order of the rows.

    Args:
        store: of the complete table.
        results: the table.
        keep: which rows.
        used: what simulated the table in this process, if anything; a `Simulator` has its programs compiled.
        check: called often; may raise an interruption. What is recorded until then stays.
        warn: called with a message if a replay does not give the table's numbers, or nothing can be recorded.

    Raises:
        DirectoryError: a file cannot be written.
    """
    say, files = warn or (lambda _: None), []

    @functools.lru_cache
    def simulator(setup: Setup, engine: str) -> Simulator:
        if (getattr(used, "setup", None), getattr(getattr(used, "engine", None), "name", "")) == (setup, engine):
            return used
        try:
            return Simulator(setup, engine)
        except ParameterError:
            say(f"the engine {engine} cannot run here: rows that are kept are replayed on the engine c.")
            return Simulator(setup, "c")

    for row, why in sorted(kept_rows(results, keep).items()):
        path = recording_file(store.out, row)
        if _is_recorded(store, row):
            files.append(path)
            continue
        check()
        found = find_row(store.out, row)
        walker = simulator(found.walk.setup, engine_for(found))
        replay = replay_row(found, progress=lambda _: check(), simulator=walker)
        if not len(replay.history.time):
            say(f"row {row} diverged in its first tick: there is nothing to record.")
            continue
        report = report_of(found, replay)
        if replay.comparison is not None and not replay.comparison.equal:
            say(f"row {row} as it is recorded: {report['compared']}")
        about = {**report, "kept": why, "sweep": store.sweep.digest()}
        content = dataclasses.replace(replay.recording(), metadata=plain(about)).content()
        store.directory.move_aside(path.relative_to(store.out))
        store.directory.write(path.relative_to(store.out), content)
        files.append(path)
    return files


def _is_recorded(store: Store, row: int) -> bool:
    """Whether there is an undamaged recording of this row of this sweep."""
    try:
        about = Recording.load(recording_file(store.out, row)).metadata
    except RecordingError:
        return False
    return (about.get("row"), about.get("sweep")) == (row, store.sweep.digest())
