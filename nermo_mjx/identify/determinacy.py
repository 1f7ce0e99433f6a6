"""Determined parameters and combinations in words, and the model classes that the data support."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Final

import numpy as np

from nermo_mjx.identify.estimation import (
    CHANCE_DEVIATIONS,
    DETERMINED_SHARE,
    Fit,
    LoggedSamples,
    noise_floor,
    rms,
)

#: A ratio or a product is reported if its deviation is smaller than the deviation of each parameter by this factor.
IMPROVEMENT_FACTOR: Final = 3.0
#: Exponents of the second parameter of a product.
_EXPONENTS: Final = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)


def find_combinations(fit: Fit) -> list[tuple[str, float, tuple[str, ...]]]:
    """Find ratios and products that are determined although their parameters are not.

    Returns:
        Formula, relative standard deviation, and names of the parameters; the smallest deviation first.
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
                narrow = 3.29 * deviation < DETERMINED_SHARE * space.width[i]
                if narrow and deviation * IMPROVEMENT_FACTOR < single_deviation:
                    pairs.append((deviation, i, j, exponent))
    for deviation, i, j, exponent in sorted(
        pairs
    ):  # the smallest deviations, one for each independent combination
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
    """A share in per cent, with two digits."""
    return f"{100 * share:.2g} %"


def describe_determinacy(fit: Fit) -> list[str]:
    """Describe in sentences what the data determine."""
    space, sentences = fit.space, list[str]()
    names = np.array([parameter.name for parameter in space.parameters])
    bound = fit.at_bound
    determined_names = [names[i] for i in range(len(names)) if fit.determined[i]]
    loose = [names[i] for i in range(len(names)) if not fit.determined[i]]
    products = find_combinations(fit)
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
class ResidualEvaluation:
    """A test whether residuals are white noise.

    Attributes:
        rms, noise: Root mean square of the residuals of each channel, and of their white part (channels,).
        white: Von Neumann's ratio of each channel (channels,): 1 for white residuals, 0 for smooth residuals.
        right: Whether the residuals of all channels are white, so that the model explains the data.
    """

    rms: np.ndarray
    noise: np.ndarray
    white: np.ndarray
    right: bool


#: Residuals are not noise if they exceed their white part by this share, and significantly.
EXCESS_SHARE: Final = 0.05


def evaluate_residuals(measured: LoggedSamples, residual: np.ndarray) -> ResidualEvaluation:
    """Compare the residuals (n,) of each channel with their white part."""
    size = measured.by_channel(lambda channel_values, i: rms(channel_values), residual)
    noise = measured.by_channel(
        lambda channel_values, i: noise_floor(channel_values, measured.quantum[i]), residual
    )
    counts = np.bincount(measured.channel, minlength=len(measured.quantum))
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.where(size > 0, np.minimum((noise / size) ** 2, 1.0), 1.0)
    beyond = (size > (1 + EXCESS_SHARE) * noise) & (
        1 - white > CHANCE_DEVIATIONS / np.sqrt(np.maximum(counts, 1))
    )
    return ResidualEvaluation(size, noise, white, not bool(beyond.any()))


def find_dispensable_kinds(fit: Fit) -> list[str]:
    """Find the kinds of parameters that the data do not require, the least important first.

    A kind is dispensable if the mean square does not increase significantly without it (Wald test with the covariance
    of the posterior).
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


def compute_gain(fit: Fit, extra: np.ndarray, white: np.ndarray) -> float:
    """Compute the share of the squared residuals that additional parameters would remove, by one linear step.

    Args:
        fit: The estimate.
        extra: Derivatives (n, q) of the whitened residuals with respect to the additional parameters.
        white: Whitened residuals (n,).
    """
    columns = np.concatenate([fit.jacobian, extra], axis=1)
    step, *_ = np.linalg.lstsq(columns, white, rcond=1e-8)
    return float(1 - np.sum((white - columns @ step) ** 2) / np.sum(white**2))


def compute_remaining_share(jacobian: np.ndarray, fit: Fit) -> float:
    """Compute the share of the deviation along the least determined direction that remains after another experiment.

    Args:
        jacobian: Derivatives (n, p) of the whitened residuals of the experiment.
        fit: The estimate.
    """
    before = (fit.directions * fit.share**2) @ fit.directions.T
    after = np.linalg.inv(np.linalg.inv(before) + jacobian.T @ jacobian)
    worst: Any = fit.directions[:, int(np.argmax(fit.share))]
    return math.sqrt(float(worst @ after @ worst) / float(worst @ before @ worst))
