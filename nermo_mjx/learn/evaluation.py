"""Evaluation of a policy on unseen bodies and starts, beside the controller that it acts on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from nermo_mjx.learn.environment import Environment
from nermo_mjx.learn.own import code_place, own_terminations
from nermo_mjx.learn.policy import Policy, RandomPolicy, load_policy
from nermo_mjx.learn.spec import Training
from nermo_mjx.learn.task import (
    EPISODE_PARAMETERS,
    POLICY_PARAMETERS,
    PUSH_PARAMETERS,
    Task,
    pushes_of,
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

#: Added to a training's seed, so that no training episode was drawn from such a key.
EVALUATION_OFFSET: Final = 0x5EED
#: Policies without a file.
ZERO_POLICY, RANDOM_POLICY = "zero", "random"
#: What is evaluated: the policy, and the controller that it acts on.
POLICY, BASELINE = "policy", "alone"
#: Metrics of the table.
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


class Draws(NamedTuple):
    """How many bodies and starts are drawn, and a number added to the training's seed."""

    number: int
    key: int


class _Part(NamedTuple):
    """The walks of one scene by one of the two."""

    scene: str
    who: str
    drawn: Mapping[str, np.ndarray]
    result: RunResult
    success: np.ndarray


class PolicyEvaluator:
    """Walks of a training's policies on an engine; a policy that comes later needs no new programs."""

    def __init__(self, training: Training, engine: str = "auto") -> None:
        self.training, self.engine = training, engine
        self._simulators: dict[tuple[str, str], Simulator] = {}

    # Long because one evaluation passes from the cases to the table.
    def __call__(
        self,
        policy: Policy,
        progress: Callable[[float], None] | None = None,
        *,
        draws: Draws | None = None,
        walkers: tuple[str, ...] = (POLICY, BASELINE),
    ) -> pa.Table:
        """Simulate every evaluation scene, with the policy and the controller alone, from the same starts and bodies.

        Args:
            policy: of the training.
            progress: called with the share done.
            draws: of bodies and starts; by default those of the training's evaluation.
            walkers: of `POLICY` and `BASELINE`.

        Returns:
            One row per walk: scene, controller, body, the drawn parameters, metrics, status, and whether it was a
            success: it lasted, covered at least the distance required by the training's evaluation, stayed in its
            scene's corridor, and none of the task's own terminations was true while it was measured.
        """
        training = self.training
        draws = draws or Draws(training.evaluation.bodies, EVALUATION_OFFSET)
        cases = [
            (setup, task, walker) for setup, task in training.evaluated() for walker in walkers
        ]
        parts: list[_Part] = []
        for i, (setup, task, walker) in enumerate(cases):
            ends = own_terminations(setup.load().config, task.terminations)
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
            bodies = unseen_bodies(training, task, draws)
            # As many walks where nothing that the simulator knows is drawn.
            values = {"start.x": 0.0} | _known(simulator.setup, {**task.set, **bodies})
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
            push = pushes_of({**task.set, **bodies}, seeds.astype(np.int32))
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


def unseen_bodies(training: Training, task: Task, draws: Draws) -> dict[str, np.ndarray]:
    """Parameters of the unseen bodies and starts (n,): from the ranges and the ensemble of the training.

    Each walk has a stream of its own, as in a sweep, so that more walks begin with those of fewer.
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
        if name not in {*task.set, *ranges}:  # where the evaluation says otherwise
            sampled[name] = np.array([float(sample[name]) for sample in command_samples])
    if task.bodies:
        ensemble = identified.bodies(task.bodies)
        sampled |= ensemble.take(ensemble.at(body))
    return sampled


def recorded(
    training: Training, policy: Policy, engine: str = "c"
) -> Iterator[tuple[str, Recording]]:
    """Each scene of a training's evaluation, and the policy's walk on its first unseen body from its first start."""
    for setup, task in training.evaluated():
        walk_setup = _setup(setup, policy)
        simulator = Simulator(walk_setup, engine=engine)
        values = _known(
            simulator.setup,
            {**task.set, **unseen_bodies(training, task, Draws(1, EVALUATION_OFFSET))},
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
    """A walk in the task of a training, of its evaluation's first unseen body from its first start.

    Args:
        training: of the task.
        policy: a policy's file; or `zero`, which never acts, or `random`, see `RandomPolicy`.
        scene: as in `Setup`; by default the first of the evaluation.
        seconds: how long; by default as in the evaluation.
        values: of parameters and commands, by name, instead of what the task sets and draws.

    Raises:
        ParameterError: there is no such scene, policy or value there, or the policy is not told a command.
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
        acting = Policy.of(environment, training.algorithm.begin(environment, training.seed))
        acting = RandomPolicy(**vars(acting)) if policy == RANDOM_POLICY else acting
    else:
        acting = load_policy(policy, code_place(training.task.observe))
    commands = acting.observer.commands
    is_delayed = bool(acting.observer.delayed)
    noisy = acting.observer.noisy
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
    return next(recorded(training, acting))[1]


def _as_number(ends: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A termination as a metric's function."""
    return lambda sensors: jnp.asarray(ends(sensors), float)


def summary_of(table: pa.Table) -> dict[str, Any]:
    """Share of successes and medians over all walks, for each scene and each of the two: scene -> who -> numbers."""
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


def _known(setup: Setup, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that a setup has a name for: a controller alone is not commanded, and has no late sensors."""
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
    for name in dict.fromkeys(name for part in parts for name in part.drawn):
        values = np.concatenate([part.drawn.get(name, np.full(n, np.nan)) for part in parts])
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
