"""A simulator that answers at once, in closed form, for tests of searches; as a program it is there to be killed."""

from __future__ import annotations

import os
import sys
import time
import types
from pathlib import Path

import numpy as np

#: Where the fake robot is fastest: amplitude [rad], phase [rad]; and what it falls above [Hz].
BEST, FALLS = (0.3, -0.6), 1.4
WALK = {
    "spine": "stride_extension",
    "run": {"duration": 2.0, "warmup": 0.5},
    "plots": False,
    "vary": {
        "frequency": {"uniform": [0.4, 1.5]},
        "spine.amplitude": {"uniform": [0.0, 0.4]},
        "spine.phase": {"uniform": [-3.14159, 3.14159]},
    },
}
SPEED = WALK | {"objective": {"maximize": "speed"}, "budget": 120, "batch": 12}
FRONT = WALK | {
    "pareto": [{"maximize": "speed"}, {"minimize": "cost_of_transport"}],
    "budget": 120,
    "batch": 20,
}
ATLAS = WALK | {
    "objective": {"minimize": "cost_of_transport"},
    "atlas": {"speed": [0.0, 0.16, 8], "roll_std": [0.0, 0.1, 6]},
    "budget": 160,
    "batch": 16,
}


def walk(frequency, amplitude, phase):
    """Speed [m/s], roll [rad] and cost of transport of the fake robot."""
    speed = (
        0.1
        * frequency
        * (1.2 - 2.0 * (amplitude - BEST[0]) ** 2 - 0.1 * (1 - np.cos(phase - BEST[1])))
    )
    return (
        speed,
        0.02 + 0.1 * amplitude**2 + 0.03 * frequency,
        1.0 + (frequency - 0.6) ** 2 + amplitude,
    )


class FakeSimulator:
    """Metrics in closed form; what steps faster than `FALLS` falls.

    Attributes:
        batches: number of worlds of each call.
        stop_at: raises `KeyboardInterrupt` in this call (counted from 0); fail_at: raises `error` in this call.
        delay: seconds that each call takes; log: a file that gets a line a call.
    """

    def __init__(self, stop_at=None, fail_at=None, error=None, delay=0.0, log=None, engine="fake"):
        self.batches, self.stop_at, self.fail_at, self.error = [], stop_at, fail_at, error
        self.delay, self.log, self.engine = delay, log, engine

    def run(self, values, run, *, progress=None, notify=None):
        if len(self.batches) == self.stop_at:
            raise KeyboardInterrupt
        if len(self.batches) == self.fail_at:
            raise self.error
        n = len(values["frequency"])
        self.batches.append(n)
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{n}\n")
        time.sleep(self.delay)
        frequency = values["frequency"]
        speed, roll, cost = walk(
            frequency, values.get("spine.amplitude", 0.0), values.get("spine.phase", 0.0)
        )
        fell = frequency > FALLS
        speed = speed + values.get("start.x", 0.0)
        metrics = {
            "speed": speed,
            "roll_std": roll,
            "cost_of_transport": cost,
            "fell": fell.astype(float),
        }
        status = np.where(fell, "fell", "ok")
        return types.SimpleNamespace(metrics=metrics, status=status, engine=self.engine, steps=100)


if __name__ == "__main__":  # search_fake.py OUT LOG
    from nermo_mjx.optimize import run_search
    from nermo_mjx.runs import Interrupted

    Path(sys.argv[2]).write_text("")
    try:
        run_search(SPEED, sys.argv[1], simulator=FakeSimulator(delay=0.1, log=sys.argv[2]))
    except Interrupted as stopped:
        print(stopped, flush=True)
        os._exit(3)
