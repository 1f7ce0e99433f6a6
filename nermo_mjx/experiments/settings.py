"""What decides the numbers of a published experiment, checked before anything runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final

from nermo_mjx.control.parameters import PROFILES, choice
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.rollout.parameters import WorldParameters

#: Repeats of each case, and of a quick run.
REPEATS, QUICK_REPEATS = 3, 1
_WORDS: Final = {"values": "parameters", "quick": "quick run"}


@dataclasses.dataclass(frozen=True)
class Settings:
    """What decides an experiment's numbers, besides the engine.

    Attributes:
        profiles: that are run, `exact` first.
        repeats, seed: of the shifted starts.
        quick: fewer cases.
        values: parameters for all worlds, by name.
    """

    profiles: tuple[str, ...]
    repeats: int
    seed: int
    quick: bool
    values: Mapping[str, float]

    def as_dict(self) -> dict[str, Any]:
        """As it is written into files."""
        return {**dataclasses.asdict(self), "profiles": list(self.profiles), "values": dict(self.values)}


def checked(
    profiles: Sequence[str], repeats: int | None, seed: int, quick: bool, values: Mapping[str, float] | None
) -> Settings:
    """Settings from what a caller gave.

    Raises:
        ParameterError: an unknown name, or a number out of range.
    """
    if isinstance(profiles, str) or not profiles:
        raise ParameterError(f"profiles is {profiles!r}: allowed is a list of {' and '.join(PROFILES)}.")
    named = {choice("profile", profile, PROFILES) for profile in profiles}
    worlds = (QUICK_REPEATS if quick else REPEATS) if repeats is None else repeats
    if not _whole(worlds) or worlds < 1:
        raise ParameterError(f"repeats is {worlds!r}: allowed is a whole number of at least 1.")
    if not _whole(seed) or seed < 0:
        raise ParameterError(f"seed is {seed!r}: allowed is a whole number that is not negative.")
    known = dict(quantities(WorldParameters))
    for name, value in (values or {}).items():
        known[choice("parameter", name, known)].check(name, value)
    numbers = {name: float(value) for name, value in sorted((values or {}).items())}
    return Settings(tuple(name for name in PROFILES if name in named), worlds, seed, quick, numbers)


def check_bodies(bodies: int | None) -> None:
    """Refuse a number of bodies that is none.

    Raises:
        ParameterError: it is not a whole number of at least 1.
    """
    if bodies is not None and (not _whole(bodies) or bodies < 1):
        raise ParameterError(f"bodies is {bodies!r}: allowed is a whole number of at least 1.")


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Where settings differ, in words: "seed: 0 instead of 1"."""
    return [
        f"{_WORDS.get(name, name)}: {said(value)} instead of {said(other.get(name))}"
        for name, value in one.items()
        if value != other.get(name)
    ]


def said(value: Any) -> str:
    """A setting in words."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " and ".join(map(str, value))
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={number:g}" for name, number in value.items()) or "as they are"
    return str(value)


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
