"""Presets of the physics: what it costs to compute, chosen by name.

Each figure behind a preset, and what was tried and left out, is in docs/benchmarks/physics.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final


@dataclasses.dataclass(frozen=True)
class PhysicsPreset:
    """What a preset chooses.

    Attributes:
        timestep: of the physics [s], unless one is given.
        trunk_contacts: whether chest, pelvis and head touch the ground. Without them a robot that falls is reported
            as soon, and then sinks into the mat. While it walks they touch nothing, but MJX solves for the rows of
            all contacts in every step, and a third of the rows are theirs.
    """

    timestep: float
    trunk_contacts: bool


class PresetTimestep(float):
    """A time step that nobody gave [s]: it is its preset's, and another preset brings its own."""


#: `reference` is the model as it was identified. `fast` keeps speeds at the published frequencies within 1.5 % of it,
#: roll and duty within 2.3 %; slip and servo work change more.
PRESETS: Final[Mapping[str, PhysicsPreset]] = {
    "reference": PhysicsPreset(timestep=0.002, trunk_contacts=True),
    "fast": PhysicsPreset(timestep=0.01 / 3, trunk_contacts=False),
}
