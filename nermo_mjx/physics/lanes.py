"""A function of one world, for batches of any size, with results that do not depend on the batch.

XLA's rounding depends on an array's shape, not on the position in it, so work is divided into chunks of one shape.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import jax
import numpy as np

from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.runtime import compiler_options

#: Worlds per chunk; the last one is padded.
CHUNK_WORLDS: Final = 256


class Lanes:
    """Applies a jittable function of one world to batches: leaves (n, ...) in, NumPy leaves (n, ...) out."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """
        Args:
            function: Jittable function of one world.
        """
        self._program = jax.jit(
            full_precision(jax.vmap(function)), compiler_options=compiler_options(level=0)
        )

    def __call__(self, *arguments: Any) -> Any:
        """The results of all worlds; n is at least 1."""
        arguments = jax.tree.map(np.asarray, arguments)
        worlds = len(jax.tree.leaves(arguments)[0])
        pieces = []
        for start in range(0, worlds, CHUNK_WORLDS):
            ids = np.minimum(np.arange(start, start + CHUNK_WORLDS), worlds - 1)
            pieces.append(self._program(*jax.tree.map(lambda leaf, ids=ids: leaf[ids], arguments)))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:worlds], *pieces)
