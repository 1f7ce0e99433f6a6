"""Evaluation of a policy on unseen bodies and starts, compared with its controller without the policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from nermo_mjx.learn.environment import Environment
from nermo_mjx.learn.own import custom_code_file, custom_terminations
from nermo_mjx.learn.policy import Policy, RandomPolicy, load_policy
from nermo_mjx.learn.spec import Training
from nermo_mjx.learn.task import (
    EPISODE_PARAMETERS,
    POLICY_PARAMETERS,
    PUSH_PARAMETERS,
    Task,
    make_pushes,
    task_parameters,
)
from nermo_mjx.progress import shown_share
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError, identified
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.robot.scene import scene_name
from nermo_mjx.robot.terrains import terrain_values
from nermo_mjx.rollout import Run, RunResult, Setup, Simulator
from nermo_mjx.rollout.custom_metrics import OwnMetric
from nermo_mjx.rollout.simulator import default_precision
from nermo_mjx.runs.rows import Columns

#: Number that is added to the seed of a training, so that evaluations and training episodes have different keys.
EVALUATION_OFFSET: Final = 0x5EED
#: Names of policies without a file.
ZERO_POLICY, RANDOM_POLICY = "zero", "random"
#: Names of the evaluated walkers: the policy, and the controller without the policy.
POLICY, BASELINE = "policy", "alone"
#: Metrics in the table.
EVALUATION_METRICS: Final = (
    "speed",
    "distance",
    "lateral_drift",
    "cross_track_peak",
    "cost_of_transport",
    "electrical_cost_of_transport",
    "servo_work",
    "slip",
    "fell",
    "diverged",
)


class BodySample(NamedTuple):
    """A sample of bodies and starts: their number, and a number that is added to the seed of the training."""

    number: int
    key: int


class _Part(NamedTuple):
    """The walks of one walker on one scene."""

    scene: str
    walker: str
    bodies: Mapping[str, np.ndarray]
    result: RunResult
    success: np.ndarray


class PolicyEvaluator:
    """Simulates walks of a training's policies on an engine. All policies use the same compiled programs."""

    def __init__(self, training: Training, engine: str = "auto") -> None:
        self.training, self.engine = training, engine
        self._simulators: dict[tuple[str, str], Simulator] = {}

    # Long because one evaluation passes from the cases to the table.
    def __call__(
        self,
        policy: Policy,
        progress: Callable[[float], None] | None = None,
        *,
        draws: BodySample | None = None,
        walkers: tuple[str, ...] = (POLICY, BASELINE),
    ) -> pa.Table:
        """Simulate every scene of the evaluation, with and without the policy, from the same starts and bodies.

        Args:
            policy: Policy of the training.
            progress: Function that receives the completed share, in [0, 1].
            draws: Sample of bodies and starts; by default the sample of the training's evaluation.
            walkers: Walkers, a selection of `POLICY` and `BASELINE`.

        Returns:
            One row per walk: scene, controller, body, the sampled parameters, metrics, status, and success. A walk
            succeeds if it lasts, covers at least the distance required by the training's evaluation, stays in the
            corridor of its scene, and never meets a custom termination of the task while it is measured.
        """
        training = self.training
        draws = draws or BodySample(training.evaluation.bodies, EVALUATION_OFFSET)
        cases = [
            (setup, task, walker) for setup, task in training.evaluated() for walker in walkers
        ]
        parts: list[_Part] = []
        for i, (setup, task, walker) in enumerate(cases):
            ends = custom_terminations(setup.load().config, task.terminations)
            ending = tuple(
                OwnMetric(
                    "1",
                    "whether it ended",
                    None,
                    f"terminated_{name}",
                    _as_number(ends[name]),
                    "max",
                )
                for name in ends
            )
            walk_setup = _setup(setup, policy if walker == POLICY else None)
            walk_setup = dataclasses.replace(walk_setup, metrics=(*walk_setup.metrics, *ending))
            key = str(setup.scene), walker
            if key not in self._simulators:
                self._simulators[key] = Simulator(walk_setup, engine=self.engine)
            simulator = self._simulators[key]
            bodies = sample_bodies(training, task, draws)
            # The start position gives the batch its size, even if the simulator has none of the sampled parameters.
            values = {"start.x": 0.0} | _select_supported(simulator.setup, {**task.set, **bodies})
            values = {name: np.broadcast_to(value, draws.number) for name, value in values.items()}
            share = (
                None
                if progress is None
                else lambda fraction, i=i: progress((i + fraction) / len(cases))
            )
            policy_parameters = (
                walk_setup.make_controller().parameters if walker == POLICY else None
            )
            batch = simulator.prepare(values, training.run, policy_parameters)
            seeds = np.random.default_rng([training.seed, draws.key]).integers(
                1 << 24, size=draws.number
            )
            push = make_pushes({**task.set, **bodies}, seeds.astype(np.int32))
            push = default_precision(
                jax.tree.map(lambda leaf: np.broadcast_to(leaf, draws.number), push)
            )
            batch = dataclasses.replace(batch, params=dataclasses.replace(batch.params, push=push))
            with shown_share("walk", share) as tell:
                result = simulator.run_batch(batch, progress=tell)
            metrics = {name: np.asarray(column) for name, column in result.metrics.items()}
            well = (np.asarray(result.status) == "ok") & (
                metrics["distance"] >= training.evaluation.distance
            )
            if task.corridor is not None:
                well &= metrics["cross_track_peak"] <= task.corridor
            for world_index in ending:
                well &= metrics[world_index.name] == 0.0
            parts.append(_Part(scene_name(str(setup.scene)), walker, bodies, result, well))
        return _table(training, draws.number, parts)


