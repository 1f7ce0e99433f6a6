"""Named presets of the physics, which set its computational cost.

The figures behind each preset, and the variants that were rejected, are in docs/benchmarks/physics.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final


@dataclasses.dataclass(frozen=True)
class PhysicsPreset:
    """The settings of a preset.

    Attributes:
        timestep: of the physics [s], unless one is given.
        trunk_contacts: whether chest, pelvis and head touch the ground. Without them a fall is reported equally soon,
            but the robot then sinks into the mat. While it walks they touch nothing, but MJX solves for the rows of all
            contacts in every step, and a third of the rows are theirs.
    """

    timestep: float
    trunk_contacts: bool


class PresetTimestep(float):
    """A time step [s] that was not given: it is that of the preset and changes with the preset."""


#: `reference` is the model as it was identified. `fast` keeps speeds at the published frequencies within 1.5 % of it,
#: roll and duty within 2.3 %; slip and servo work change more.
PRESETS: Final[Mapping[str, PhysicsPreset]] = {
    "reference": PhysicsPreset(timestep=0.002, trunk_contacts=True),
    "fast": PhysicsPreset(timestep=0.01 / 3, trunk_contacts=False),
}
