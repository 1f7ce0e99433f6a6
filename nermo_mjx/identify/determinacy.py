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
    space, compensations = fit.space, list[tuple[str, float, tuple[str, ...]]]()
    logs = fit.draws * space.deviation
    loose = [i for i in range(len(space)) if space.log[i] and not fit.determined[i]]
    group = {i: i for i in loose}
    pairs = []
    for a, i in enumerate(loose):
        for j in loose[a + 1 :]:
            for exponent in _EXPONENTS:
                deviation = float(np.std(logs[:, i] + exponent * logs[:, j]))
                single_deviation = min(
                    float(np.std(logs[:, i])), abs(exponent) * float(np.std(logs[:, j]))
                )
                narrow = 3.29 * deviation < DETERMINED * space.width[i]
                if narrow and deviation * BETTER < single_deviation:
                    pairs.append((deviation, i, j, exponent))
    for deviation, i, j, exponent in sorted(
        pairs
    ):  # the best known ones, each of which says something new
        if group[i] == group[j]:
            continue
        group = {k: group[i] if g == group[j] else g for k, g in group.items()}
        first_name, second_name = space.parameters[i].name, space.parameters[j].name
        power = "" if abs(exponent) == 1 else f"^{abs(exponent):g}"
        compensations.append(
            (
                f"{first_name} {'/' if exponent < 0 else '*'} {second_name}{power}",
                deviation,
                (first_name, second_name),
            )
        )
    return compensations


def percent(share: float) -> str:
    """A share as per cent with two digits."""
    return f"{100 * share:.2g} %"


def determinacy_sentences(fit: Fit) -> list[str]:
    """What the data determine, in words."""
    space, sentences = fit.space, list[str]()
    names = np.array([parameter.name for parameter in space.parameters])
    bound = fit.at_bound
    determined_names = [names[i] for i in range(len(names)) if fit.determined[i]]
    loose = [names[i] for i in range(len(names)) if not fit.determined[i]]
    products = combinations(fit)
    if determined_names:
        sentences.append(f"Determined: {', '.join(determined_names)}.")
    if products:
        listed = ", ".join(
            f"{formula} to {percent(deviation)}" for formula, deviation, _ in products
        )
        sentences.append(
            f"Determined only together: {listed}; each of these parameters alone could be another."
        )
    if loose:
        sentences.append(
            f"Not determined by these data: {', '.join(loose)}. Where they stay near the default, that is no result."
        )
    if not determined_names and not products:
        sentences.append("These data determine none of the parameters.")
    for name, end in zip(names, bound, strict=True):
        if end:
            sentences.append(f"{name} is at its {end} bound.")
    return sentences


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
    size = measured.by_channel(lambda channel_values, i: rms(channel_values), residual)
    noise = measured.by_channel(
        lambda channel_values, i: floor(channel_values, measured.quantum[i]), residual
    )
    counts = np.bincount(measured.channel, minlength=len(measured.quantum))
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.where(size > 0, np.minimum((noise / size) ** 2, 1.0), 1.0)
    beyond = (size > (1 + EXCESS) * noise) & (1 - white > CHANCE / np.sqrt(np.maximum(counts, 1)))
    return Judgement(size, noise, white, not bool(beyond.any()))


def dispensable(fit: Fit) -> list[str]:
    """Kinds of parameters that the data do not ask for, those that matter least first.

    A kind is left out if the mean square rises by less than chance lets it (Wald, with the posterior's covariance).
    """
    space, left_out = fit.space, list[str]()
    kinds = list(dict.fromkeys(parameter.kind for parameter in space.parameters))
    optional = [
        k for k in kinds if all(math.isfinite(p.neutral) for p in space.parameters if p.kind == k)
    ]
    covariance = (fit.directions * fit.share**2) @ fit.directions.T
    distance = fit.x - space.coordinates(
        np.array([parameter.absent for parameter in space.parameters])
    )
    while optional:

        def rise(kind: str) -> float:
            indices = [i for i, p in enumerate(space.parameters) if p.kind in (*left_out, kind)]
            block = covariance[np.ix_(indices, indices)]
            return float(distance[indices] @ np.linalg.solve(block, distance[indices])) / (
                len(indices) + 2 * math.sqrt(2 * len(indices))
            )

        least_needed = min(optional, key=rise)
        if rise(least_needed) > 1.0:
            break
        left_out.append(least_needed)
        optional.remove(least_needed)
    return left_out


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
