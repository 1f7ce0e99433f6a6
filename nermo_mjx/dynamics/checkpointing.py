"""A scan whose reverse mode stores little and recomputes little."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import jax

#: Name of the values that the backward pass stores for every step instead of recomputing them: the constraint solver's
#: result, which is as small as the state and takes a third of a step's time.
STORED_NAME: Final = "solution"

#: Ratio of the size of a step's results to its carry, in bytes; determines the length of a segment. The order of
#: magnitude of a tick of the robot (a megabyte over some kilobytes).
_RESULTS_OVER_CARRY: Final = 256

#: Operations that only move data: the backward pass repeats them instead of storing their results. Gathers made up half
#: of what was stored for a step of the robot.
_MOVE_OPERATIONS: Final = frozenset(
    {
        "broadcast_in_dim",
        "concatenate",
        "convert_element_type",
        "dynamic_slice",
        "gather",
        "iota",
        "neg",
        "pad",
        "reshape",
        "rev",
        "select_n",
        "slice",
        "split",
        "squeeze",
        "transpose",
    }
)


def keeping_little(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function; its reverse mode stores computed intermediate results, but not those that were only moved."""
    return jax.checkpoint(
        function,
        policy=lambda primitive, *_, **__: primitive.name not in _MOVE_OPERATIONS,
        prevent_cse=False,
    )


def checkpointed_scan(
    body: Callable[[Any], tuple[Any, Any]], carry: Any, length: int
) -> tuple[Any, Any]:
    """Apply `body` at least `length` times; in reverse mode, memory grows with the square root of `length`.

    The forward pass stores the carry before each segment of steps; the backward pass recomputes one segment at a time
    and holds its intermediate results meanwhile (checkpointing; Griewank and Walther, Evaluating Derivatives, 2008,
    chapter 12). With r the ratio of a step's results to its carry, both parts are equal at sqrt(length / r) steps per
    segment, which ranges from one step to hundreds. Values that `body` marks with `jax.ad_checkpoint.checkpoint_name(x,
    STORED_NAME)` are stored as well. They are then combined with recomputed states, which are equal only up to rounding: a
    solver result in float32, with MJX's error of 5e-3, made the gradient of a walk wrong by 100 %, until a Newton step
    was added.

    Args:
        body: carry -> (new carry, output).
        carry: the first.
        length: number of steps, at least 1. A few more are made if it is not a multiple of the segment's length.

    Returns:
        The last carry, and the outputs of the first `length` steps, stacked.
    """
    steps = max(1, round(math.sqrt(length / _RESULTS_OVER_CARRY)))
    policy = jax.checkpoint_policies.save_only_these_names(STORED_NAME)

    def segment(carry: Any, _: None) -> tuple[Any, Any]:
        return jax.lax.scan(lambda carry, _: body(carry), carry, None, length=steps)

    segment = jax.checkpoint(segment, prevent_cse=False, policy=policy)
    carry, outputs = jax.lax.scan(segment, carry, None, length=-(-length // steps))
    return carry, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:length], outputs)
