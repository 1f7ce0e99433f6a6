"""Gravity in the frame of the ground: its magnitude, and the steepness and direction of the slope."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def gravity_vector(gravity: Any, slope: Any, direction: Any, xp: Any = np) -> Any:
    """Acceleration of free fall in the frame of the ground, (3,) [m/s^2]: g (-u sin s, -cos s).

    Args:
        gravity: its magnitude g [m/s^2].
        slope: angle s at which the ground rises [rad].
        direction: of the rise, u = (sin d, -cos d): 0 is -y, the heading of a robot with yaw 0, and pi/2 is x, its
        left.
        xp: `numpy`, or `jax.numpy`.
    """
    along = -gravity * xp.sin(slope)
    return xp.stack([along * xp.sin(direction), -along * xp.cos(direction), -gravity * xp.cos(slope)])


def gravity_values(vector: np.ndarray) -> dict[str, float]:
    """The parameters `ground.*` of a gravity (3,) that points down."""
    x, y, z = map(float, vector)
    direction = math.atan2(-x, y) if x or y else 0.0
    return {
        "ground.gravity": math.hypot(x, y, z), "ground.slope": math.atan2(math.hypot(x, y), -z),
        "ground.direction": direction,
    }  # fmt: skip
