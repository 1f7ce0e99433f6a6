"""Numbers and tables of docs/gradients.md, as JSON.

python docs/answers/gradients.py slopes   # derivatives at points beside slopes as wide as a tuner's steps
python docs/answers/gradients.py costs    # of first and further gradients; needs an idle machine
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from model import STIFF

from nermo_mjx import Run, Setup, Simulator

ROOT = Path(__file__).parents[2]
GAITS = {"trot": 0.8, "walking_trot": 0.67, "lateral_walk": 0.67}
RUN = Run(cycles=4, warmup_cycles=1)
POINTS = 24
#: Amplitude [rad] and phase [rad]: where points are drawn, and the ranges of which widths are shares.
LOW, HIGH, RANGES = np.array([0.06, -np.pi]), np.array([0.34, np.pi]), np.array([0.4, 2 * np.pi])
#: Shares of the ranges to either side: for the derivative at a point, as in `Rollout` on MuJoCo C, and a tuner's step.
EXACT, WIDE = 1e-7, 0.02
HARD = {**STIFF, "build.tendon_impedance": 0.95}
#: Of a parabola over 1 % of the range: points along it, and places where it is fitted.
ALONG, PLACES = 21, 8


def speeds(gait: str, changed: dict[str, float]) -> Callable[[np.ndarray], np.ndarray]:
    """A function from amplitudes and phases (n, 2) to speeds (n,) [m/s]: loop in float64, solved to rounding."""
    simulator = Simulator(Setup(gait=gait, spine="stride_extension"), engine="c")
    simulator.engine.model.opt.tolerance = 1e-12

    def walked(points: np.ndarray) -> np.ndarray:
        amplitude, phase = points.T
        values = {
            "frequency": GAITS[gait],
            "spine.amplitude": amplitude,
            "spine.phase": phase,
            **changed,
        }
        return np.asarray(simulator.run(values, RUN).metrics["speed"], float)

    return walked


def cosines(
    speed: Callable[[np.ndarray], np.ndarray], points: np.ndarray
) -> tuple[np.ndarray, float]:
    """Cosine of derivative and wide slope at each point, and the mean speed [m/s]."""
    ends = [
        points + side * share * RANGES * np.eye(2)[k]
        for share in (EXACT, WIDE)
        for k in (0, 1)
        for side in (-1, 1)
    ]
    found = speed(np.concatenate(ends)).reshape(
        2, 2, 2, len(points)
    )  # share, parameter, side, point
    exact, wide = (found[:, :, 1] - found[:, :, 0]) / np.array([EXACT, WIDE])[:, None, None]
    lengths = np.linalg.norm(exact, axis=0) * np.linalg.norm(wide, axis=0)
    return (exact * wide).sum(axis=0) / lengths, float(found[1].mean())


def roughness(speed: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Root mean square of the speed off a parabola over 1 % of the range, by parameter and place (2 n,) [m/s]."""
    along = np.linspace(-0.005, 0.005, ALONG)
    lines = points[:, None, None] + along[:, None, None] * (
        RANGES * np.eye(2)
    )  # place, along, parameter, (2,)
    found = (
        speed(lines.reshape(-1, 2))
        .reshape(len(points), ALONG, 2)
        .transpose(0, 2, 1)
        .reshape(-1, ALONG)
    )
    fits = np.polynomial.polynomial.polyfit(along / 0.005, found.T, 2)
    left = found - np.polynomial.polynomial.polyval(along / 0.005, fits)
    return np.sqrt((left**2).mean(axis=1))


