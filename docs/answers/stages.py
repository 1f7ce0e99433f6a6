"""Where the time of a physics step goes, and what other settings of it cost and give, for docs/benchmarks/physics.md.

    python docs/answers/stages.py      # JSON

Stages are of `docs/benchmarks/profile_step.py`. A setting walks the 24 walks of `presets.py` in MuJoCo C, its
processor time between those of the preset `reference`.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from presets import GAIT_METRICS, GAITS, RUN, changes, percent

from nermo_mjx import Setup, Simulator
from nermo_mjx.control.parameters import published_values

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from profile_step import profile

#: Stages that a row of the table adds up, by their names in C and MJX.
STAGES = {
    "solver": ("solver",),
    "sensors, and in C all without a timer": ("sensors", "sensors and other"),
    "tendons": ("tendons",),
    "kinematics": ("kinematics",),
    "inertia, collision, constraint rows, velocity, forces, integration": (
        *("inertia", "collision", "constraint", "velocity", "forces", "integration"),
    ),
}
Change = Callable[[mujoco.MjModel], None]
ROUNDS = 2


def option(**values: Any) -> Change:
    """Set MuJoCo's options of a model."""

    def change(model: mujoco.MjModel) -> None:
        for name, value in values.items():
            setattr(model.opt, name, value)

    return change


def same(model: mujoco.MjModel) -> None:
    """Change nothing."""


#: What is changed, by its name: fields of the set-up, and options of MuJoCo.
SETTINGS: dict[str, tuple[dict[str, Any], Change]] = {
    "dense Jacobians": ({}, option(jacobian=mujoco.mjtJacobian.mjJAC_DENSE)),
    "preset `fast`": ({"physics": "fast"}, same),
    "steps of 5 ms": ({"timestep": 0.005}, same),
    "steps of 1 ms": ({"timestep": 0.001}, same),
    "`implicitfast`, steps of 10/3 ms": (
        {"timestep": 0.01 / 3},
        option(integrator=mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
    ),
    "RK4": ({}, option(integrator=mujoco.mjtIntegrator.mjINT_RK4)),
    "a tolerance of 1e-4": ({}, option(tolerance=1e-4)),
    "at most 2 iterations": ({}, option(iterations=2)),
    "CG": ({}, option(solver=mujoco.mjtSolver.mjSOL_CG)),
    "a pyramidal cone": ({"cone": "pyramidal"}, same),
    "an articulated tail": ({"tail": "articulated"}, same),
}
#: Much shorter steps, solved to rounding: what all others are compared with, too.
TRUTH = ({"timestep": 0.00025}, option(tolerance=1e-12, iterations=200))

Metrics = dict[str, np.ndarray]


def walked(setup: dict[str, Any], change: Change) -> Callable[[], tuple[Metrics, int]]:
    """A function that walks every gait, frequency and turn rate without and with the spine: metrics, and how many fell.

    It is compiled.
    """
    rows = [
        published_values(gait, steering="mix") | {"frequency": frequency, "pilot.turn_rate": turn}
        for gait in GAITS
        for frequency in (0.5, 0.8)
        for turn in (0.0, 0.7)
    ]
    values = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    simulators = [
        Simulator(Setup(pilot="open_loop", spine=spine, **setup), engine="c")
        for spine in ("none", "stride_extension")
    ]
    for each in simulators:
        change(each.engine.model)

    def walk() -> tuple[Metrics, int]:
        results = [each.run(values, RUN) for each in simulators]
        fell = sum(int((each.status != "ok").sum()) for each in results)
        return {
            name: np.concatenate([each.metrics[name] for each in results]) for name in GAIT_METRICS
        }, fell

    walk()
    return walk


def timed(walk: Callable[[], tuple[Metrics, int]]) -> tuple[float, tuple[Metrics, int]]:
    """Processor seconds of the walks, and what they give."""
    began = time.process_time()
    found = walk()
    return time.process_time() - began, found


def errors(found: Metrics, reference: Metrics) -> str:
    """Median and largest relative change of all metrics, two cells; walks that fell in either are left out."""
    each = changes(found, reference, GAIT_METRICS)
    return " | ".join(percent(of(each[np.isfinite(each)])) for of in (np.median, np.max))


def settings() -> dict[str, str]:
    plain = walked({}, same)
    reference, _ = plain()
    lines = ["| change | speed | median error | largest error |", "|---|--:|--:|--:|"]
    for name, (setup, change) in SETTINGS.items():
        other = walked(setup, change)
        ratios = []
        for _ in range(ROUNDS):
            base, (took, (found, fell)) = timed(plain)[0], timed(other)
            ratios.append(base / took)
        told = f"{name}; {fell} of 24 fall" if fell else name
        lines.append(f"| {told} | {statistics.median(ratios):.2f} | {errors(found, reference)} |")
    truth, _ = walked(*TRUTH)()
    fast, _ = walked(*SETTINGS["preset `fast`"])()
    against = {"reference": reference, "fast": fast}
    told = {name: changes(each, truth, GAIT_METRICS) for name, each in against.items()}
    return {"stages.settings": "\n".join(lines)} | {
        f"stages.{name}_{what}": percent(of(each))
        for name, each in told.items()
        for what, of in (("median", np.median), ("largest", np.max))
    }


def stages() -> str:
    """The table of both engines' stages."""
    found = {
        engine: {row["stage"]: row for row in profile(engine)["stages"]} for engine in ("c", "mjx")
    }
    lines = ["| stage | `c` [µs] | share | `mjx` share | compile [s] |", "|---|--:|--:|--:|--:|"]
    for title, names in STAGES.items():
        of = {
            engine: [rows[name] for name in names if name in rows] for engine, rows in found.items()
        }
        us, share = (sum(row[what] for row in of["c"]) for what in ("us", "share"))
        there, compiling = (sum(row[what] for row in of["mjx"]) for what in ("share", "compile_s"))
        lines.append(
            f"| {title} | {us:.1f} | {100 * share:.0f} % | {100 * there:.0f} % | {compiling:.1f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(json.dumps(settings() | {"stages": stages()}, indent=1, ensure_ascii=False))
