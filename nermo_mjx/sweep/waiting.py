"""The end of a sweep that several processes share: what of it is missing, and waiting for those who run it."""

from __future__ import annotations

import time

import numpy as np

from nermo_mjx.sweep.chunks import SweepError, Work
from nermo_mjx.sweep.layout import listed
from nermo_mjx.sweep.presence import Presence

#: Seconds between two looks at the directory.
LOOK = 1.0


def missing(work: Work) -> str:
    """Which chunks are not there, and how to run them, in a sentence; empty if none is missing."""
    chunks = np.flatnonzero(~work.done)
    if not len(chunks):
        return ""
    named = f"chunk{'s' if len(chunks) > 1 else ''} {listed(chunks)}"
    shares = " and ".join(f"--shard {part}/{_parts(work)}" for part in _owners(work))
    return (f"{named} ({work.rows_of(chunks):,} runs) of {len(work.layout):,} are missing; unless they are being run, "
            f"run them with {shares}.")  # fmt: skip


def wait_for_others(work: Work, presence: Presence) -> None:
    """Return when all chunks are there.

    Raises:
        SweepError: those who run the missing ones are lost.
    """
    while True:
        work.look()
        work.tally.finish(np.flatnonzero(work.done).tolist())
        work.tally.tell()
        silent = [presence.lost(part) for part in _owners(work)]
        if all(silent):
            break
        time.sleep(LOOK)
    if silent:
        raise lost(work)


def lost(work: Work) -> SweepError:
    """The error of a process that is left alone."""
    others, chunks = _owners(work), np.flatnonzero(~work.done)
    named = f"process{'es' if len(others) > 1 else ''} {listed(np.array(others))} of {_parts(work)}"
    return SweepError(
        f"{named} did not come back: chunk{'s' if len(chunks) > 1 else ''} {listed(chunks)} ({work.rows_of(chunks):,} "
        f"runs) of {len(work.layout):,} are missing. What is finished is kept in {work.store.out}: run the same "
        "command again, on any number of hosts."
    )


def _parts(work: Work) -> int:
    return (work.store.part or (0, 1))[1]


def _owners(work: Work) -> list[int]:
    """The other processes whose chunks are missing."""
    own = (work.store.part or (0, 1))[0]
    return sorted(set((np.flatnonzero(~work.done) % _parts(work)).tolist()) - {own})
