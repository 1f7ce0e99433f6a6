"""`nermo-mjx train`: train a policy."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.progress import Stages, duration

if TYPE_CHECKING:
    from nermo_mjx.learn.cost import Cost
    from nermo_mjx.learn.run import TrainingProgress, TrainingResult

EPILOG = """\b
Examples:
  nermo-mjx train sweeps/train_residual.yaml --out runs/walker
  nermo-mjx train sweeps/train_residual.yaml --out runs/walker --dry-run
  nermo-mjx train sweeps/train_residual.yaml --seed 1 --out runs/walker-1
"""


@click.command("train", epilog=EPILOG)
@click.argument("spec", metavar="SPEC.yaml", type=options.SPEC)
@options.out
@options.engine
@options.number("--steps", "Number of control steps, overriding the file.", click.IntRange(1))
@options.number("--worlds", "Number of parallel worlds, overriding the file.", click.IntRange(1, 1_000_000))
@options.number("--seed", "Seed, overriding the file.", click.IntRange(0, 2**32 - 1))
@click.option("--plots/--no-plots", default=None, help="Draw figures regardless of the file.")
@click.option("--onnx", is_flag=True, help="Also write policy.onnx; needs the extra onnx.")
@click.option("--tensorboard", is_flag=True, help="Log each iteration to TensorBoard, in DIR.")
@click.option("--dry-run", is_flag=True, help="Estimate the cost on this machine; write nothing.")
@options.accept_new_code
@options.report
def command(
    spec: Path, out: Path, engine: str, onnx: bool, tensorboard: bool, dry_run: bool, accept_new_code: bool,
    as_json: bool, quiet: bool, **chosen: Any,
) -> None:  # fmt: skip
    """Train a policy as described in a training file.

    Writes the policy, which walk and sweep files accept as a controller,
    learning curves, checkpoints, and an evaluation on unseen bodies to DIR.
    After Ctrl-C or a crash, run the same command again: it resumes, and
    ends with the same numbers. More steps extend a completed training.
    """
    with stdout_reserved():
        from nermo_mjx.learn.spec import Training, changed

        training = changed(Training.from_file(spec), **{key: each for key, each in chosen.items() if each is not None})
        if onnx:
            from nermo_mjx.learn.onnx import check_onnx

            check_onnx()
    if dry_run:
        with stdout_reserved():
            from nermo_mjx.learn.cost import cost_of

            cost = cost_of(training, engine)
        print_json({"cost": dataclasses.asdict(cost)}) if as_json else _print_cost(cost)
        return
    with stdout_reserved():
        from nermo_mjx.learn.run import run_training

        with Stages(quiet, compiles=lambda what: True) as stages:
            result = run_training(
                training, out, engine=engine, progress=lambda done: _show(stages, done), warn=stages.say,
                tensorboard=tensorboard, evaluating=lambda share: stages.share("evaluation", share),
                accept_new_code=accept_new_code,
            )  # fmt: skip
        exported = _export(result) if onnx else None
    if as_json:
        print_json({"out": result.out, **result.summary, "iterations_run": result.iterations_run,
                    "policy": result.policy, "onnx": exported, "plots": result.plots})  # fmt: skip
    elif not quiet:
        _print(result, exported)


def _show(stages: Stages, done: TrainingProgress) -> None:
    """Show the training's progress, and the results of its last episodes."""
    known = [f"{name} {done.numbers[name]:.3g}" for name in ("return", "reward")
             if math.isfinite(done.numbers.get(name, math.nan))]  # fmt: skip
    stages.part("train", "steps").share(
        min(1.0, done.steps / done.total), min(done.steps, done.total), done.total, ", ".join(known)
    )


def _export(result: TrainingResult) -> Path | None:
    from nermo_mjx.learn.onnx import export
    from nermo_mjx.learn.policy import load_policy
    from nermo_mjx.runs.files import replace_file

    if result.policy is None:
        return None
    path = result.policy.with_suffix(".onnx")
    replace_file(path, export(load_policy(result.policy)))
    return path


def _print(result: TrainingResult, exported: Path | None) -> None:
    summary = result.summary
    rows = []
    for scene, about in summary["scenes"].items():
        for who, called in (("policy", "policy"), ("alone", "controller alone")):
            numbers = about[who]
            rows.append([scene, called, f"{100 * numbers['success']:.0f}", f"{1e3 * numbers['speed']:.1f}",
                         f"{numbers['cost_of_transport']:.3g}"])  # fmt: skip
    if rows:
        columns = [("scene", "left"), ("walks", "left"), ("success [%]", "right"), ("speed [mm/s]", "right"),
                   ("cost of transport", "right")]  # fmt: skip
        print_table(f"On {result.training.evaluation.bodies:,} unseen bodies and starts", columns, rows)
    cpu = summary["environment_cpu"] + summary["learner_cpu"]
    click.echo(f"{summary['steps']:,} control steps, {duration(summary['simulated_seconds'])} simulated, in "
               f"{duration(summary['wall_seconds'])} ({duration(cpu)} of CPU time)")  # fmt: skip
    if result.training.validation:
        click.echo(f"policy after {summary['policy_steps']:,} steps, the best of all checkpoints in its walks")
    places = {"policy": result.policy, "onnx": exported, "history": result.out / "history.parquet"}
    for name, path in places.items():
        if path is not None:
            click.echo(f"{name:<8}{path}")
    if result.plots:
        click.echo(f"plots   {result.out / 'plots'}")


def _print_cost(cost: Cost) -> None:
    click.echo(f"{cost.iterations:,} iterations of {cost.steps_per_iteration:,} control steps, {cost.steps:,} in all")
    time = f"about {duration(cost.wall_seconds)} here" if math.isfinite(cost.wall_seconds) else "for an unknown time"
    click.echo(f"{duration(cost.simulated_seconds)} simulated; {time} on the engine {cost.engine}, and "
               f"{cost.disk_bytes / 1e6:.3g} MB on disk")  # fmt: skip
    click.echo(cost.rate_from)
