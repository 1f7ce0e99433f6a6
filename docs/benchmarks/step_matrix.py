"""Reverse mode through the steps of many models, each in a separate process: `python docs/benchmarks/step_matrix.py`.

Each model has three parts, from a state with contacts: `gradient`, the gradient of five steps in float64 against
central differences; `float32`, its cosine with that of float32, and its cost; and `plain`, the result of `mjx.step`.
One line of JSON per part; parts that have a line are skipped, so that an interrupted run resumes where it was.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

import click
import jax
import mujoco
import numpy as np
from step_models import installed_models, load, models_below, touching

from nermo_mjx.bench import machine_description
from nermo_mjx.dynamics.checking import (
    DIFFERENCE_WIDTHS,
    Trial,
    compare_gradient,
    distance,
    moved_entries,
    trial,
)
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.runtime import compiler_options

STEPS: Final = 5
#: Calls per timing, and number of timings.
CALLS: Final = 10
ROUNDS: Final = 5
#: Compilation is three times as fast on a CPU; the programs take about twice as long.
PLAIN_CODE: Final = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def measure(
    path: Path, part: str, found: dict[str, Any], optimized: bool = False
) -> dict[str, Any]:
    """The figures of one part of a model's line.

    Args:
        path: an MJCF file.
        part: one of `PARTS`.
        found: figures of `gradient`, for the other parts.
        optimized: whether programs are compiled as for users; times are not meaningful otherwise.
    """
    options = dict(compiler_options()) | ({} if optimized else PLAIN_CODE)
    model = load(path)
    mjx.put_model(model)
    figures = PARTS[part](model, touching(model, STEPS), found, options)
    return figures | {"optimized": optimized, "cpu_s": time.process_time()}


def _gradient(
    model: mujoco.MjModel, data: mujoco.MjData, _: Any, options: dict[str, Any]
) -> dict[str, Any]:
    figures = {
        "nv": model.nv,
        "contacts": data.ncon,
        "rows": data.nefc,
        "start_s": data.time,
        "steps": STEPS,
        "cone": mujoco.mjtCone(model.opt.cone).name[7:].lower(),
        "integrator": mujoco.mjtIntegrator(model.opt.integrator).name[6:].lower(),
    }
    with jax.enable_x64(True):
        run = trial(model, data, STEPS)
        program = _Program(jax.value_and_grad(run.value, has_aux=True), run, options)
        _, slopes = program(run.zero)
        check = compare_gradient(run, slopes, lambda point: program(point)[0])
    return figures | {
        "finite": check.is_finite,
        "error": check.error,
        "spread": check.spread,
        "width": DIFFERENCE_WIDTHS[check.chosen],
        "errors": check.errors,
        "end_off_c": _off(model, data, check.end),
        "group": check.group.tolist(),
        "gradient": _rounded(check.gradient),
        "differences": _rounded(check.differences[check.chosen]),
    }


def _float32(
    model: mujoco.MjModel, data: mujoco.MjData, found: dict[str, Any], options: dict[str, Any]
) -> dict[str, Any]:
    with jax.enable_x64(False):
        run = trial(model, data, STEPS)
        value = _Program(run.value, run, options)
        gradient = _Program(jax.value_and_grad(run.value, has_aux=True), run, options)
        slopes = moved_entries(gradient(run.zero)[1])
    return {
        "cosine": _cosine(slopes.astype(float), np.array(found["gradient"])),
        "trace_s": gradient.trace_s,
        "compile_s": gradient.compile_s,
        "forward_ms": 1e3 * value.seconds / STEPS,
        "ratio": gradient.seconds / value.seconds,
    }


def _plain(
    model: mujoco.MjModel, data: mujoco.MjData, found: dict[str, Any], options: dict[str, Any]
) -> dict[str, Any]:
    """The error of the gradient of `mjx.step` against the same differences, or why it has none."""
    with jax.enable_x64(True):
        run = trial(model, data, STEPS, mjx)
        try:
            slopes = _Program(jax.grad(lambda point: run.value(point)[0]), run, options)(run.zero)
        except ValueError as error:
            if "while_loop" not in str(error):
                raise
            return {"plain": "refuses: while_loop"}
    one = moved_entries(slopes)
    finite = bool(np.isfinite(one).all())
    return {
        "plain": distance(np.array(found["group"]), one, np.array(found["differences"]))
        if finite
        else "NaN"
    }


#: The function that measures each part.
PARTS: Final = {"gradient": _gradient, "float32": _float32, "plain": _plain}


class _Program:
    """A compiled function of a trial's point, and its compile times."""

    def __init__(self, function: Any, run: Trial, options: dict[str, Any]) -> None:
        start = time.process_time()
        lowered = jax.jit(function, compiler_options=options).lower(run.zero)
        traced = time.process_time()
        self._program = lowered.compile()
        self.trace_s, self.compile_s = traced - start, time.process_time() - traced
        self._zero = run.zero

    def __call__(self, point: Any) -> Any:
        return self._program(point)

    @property
    def seconds(self) -> float:
        """Processor time of a call, the minimum of several."""
        taken = []
        for _ in range(ROUNDS):
            start = time.process_time()
            for _ in range(CALLS):
                jax.block_until_ready(self._program(self._zero))
            taken.append((time.process_time() - start) / CALLS)
        return min(taken)


