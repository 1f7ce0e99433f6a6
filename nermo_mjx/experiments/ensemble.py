"""The identification's uncertainty: many bodies that match the published speeds about as well as the best one.

The free parameters are the identified ones and, within plausible ranges, the friction of soles and tail. Prior: uniform
in the logarithms within the bounds. A body belongs to the ensemble if its objective is within a tolerance that was
fixed beforehand; within the tolerance, all are equivalent. They are found by a sequential Monte Carlo sampler, adaptive
multiple importance sampling (Cornuet et al., 2012): a Sobol sample of the prior comes first; then, in each sweep, as
many proposals from a mixture of normal distributions around the best points, with their covariance, where the level
decreases to the tolerance as points permit. Every point ever evaluated is weighted by the prior over the mean proposal
density of all sweeps, so that each one within the tolerance counts, no matter which sweep found it, and the initial
centres hardly matter. Since the Sobol sample is part of that mean, no weight can exceed the number of sweeps plus one.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullLocator
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from scipy.stats import qmc

from nermo_mjx.experiments.cases import texts
from nermo_mjx.experiments.report import rounded
from nermo_mjx.plotting.charts import FigurePage
from nermo_mjx.plotting.style import BAND, BEST, COLOURS, INK, LINE, MUTED, SMALL
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.runs.files import MISSING, table

# --- the space: the free parameters, their physical bounds, and the unit cube that represents them


@dataclasses.dataclass(frozen=True)
class Free:
    """A free parameter.

    Attributes:
        names: model parameters that share the value.
        low, high: physical bounds.
        why: reason for the bounds.
    """

    names: tuple[str, ...]
    low: float
    high: float
    why: str


def _space(of: Mapping[str, Any]) -> dict[str, Free]:
    return {name: Free(**about | {"names": tuple(about["names"])}) for name, about in of.items()}


#: What is searched, what is not but uncertain and so free in the ensemble, and its space; see `experiments.yaml`.
FREE: Final = _space(texts("identification")["free"])
UNCERTAIN: Final = _space(texts("identification")["uncertain"])
ALL: Final = FREE | UNCERTAIN
#: What is searched in the set-up of the published tests, whose servos are stiffer.
FREE_IN: Final = {"exact": FREE, "as_published": FREE | _space({"kp": texts("identification")["stiff"]})}

#: To four significant digits, as their decimal text reads, so that printed and shipped values are the simulated ones.
_rounded: Final = np.vectorize(lambda value: float(f"{value:.4g}"), otypes=[float])


def parameters_of(point: np.ndarray, space: Mapping[str, Free] = FREE) -> dict[str, Any]:
    """Model parameters, to four digits, at points (..., d) of the unit cube, whose axes are logarithms in bounds."""
    values: dict[str, Any] = {}
    for axis, free in enumerate(space.values()):
        value = _rounded(free.low * (free.high / free.low) ** np.clip(point[..., axis], 0.0, 1.0))
        values |= dict.fromkeys(free.names, value)
    return values


def point_of(parameters: Mapping[str, float], space: Mapping[str, Free] = FREE) -> np.ndarray:
    """Inverse of `parameters_of`, shape (d,)."""
    shares = [math.log(parameters[f.names[0]] / f.low) / math.log(f.high / f.low) for f in space.values()]
    return np.clip(shares, 0.0, 1.0)


def free_names(space: Mapping[str, Free] = ALL) -> tuple[str, ...]:
    """Every model parameter of a space, in order."""
    return tuple(name for free in space.values() for name in free.names)


# --- sampling

#: Minimum number of centres of a mixture, as a fraction of a sweep's points.
_CENTRES: Final = 1 / 8
#: Share of the first sweep's proposals around the seeds.
_SEEDED: Final = 0.25
#: Number of draws to estimate the share of a mixture that lies in the cube.
_INSIDE: Final = 20_000


@dataclasses.dataclass(frozen=True)
class EnsembleSample:
    """Points within the tolerance.

    Attributes:
        points: in the cube, (m, d).
        costs: their objective, (m,).
        weights: of a uniform distribution over the region, (m,); their sum is 1.
        sweeps: of the Sobol sample, and the sweeps after it: number of `candidates`, the `level` within which its
            centres lay, and `acceptance`, the share within the tolerance.
        share: estimated share of the cube within the tolerance, a few per cent too low if it is small.
        effective: effective sample size (Kish).
    """

    points: np.ndarray
    costs: np.ndarray
    weights: np.ndarray
    sweeps: list[dict[str, float]]
    share: float
    effective: float


class _Mixture:
    """Normal distributions about weighted centres (k, d), with a common covariance and the bandwidth of a density
    estimate (Silverman), truncated to the unit cube."""

    def __init__(
        self, centres: np.ndarray, weights: np.ndarray, seeds: np.ndarray | None, random: np.random.Generator
    ) -> None:
        self.centres, self.shares, d = centres, weights / weights.sum(), centres.shape[1]
        away = centres - self.shares @ centres
        covariance = (away.T * self.shares) @ away + 1e-4 * np.eye(d)
        width = (4 / ((d + 2) * _effective(weights))) ** (2 / (d + 4))
        if seeds is not None and len(seeds):
            self.centres = np.vstack([centres, seeds])
            seeded = np.full(len(seeds), _SEEDED / len(seeds))
            self.shares = np.concatenate([(1 - _SEEDED) * self.shares, seeded])
        self.root = np.linalg.cholesky(width * covariance)
        self.inside = float(np.mean(_in_cube(self._unbounded(_INSIDE, random))))

    def draw(self, n: int, random: np.random.Generator) -> np.ndarray:
        """Points (n, d)."""
        points = np.empty((0, self.centres.shape[1]))
        while len(points) < n:
            drawn = self._unbounded(n, random)
            points = np.vstack([points, drawn[_in_cube(drawn)]])
        return points[:n]

    def density(self, points: np.ndarray) -> np.ndarray:
        """Density at points (n, d) of the cube, (n,); at a centre, that of the others, since it would find itself."""
        white, centres = (solve_triangular(self.root, each.T, lower=True).T for each in (points, self.centres))
        away = cdist(white, centres, "sqeuclidean")
        own = away == 0.0
        density = np.where(own, 0.0, np.exp(-0.5 * away)) @ self.shares / (1.0 - own @ self.shares)
        volume = (2 * np.pi) ** (points.shape[1] / 2) * np.prod(np.diag(self.root))
        return density / (volume * self.inside)

    def _unbounded(self, n: int, random: np.random.Generator) -> np.ndarray:
        chosen = random.choice(len(self.centres), n, p=self.shares)
        return self.centres[chosen] + random.standard_normal((n, self.centres.shape[1])) @ self.root.T


def sample_bodies(
    evaluate: Callable[[np.ndarray], np.ndarray],
    dimension: int,
    *,
    tolerance: float,
    size: int,
    sweeps: int,
    seed: int,
    seeds: np.ndarray | None = None,
) -> EnsembleSample:
    """Sample the region until the effective sample size reaches `size`, or for the given number of sweeps.

    Args:
        evaluate: objective of points (n, d), (n,).
        dimension: d.
        tolerance: of the objective.
        size: points per sweep, and requested effective sample size.
        sweeps: maximum number after the Sobol sample.
        seed: makes it repeatable.
        seeds: additional points (k, d) to start from; their origin does not matter.
    """
    random = np.random.default_rng((seed, dimension, size))
    points = qmc.Sobol(dimension, rng=random).random_base2(max(size - 1, 1).bit_length())[:size]
    fewest = min(max(dimension + 2, int(_CENTRES * size)), size)
    costs, mixtures, levels = evaluate(points), list[_Mixture](), [np.inf]
    while True:
        # The prior's density, 1, over the mean proposal density; sweeps are of equal size.
        proposals = [np.ones(len(points)), *(mixture.density(points) for mixture in mixtures)]
        weights = len(proposals) / functools.reduce(np.add, proposals)
        within = costs <= tolerance
        if len(levels) > sweeps or _effective(weights[within]) >= size:
            break
        level = max(tolerance, float(np.sort(costs)[fewest - 1]))
        near = costs <= level
        mixtures.append(_Mixture(points[near], weights[near], seeds if len(levels) == 1 else None, random))
        proposed = mixtures[-1].draw(size, random)
        points, costs = np.vstack([points, proposed]), np.concatenate([costs, evaluate(proposed)])
        levels.append(level)
    rounds = [
        {"candidates": size, "level": level, "acceptance": float(np.mean(within[i * size : (i + 1) * size]))}
        for i, level in enumerate(levels)
    ]
    taken = weights[within]
    share, total = float(np.sum(taken) / len(points)), taken.sum() or 1.0
    return EnsembleSample(points[within], costs[within], taken / total, rounds, share, _effective(taken))


def thin(sample: EnsembleSample, n: int, seed: int) -> EnsembleSample:
    """At most n of the points, selected roughly in proportion to weight, so that the remaining weights are similar."""
    if len(sample.points) <= n:
        return sample
    # Probability that each point is among n, in proportion to its weight but at most 1.
    certain = np.zeros(len(sample.weights), bool)
    while True:
        rest = np.where(certain, 0.0, sample.weights)
        taken = np.where(certain, 1.0, rest * (n - certain.sum()) / rest.sum())
        if not (over := (taken > 1.0) & ~certain).any():
            break
        certain |= over
    random = np.random.default_rng((seed, n))
    order = random.permutation(len(taken))
    # Systematic sampling: marks one apart on the line of the shares, from one random start.
    ends = np.cumsum(taken[order])
    marks = np.floor(ends - random.uniform())
    kept = np.sort(order[np.diff(marks, prepend=-1.0) > 0])
    weights = sample.weights[kept] / taken[kept]
    weights = weights / weights.sum()
    return dataclasses.replace(sample, points=sample.points[kept], costs=sample.costs[kept], weights=weights)


def _effective(weights: np.ndarray) -> float:
    return float(weights.sum() ** 2 / np.sum(weights**2)) if len(weights) else 0.0


def _in_cube(points: np.ndarray) -> np.ndarray:
    return np.all((points >= 0) & (points <= 1), axis=1)


# --- bodies

#: Maximum objective of a body in the ensemble: half of the deviation declared acceptable, at which all targets are off
#: by one tolerance each.
TOLERANCE: Final = 0.5


@dataclasses.dataclass(frozen=True)
class Bodies:
    """An ensemble of n bodies; the first is the best of the search, if that is within the tolerance.

    Attributes:
        values: model parameter -> (n,).
        objective, weights: (n,); the sum of the weights is 1.
        tolerance: of the objective.
        found: the sample from which these were selected.
    """

    values: dict[str, np.ndarray]
    objective: np.ndarray
    weights: np.ndarray
    tolerance: float
    found: EnsembleSample


# --- an ensemble in identification.json, in ensemble.csv, and as a section to read

QUANTILES: Final = (0.05, 0.5, 0.95)
#: Smallest correlation that is listed.
_WORTH: Final = 0.3


def ensemble_content(bodies: Bodies, space: Mapping[str, Free] = ALL) -> dict[str, Any]:
    """An ensemble for identification.json; parameters that share a value are represented by the first."""
    size = len(bodies.objective)
    shown = {free.names[0]: bodies.values[free.names[0]] for free in space.values()}
    content: dict[str, Any] = {
        "size": size,
        "tolerance": bodies.tolerance,
        "found": len(bodies.found.points),
        "effective_size": bodies.found.effective,
        "share_of_prior": bodies.found.share,
        "sweeps": bodies.found.sweeps,
        "better_than_default": int(np.sum(bodies.objective < bodies.objective[0])) if size else 0,
        "parameters": {
            free.names[0]: {"low": free.low, "high": free.high, "why": free.why, "names": list(free.names)}
            for free in space.values()
        },
    }
    if size:
        for name, column in shown.items():
            content["parameters"][name]["quantiles"] = quantiles(column, bodies.weights)
        content["correlations"] = correlations(shown, bodies.weights)
        content["bodies"] = {name: column.tolist() for name, column in bodies.values.items()} | {
            "objective": bodies.objective.tolist(),
            "weight": bodies.weights.tolist(),
        }
    return content


def quantiles(values: np.ndarray, weights: np.ndarray) -> list[float]:
    """The 5, 50 and 95 % quantiles of values (n,) with weights (n,)."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order]) - 0.5 * weights[order]
    return np.interp(QUANTILES, below / weights.sum(), values[order]).tolist()


