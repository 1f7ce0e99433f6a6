"""Run a training: resume from the directory's latest checkpoint, learn for the given steps, evaluate the policy.

The result is the policy of the last checkpoint or, with `validation`, the best of all checkpoints in walks that differ
from the training and the evaluation. The criterion is the success on the scene with the least success, as in a training's
summary; the mean decides between equal policies. The untrained policy, which does not change the controller, is the
first candidate, so that a training whose corrections are harmful does not replace it. With `until`, the training ends
when such a policy is good enough; then a walk must also be fast enough to count as a success.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nermo_mjx.learn.directory import (
    EVALUATION_FILE,
    POLICY_FILE,
    SPEC_FILE,
    SUMMARY_FILE,
    Curves,
    TrainingDirectory,
)
from nermo_mjx.learn.environment import Environment, Mixture
from nermo_mjx.learn.evaluation import (
    POLICY,
    BodySample,
    PolicyEvaluator,
    record_walks,
    summarize_walks,
)
from nermo_mjx.learn.experience import RESET_KEY, EnvironmentLike, EpisodeScores, LearningState
from nermo_mjx.learn.own import custom_code_file
from nermo_mjx.learn.policy import Policy, evaluation_physics, load_policy
from nermo_mjx.learn.spec import Training, Until
from nermo_mjx.physics import resolve_engine
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot.quantity import ParameterError, require
from nermo_mjx.runs import RunDirectory, session
from nermo_mjx.runs.checkpoints import KEPT
from nermo_mjx.runs.files import content_of, parquet_bytes, parquet_table, to_json
from nermo_mjx.runs.job import (
    SILENT,
    Forecast,
    Interruption,
    Progress,
    TensorBoard,
    Watch,
    resumable,
)
from nermo_mjx.runtime import compiler_options

#: The table of the candidates: one row per checkpoint.
VALIDATION_FILE: Final = "validation.parquet"
#: Video of the policy at a checkpoint, with the number of control steps.
VIDEO_FILE: Final = "videos/{:012d}.mp4"
#: Number that is added to a training's seed; it differs from the number of the evaluation.
_VALIDATION_OFFSET: Final = 0xB0D1E5


class _Candidate(NamedTuple):
    """A policy's control steps of training, and its share of successes on each scene."""

    steps: int
    scenes: Mapping[str, float]

    @property
    def rank(self) -> tuple[float, float]:
        """The least share of successes on a scene, and the mean share; a larger rank is better."""
        shares = list(self.scenes.values())
        return min(shares), float(np.mean(shares))


class BestPolicy:
    """The best policy of a training's directory so far, which is the content of its policy file.

    The file is written before the table that refers to it, so that a killed training tests its last policy again and
    comes to the same result.
    """

    def __init__(
        self,
        directory: RunDirectory,
        walks: Callable[[Policy], Mapping[str, float]],
        warn: Callable[[str], None],
        code: str = "",
    ) -> None:
        """
        Args:
            directory: Directory of the training.
            walks: Function from a policy to its share of successes on each scene.
            warn: Function that receives a message if the policy file is lost.
            code: File of the policies' custom observations.
        """
        self._held, self._walks, self._warn, self._code = directory, walks, warn, code
        table = parquet_table(content_of(directory.out / VALIDATION_FILE) or b"")
        rows = [] if table is None else table.to_pylist()
        self._tried = [_Candidate(row.pop("steps"), row) for row in rows]

    def choose(self, policy: Policy) -> Policy:
        """The best of this policy and all policies before, and the earliest of equal ones; the files are updated."""
        steps, stored, best_steps = int(policy.about["trained"]["steps"]), None, None
        with contextlib.suppress(ParameterError):  # the file is missing or cannot be read
            stored = load_policy(Path(self._held.out) / POLICY_FILE, self._code)
            best_steps = stored.about.get("trained", {}).get("steps")
        best = next((tried for tried in self._tried if tried.steps == best_steps), None)
        if self._tried and best is None and best_steps != steps:
            self._warn(
                f"{self._held.out / POLICY_FILE} is not the policy that was chosen: the choice begins anew."
            )
            self._tried = []
        if steps not in [tried.steps for tried in self._tried]:
            candidate = _Candidate(steps, dict(self._walks(policy)))
            if best is None or candidate.rank > best.rank:
                self._held.write(POLICY_FILE, policy.content())
                stored = policy
            self._tried.append(candidate)
            rows = [{"steps": tried.steps, **tried.scenes} for tried in self._tried]
            self._held.write(VALIDATION_FILE, parquet_bytes(pa.Table.from_pylist(rows)))
        return stored or policy

    def is_sufficient(self, until: Until | None, steps: int) -> bool:
        """Whether a policy with at most these steps is as good as `until` requires."""
        return until is not None and any(
            tried.steps <= steps and min(tried.scenes.values()) >= until.success
            for tried in self._tried
        )