def sample_bodies(training: Training, task: Task, draws: BodySample) -> dict[str, np.ndarray]:
    """Sample the parameters of unseen bodies and starts (n,), by name, from the ranges and the ensemble of the training.

    Each walk has its own random stream, as in a sweep, so that a larger sample begins with the smaller ones.
    """
    ranges, walks = task.randomize, range(draws.number)
    streams = (np.random.default_rng([training.seed, draws.key, walk]) for walk in walks)
    *shares, body = np.array([stream.random(len(ranges) + 1) for stream in streams]).T
    sampled = {
        name: low + share * (high - low)
        for (name, (low, high)), share in zip(ranges.items(), shares, strict=True)
    }
    key = jax.random.fold_in(jax.random.key(training.seed), draws.key)
    command_samples = (
        [task.sample(jax.random.fold_in(key, walk), jnp.inf) for walk in walks]
        if task.commands
        else []
    )
    for name in task.sampled:
        if name not in {*task.set, *ranges}:  # values and ranges of the evaluation take precedence
            sampled[name] = np.array([float(sample[name]) for sample in command_samples])
    if task.bodies:
        ensemble = identified.bodies(task.bodies)
        sampled |= ensemble.take(ensemble.at(body))
    return sampled


def record_walks(
    training: Training, policy: Policy, engine: str = "c"
) -> Iterator[tuple[str, Recording]]:
    """Record the policy's walk on each scene of a training's evaluation, with the first unseen body and start."""
    for setup, task in training.evaluated():
        walk_setup = _setup(setup, policy)
        simulator = Simulator(walk_setup, engine=engine)
        values = _select_supported(
            simulator.setup,
            {**task.set, **sample_bodies(training, task, BodySample(1, EVALUATION_OFFSET))},
        )
        yield (
            scene_name(str(setup.scene)),
            simulator.run(values, training.run, record=True).recording(),
        )


def played_task(
    training: Training,
    policy: str,
    *,
    scene: str | None = None,
    seconds: float | None = None,
    values: Mapping[str, float] | None = None,
) -> Recording:
    """Simulate a walk in the task of a training, with the first unseen body and start of its evaluation.

    Args:
        training: Training with the task.
        policy: File of a policy; or `zero`, a policy whose actions are zero, or `random`, see `RandomPolicy`.
        scene: Scene as in `Setup`; by default the first scene of the evaluation.
        seconds: Duration [s]; by default the duration of the evaluation.
        values: Values of parameters and commands, by name, which replace values and ranges of the task.

    Raises:
        ParameterError: The scene, policy or parameter does not exist, or the policy does not observe the command.
    """
    values, evaluation = values or {}, training.evaluation
    scenes = (scene or str(training.evaluated()[0][0].scene),)
    for name in values:
        if name.startswith("terrain.") and name not in terrain_values(scenes[0]):
            raise ParameterError(
                f"{name} is given, and {scene_name(scenes[0])!r} does not have it: leave it out."
            )
    evaluation = dataclasses.replace(evaluation, scenes=scenes, set={**evaluation.set, **values})
    run = training.run if seconds is None else Run(duration=seconds, warmup=0.0)
    training = dataclasses.replace(training, evaluation=evaluation, run=run)
    ((setup, task),) = training.evaluated()
    task.check(setup)
    if policy in (ZERO_POLICY, RANDOM_POLICY):
        environment = Environment(setup, worlds=1, task=task)
        walker = Policy.of(environment, training.algorithm.begin(environment, training.seed))
        walker = RandomPolicy(**vars(walker)) if policy == RANDOM_POLICY else walker
    else:
        walker = load_policy(policy, custom_code_file(training.task.observe))
    commands = walker.observer.commands
    is_delayed = bool(walker.observer.delayed)
    noisy = walker.observer.noisy
    declared = {f"command.{name}" for name in commands} | (
        {"sensing.delay"} if is_delayed else set()
    )
    for name in values:
        if name in PUSH_PARAMETERS:
            raise ParameterError(
                f"{name} is given, and a walk that is played is not pushed: push it in drive."
            )
        if (
            name in POLICY_PARAMETERS
            and name not in declared
            and not (noisy and name.endswith("_noise"))
        ):
            raise ParameterError(
                f"{name} is given, and the policy was not trained with it: leave it out."
            )
    return next(record_walks(training, walker))[1]


