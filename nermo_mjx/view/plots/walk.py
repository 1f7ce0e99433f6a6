"""Data shared by the figures of a recording: its gait, planned and measured contact, and the time range shown."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from nermo_mjx.control.free_stepping import FREE, FreeStepping
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.published import published_values
from nermo_mjx.control.stepping import Stepping
from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.recording import Recording
from nermo_mjx.robot import GAITS, LIMBS
from nermo_mjx.robot.quantity import quantities, replace_quantities
from nermo_mjx.view.standing import STANDING

#: Gait cycles shown in figures of single steps: the last whole ones.
SHOWN_CYCLES: Final = 4
NAMES: Final = {"trt": "trot", "trt1": "walking trot", "lat": "lateral sequence walk"}


@dataclasses.dataclass(frozen=True)
class Walk:
    """A recording, with the gait from its metadata."""

    recording: Recording

    @cached_property
    def values(self) -> dict[str, float]:
        """The parameters that are known by name."""
        setup = self.recording.metadata.get("setup", {})
        known: dict[str, Any] = published_values(setup["gait"]) if setup.get("gait") in GAITS else {}
        return known | dict(self.recording.metadata.get("parameters", {}))

    @property
    def cycle(self) -> float | None:
        """Simulated time of a gait cycle [s]; None if the recording does not say."""
        frequency = self.values.get("frequency", 0.0)
        return self.values.get("tracking.clock_ratio", 1.0) / frequency if frequency > 0 else None

    @property
    def title(self) -> str:
        """The gait in words, after a colon; empty if unknown."""
        setup, labels = self.recording.metadata.get("setup", {}), self.recording.metadata.get("labels", {})
        gait = NAMES.get(setup.get("gait", labels.get("gait")), "")
        if self.cycle is None:
            return f": {gait}" if gait else ""
        return f": {gait} at {self.values['frequency']:.3g} Hz" if gait else f" at {self.values['frequency']:.3g} Hz"

    @cached_property
    def shown(self) -> tuple[slice, str]:
        """The samples of the last whole gait cycles, or all, and their description."""
        time = self.recording.time
        if self.cycle is None or time[-1] < self.cycle:
            return slice(None), "the whole recording"
        whole = int(time[-1] / self.cycle + 1e-6)
        count = min(SHOWN_CYCLES, whole)
        begin, end = np.searchsorted(time, [(whole - count) * self.cycle - 1e-9, whole * self.cycle + 1e-9])
        return slice(int(begin), max(int(end), int(begin) + 2)), f"the last {count} whole gait cycles"

    @cached_property
    def planned(self) -> np.ndarray | None:
        """Planned contact of each foot, (T, 4); None if the recording does not contain it."""
        if self.cycle is None or not {"duty", *(f"offset.{limb}" for limb in LIMBS)} <= set(self.values):
            return None
        phase = (self.values.get("start.phase", 0.0) + self.recording.time / self.cycle) % 1.0
        known = {name for name, _ in quantities(ControlParameters)}
        given = {name: np.asarray(value) for name, value in self.values.items() if name in known}
        free = self.recording.metadata.get("setup", {}).get("trajectory") == FREE
        stepping = FreeStepping() if free else Stepping()
        limbs = stepping.limbs(replace_quantities(ControlParameters(), given), jnp.asarray(phase))
        return np.asarray(limbs.stance)

    @cached_property
    def contact(self) -> np.ndarray | None:
        """Whether each foot bears a load, (T, 4); None without such a sensor."""
        force = self.recording.sensors.get("foot_force")
        return None if force is None else np.asarray(force) > STANDING

    @cached_property
    def angles(self) -> np.ndarray | None:
        """Roll, pitch and yaw of the torso, (T, 3) [deg]; the yaw does not jump. None without such a sensor."""
        orientation = self.recording.sensors.get("orientation")
        if orientation is None:
            return None
        found = np.array(attitude(jnp.asarray(orientation)), float)
        found[:, 2] = np.unwrap(found[:, 2])
        return np.degrees(found)


def name_of(limb: str) -> str:
    """A limb's display name."""
    return limb.replace("_", " ")
