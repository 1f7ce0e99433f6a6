"""How fast this machine simulates a walk, from a short measurement: estimates for sweeps, searches and tunings."""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from nermo_mjx.rollout import Run, Setup
from nermo_mjx.sweep.simulating import SimulatorLike

#: Simulated time of the probe [s]; with 16 worlds it takes two cores a tenth of a second.
PROBE: Final = 0.5


def pace(simulator: SimulatorLike, setup: Setup, worlds: int) -> float:
    """Simulated seconds of all worlds together per second of wall time, once programs are compiled.

    Args:
        worlds: of a batch.
    """
    frequency = {name: np.full(worlds, setup.defaults()[name]) for name in ("frequency",) if name in setup.timing}
    values = frequency or {name: np.full(worlds, value) for name, value in list(setup.defaults().items())[:1]}
    run = Run(duration=PROBE, warmup=0.0)
    simulator.run(values, run)
    began = time.perf_counter()
    simulator.run(values, run)
    return worlds * PROBE / (time.perf_counter() - began)