def correlations(columns: Mapping[str, np.ndarray], weights: np.ndarray) -> dict[str, dict[str, float]]:
    """Weighted correlations of the logarithms between all columns."""
    logs = np.array([np.log(column) for column in columns.values()])
    away = logs - (logs @ weights / weights.sum())[:, None]
    covariance = (away * weights) @ away.T
    scale = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        matrix = covariance / np.outer(scale, scale)
    return {name: dict(zip(columns, row.tolist(), strict=True)) for name, row in zip(columns, matrix, strict=True)}


def csv_text(content: Mapping[str, Any]) -> str:
    """ensemble.csv: its origin, then one body per row; the best of the search comes first if it is one of them."""
    ensemble, settings = content["ensemble"], content["settings"]
    tried = sum(sweep["candidates"] for sweep in ensemble["sweeps"])
    units = {name: about.unit for name, about in quantities(ModelParameters)}
    options = " ".join(f"--{name} {value}" for name, value in settings.items())
    columns = ensemble["bodies"]
    about = (
        f"Bodies whose objective on the straight line, in the profile {settings['profile']}, is at most "
        f"{ensemble['tolerance']:g}; the first is the best found.",
        f"{ensemble['found']} of {tried} candidates were; these stand for them. Made by: nermo-mjx identify {options}",
        f"Engine {content['engine']}, MuJoCo {content['versions']['mujoco']}.",
        "Units: " + ", ".join(f"{name} {units[name]}" for name in columns if units.get(name, "1") != "1"),
    )
    forms = [{"objective": "{:.4f}", "weight": "{:.6f}"}.get(name, "{:.4g}") for name in columns]
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(form.format(value) for form, value in zip(forms, row, strict=True)) for row in rows]
    return "\n".join([*(f"# {line}" for line in about), ",".join(columns), *lines]) + "\n"