def _as_number(ends: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The function of a metric that is 1 while a termination is true."""
    return lambda sensors: jnp.asarray(ends(sensors), float)


def summarize_walks(table: pa.Table) -> dict[str, Any]:
    """Share of successes and medians over all walks, by scene, walker and metric."""
    names = (
        "scene",
        "controller",
        "success",
        "speed",
        "distance",
        "cost_of_transport",
        "electrical_cost_of_transport",
    )
    columns = {name: np.asarray(table.column(name).to_pylist()) for name in names}
    summary: dict[str, Any] = {}
    for scene in dict.fromkeys(columns["scene"].tolist()):
        for walker in dict.fromkeys(columns["controller"].tolist()):
            rows = (columns["scene"] == scene) & (columns["controller"] == walker)
            statistics = {"success": float(columns["success"][rows].mean())}
            statistics |= {
                name: float(np.nanmedian(columns[name][rows].astype(float))) for name in names[3:]
            }
            summary.setdefault(scene, {})[walker] = statistics
    return summary


def _setup(setup: Setup, policy: Policy | None) -> Setup:
    if policy is None:
        return setup
    options = (
        "robot",
        "scene",
        "tail",
        "routing",
        "cone",
        "physics",
        "timestep",
        "feet",
        "hinges",
        "metrics",
    )
    policy_setup = policy.upon(pilot=setup.pilot, waypoints=setup.waypoints)
    return Setup(**{name: getattr(setup, name) for name in options}, controller=policy_setup)


def _select_supported(setup: Setup, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values whose names a setup has; a controller without a policy has no commands and no sensor delay."""
    declarations = dict(quantities(setup.world({})))
    return {
        name: value
        for name, value in values.items()
        if name in declarations or name not in EPISODE_PARAMETERS
    }


def _table(training: Training, n: int, parts: list[_Part]) -> pa.Table:
    table, metrics = Columns(), training.metrics
    units = {
        name: declaration
        for setup, _ in training.evaluated()
        for name, declaration in task_parameters(setup).items()
    }

    scenes, walkers = (
        np.repeat(np.array([part[i] for part in parts], object), n) for i in range(2)
    )
    table.add("scene", scenes, "index", "1", "where it walks")
    table.add("controller", walkers, "index", "1", "the policy, or what it acts on alone")
    table.add("body", np.tile(np.arange(n), len(parts)), "index", "1", "which body and start")
    for name in dict.fromkeys(name for part in parts for name in part.bodies):
        values = np.concatenate([part.bodies.get(name, np.full(n, np.nan)) for part in parts])
        table.add(name, values, "randomized", units[name].unit, units[name].doc)
    for name in EVALUATION_METRICS:
        column = np.concatenate([np.asarray(part.result.metrics[name]) for part in parts])
        table.add(name, column, "metric", metrics[name].unit, metrics[name].doc)
    status = np.concatenate([np.asarray(part.result.status) for part in parts])
    table.add("status", status, "status", "1", "ok, or how the walk ended")
    success = np.concatenate([part.success for part in parts])
    table.add(
        "success",
        success,
        "status",
        "1",
        "whether it lasted, went far enough, and stayed in the corridor",
    )
    return table.table({"training": training.digest(), "engine": parts[0].result.engine})
