"""The controller's two-mass model of the robot: front and rear, joined by a massless spine (5.34)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MassModel:
    """Masses and centres of mass, computed from the assembled robot (`Robot.mass_model`), so that there is no second
    list of them.

    Attributes:
        front_mass, rear_mass: of everything in front of and behind the spine [kg].
        front_com: shape (3,), from the spine base, in the torso's frame [m].
        rear_com: shape (3,), from the spine end, in the hip's frame [m].
    """

    front_mass: Any
    rear_mass: Any
    front_com: Any
    rear_com: Any
