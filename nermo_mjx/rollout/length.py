"""How long a run lasts and what part of it is measured."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from nermo_mjx.robot import ParameterError

Length = float | np.ndarray


@dataclasses.dataclass(frozen=True)
class Run:
    """How long a run lasts and what part of it is measured: gait cycles, or seconds.

    >>> Run(duration=2.0, warmup=2.5)
    Traceback (most recent call last):
    nermo_mjx.robot.quantity.ParameterError: run.warmup is 2.5: allowed is less than the run's length, 2.

    Each number holds for all worlds, or is an array (n,) with one entry per world.

    Attributes:
        cycles, warmup_cycles: length of the run, and of its unmeasured start, in gait cycles.
        duration, warmup: the same in simulated seconds; `duration` excludes `cycles`.
        distance: measuring stops at the end of the gait cycle in which the robot has walked this far [m].

    Raises:
        ParameterError: neither or both lengths, a warm-up as long as the run, a value that is not finite.
    """

    cycles: Length | None = None
    warmup_cycles: Length | None = None
    duration: Length | None = None
    warmup: Length | None = None
    distance: Length | None = None

    def __post_init__(self) -> None:
        for name in ("cycles", "warmup_cycles", "duration", "warmup", "distance"):
            value, zero_ok = getattr(self, name), name.startswith("warmup")
            if value is None:
                continue
            bad = ~(np.isfinite(value) & ((np.asarray(value) > 0) | (zero_ok & (np.asarray(value) == 0))))
            if bad.any():
                shown = np.asarray(value)[bad].flat[0]
                raise ParameterError(f"run.{name} is {float(shown)!r}: allowed is {'[' if zero_ok else '('}0, inf).")
        if self.duration is not None and (self.cycles is not None or self.warmup_cycles is not None):
            raise ParameterError("run.duration is given beside run.cycles: give either seconds or gait cycles.")
        if self.duration is None and self.warmup is not None:
            raise ParameterError("run.warmup is given without run.duration: with cycles, give run.warmup_cycles.")
        length, warmup = np.broadcast_arrays(*self._lengths())
        late = warmup >= length
        if late.any():
            name = "warmup_cycles" if self.duration is None else "warmup"
            raise ParameterError(
                f"run.{name} is {warmup[late].flat[0]:g}: allowed is less than the run's length, "
                f"{length[late].flat[0]:g}."
            )

    def _lengths(self) -> tuple[Length, Length]:
        if self.duration is not None:
            return self.duration, 0.0 if self.warmup is None else self.warmup
        cycles = 8.0 if self.cycles is None else self.cycles
        default = np.where(np.asarray(cycles) > 2.0, 2.0, 0.0)
        return cycles, default if self.warmup_cycles is None else self.warmup_cycles

    def seconds(self, cycle_rate: Any) -> tuple[Any, Any]:
        """(end of the warm-up, end of the run) in simulated seconds, shaped as `cycle_rate`, which may be traced.

        >>> [float(each) for each in Run(cycles=8).seconds(0.8)]
        [2.5, 10.0]

        Args:
            cycle_rate: gait cycles per simulated second [1/s].
        """
        length, warmup = self._lengths()
        period = 1.0 / cycle_rate if self.duration is None else cycle_rate**0
        return warmup * period, length * period
