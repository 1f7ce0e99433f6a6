"""Results that depend neither on the backend's precision of matrix products nor on what shares a batch."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final, ParamSpec, TypeVar

import jax
import numpy as np

from nermo_mjx.runtime import compiler_options

P = ParamSpec("P")
T = TypeVar("T")


def full_precision(function: Callable[P, T]) -> Callable[P, T]:
    """The function, with all matrix products traced in it in the precision of their arguments.

    JAX's default on NVIDIA GPUs from Ampere on is TF32, which keeps 10 bits of float32's 23: residuals of the
    constraint solver would be wrong by 2.5e-3 instead of 6e-7. A product keeps its precision under `vmap` and in
    derivatives, except in the rules of `own_derivative`, which JAX may trace later: those are wrapped themselves.
    """

    @functools.wraps(function)
    def precise(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return precise


# ---
# A function of one world, for batches of any size, with results that do not depend on the batch.
#
# XLA's rounding depends on an array's shape, not on the position in it, so work is divided into chunks of one shape.


#: Worlds per chunk; the last one is padded.
LANES: Final = 256


class Lanes:
    """Applies a jittable function of one world to batches: leaves (n, ...) in, NumPy leaves (n, ...) out."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """
        Args:
            function: of one world.
        """
        self._program = jax.jit(full_precision(jax.vmap(function)), compiler_options=compiler_options(level=0))

    def __call__(self, *arguments: Any) -> Any:
        """The results of all worlds; n is at least 1."""
        arguments = jax.tree.map(np.asarray, arguments)
        worlds = len(jax.tree.leaves(arguments)[0])
        pieces = []
        for start in range(0, worlds, LANES):
            ids = np.minimum(np.arange(start, start + LANES), worlds - 1)
            pieces.append(self._program(*jax.tree.map(lambda leaf, ids=ids: leaf[ids], arguments)))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:worlds], *pieces)
