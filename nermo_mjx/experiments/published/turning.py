"""Turning: section 6.3."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments import turning
from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import HARDWARE, Measure, Number, clock, quotient


def _turn(column: str, gait: str, frequency: float, radius: float, strategy: str, side: str = "left") -> Number:
    def measure(outcome: Outcome, profile: str) -> float:
        wanted = {"gait": gait, "frequency": frequency, "radius": radius, "strategy": strategy, "side": side}
        return outcome.mean(column, profile=profile, **wanted)

    return measure


def _time(strategy: str) -> Number:
    time = _turn("time", "trt", 0.67, 0.5, strategy)
    return lambda outcome, profile: float(time(outcome, profile)) / clock(profile)


def _circles(outcome: Outcome) -> list[tuple[str, float, float]]:
    """The quarter circles that were walked, as (gait, frequency, radius)."""
    rows = outcome.where(side="left") & (np.asarray(outcome.columns["radius"], float) > 0)
    names = ("gait", "frequency", "radius")
    return sorted({tuple(row) for row in zip(*(outcome.columns[name][rows].tolist() for name in names), strict=True)})


def followed(outcome: Outcome, profile: str, gait: str, frequency: float, radius: float, strategy: str) -> bool:
    """Whether all repeats followed a quarter circle."""
    return _turn("followed", gait, frequency, radius, strategy)(outcome, profile) == 1.0


def _compared(outcome: Outcome, profile: str, strategies: tuple[str, ...]) -> list[tuple[float, ...]]:
    """Speeds of the strategies on every quarter circle that all of them followed."""
    return [
        tuple(_turn("speed", *circle, strategy)(outcome, profile) for strategy in strategies)
        for circle in _circles(outcome)
        if all(followed(outcome, profile, *circle, strategy) for strategy in strategies)
    ]


def _spine_fastest(outcome: Outcome, profile: str) -> bool | None:
    pairs = _compared(outcome, profile, ("spine", "leg")) + _compared(outcome, profile, ("spine", "mix"))
    return all(spine > other for spine, other in pairs) if pairs else None


def _mix_between(outcome: Outcome, profile: str) -> bool | None:
    triples = _compared(outcome, profile, ("leg", "mix", "spine"))
    return all(leg < mix < spine for leg, mix, spine in triples) if triples else None


def _spine_over_leg(outcome: Outcome, profile: str) -> float:
    pairs = _compared(outcome, profile, ("spine", "leg"))
    return float(np.mean([spine / leg for spine, leg in pairs])) if pairs else float("nan")


def _failed(outcome: Outcome, profile: str) -> str:
    names = [
        f"{gait}, {frequency:g} Hz, {strategy}, {radius:g} m"
        for gait, frequency, radius in _circles(outcome)
        for strategy in turning.STRATEGIES
        if not followed(outcome, profile, gait, frequency, radius, strategy)
    ]
    return "; ".join(names) or "none"


def _radius(gait: str, strategy: str, frequency: float = 0.67) -> Number:
    return _turn("turning_radius", gait, frequency, turning.FULL_LOCK, strategy)


def _best_radius(outcome: Outcome, profile: str) -> float:
    rows = outcome.where(profile=profile, strategy="mix", radius=turning.FULL_LOCK)
    return float(np.nanmin(np.asarray(outcome.columns["turning_radius"], float)[rows]))


def _below(gait: str, other: str) -> Number:
    """By what share the mix-based smallest radius is below another's."""
    mix, than = _radius(gait, "mix"), _radius(gait, other)
    return lambda outcome, profile: 1.0 - float(mix(outcome, profile)) / float(than(outcome, profile))


