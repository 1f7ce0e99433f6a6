"""Matrix products in full precision on every backend."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

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
