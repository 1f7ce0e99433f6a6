"""When a tuning ends: its iterations are done, or the last of them gained almost nothing."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.tune.history import Log
from nermo_mjx.tune.spec import Tuning

#: Fraction of the total gain that counts as nothing.
NOTHING: Final = 0.01


def is_done(tuning: Tuning, log: Log | None) -> bool:
    """Whether there is nothing left to do."""
    return log is not None and (len(log) > tuning.iterations or stalled(tuning, log))


def why_done(tuning: Tuning, log: Log) -> str | None:
    """Why the tuning ended before its iterations were done, as a sentence; None if it did not."""
    if len(log) > tuning.iterations or not stalled(tuning, log):
        return None
    return (f"It stopped after {len(log) - 1} of {tuning.iterations} iterations: the last {tuning.patience} gained "
            f"less than {NOTHING:.0%} of the total gain; a longer patience continues.")  # fmt: skip


def stalled(tuning: Tuning, log: Log) -> bool:
    """Whether the last `patience` iterations gained almost nothing, at each start.

    What counts is the lowest objective so far: of each start, or of all points together where they are a generation.
    The total gain is from the first iteration with a completed walk to the best of all.
    """
    if len(log) <= tuning.patience:
        return False
    value = log.values(tuning)
    value = np.where(np.isfinite(value), value, np.inf)
    value = value if tuning.method.has_gradient else value.min(axis=1, keepdims=True)
    lowest = np.minimum.accumulate(value)
    walked = np.asarray(np.isfinite(lowest).any(axis=1))
    if not walked[-1 - tuning.patience]:
        return False
    gained = lowest[int(walked.argmax())].min() - lowest[-1].min()
    before, now = lowest[-1 - tuning.patience], lowest[-1]
    lately = np.where(np.isfinite(now), before - np.where(np.isfinite(now), now, 0.0), 0.0)
    return bool((lately <= NOTHING * gained).all())