def _mirrored(outcome: Outcome, profile: str) -> bool:
    """Whether right is as left within the spread of the repeats, in speed and in the radius at full lock.

    A single repeat has no spread: then within 0.2 %, which is what rounding grows to on the way.
    """
    sides = {side: outcome.where(profile=profile, side=side) for side in turning.SIDES}
    for row in np.flatnonzero(sides["right"]):
        labels = {name: outcome.columns[name][row] for name in ("profile", "gait", "frequency", "radius", "strategy")}
        for column in ("speed",) if labels["radius"] > 0 else ("speed", "turning_radius"):
            values = {
                side: np.asarray(outcome.columns[column], float)[outcome.where(side=side, **labels)] for side in sides
            }
            spread = max(np.ptp(each) for each in values.values())
            gap = abs(values["left"].mean() - values["right"].mean())
            if not gap <= (spread if len(values["left"]) > 1 else 2e-3 * values["left"].mean()):
                return False
    return True


def _did_follow(strategy: str) -> Measure:
    return lambda outcome, profile: followed(outcome, profile, "trt", 0.67, 0.5, strategy)


FIGURES: Final = (
    Figure("spine-based turning fastest wherever it follows the path", True, _spine_fastest, source="6.3"),
    Figure("mix-based turning between leg- and spine-based", True, _mix_between, source="6.3"),
    Figure("speed, spine- over leg-based, mean of all paths", (1.15, 1.30), _spine_over_leg, source="6.3"),
    Figure(
        "speed, spine- over mix-based, trt, 1.0 m, 0.5 Hz",
        1.01,
        quotient(_turn("speed", "trt", 0.5, 1.0, "spine"), _turn("speed", "trt", 0.5, 1.0, "mix")),
        source="6.3",
    ),
    Figure(
        "speed, spine- over mix-based, trt1, 1.0 m, 0.5 Hz",
        1.03,
        quotient(_turn("speed", "trt1", 0.5, 1.0, "spine"), _turn("speed", "trt1", 0.5, 1.0, "mix")),
        source="6.3",
    ),
    Figure("paths not followed", "lat, 0.8 Hz, spine, 0.5 m", _failed, source="6.3"),
    Figure("time for 0.5 m, trt, 0.67 Hz, spine-based", 13.0, _time("spine"), "s", "6.3"),
    Figure("time for 0.5 m, trt, 0.67 Hz, leg-based", 18.4, _time("leg"), "s", "6.3"),
    Figure("time for 0.5 m, trt, 0.67 Hz, mix-based", 14.5, _time("mix"), "s", "6.3"),
    Figure(
        "theory: smallest radius, leg-based", 0.151, _turn("theory_radius", "trt", 0.67, 0.0, "leg"), "m", "5.40-5.42"
    ),
    Figure(
        "theory: smallest radius, mix-based", 0.134, _turn("theory_radius", "trt", 0.67, 0.0, "mix"), "m", "5.40-5.42"
    ),
    Figure("smallest radius of trt, leg-based", 0.174, _radius("trt", "leg"), "m", "6.3"),
    Figure("smallest radius of trt, mix-based", 0.135, _radius("trt", "mix"), "m", "6.3"),
    Figure("smallest radius of all, mix-based", 0.12, _best_radius, "m", "6.3"),
    *(
        Figure(
            f"smallest radius of {gait}, mix-based below leg-based",
            (0.25, 0.30),
            _below(gait, "leg"),
            source="6.3",
            demanded=(0.15, 1.0),
        )
        for gait in turning.GAITS
    ),
    *(
        Figure(
            f"smallest radius of {gait}, mix-based below spine-based",
            None,
            _below(gait, "spine"),
            source="this project",
            demanded=(0.50, 1.0),
        )
        for gait in turning.GAITS
    ),
    Figure("right turns as left turns", True, _mirrored, source="symmetry"),
    Figure("hardware: time for 0.5 m, trt, 0.67 Hz, spine-based", 15.5, _time("spine"), "s", HARDWARE),
    Figure("hardware: time for 0.5 m, trt, 0.67 Hz, leg-based", 22.0, _time("leg"), "s", HARDWARE),
    Figure("hardware: time for 0.5 m, trt, 0.67 Hz, mix-based", 16.3, _time("mix"), "s", HARDWARE),
    *(
        Figure(
            f"hardware: 0.5 m, trt, 0.67 Hz, followed, {strategy}-based",
            did,
            _did_follow(strategy),
            source=HARDWARE,
        )
        for strategy, did in (("spine", False), ("leg", True), ("mix", True))
    ),
)
