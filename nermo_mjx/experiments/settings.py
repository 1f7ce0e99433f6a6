"""Settings of a published experiment, checked before anything runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from nermo_mjx.control.published import PROFILES, SIMULATED
from nermo_mjx.experiments.substitute import Substitute
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.rollout import Setup
from nermo_mjx.rollout.parameters import WorldParameters

#: Repeats of each case, and of a quick run.
REPEATS, QUICK_REPEATS = 3, 1
_WORDS: Final = {"values": "parameters", "quick": "quick run"}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an experiment; the first six determine its numbers.

    Attributes:
        profiles: of `PROFILES`, in their order; reports compare those of `SIMULATED`.
        repeats: worlds of each case, from starts that differ by a seeded shift.
        seed: of the shifts.
        quick: fewer cases.
        values: parameters for all worlds, by name.
        controller: what walks instead of the published controller; None is that.
        engine: of the simulations.
        bodies: parameter name -> (n,) values of n bodies, each of which runs all cases; they override `values`, and no
            run is recorded.
        progress: called with the share done.

    Raises:
        ParameterError: an unknown name, or a number out of range.
    """

    profiles: Sequence[str] = SIMULATED
    repeats: int = REPEATS
    seed: int = 0
    quick: bool = False
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    controller: Substitute | None = None
    engine: str = "auto"
    bodies: Mapping[str, np.ndarray] | None = None
    progress: Callable[[float], None] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.profiles, str) or not self.profiles:
            raise ParameterError(f"profiles is {self.profiles!r}: allowed is a list of {' and '.join(SIMULATED)}.")
        named = {choice("profile", profile, PROFILES) for profile in self.profiles}
        if not _whole(self.repeats) or self.repeats < 1:
            raise ParameterError(f"repeats is {self.repeats!r}: allowed is a whole number of at least 1.")
        if not _whole(self.seed) or self.seed < 0:
            raise ParameterError(f"seed is {self.seed!r}: allowed is a whole number that is not negative.")
        known = dict(quantities(WorldParameters))
        for name, value in self.values.items():
            if isinstance(value, str) or np.ndim(value):
                raise ParameterError(f"{name} is {value!r}: allowed is one number for all cases.")
            known[choice("parameter", name, known)].check(name, value)
        object.__setattr__(self, "profiles", tuple(name for name in PROFILES if name in named))
        object.__setattr__(self, "values", {name: float(value) for name, value in sorted(self.values.items())})

    def as_dict(self) -> dict[str, Any]:
        """The settings that determine the numbers, as written to files."""
        other = {} if self.controller is None else {"controller": self.controller.name}
        return {"profiles": list(self.profiles), "repeats": self.repeats, "seed": self.seed, "quick": self.quick,
                "values": dict(self.values), **other}  # fmt: skip

    def setup(self, scene: str, **choices: Any) -> Setup:
        """The setup of a walk in a scene.

        Args:
            scene: see `Setup`.
            choices: of the published controller, which another acts upon.

        Raises:
            ParameterError: the controller cannot act upon such a one.
        """
        if self.controller is None:
            return Setup(scene=scene, **choices)
        return Setup(scene=scene, controller=self.controller.acts.upon(**choices))

    def but(self, **other: Any) -> Settings:
        """The same, except for what is named."""
        return dataclasses.replace(self, **other)

    def of_one_run(self) -> Settings:
        """Labels of a run to show: the first profile, and the first start."""
        return self.but(profiles=self.profiles[:1], repeats=1)


def body_count(bodies: Mapping[str, np.ndarray] | None) -> int:
    """Number of bodies; 0 if there is only the default one.

    Raises:
        ParameterError: parameters with different numbers of values, or without any.
    """
    if bodies is None:
        return 0
    sizes = {len(values) for values in bodies.values()}
    if len(sizes) != 1 or sizes == {0}:
        raise ParameterError(f"bodies has {sorted(sizes)} values of its parameters: allowed is one number, at least 1.")
    return sizes.pop()


def check_bodies(bodies: int | None) -> None:
    """Reject an invalid number of bodies.

    Raises:
        ParameterError: it is not a whole number of at least 1.
    """
    if bodies is not None and (not _whole(bodies) or bodies < 1):
        raise ParameterError(f"bodies is {bodies!r}: allowed is a whole number of at least 1.")


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Differences between settings, in words: "seed: 0 instead of 1"."""
    return [
        f"{_WORDS.get(name, name)}: {said(one.get(name))} instead of {said(other.get(name))}"
        for name in dict.fromkeys((*one, *other))
        if one.get(name) != other.get(name)
    ]


def said(value: Any) -> str:
    """A setting in words."""
    if value is None:
        return "the published one"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " and ".join(map(str, value))
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={number:g}" for name, number in value.items()) or "as they are"
    return str(value)


def _whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
