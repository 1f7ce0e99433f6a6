"""Time to a good policy: success and speed of the best policy so far, over wall time from the command's first second.

    python docs/benchmarks/policy_in_a_minute.py SPEC.yaml --seeds 5 --faster 1.5 --out DIR

Each seed is one `nermo-mjx train` in a process of its own, start and compiling included. Whenever it writes a policy,
that policy is set aside with its time; when the process has ended, each walks on the bodies and starts of the
training's evaluation, beside the controller alone. A walk counts if it succeeds and is `--faster` times as fast as the
controller alone on the same body from the same start. Programs are compiled before, by a short training without times.
A policy's time is when it was written: of a training that `until` did not end (`reached` is false), the best one's.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd

from nermo_mjx.learn import Training, load_policy
from nermo_mjx.learn.evaluation import BASELINE, POLICY, PolicyEvaluator
from nermo_mjx.learn.spec import changed


def trained(spec: Path, seed: int, out: Path, *more: str) -> list[tuple[float, float, Path]]:
    """Train; wall time [s] and processor time [s] at which each policy was written, and its file."""
    out.mkdir(parents=True)
    found: list[tuple[float, float, Path]] = []
    command = [
        sys.executable,
        "-m",
        "nermo_mjx",
        "train",
        spec,
        "--seed",
        str(seed),
        "--out",
        out / "run",
        "--quiet",
    ]
    began = time.time()
    process = subprocess.Popen([*command, *more])
    held = out / "run" / "policy.npz"
    ended = None
    while ended is None:
        time.sleep(0.02)
        ended = process.poll()  # before the file is looked at: what it wrote last is not missed
        written = held.stat().st_mtime - began if held.exists() else 0.0
        if written and (not found or held.read_bytes() != found[-1][2].read_bytes()):
            found.append(
                (
                    written,
                    cpu_seconds(process.pid),
                    Path(shutil.copy(held, out / f"policy-{len(found)}.npz")),
                )
            )
    if ended:
        raise SystemExit(f"the training of seed {seed} failed with exit code {ended}")
    return found


def cpu_seconds(pid: int) -> float:
    """Processor time of a process so far [s], as Linux tells it; NaN once it has gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / 100.0


def judged(
    evaluator: PolicyEvaluator, path: Path, alone: pd.DataFrame, faster: float
) -> dict[str, float]:
    """Share of walks that count where fewest do, median speed [m/s], and how much faster it is, 5 % and median."""
    policy = load_policy(path)
    walks = evaluator(policy, walkers=(POLICY,)).to_pandas()
    gain = walks.speed / alone.speed
    counts = walks.success & (gain >= faster)
    return {
        "steps": policy.about["trained"]["steps"],
        "share": counts.groupby(walks.scene).mean().min(),
        "success": walks.success.groupby(walks.scene).mean().min(),
        "speed": walks.speed.median(),
        "gain_5_percent": gain.quantile(0.05),
        "gain": gain.median(),
    }


def drawn(rows: pd.DataFrame, file: Path) -> None:
    """The curve of each seed: a policy counts from when it was written to the next one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    for seed, one in rows.groupby("seed"):
        for ax, name, factor in ((above, "share", 100.0), (below, "speed", 1e3)):
            ax.step(
                one.wall_seconds, factor * one[name], where="post", marker=".", label=f"seed {seed}"
            )
    above.set(ylabel="walks that count [%]", ylim=(-3, 103))
    below.set(ylabel="median speed [mm/s]", xlabel="wall time from the command's first second [s]")
    below.legend(frameon=False, ncols=3)
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("spec", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--faster", type=float, default=1.5)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    trained(given.spec, given.first, given.out / "warm", "--steps", "1")
    rows, reached = [], []
    for seed in range(given.first, given.first + given.seeds):
        policies = trained(given.spec, seed, given.out / f"seed-{seed}")
        evaluator = PolicyEvaluator(changed(Training.from_file(given.spec), seed=seed))
        alone = evaluator(load_policy(policies[0][2]), walkers=(BASELINE,)).to_pandas()
        for wall, cpu, path in policies:
            about = judged(evaluator, path, alone, given.faster)
            rows.append({"seed": seed, "wall_seconds": wall, "cpu_seconds": cpu, **about})
            print({name: float(np.round(value, 4)) for name, value in rows[-1].items()}, flush=True)
        tried = pd.read_parquet(given.out / f"seed-{seed}" / "run" / "validation.parquet").drop(
            columns="steps"
        )
        until = evaluator.training.until
        reached.append(until is not None and bool(tried.min(axis=1).max() >= until.success))
        # What there is so far stays if a later seed is stopped.
        pd.DataFrame(rows).to_csv(given.out / "policies.csv", index=False, float_format="%.5g")
    table = pd.DataFrame(rows)
    ends = table.groupby("seed").last()
    summary = {
        "spec": given.spec.name,
        "faster": given.faster,
        "seeds": given.seeds,
        "wall_seconds": ends.wall_seconds.tolist(),
        "median_wall_seconds": ends.wall_seconds.median(),
        "share": ends.share.tolist(),
        "least_share": ends.share.min(),
        "gain": ends.gain.tolist(),
        "reached": reached,
    }
    (given.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    drawn(table, given.out / "policies.png")
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