def slopes() -> dict[str, str]:
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(3)
    rows: dict[str, list[str]] = {
        "measure": [],
        "median cosine, share above 0.9": [],
        "the same with stiff soles and tendons": [],
        "worst, here and with stiff ones": [],
        "mean speed, here and with stiff ones [mm/s]": [],
    }
    told = {}
    for gait, frequency in GAITS.items():
        points = rng.uniform(LOW, HIGH, (POINTS, 2))
        (here, mean), (stiff, other) = (
            cosines(speeds(gait, changed), points) for changed in ({}, HARD)
        )
        cells = [f"{gait.replace('_', ' ')}, {frequency:g} Hz"]
        cells += [
            f"{np.median(each):.3f}, {(each > 0.9).sum()} of {POINTS}" for each in (here, stiff)
        ]
        cells += [f"{here.min():.2f}, {stiff.min():.2f}", f"{1e3 * mean:.1f}, {1e3 * other:.1f}"]
        for row, cell in zip(rows.values(), cells, strict=True):
            row.append(cell)
        if gait == "trot":
            rough = roughness(speeds(gait, {}), points[:PLACES])
            ends = {"rough": np.median(rough), "roughest": rough.max()}
            told = {
                f"slopes.{name}": f"{each:.1e}".replace("e-0", "e-") for name, each in ends.items()
            }
    lines = [f"| {title} | {' | '.join(cells)} |" for title, cells in rows.items()]
    lines.insert(1, "|---" * (1 + len(GAITS)) + "|")
    return {"slopes": "\n".join(lines)} | told


#: A first and a further gradient, in a fresh process; it prints processor seconds from its start, and of the second.
FIRST = """
import resource, time
import jax
from nermo_mjx import Rollout, Run, Setup
walk = Rollout(Setup(spine="stride_extension"), Run(cycles=4, warmup_cycles=1), engine="{engine}")
slope = jax.jit(jax.value_and_grad(lambda values: walk({{"frequency": 0.8, **values}})["speed"]))
def spent():
    return sum(getattr(resource.getrusage(resource.RUSAGE_SELF), name) for name in ("ru_utime", "ru_stime"))
values = {{name: jax.numpy.float32(value) for name, value in (("spine.amplitude", 0.2), ("spine.phase", -0.5))}}
jax.block_until_ready(slope(values))
first = spent()
jax.block_until_ready(slope({{**values, "spine.phase": jax.numpy.float32(-0.4)}}))
print(first, spent() - first, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
"""


def first(engine: str, cache: str) -> list[float]:
    """Processor seconds to the first gradient and of the next one, and memory [GB]."""
    env = os.environ | {"NERMO_MJX_CACHE": cache, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", FIRST.format(engine=engine)]
    done = subprocess.run(command, env=env, stdout=subprocess.PIPE, check=True)
    return [float(each) for each in done.stdout.split()]


def tuned(cache: str, out: str) -> tuple[float, float]:
    """Processor and wall seconds of the shipped tuning, from a cold start."""
    env = os.environ | {"NERMO_MJX_CACHE": cache, "PYTHONPATH": str(ROOT)}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "nermo_mjx", "tune", "sweeps/tune_speed.yaml", "--out", out]
    subprocess.run(
        command, cwd=ROOT, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (
        after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        time.perf_counter() - began,
    )


def costs() -> dict[str, str]:
    lines = [
        "| run | cold: start to the first value and gradient | compiled | each further |",
        "|---|---|---|---|",
    ]
    for engine, title in (("c", "engine `c`"), ("mjx", "engine `mjx`, reverse mode, float32")):
        with tempfile.TemporaryDirectory() as cache:
            cold, compiled = first(engine, cache), first(engine, cache)
        cells = [
            f"{each[0]:.{0 if each[0] > 20 else 1}f}, {each[2]:.1f} GB" for each in (cold, compiled)
        ]
        lines.append(f"| {title} | {' | '.join(cells)} | {compiled[1]:.1f} |")
    with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as out:
        processor, wall = tuned(cache, f"{out}/tuned")
    lines.append(
        f"| `nermo-mjx tune sweeps/tune_speed.yaml`, figures included | {processor:.0f}, in {wall:.0f} s | | |"
    )
    return {"costs": "\n".join(lines)}


if __name__ == "__main__":
    print(
        json.dumps({"slopes": slopes, "costs": costs}[sys.argv[1]](), indent=1, ensure_ascii=False)
    )
