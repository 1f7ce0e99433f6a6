"""When a foot of a recording is in stance, the same for all figures."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float

#: A foot is in stance above this load [N]; the robot weighs 2.65 N. The metrics' smooth threshold is centred on it.
STANDING: Final = 0.02


def spans(flags: Bool[np.ndarray, " T"], time: Float[np.ndarray, " T"]) -> list[tuple[float, float]]:
    """(begin, length) of each stretch of samples that are true; a sample stands for the time since the one before.

    Args:
        flags: (T,) bool.
        time: (T,) [s].
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    begins = np.concatenate([time - step, [time[-1]]])
    return [(float(begins[a]), float(begins[b] - begins[a])) for a, b in edges.reshape(-1, 2)]
