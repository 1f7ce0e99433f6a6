"""The cost of a search on this machine, before it starts."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from nermo_mjx.physics import resolve_engine
from nermo_mjx.rollout import Simulator
from nermo_mjx.search.evolution import WalkGradients, check_library
from nermo_mjx.search.run import batch_points
from nermo_mjx.search.spec import Search, Space
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.simulating import SimulatorLike, pace

#: Points whose mean length of a run stands for all.
_TRIED = 256
#: Bytes of a row of the table.
_ROW_BYTES = 700


@dataclasses.dataclass(frozen=True)
class Cost:
    """The cost of a search.

    Attributes:
        engine: that it will run on.
        batch: points of a batch.
        batches, evaluations, runs: whole batches, and what is in them.
        simulated_seconds: of all runs [s], by the mean over the bounds.
        wall_seconds: at this machine's current speed, measured now [s].
        disk_bytes: of the table.
        gradient_runs: what gradients cost, in forward runs; their time is not in the others.
    """

    engine: str
    batch: int
    batches: int
    evaluations: int
    runs: int
    simulated_seconds: float
    wall_seconds: float
    disk_bytes: int
    gradient_runs: int = 0


def cost_of(search: Search, engine: str = "auto", simulator: SimulatorLike | None = None) -> Cost:
    """The cost of a search from the start.

    Args:
        engine: of the simulator.
        simulator: replaces `Simulator(search.setup, engine)`.

    Raises:
        ParameterError: an unknown engine, or a library that is missing.
    """
    check_library(search.method)
    engine = resolve_engine(engine)
    batch = search.batch or batch_points(search, engine)
    shares = Space(search).spread(_TRIED)
    rows = Sample(search.sweep, shares).take(np.arange(0, len(shares) * search.repeats, search.repeats))
    known = search.sweep.constants | rows.values
    rate = search.setup.cycle_rate({name: known[name] for name in search.setup.timing if name in known})
    point = search.repeats * float(np.mean(search.run.seconds(rate)[1]))
    wanted = search.evaluations if search.evaluations is not None else (search.simulated_seconds or 0.0) / point
    batches = math.ceil(wanted / batch)
    evaluations = batches * batch
    simulator = simulator or Simulator(search.setup, engine)
    simulated = evaluations * point
    wall = simulated / pace(simulator, search.setup, batch * search.repeats)
    gradients = 0
    if search.method == "cma_mega":
        centres = int(search.options.get("emitters", 4)) * (batches // 2)
        gradients = round(centres * search.repeats * WalkGradients.cost_of(search))
    return Cost(engine, batch, batches, evaluations, evaluations * search.repeats, simulated, wall,
                evaluations * search.repeats * _ROW_BYTES, gradients)  # fmt: skip