def ensemble_section(content: Mapping[str, Any]) -> str:
    """The ensemble's part of identification.md."""
    ensemble = content["ensemble"]
    if ensemble is None:
        return ""
    tried = sum(sweep["candidates"] for sweep in ensemble["sweeps"])
    text = texts("report")["ensemble"].format(tried=tried, **ensemble)
    if not ensemble["size"]:
        return f"{text}\nThere is no body to draw.\n\n"
    better = ensemble["better_than_default"]
    units = {name: about.unit for name, about in quantities(ModelParameters)}
    rows = []
    for name, about in ensemble["parameters"].items():
        unit = "" if units.get(name, "1") == "1" else f" [{units[name]}]"
        bounds = f"{about['low']:g} to {about['high']:g}"
        numbers = map(rounded, (*about["quantiles"], ensemble["bodies"][name][0]))
        rows.append([", ".join(about["names"]) + unit, *numbers, bounds, about["why"]])
    sweeps = [
        [
            str(i) if i else "even",
            str(sweep["candidates"]),
            f"{sweep['level']:.2f}" if i else MISSING,
            f"{sweep['acceptance']:.0%}",
        ]
        for i, sweep in enumerate(ensemble["sweeps"])
    ]
    names, matrix = list(ensemble["correlations"]), ensemble["correlations"]
    pairs = [(matrix[a][b], a, b) for i, a in enumerate(names) for b in names[:i] if abs(matrix[a][b]) > _WORTH]
    related = [f"{a} with {b} {value:+.2f}" for value, a, b in sorted(pairs, key=lambda pair: -abs(pair[0]))]
    return (
        text
        + "\n"
        + texts("report")["bodies"].format(
            **ensemble,
            better=f"{better or 'none'} of the others {'come' if better > 1 else 'comes'}",
            worth=_WORTH,
            related="; ".join(related) or "none",
            parameter_table=table(
                ["parameter", "5 %", "median", "95 %", "best", "bounds", "why these"], rows, "lrrrrll"
            ),
            sweep_table=table(
                ["sweep", "candidates", "begun from bodies within", "within the tolerance"], sweeps, "lrrr"
            ),
        )
        + "\n"
    )


