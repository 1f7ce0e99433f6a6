"""What data determine of named parameters, in words, and which model classes the data support."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Final

import numpy as np

from nermo_mjx.identify.estimation import CHANCE, DETERMINED, Fit, LoggedSamples, floor, rms

#: A ratio or a product is determined if it is known this much better than each of its parameters.
BETTER: Final = 3.0
#: Exponents of products that are tried.
_EXPONENTS: Final = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)


def combinations(fit: Fit) -> list[tuple[str, float, tuple[str, ...]]]:
    """Ratios and products that are determined though their parameters are not.

    Returns:
        Formula, relative standard deviation, and the names in it; the best known first.
    """
    space, found = fit.space, list[tuple[str, float, tuple[str, ...]]]()
    logs = fit.draws * space.deviation
    loose = [i for i in range(len(space)) if space.log[i] and not fit.determined[i]]
    group = {i: i for i in loose}
    pairs = []
    for a, i in enumerate(loose):
        for j in loose[a + 1 :]:
            for exponent in _EXPONENTS:
                deviation = float(np.std(logs[:, i] + exponent * logs[:, j]))
                alone = min(float(np.std(logs[:, i])), abs(exponent) * float(np.std(logs[:, j])))
                narrow = 3.29 * deviation < DETERMINED * space.width[i]
                if narrow and deviation * BETTER < alone:
                    pairs.append((deviation, i, j, exponent))
    for deviation, i, j, exponent in sorted(
        pairs
    ):  # the best known ones, each of which says something new
        if group[i] == group[j]:
            continue
        group = {k: group[i] if g == group[j] else g for k, g in group.items()}
        one, other = space.parameters[i].name, space.parameters[j].name
        power = "" if abs(exponent) == 1 else f"^{abs(exponent):g}"
        found.append(
            (f"{one} {'/' if exponent < 0 else '*'} {other}{power}", deviation, (one, other))
        )
    return found


def percent(share: float) -> str:
    """A share as per cent with two digits."""
    return f"{100 * share:.2g} %"


def determinacy_sentences(fit: Fit) -> list[str]:
    """What the data determine, in words."""
    space, said = fit.space, list[str]()
    names = np.array([each.name for each in space.parameters])
    bound = fit.at_bound
    known = [names[i] for i in range(len(names)) if fit.determined[i]]
    loose = [names[i] for i in range(len(names)) if not fit.determined[i]]
    products = combinations(fit)
    if known:
        said.append(f"Determined: {', '.join(known)}.")
    if products:
        listed = ", ".join(
            f"{formula} to {percent(deviation)}" for formula, deviation, _ in products
        )
        said.append(
            f"Determined only together: {listed}; each of these parameters alone could be another."
        )
    if loose:
        said.append(
            f"Not determined by these data: {', '.join(loose)}. Where they stay near the default, that is no result."
        )
    if not known and not products:
        said.append("These data determine none of the parameters.")
    for name, end in zip(names, bound, strict=True):
        if end:
            said.append(f"{name} is at its {end} bound.")
    return said


# --- model classes


@dataclasses.dataclass(frozen=True)
class Judgement:
    """Whether residuals are noise.

    Attributes:
        rms, noise: of each channel (channels,): residuals, and their white part.
        white: the ratio of von Neumann of each channel (channels,): 1 if residuals are white, 0 if they are smooth.
        right: whether the model explains the data to the noise.
    """

    rms: np.ndarray
    noise: np.ndarray
    white: np.ndarray
    right: bool


#: Residuals that exceed their white part by this share are no noise, if that is not chance.
EXCESS: Final = 0.05


def judge(measured: LoggedSamples, residual: np.ndarray) -> Judgement:
    """Compare residuals (n,) with their white part, channel by channel."""
    size = measured.by_channel(lambda each, i: rms(each), residual)
    noise = measured.by_channel(lambda each, i: floor(each, measured.quantum[i]), residual)
    counts = np.bincount(measured.channel, minlength=len(measured.quantum))
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.where(size > 0, np.minimum((noise / size) ** 2, 1.0), 1.0)
    beyond = (size > (1 + EXCESS) * noise) & (1 - white > CHANCE / np.sqrt(np.maximum(counts, 1)))
    return Judgement(size, noise, white, not bool(beyond.any()))


def dispensable(fit: Fit) -> list[str]:
    """Kinds of parameters that the data do not ask for, those that matter least first.

    A kind is left out if the mean square rises by less than chance lets it (Wald, with the posterior's covariance).
    """
    space, left = fit.space, list[str]()
    kinds = list(dict.fromkeys(each.kind for each in space.parameters))
    optional = [
        k for k in kinds if all(math.isfinite(p.neutral) for p in space.parameters if p.kind == k)
    ]
    covariance = (fit.directions * fit.share**2) @ fit.directions.T
    away = fit.x - space.coordinates(np.array([each.absent for each in space.parameters]))
    while optional:

        def rise(kind: str) -> float:
            chosen = [i for i, p in enumerate(space.parameters) if p.kind in (*left, kind)]
            block = covariance[np.ix_(chosen, chosen)]
            return float(away[chosen] @ np.linalg.solve(block, away[chosen])) / (
                len(chosen) + 2 * math.sqrt(2 * len(chosen))
            )

        least = min(optional, key=rise)
        if rise(least) > 1.0:
            break
        left.append(least)
        optional.remove(least)
    return left


def gain_of(fit: Fit, extra: np.ndarray, white: np.ndarray) -> float:
    """The share of the squares that further parameters would remove, by one linear step.

    Args:
        extra: derivatives of the whitened residuals to them (n, q).
        white: the residuals (n,).
    """
    columns = np.concatenate([fit.jacobian, extra], axis=1)
    step, *_ = np.linalg.lstsq(columns, white, rcond=1e-8)
    return float(1 - np.sum((white - columns @ step) ** 2) / np.sum(white**2))


def contribution(jacobian: np.ndarray, fit: Fit) -> float:
    """Share of the least known direction's deviation that is left after another experiment, jacobian (n, p)."""
    before = (fit.directions * fit.share**2) @ fit.directions.T
    after = np.linalg.inv(np.linalg.inv(before) + jacobian.T @ jacobian)
    worst: Any = fit.directions[:, int(np.argmax(fit.share))]
    return math.sqrt(float(worst @ after @ worst) / float(worst @ before @ worst))