def _off(model: mujoco.MjModel, data: mujoco.MjData, end: np.ndarray) -> float:
    """Largest difference of the last state from that of MuJoCo C, whose solver also runs to convergence."""
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 200, 200, 0.0
    data.qacc_warmstart[:] = 0.0
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    return float(np.abs(np.concatenate([data.qpos, data.qvel]) - end).max(initial=0.0))


def _cosine(one: np.ndarray, other: np.ndarray) -> float | None:
    """Cosine of two gradients; None if one of them vanishes or is not finite."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other / size) if size > 0.0 and np.isfinite(size) else None


def _rounded(array: np.ndarray) -> list[float]:
    return [float(f"{each:.10g}") for each in array]


def lines_of(file: Path) -> dict[str, dict[str, Any]]:
    """Model -> its figures, of all its parts."""
    found: dict[str, dict[str, Any]] = {}
    for line in file.read_text().splitlines() if file.exists() else ():
        figures = json.loads(line)
        entry = found.setdefault(figures["model"], {"parts": []})
        entry["parts"].append(figures.pop("part"))
        entry.update(figures)
    return found


@click.command()
@click.argument("models", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--into",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("step.jsonl"),
    show_default=True,
    help="File that lines are added to.",
)
@click.option(
    "--part",
    "parts",
    type=click.Choice(list(PARTS)),
    multiple=True,
    help="Repeatable; all by default.",
)
@click.option("--only", multiple=True, help="Part of a model's name; repeatable.")
@click.option("--prefix", default="", help="What the names of MODELS begin with.")
@click.option(
    "--limit", type=float, default=900.0, show_default=True, help="Longest time for one part [s]."
)
@click.option(
    "--optimized",
    is_flag=True,
    help="Compile as for a user, three times as long; for figures of time.",
)
def main(
    models: tuple[Path, ...],
    into: Path,
    parts: tuple[str, ...],
    only: tuple[str, ...],
    prefix: str,
    limit: float,
    optimized: bool,
) -> None:
    """Check the gradient through MODELS, MJCF files or directories of them.

    Without MODELS: those that come with mujoco-mjx, and with playground if it is installed. Parts with a line in the
    file are skipped; the parts run one after the other, each with small models first.
    """
    found = (
        [each for root in models for each in models_below(root, prefix)]
        if models
        else list(installed_models())
    )
    chosen = sorted(
        ((name, path) for name, path in found if not only or any(each in name for each in only)),
        key=lambda each: _size(each[1]),
    )
    for part in [each for each in PARTS if each in (parts or PARTS)]:
        for name, path in chosen:
            before = lines_of(into).get(name, {"parts": []})
            if (
                part in before["parts"]
                or "failed" in before
                or (part != "gradient" and "gradient" not in before)
            ):
                continue
            click.echo(f"{part} {name}", err=True)
            line = {"model": name, "part": part, **_apart(path, part, before, limit, optimized)}
            with into.open("a") as file:
                file.write(json.dumps(line) + "\n")


def _size(path: Path) -> int:
    try:
        return int(load(path).nv)
    except ValueError:
        return 0


def _apart(
    path: Path, part: str, before: dict[str, Any], limit: float, optimized: bool
) -> dict[str, Any]:
    """The figures of one part, from a separate process, or `failed`, a sentence."""
    given = json.dumps(
        [str(path), part, {name: before.get(name) for name in ("group", "gradient", "differences")}]
    )
    where = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); "
    code = f"{where}from step_matrix import report; report({given!r}, {optimized})"
    try:
        ended = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"no end within {limit:g} s"}
    if ended.returncode:
        return {"failed": f"the process ended with {ended.returncode}"}
    return dict(json.loads(ended.stdout.splitlines()[-1]))


def report(given: str, optimized: bool) -> None:
    """Print the figures of a part, or the reason for their absence; see `_apart`."""
    path, part, found = json.loads(given)
    try:
        figures = measure(Path(path), part, found, optimized)
        if part == "gradient":
            figures |= machine_description()
    except Exception as error:  # whatever MuJoCo or MJX raise for a model
        sentence = " ".join(f"{type(error).__name__}: {error}".split())
        figures = {
            "failed": re.sub(r"'[^']*/([^/']+)'", r"'\1'", sentence)[:200]
        }  # a file's name, not its path
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