def success_shares(evaluator: PolicyEvaluator, policy: Policy) -> dict[str, float]:
    """The share of successful walks of a policy on each scene of the evaluation, in `validation` walks.

    A walk must also be as fast as `until` requires.
    """
    training = evaluator.training
    table = evaluator(
        policy, draws=BodySample(training.validation, _VALIDATION_OFFSET), walkers=(POLICY,)
    )
    if training.until is not None:
        fast = pc.fill_null(pc.greater_equal(table["speed"], training.until.speed), False)
        column = table.column_names.index("success")
        table = table.set_column(column, "success", pc.and_(table["success"], fast))
    return {
        scene: statistics[POLICY]["success"] for scene, statistics in summarize_walks(table).items()
    }


@dataclasses.dataclass(frozen=True)
class TrainingResult:
    """The result of a training.

    Attributes:
        out: Directory of the training.
        training: Training that was run.
        policy: File of the policy; None in an environment without a robot.
        summary: Content of summary.json: `steps`, `policy_steps` after which the policy was chosen, `return`,
            `success`, `judged` with the physics and time step [s] of the evaluation, and the numbers with and without
            the policy for each scene of the evaluation.
        learned: Learning state after the last iteration.
        history: Numbers of each iteration.
        iterations_run: Number of iterations of this call.
        plots: Paths of the figures.
    """

    out: Path
    training: Training
    policy: Path | None
    summary: dict[str, Any]
    learned: LearningState
    history: Curves
    iterations_run: int
    plots: list[Path]


