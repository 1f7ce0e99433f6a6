"""What tuning by gradient and CMA-ES find of a trot's best spine, against a dense sweep; a line of search.jsonl each.

    python docs/benchmarks/search.py --frequency 0.8

Amplitude and phase of the stride extension, for the speed over 6 gait cycles of which 2 are warm-up, on the engine `c`.
Dense: 21 x 24 points. `search`: 96 evaluations, in six batches of 16, with each of ten seeds, from the published gait.
`gradient`: what a tenth of the dense sweep's simulated time allows, gradients at their cost in runs, from an almost
stiff spine a quarter turn before and after the best phase.
"""

import json
import tempfile
import time
from pathlib import Path

import click
import numpy as np
from measuring import append, run_of

from nermo_mjx.optimize import run_search, run_tuning
from nermo_mjx.rollout import Run, Setup, Simulator

WALK = {"gait": "trot", "spine": "stride_extension", "run": {"cycles": 6, "warmup_cycles": 2}}
EVALUATIONS, BATCH, SEEDS = 96, 16, 10
#: Runs that a gradient in reverse mode costs, for the budget.
GRADIENT_COST = 5


def dense_sweep(simulator, frequency):
    """The best of a dense sweep: (amplitude [rad], phase [rad], speed [m/s], runs, seconds)."""
    amplitudes, phases = np.linspace(0.0, 0.4, 21), np.linspace(-np.pi, np.pi, 24, endpoint=False)
    points = np.stack(np.meshgrid(amplitudes, phases, indexing="ij"), axis=-1).reshape(-1, 2)
    values = {"frequency": np.full(len(points), frequency)}
    values |= {"spine.amplitude": points[:, 0], "spine.phase": points[:, 1]}
    began = time.perf_counter()
    result = simulator.run(values, Run(cycles=6, warmup_cycles=2))
    speeds = np.where(result.status == "ok", result.metrics["speed"], 0.0)
    best = points[speeds.argmax()]
    return (
        float(best[0]),
        float(best[1]),
        float(speeds.max()),
        len(points),
        time.perf_counter() - began,
    )


def searched(simulator, frequency, seed, dense):
    """A search of one seed: its best point, the run that reached 99 % of the dense sweep, and its wall time."""
    spec = {
        **WALK,
        "set": {"frequency": frequency},
        "objective": {"maximize": "speed"},
        "budget": EVALUATIONS,
        "vary": {
            "spine.amplitude": {"uniform": [0.0, 0.4]},
            "spine.phase": {"uniform": [-np.pi, np.pi]},
        },
        "batch": BATCH,
        "seed": seed,
        "plots": False,
    }
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = run_search(spec, folder, simulator=simulator)
        wall, table = time.perf_counter() - began, result.table
    well = np.array(table.column("status").to_pylist()) == "ok"
    speed = np.where(well, table.column("speed").to_numpy(), 0.0)
    reached = np.flatnonzero(np.maximum.accumulate(speed) >= 0.99 * dense)
    best = result.best
    return {
        "seed": seed,
        "amplitude": best["parameters"]["spine.amplitude"],
        "phase": best["parameters"]["spine.phase"],
        "speed": best["metrics"]["speed"],
        "share": best["metrics"]["speed"] / dense,
        "runs": len(speed),
        "runs_to_99": int(reached[0]) + 1 if len(reached) else None,
        "wall_s": wall,
        "first_share": speed[0] / dense,
    }


def tuned(frequency, phase, iterations, dense):
    """A tuning by gradient from an almost stiff spine: its best point, by its own and not the engine `c`'s speed."""
    spec = {
        **WALK,
        "set": {"frequency": frequency},
        "objective": [{"maximize": "speed", "scale": 0.1}],
        "tune": {
            "spine.amplitude": {"bounds": [0.0, 0.4], "start": 0.05},
            "spine.phase": {"bounds": [-np.pi, np.pi], "start": phase, "periodic": True},
        },
        "optimizer": {"name": "adam", "learning_rate": 0.5, "b1": 0.8, "b2": 0.9},
        "iterations": iterations,
        "plots": False,
    }
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        best = run_tuning(spec, folder).best
    speed = best["metrics"]["speed"]
    return {
        "search": "gradient",
        "start_phase": phase,
        "amplitude": best["parameters"]["spine.amplitude"],
        "phase": best["parameters"]["spine.phase"],
        "speed": speed,
        "share": speed / dense,
        "iterations": iterations,
        "wall_s": time.perf_counter() - began,
    }


@click.command(help=__doc__)
@click.option("--frequency", type=float, default=0.8, help="Of the trot [Hz].")
@click.option(
    "--gradient/--no-gradient", default=False, help="Also tune by gradient; compiles for minutes."
)
@click.option(
    "--into", type=click.Path(path_type=Path), default=Path(__file__).with_suffix(".jsonl")
)
def main(frequency, gradient, into):
    simulator = Simulator(Setup(spine="stride_extension"), "c")
    amplitude, phase, speed, runs, seconds = dense_sweep(simulator, frequency)
    line = {
        "case": "search",
        "frequency": frequency,
        "dense_runs": runs,
        "dense_s": seconds,
        "dense_speed": speed,
        "dense_amplitude": amplitude,
        "dense_phase": phase,
        "budget_runs": EVALUATIONS,
    }
    found = [searched(simulator, frequency, seed, speed) for seed in range(SEEDS)]
    line["median_share"] = float(np.median([each["share"] for each in found]))
    line["median_wall_s"] = float(np.median([each["wall_s"] for each in found]))
    line["published_share"] = found[0]["first_share"]
    iterations = int(0.1 * runs / GRADIENT_COST)
    turned = [
        float((phase + turn + np.pi) % (2 * np.pi) - np.pi) for turn in (np.pi / 2, -np.pi / 2)
    ]
    line["searches"] = found + [
        tuned(frequency, each, iterations, speed) for each in turned if gradient
    ]
    append(into, run_of([line]))
    print(json.dumps(line, indent=2))


if __name__ == "__main__":
    main()
