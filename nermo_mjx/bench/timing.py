"""Timing on shared, noisy machines: two programs in turns, compared round by round."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(ours: Callable[[], object], plain: Callable[[], object], rounds: int) -> tuple[float, float, float]:
    """(seconds of `ours`, seconds of `plain`, plain over ours), medians over rounds in which both ran, in turns."""
    pairs = []
    for i in range(rounds):
        if i % 2:
            plain_seconds, our_seconds = seconds(plain), seconds(ours)
        else:
            our_seconds, plain_seconds = seconds(ours), seconds(plain)
        pairs.append((our_seconds, plain_seconds))
    return (
        statistics.median(our for our, _ in pairs),
        statistics.median(plain for _, plain in pairs),
        statistics.median(plain / our for our, plain in pairs),
    )