@shows_progress("training", "steps")
# Many parameters because it is a public job with named options.
def run_training(
    spec: Training | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    environment: EnvironmentLike | None = None,
    watch: Watch = SILENT,
    progress: bool = True,
    accept_new_code: bool = False,
    tensorboard: bool = False,
    video: bool = False,
) -> TrainingResult:
    """Learn a policy into a directory, or resume what it contains, and evaluate it.

    The learning state is stored after each section of iterations, and the next section starts new episodes. Therefore a
    training that was killed and resumed has the same results as an uninterrupted one, on the engine `c` bit for bit;
    only the section in progress is lost.

    Args:
        spec: A `Training`, a dict with the fields of a training file, or the path of a training file.
        out: Directory of the training; see `nermo_mjx.learn.directory`.
        engine: Engine of the environment; `auto` is `c` on a machine without a GPU, otherwise `mjx`.
        environment: Environment that replaces the environment of the training; then there is neither a policy file nor
            an evaluation.
        watch: Receiver of the progress before the first iteration and after each iteration, with the numbers by column
            of the history, of the progress of the evaluation, and of messages about files that are moved aside.
        progress: Whether to show a progress bar in a terminal or notebook, if there is no watch.
        accept_new_code: Whether to resume a directory that other code started.
        tensorboard: Whether to write scalars of each iteration to DIR/tensorboard; needs the extra of this name.
        video: Whether to render the newest policy at each checkpoint to DIR/videos, on the evaluation's first scene.

    Raises:
        SpecError, DirectoryError, OtherCode, Interrupted: see "Errors of jobs" in docs/reference/python.md.
    """
    training = Training.of(spec)
    if tensorboard:
        require("tensorboard", "tensorboardX", "tensorboard")
    if video:
        from nermo_mjx.view import check_video

        check_video(training.setup.load().model, VIDEO_FILE.format(0))
    name = training_engine(engine)
    with (
        TrainingDirectory(out, training, name, watch.warn) as directory,
        resumable(directory.out, f"train {directory.out / SPEC_FILE}") as interruption,
        contextlib.ExitStack() as stack,
    ):
        worlds = environment or training.environment(name)
        learned, curves = directory.restore(
            training.algorithm.begin(worlds, training.seed), accept=accept_new_code
        )
        begun = len(curves)
        evaluator, choice = PolicyEvaluator(training), None
        if training.validation:
            walks = functools.partial(success_shares, evaluator)
            code = custom_code_file(training.task.observe)
            choice = BestPolicy(directory.run_directory, walks, watch.warn, code)
        goes_on = not _is_complete(training, learned, curves, choice)
        code = directory.take_code(curves, accept=accept_new_code) if goes_on else ""
        directory.claim()
        board = stack.enter_context(TensorBoard(directory.out)) if tensorboard else None
        learning = _TrainingLoop(directory, worlds, interruption, watch, board, code, choice, video)
        if goes_on:
            directory.run_directory.note_session(session(begun_at=begun))
            learned, curves = learning.learn(learned, curves)
        policy = learning.publish(learned, curves)
        table = None if policy is None else _evaluate(directory, policy, evaluator, watch)
        summary = _summary(training, learned, curves, policy, table)
        summary["complete"] = _is_complete(training, learned, curves, choice)
        directory.run_directory.write(SUMMARY_FILE, to_json(summary))
        plots = _write_plots(directory.out, training, curves, table) if training.plots else []
        path = None if policy is None else directory.out / POLICY_FILE
        return TrainingResult(
            directory.out,
            directory.training,
            path,
            summary,
            learned,
            curves,
            len(curves) - begun,
            plots,
        )


def _write_plots(out: Path, training: Training, curves: Curves, table: Any) -> list[Path]:
    """Draw the figures of a training from its history and the table of its evaluation, and return their paths."""
    # Matplotlib takes as long to import as the first control steps.
    from nermo_mjx.learn.plots import figures_of_training
    from nermo_mjx.plotting.files import write_figures

    return write_figures(figures_of_training(training, curves, table), out / "plots")


def training_engine(engine: str) -> str:
    """Name of the engine on which a training runs: `c` or `mjx`.

    Raises:
        ParameterError: The training cannot run on this engine.
    """
    name = resolve_engine(engine)
    name = "mjx" if engine == "auto" and name == "warp" else name
    if name not in ("c", "mjx"):
        raise ParameterError(f"engine is {engine!r}: a training runs on auto, c or mjx.")
    return name


def _is_complete(
    training: Training, learned: LearningState, curves: Curves, choice: BestPolicy | None
) -> bool:
    """Whether all iterations are done, or a checkpoint was good enough."""
    done = len(curves) >= training.iterations
    return done or (choice is not None and choice.is_sufficient(training.until, int(learned.steps)))


