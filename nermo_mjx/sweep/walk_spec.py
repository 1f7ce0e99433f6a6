"""What a sweep's and a tuning's file have in common: which walk it is about, and what is fixed in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any, Final

from nermo_mjx.robot.quantity import Quantity
from nermo_mjx.rollout import Run, Setup, all_parameters
from nermo_mjx.sweep.axes import check_value
from nermo_mjx.sweep.reading import Document
from nermo_mjx.sweep.sections import PILOT_OPTIONS, SETUP_FIELDS

#: Parameters that nothing reads unless a choice of the setup turns them on.
_NEEDS: Final = {
    "spine.amplitude": ("spine", "stride_extension"),
    "spine.phase": ("spine", "stride_extension"),
    "spine.balance_lift": ("spine", "balance"),
    "pilot.turn_rate": ("pilot", "open_loop"),
    "pilot.radius": ("pilot", "arc"),
    "pilot.direction": ("pilot", "arc"),
}


@dataclasses.dataclass(frozen=True)
class WalkSpec:
    """A walk whose parameters are to be changed.

    Attributes:
        setup: the static choices: robot, scene, gait, spine mode, pilot.
        run: how long each run lasts, and how much of it is warm-up.
        fixed: parameters set to one value for all runs (`set`).
        pilot: options of the pilot, as given.
    """

    setup: Setup
    run: Run
    fixed: Mapping[str, float]
    pilot: Mapping[str, Any]

    @property
    def constants(self) -> dict[str, float]:
        """Every parameter with one value for all runs: `set` and the pilot's options."""
        options = PILOT_OPTIONS.get(self.setup.pilot, {})
        return dict(self.fixed) | {name: self.pilot[key] for key, name in options.items() if name and key in self.pilot}

    @property
    def parameters(self) -> dict[str, Quantity]:
        """Every parameter that this setup has, by name."""
        return all_parameters(self.setup)

    def walk_fields(self) -> dict[str, Any]:
        """Setup, pilot, run and fixed parameters, as they stand in a file."""
        data: dict[str, Any] = {field: getattr(self.setup, field) for field in SETUP_FIELDS}
        data["timestep"] = float(self.setup.timestep)
        data["pilot"] = {self.setup.pilot: dict(self.pilot)} if self.pilot else self.setup.pilot
        names = ("duration", "warmup") if self.run.duration is not None else ("cycles", "warmup_cycles")
        data["run"] = {name: float(getattr(self.run, name)) for name in names}
        data["set"] = dict(self.fixed)
        return data


def check_sources(
    doc: Document, walk: WalkSpec, sections: Mapping[str, list[str]], bodies: Collection[str] = ()
) -> None:
    """Fail where a parameter has two sources, or no effect.

    Args:
        sections: names of the parameters that each section of the file changes.
        bodies: names of the parameters that `randomize.from` draws together.
    """
    parameters, pilot = walk.parameters, walk.setup.pilot
    sources = dict.fromkeys(bodies, "drawn by 'randomize.from'")
    for name in walk.fixed:
        if name in sources:
            doc.fail(("set", name), f"is under 'set' and also {sources[name]}: give it one source.", name)
    sources |= dict.fromkeys(walk.constants, f"set by 'pilot.{pilot}'")
    sources |= dict.fromkeys(walk.fixed, "fixed under 'set'")
    for section, names in sections.items():
        for name in names:
            if name in sources:
                doc.fail((section, name), f"is under '{section}' and also {sources[name]}: give it one source.", name)
            sources[name] = f"under '{section}'"
            choice, wanted = _NEEDS.get(name, ("", ""))
            if choice and wanted not in (chosen := getattr(walk.setup, choice)).split("+"):
                doc.fail((section, name), f"has no effect: it is read only with {choice}: {wanted}, and {choice} is "
                                          f"{chosen}.", name)  # fmt: skip
    for key, option in PILOT_OPTIONS.get(pilot, {}).items():
        if option and key in walk.pilot:
            if option in walk.fixed:
                doc.fail(("set", option), f"is under 'set' and also set by 'pilot.{pilot}.{key}': give it one source.",
                         option)  # fmt: skip
            check_value(doc, ("pilot", pilot, key), option, parameters[option], walk.pilot[key])