# --- its figure: the distribution of each parameter within its bounds, and pairs

_BINS: Final = 12
_PANEL: Final = 1.42
#: Labels of parameters that share a value.
_SHORT: Final = {"damping.knee": "damping of\nknee, ankle"}


def ensemble_figure(content: Mapping[str, Any], profile: str) -> Figure:
    """Marginals on the diagonal, pairs below it; axes are the bounds, logarithmic.

    Args:
        content: `ensemble` of identification.json, with bodies.
        profile: that of the walks, in words.
    """
    names, bodies = list(content["parameters"]), content["bodies"]
    values = [np.asarray(bodies[name], float) for name in names]
    bounds = [(content["parameters"][name]["low"], content["parameters"][name]["high"]) for name in names]
    objective, weights = np.asarray(bodies["objective"], float), np.asarray(bodies["weight"], float)
    n, shades = len(names), Normalize(objective.min(), content["tolerance"])
    order = np.argsort(-objective, kind="stable")  # the best on top
    units = {name: about.unit for name, about in quantities(ModelParameters)}
    labels = [f"{_SHORT.get(name, name.replace('.', chr(10), 1))}\n[{units.get(name, '1')}]" for name in names]
    page = FigurePage("Bodies that walk as published within the tolerance", (_PANEL * n + 0.9, _PANEL * n + 0.9), n, n)
    for i, j in itertools.product(range(n), range(n)):
        ax: Axes = page.axes[i, j]
        if j > i:
            ax.set_axis_off()
        elif j == i:
            edges = np.geomspace(*bounds[i], _BINS + 1)
            shares, _ = np.histogram(np.clip(values[i], *bounds[i]), edges, weights=weights)
            ax.stairs(shares, edges, fill=True, color=BAND)
            ax.axhline(1 / _BINS, color=MUTED, lw=0.9)
            quantiles = content["parameters"][names[i]]["quantiles"]
            for each in (quantiles[0], quantiles[-1]):
                ax.axvline(each, color=LINE, ls="--", lw=1)
            ax.axvline(values[i][0], color=BEST, lw=1.6)
            ax.set_ylim(0, 1.12 * max(shares.max(), 1 / _BINS))
            ax.set_yticks([])
            ax.spines["left"].set_visible(False)
        else:
            ax.scatter(values[j][order], values[i][order], c=objective[order], s=7, lw=0, cmap=COLOURS, norm=shades)
            ax.plot(values[j][0], values[i][0], marker="+", ms=9, mew=1.6, color=BEST, clip_on=False)
            _scale(ax, bounds[i], "y")
        _scale(ax, bounds[j], "x")
        # Names at the left and at the bottom only.
        ax.tick_params(labelsize=SMALL - 1, labelbottom=i == n - 1, labelleft=j == 0 and i > 0)
        if i == n - 1:
            ax.set_xlabel(labels[j], fontsize=SMALL, color=INK)
            ax.tick_params(axis="x", rotation=45)
        if j == 0 and i > 0:
            ax.set_ylabel(labels[i], fontsize=SMALL, color=INK)
    page.figure.align_labels()
    place = page.axes[0, -1].inset_axes((-2.2, 0.6, 3.0, 0.13))  # in the empty corner, and ignored by the layout
    place.set_in_layout(False)
    bar = page.figure.colorbar(ScalarMappable(shades, COLOURS), cax=place, orientation="horizontal")
    bar.set_label("objective [1]", fontsize=SMALL)
    bar.outline.set_visible(False)
    handles = [
        Patch(color=BAND, label="share of the bodies"),
        Line2D([], [], color=LINE, ls="--", lw=1, label="5 and 95 %"),
        Line2D([], [], color=MUTED, lw=1, label="share in the prior"),
        Line2D([], [], color=BEST, marker="+", ms=9, mew=1.6, lw=1.6, label="best found"),
    ]
    return page.finish(handles, f"{content['size']} bodies, {profile}; an axis spans a parameter's bounds.")


def _scale(ax: Axes, bounds: tuple[float, float], axis: str) -> None:
    """A logarithmic axis over the bounds, with ticks at the bounds and a round value in between."""
    low, high = bounds
    middle = float(f"{np.sqrt(low * high):.{1 if high > 2 * low else 2}g}")
    along = ax.xaxis if axis == "x" else ax.yaxis
    ax.set(**{f"{axis}scale": "log", f"{axis}lim": (low, high)})
    along.set_major_locator(FixedLocator([low, middle, high]))
    along.set_major_formatter(FormatStrFormatter("%g"))
    along.set_minor_locator(NullLocator())
