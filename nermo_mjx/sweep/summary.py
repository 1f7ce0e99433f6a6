"""summary.json: what a sweep's table says in numbers. SI units and radians, as in the table."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from scipy import stats

from nermo_mjx.sweep.table import columns_of

#: Metrics with a better side, and which one it is.
OBJECTIVES = {
    "speed": "max",
    "cost_of_transport": "min",
    "servo_work": "min",
    "slip": "min",
    "roll_std": "min",
    "pitch_std": "min",
    "yaw_std": "min",
    "lateral_drift": "nearest zero",
}
#: The metric whose dependence on each parameter is summed up.
LEADING = "speed"


def summarize(table: pa.Table, chunks: Sequence[pa.Table]) -> dict[str, Any]:
    """The summary of a complete table; `chunks` carry the time that each part took."""
    frame = {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names}
    well = frame["status"] == "ok"
    varied, metrics = columns_of(table, "varied"), columns_of(table, "metric")
    variants = _variants(frame, well, varied, [name for name in metrics if frame[name].dtype == float])
    names, counts = np.unique(frame["status"], return_counts=True)
    grid = (table.schema.metadata or {}).get(b"sampler") == b"grid"
    return {
        "rows": table.num_rows,
        "variants": int(frame["variant"].max()) + 1,
        "repeats": int(frame["repeat"].max()) + 1,
        "status": dict(zip(names.tolist(), counts.tolist(), strict=True)),
        "metrics": {name: _spread(frame[name][well]) for name in metrics if name not in ("fell", "diverged")},
        "best": {name: _best(variants, name, side, varied) for name, side in OBJECTIVES.items() if name in metrics},
        "marginal_means": {name: _marginal(variants, name) for name in varied} if grid and LEADING in metrics else {},
        "rank_correlations": {} if LEADING not in metrics else _correlations(table, frame, well),
        "spine_gain": _spine_gain(variants, varied) if grid and LEADING in metrics else [],
        **_effort(chunks),
    }


def spine_ratio(table: pa.Table) -> dict[str, np.ndarray]:
    """How fast each variant walks relative to the stiff spine.

    Returns:
        One entry a variant with a run that went well: the varied parameters, `ratio` (speed over the mean speed at
        amplitude 0, all else but the spine's phase alike; nan without such a run), and `base` (that mean speed).
    """
    frame = {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names}
    varied = columns_of(table, "varied")
    variants = _variants(frame, frame["status"] == "ok", varied, [LEADING])
    ratio, base = _spine_ratio(variants, varied)
    return {**{name: variants[name] for name in varied}, "ratio": ratio, "base": base}


def to_json(summary: Mapping[str, Any]) -> bytes:
    """JSON text; what is not finite becomes null."""
    return (json.dumps(_finite(summary), indent=2, allow_nan=False) + "\n").encode()


def _variants(
    frame: Mapping[str, np.ndarray], well: np.ndarray, varied: Sequence[str], metrics: Sequence[str]
) -> dict[str, np.ndarray]:
    """Means over the repeats that went well, one entry a variant that has any; `<metric>` and `<metric>.std`."""
    variant, first, count = np.unique(frame["variant"][well], return_index=True, return_counts=True)
    place = np.searchsorted(variant, frame["variant"][well])
    result = {"variant": variant, "count": count, **{name: frame[name][well][first] for name in varied}}
    for name in metrics:
        values = frame[name][well]
        mean = np.bincount(place, values, len(variant)) / count
        squares = np.bincount(place, (values - mean[place]) ** 2, len(variant))
        result[name] = mean
        result[f"{name}.std"] = np.sqrt(squares / np.maximum(count - 1, 1))
    return result


def _spread(values: np.ndarray) -> dict[str, float]:
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    if not len(values):
        return {}
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "min": float(values.min()),
        "max": float(values.max()),
    }


def _best(variants: Mapping[str, np.ndarray], name: str, side: str, varied: Sequence[str]) -> dict[str, Any] | None:
    """The variant with the best mean over its repeats."""
    score = {"max": -variants[name], "min": variants[name], "nearest zero": np.abs(variants[name])}[side]
    if not np.isfinite(score).any():
        return None
    at = int(np.nanargmin(score))
    return {
        "side": side,
        "variant": int(variants["variant"][at]),
        "mean": float(variants[name][at]),
        "std": float(variants[f"{name}.std"][at]),
        "runs": int(variants["count"][at]),
        "parameters": {parameter: float(variants[parameter][at]) for parameter in varied},
    }


def _marginal(variants: Mapping[str, np.ndarray], name: str) -> list[dict[str, float]]:
    """Mean of the leading metric at each value of a parameter, over everything else."""
    return [
        {"value": float(value), LEADING: float(np.nanmean(variants[LEADING][variants[name] == value]))}
        for value in np.unique(variants[name])
    ]


def _correlations(table: pa.Table, frame: Mapping[str, np.ndarray], well: np.ndarray) -> dict[str, float]:
    """Spearman's rank correlation of the leading metric with each parameter."""
    result = {}
    for name in columns_of(table, "varied", "randomized"):
        x, y = frame[name][well], frame[LEADING][well]
        constant = len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0
        result[name] = math.nan if constant else float(stats.spearmanr(x, y).statistic)
    return result


def _spine_ratio(variants: Mapping[str, np.ndarray], varied: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Speed over speed at amplitude 0, all else but the spine's phase alike, and that speed at amplitude 0."""
    amplitude, speed = variants["spine.amplitude"], variants[LEADING]
    alike = [name for name in varied if name not in ("spine.amplitude", "spine.phase")]
    keys = list(zip(*(variants[name] for name in alike), strict=True)) if alike else [()] * len(speed)
    still: dict[tuple[float, ...], list[float]] = {key: [] for key in keys}
    for key, value in zip(keys, np.where(amplitude == 0, speed, math.nan).tolist(), strict=True):
        still[key] += [value] if math.isfinite(value) else []
    base = np.array([np.mean(still[key]) if still[key] else math.nan for key in keys])
    return speed / np.where(base > 0, base, math.nan), base


def _spine_gain(variants: Mapping[str, np.ndarray], varied: Sequence[str]) -> list[dict[str, Any]]:
    """Speed with the spine relative to the stiff spine; best and worst a frequency."""
    if "spine.amplitude" not in varied:
        return []
    speed = variants[LEADING]
    ratio, base = _spine_ratio(variants, varied)
    ratio = np.where(variants["spine.amplitude"] > 0, ratio, math.nan)
    lines = []
    for frequency in np.unique(variants["frequency"]) if "frequency" in varied else [None]:
        here = np.isfinite(ratio) & (True if frequency is None else variants["frequency"] == frequency)
        line: dict[str, Any] = {} if frequency is None else {"frequency": float(frequency)}
        for word, pick in (("best", np.argmax), ("worst", np.argmin)):
            if here.any():
                at = int(np.flatnonzero(here)[pick(ratio[here])])
                parameters = {name: float(variants[name][at]) for name in varied if name != "frequency"}
                line[word] = {
                    "ratio": float(ratio[at]),
                    "speed": float(speed[at]),
                    "speed_without": float(base[at]),
                    "parameters": parameters,
                }
        lines += [line] if here.any() else []
    return lines


def _effort(chunks: Sequence[pa.Table]) -> dict[str, Any]:
    """Engine, physics steps and the time they took, over all sessions."""
    notes = [chunk.schema.metadata or {} for chunk in chunks]
    steps, seconds = (sum(float(note[key]) for note in notes) for key in (b"steps", b"wall_seconds"))
    return {
        "engine": notes[0][b"engine"].decode(),
        "chunks": len(notes),
        "steps": int(steps),
        "wall_seconds": round(seconds, 3),
        "steps_per_second": round(steps / seconds, 1) if seconds else math.nan,
    }


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
