"""The cost of a training on this machine, before it starts."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from typing import Final

from nermo_mjx.learn.experience import RESET
from nermo_mjx.learn.run import engine_for
from nermo_mjx.learn.spec import Training
from nermo_mjx.runs.checkpoints import KEPT

#: Number of timed iterations; one before them compiles.
_TIMED: Final = 2
#: Bytes of a row of the history, of each number in it.
_NUMBER: Final = 8


@dataclasses.dataclass(frozen=True)
class Cost:
    """The cost of a training.

    Attributes:
        engine: that it will run on.
        iterations, steps_per_iteration, steps: whole iterations, and control steps of all worlds.
        simulated_seconds: of all worlds [s].
        wall_seconds: of the iterations at this machine's current speed, with their compiling, measured now [s]; NaN on
            `mjx`, which compiles for minutes.
        evaluated_seconds: of the evaluation's walks, simulated on top of that [s].
        rate_from: source of the rate, in words.
        disk_bytes: of the directory.
    """

    engine: str
    iterations: int
    steps_per_iteration: int
    steps: int
    simulated_seconds: float
    wall_seconds: float
    rate_from: str
    disk_bytes: int
    evaluated_seconds: float


def cost_of(training: Training, engine: str = "auto") -> Cost:
    """The cost of a training from the start; raises `ParameterError` for an unknown engine."""
    name, wall = engine_for(training, engine), math.nan
    steps = training.iterations * training.steps_per_iteration
    said = "its pace is not known before its program is compiled, which takes minutes, once per machine"
    worlds = training.environment(name)
    if not worlds.pure:
        iterate = training.algorithm.iteration(worlds)
        compiles = time.perf_counter()
        learned = training.algorithm.begin(worlds, training.seed)
        learned, state, *_ = iterate(learned, worlds.reset(learned.random(RESET)))
        float(learned.steps)
        began = time.perf_counter()
        for _ in range(_TIMED):
            learned, state, *_ = iterate(learned, state)
        float(learned.steps)
        rate = _TIMED * training.steps_per_iteration / (time.perf_counter() - began)
        wall, said = began - compiles + steps / rate, f"{rate:,.0f} control steps/s, measured now"
    seen = worlds.observation_size + worlds.privileged_size
    units = [seen, *training.algorithm.hidden]
    weights = 2 * sum(a * b for a, b in itertools.pairwise(units))
    # Networks, a slow copy, and two moments of Adam, in float32; and the history.
    disk = KEPT * 16 * weights + 40 * _NUMBER * training.iterations
    walks = 2 * training.evaluation.bodies  # by the policy, and by the controller alone
    evaluated = sum(walks * float(training.run.seconds(setup.cycle_rate({}))[1]) for setup, _ in training.evaluated())
    return Cost(
        name,
        training.iterations,
        training.steps_per_iteration,
        steps,
        steps * worlds.step_seconds,
        wall,
        said,
        disk,
        evaluated,
    )