@dataclasses.dataclass
class _TrainingLoop:
    """The iterations of a training, and their progress messages."""

    directory: TrainingDirectory
    environment: EnvironmentLike
    interruption: Interruption
    watch: Watch
    board: TensorBoard | None
    code: str
    choice: BestPolicy | None
    video: bool

    def learn(self, learned: LearningState, curves: Curves) -> tuple[LearningState, Curves]:
        """Run the iterations to the end, section by section: the last learning state, and the history."""
        training = self.directory.training
        iterate, reset = training.algorithm.make_iteration(self.environment), self.environment.reset
        if self.environment.pure:
            reset = jax.jit(reset, compiler_options=compiler_options())
        self._report_progress(int(learned.steps), {})
        self._choose_policy(learned)
        while not _is_complete(training, learned, curves, self.choice):
            so_far = {} if self._robot is None else {"steps": float(learned.steps)}
            state = reset(learned.random_key(RESET_KEY), **so_far)
            scores = EpisodeScores.empty(training.worlds)
            # Sections are counted from the beginning of the training.
            end = min((len(curves) // training.section + 1) * training.section, training.iterations)
            while len(curves) < end:
                wall, cpu = time.perf_counter(), time.process_time()
                learned, state, experience, loss_values = iterate(learned, state)
                numbers = {"steps": float(learned.steps), **scores.tally(experience)}
                numbers |= {
                    "environment_cpu": math.nan,
                    **{name: float(value) for name, value in loss_values.items()},
                }
                other_cpu = time.process_time() - cpu - np.nan_to_num(numbers["environment_cpu"])
                numbers |= {"wall_seconds": time.perf_counter() - wall, "learner_cpu": other_cpu}
                curves = curves.extend(numbers, self.code)
                self.interruption.check()
                if self.board is not None:
                    values = {key: number for key, number in numbers.items() if key != "steps"}
                    self.board.log(int(numbers["steps"]), values)
                self._report_progress(int(numbers["steps"]), numbers)
            with self.interruption.shielded():
                self.directory.keep(learned, curves)
            self.publish(learned, curves)
            if self.video and (policy := self._policy(learned)) is not None:
                self._film(policy, self.directory.out / VIDEO_FILE.format(int(learned.steps)))
        return learned, curves

    def publish(self, learned: LearningState, curves: Curves) -> Policy | None:
        """Write the files of the history and the policy, and return the policy."""
        policy = self._choose_policy(learned)
        with self.interruption.shielded():
            units = (
                {}
                if self._robot is None
                else {term.name: term.unit for term in self._robot.loop.terms}
            )
            self.directory.publish(curves, units, policy if policy is None else policy.content())
        return policy

    def _choose_policy(self, learned: LearningState) -> Policy | None:
        """The best policy so far if the training validates its policies, otherwise the latest policy."""
        policy = self._policy(learned)
        if policy is None or self.choice is None:
            return policy
        best = self.choice.choose(policy)  # perhaps from an earlier session with another evaluation
        return dataclasses.replace(best, about={**best.about, "judged": self._evaluation_physics})

    def _policy(self, learned: LearningState) -> Policy | None:
        """The policy of a learning state; None in an environment without a robot."""
        if (robot := self._robot) is None:
            return None
        trained = {"steps": int(learned.steps), "training": self.directory.training.digest()}
        metadata = {"trained": trained, "judged": self._evaluation_physics}
        return Policy.of(robot, learned, metadata)

    @property
    def _evaluation_physics(self) -> dict[str, Any]:
        """The physics of the evaluation, which is the same for all of its scenes."""
        return evaluation_physics(self.directory.training.evaluated()[0][0])

    @property
    def _robot(self) -> Environment | None:
        """The environment of the robot, and the first one of several."""
        first = (
            self.environment.parts[0] if isinstance(self.environment, Mixture) else self.environment
        )
        return first if isinstance(first, Environment) else None

    def _film(self, policy: Policy, path: Path) -> None:
        """Render the policy's walk on the first scene of the evaluation."""
        from nermo_mjx.view import render, robot_of, shown_model

        _, walk = next(record_walks(self.directory.training, policy))
        path.parent.mkdir(exist_ok=True)
        render(walk, shown_model(walk, robot_of(walk)), path)

    def _report_progress(self, done: int, numbers: Mapping[str, float]) -> None:
        total = self.directory.training.steps
        self.watch.progress(Progress(min(1.0, done / total), done, total, numbers=numbers))


def _evaluate(
    directory: TrainingDirectory, policy: Policy, evaluator: PolicyEvaluator, watch: Watch
) -> pa.Table:
    """The table of this policy's evaluation, which is computed once."""
    cached = parquet_table(content_of(directory.out / EVALUATION_FILE) or b"")
    training = directory.training
    policy_key = f"{training.digest()} {training.evaluation} {training.run} {policy.about['trained']['steps']}"
    if (
        cached is not None
        and (cached.schema.metadata or {}).get(b"evaluated") == policy_key.encode()
    ):
        return cached
    table = evaluator(policy, lambda share: watch.progress(Progress(share, what="evaluation")))
    table = table.replace_schema_metadata(
        {**(table.schema.metadata or {}), b"evaluated": policy_key.encode()}
    )
    directory.run_directory.write(EVALUATION_FILE, parquet_bytes(table))
    return table


def _summary(
    training: Training,
    learned: LearningState,
    curves: Curves,
    policy: Policy | None,
    table: pa.Table | None,
) -> dict[str, Any]:
    """The content of summary.json; without an evaluation, success is the share of episodes that lasted."""
    scenes = {} if table is None else summarize_walks(table)
    success_rates = [statistics["policy"]["success"] for statistics in scenes.values()]
    effort = {
        name: float(np.nansum(curves.column(name)))
        for name in ("environment_cpu", "learner_cpu", "wall_seconds")
    }
    return {
        "steps": int(learned.steps),
        "policy_steps": int(learned.steps)
        if policy is None
        else int(policy.about["trained"]["steps"]),
        "success": min(success_rates) if success_rates else curves.last("lasted"),
        "return": curves.last("return"),
        "episodes": int(curves.column("episodes").sum()),
        "simulated_seconds": float(int(learned.steps) * training.step_seconds),
        **effort,
        **({} if policy is None else {"judged": evaluation_physics(training.evaluated()[0][0])}),
        "scenes": scenes,
    }


# ---
# The cost of a training on this machine, before it starts.


#: Number of timed iterations; one before them compiles.
_TIMED_ITERATIONS: Final = 2


def training_forecast(training: Training, engine: str = "auto") -> Forecast:
    """Estimate the cost of a whole training; raises `ParameterError` for an unknown engine.

    The counts are the number of iterations, and the control steps of all worlds in one and in all iterations. The pace on
    `mjx` is unknown, because a measurement would compile for minutes.
    """
    name, wall = training_engine(engine), math.nan
    steps = training.iterations * training.steps_per_iteration
    note = "its pace is not known before its program is compiled, which takes minutes, once per machine"
    worlds, notes = training.environment(name), []
    if not worlds.pure:
        iterate = training.algorithm.make_iteration(worlds)
        compiles = time.perf_counter()
        learned = training.algorithm.begin(worlds, training.seed)
        learned, state, *_ = iterate(learned, worlds.reset(learned.random_key(RESET_KEY)))
        float(learned.steps)
        began = time.perf_counter()
        for _ in range(_TIMED_ITERATIONS):
            learned, state, *_ = iterate(learned, state)
        float(learned.steps)
        rate = _TIMED_ITERATIONS * training.steps_per_iteration / (time.perf_counter() - began)
        wall, note = steps / rate, f"{rate:,.0f} control steps/s, measured now"
        notes.append(f"Compiling takes {began - compiles:.0f} s on top.")
    input_size = worlds.observation_size + worlds.privileged_size
    units = [input_size, *training.algorithm.hidden]
    weights = 2 * sum(a * b for a, b in itertools.pairwise(units))
    # A checkpoint contains the networks, the initial critic, two moments of Adam, in float32, and the history.
    disk = KEPT * 16 * weights + 40 * 8 * training.iterations
    walks = 2 * training.evaluation.bodies  # with and without the policy
    evaluated = sum(
        walks * float(training.run.seconds(setup.cycle_rate({}))[1])
        for setup, _ in training.evaluated()
    )
    notes.append(f"Then the evaluation simulates {evaluated:,.0f} s, and compiles, on top.")
    counts = {
        "iterations": training.iterations,
        "steps_per_iteration": training.steps_per_iteration,
        "steps": steps,
    }
    return Forecast(name, counts, steps * worlds.step_seconds, wall, note, disk, notes=tuple(notes))
