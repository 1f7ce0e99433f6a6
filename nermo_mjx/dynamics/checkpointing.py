"""A scan whose reverse mode stores little, and computes little twice."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import jax

#: Name of what the backward run keeps of every step instead of computing it again: where the constraint solver came to,
#: which is as small as the state and took a third of a step's time.
KEPT: Final = "solution"

#: Results of one step over its carry, in bytes; decides the length of a segment. The order of magnitude of a tick of
#: the robot (a megabyte over some kilobytes).
_RESULTS_OVER_CARRY: Final = 256

#: What only moves numbers about: the backward run does it again rather than keep its results. Gathers made half of all
#: that was kept of a step of the robot.
_MOVES: Final = frozenset(
    {"broadcast_in_dim", "concatenate", "convert_element_type", "dynamic_slice", "gather", "iota", "neg", "pad",
     "reshape", "rev", "select_n", "slice", "split", "squeeze", "transpose"}
)  # fmt: skip


def keeping_little(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function; its reverse mode keeps what was computed on the way, and not what was only moved about."""
    return jax.checkpoint(function, policy=lambda primitive, *_, **__: primitive.name not in _MOVES, prevent_cse=False)


def checkpointed_scan(body: Callable[[Any], tuple[Any, Any]], carry: Any, length: int) -> tuple[Any, Any]:
    """Apply `body` at least `length` times; in reverse mode memory grows with the square root of `length`.

    The forward run keeps the carry before each segment of steps; the backward run repeats one segment at a time and
    keeps its intermediate results meanwhile (checkpointing; Griewank and Walther, Evaluating Derivatives, 2008, chapter
    12). With r the ratio of a step's results to its carry, both parts are alike with sqrt(length / r) steps a segment,
    which is one step up to hundreds of them. Whatever `body` marks with `jax.ad_checkpoint.checkpoint_name(x, KEPT)` is
    kept as well. It then meets states that are computed anew, and equal only up to rounding: a result of the solver in
    float32, 5e-3 off as MJX's was, made the gradient of a walk wrong by its own size, until a Newton step followed it.

    Args:
        body: carry -> (new carry, output).
        carry: the first.
        length: number of steps that are wanted, 1 or more. A few more are made where the segments do not divide it.

    Returns:
        The last carry, and the outputs of the first `length` steps, stacked.
    """
    steps = max(1, round(math.sqrt(length / _RESULTS_OVER_CARRY)))
    policy = jax.checkpoint_policies.save_only_these_names(KEPT)

    def segment(carry: Any, _: None) -> tuple[Any, Any]:
        return jax.lax.scan(lambda carry, _: body(carry), carry, None, length=steps)

    segment = jax.checkpoint(segment, prevent_cse=False, policy=policy)
    carry, outputs = jax.lax.scan(segment, carry, None, length=-(-length // steps))
    return carry, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:length], outputs)
