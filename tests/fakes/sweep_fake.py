"""A simulator that answers at once, in closed form, for tests of everything around it."""

from __future__ import annotations

import os
import sys
import time
import types
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

AMPLITUDES, FREQUENCIES, PHASES = (0.0, 0.2, 0.4), (0.5, 0.7, 0.9, 1.1), (-1.0, 0.0, 1.0)
SPEC = {
    "spine": "stride_extension",
    "run": {"cycles": 4, "warmup_cycles": 1},
    "plots": False,
    "vary": {
        "frequency": list(FREQUENCIES),
        "spine.amplitude": list(AMPLITUDES),
        "spine.phase": list(PHASES),
    },
}
#: Seconds that nobody waits: the process is ended by then.
HELD = 120.0


def speed(frequency, amplitude=0.0, phase=0.0):
    """Speed of the fake robot [m/s]: best at phase 0."""
    return 0.1 * frequency * (1 + 0.5 * amplitude * np.cos(phase))


class FakeSimulator:
    """Metrics in closed form; what is faster than `falls_above` falls.

    Attributes:
        batches: number of worlds of each call.
        stop_at: raises `KeyboardInterrupt` in this call (counted from 0).
        fail_at: raises `error` in this call.
        delay: seconds that each call takes.
        hold_at: this call waits for the signal that ends the process, however slow the machine is.
    """

    def __init__(
        self,
        stop_at=None,
        delay=0.0,
        engine="fake",
        falls_above=np.inf,
        log=None,
        fail_at=None,
        error=None,
        hold_at=None,
    ):
        self.batches, self.stop_at, self.delay, self.engine = [], stop_at, delay, engine
        self.falls_above, self.log, self.fail_at, self.error = falls_above, log, fail_at, error
        self.hold_at = hold_at

    def run(self, values, run, *, progress=None, notify=None):
        if len(self.batches) == self.stop_at:
            raise KeyboardInterrupt
        if len(self.batches) == self.fail_at:
            raise self.error
        worlds = {len(column) for column in values.values()} or {1}
        assert len(worlds) == 1, "every parameter comes as an array of one length"
        n = worlds.pop()
        self.batches.append(n)
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{n}\n")
        time.sleep(HELD if len(self.batches) - 1 == self.hold_at else self.delay)
        frequency = values.get("frequency", np.full(n, 0.67))
        result = speed(
            frequency, values.get("spine.amplitude", 0.0), values.get("spine.phase", 0.0)
        )
        result = (
            result + values.get("start.x", 0.0) + 0.01 * (values.get("contact.friction", 1.0) - 1.0)
        )
        result = np.broadcast_to(result, n).astype(np.float32)
        fell = result > self.falls_above
        if progress:
            progress(0.5)
            progress(1.0)
        metrics = {"speed": result, "roll_std": np.full(n, 0.1), "fell": fell.astype(float)}
        return types.SimpleNamespace(
            metrics=metrics, status=np.where(fell, "fell", "ok"), engine=self.engine, steps=100
        )


def contents(*folders):
    """Content of every file below the folders."""
    return {
        path: path.read_bytes()
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file()
    }


def part_of(out, row):
    """The file of a directory that holds a row."""
    files = sorted(Path(out).glob("results/*.parquet"))
    return next(
        path for path in files if row in pq.read_table(path, columns=["row"])["row"].to_pylist()
    )


def work(out, log="", chunk=4, delay=0.0, hold_at=None):
    """A process to be killed: runs the sweep, and ends as the command does."""
    from nermo_mjx.runs import Interrupted, JobFailed
    from nermo_mjx.sweep import run_sweep

    try:
        simulator = FakeSimulator(delay=delay, log=log, hold_at=hold_at)
        run_sweep(SPEC, out, chunk=chunk, simulator=simulator)
        code = 0
    except Interrupted as stopped:
        print(stopped, flush=True)
        code = 3
    except JobFailed as error:
        print(error, flush=True)
        code = 1
    sys.stdout.flush()
    os._exit(code)  # no waiting for threads


# sweep_fake.py OUT LOG: waits in its fourth chunk.
if __name__ == "__main__":
    Path(sys.argv[2]).write_text("")
    work(*sys.argv[1:], hold_at=3)


#: A sweep that seeks an optimum, for `Noisy`.
OPTIMUM = {
    "run": {"duration": 0.2, "warmup": 0},
    "plots": False,
    "vary": {
        "gait": ["trot", "lateral_walk"],
        "spine": ["none", "stride_extension"],
        "spine.amplitude": [0.1, 0.3],
        "spine.phase": [-1.0, 0.0, 1.0],
    },
    "randomize": {
        "repeats": 3,
        "paired": ["spine.amplitude", "spine.phase"],
        "contact.friction": {"uniform": [0.8, 1.4]},
    },
    "optimum": {
        "over": ["spine.amplitude", "spine.phase"],
        "for": ["gait"],
        "base": {"spine": "none"},
        "fresh": 4,
        "budget": 30,
        "until": 1,
    },
}


class Noisy(FakeSimulator):
    """Adds noise that depends on the run alone: 0.02 at the phases 0 and 1, which are alike."""

    def run(self, values, run, **options):
        alike = (
            {"spine.phase": np.minimum(values["spine.phase"], 0.0)}
            if "spine.phase" in values
            else {}
        )
        result = super().run({**values, **alike}, run)
        parts = [
            values[name] for name in ("spine.amplitude", "spine.phase", "start.x") if name in values
        ]
        speed = result.metrics["speed"] + 2e-4 * np.sin(
            1e4 * sum(parts) + 1e5 * values.get("contact.friction", 1.0)
        )
        costs = {"cost_of_transport": 1.0 - speed, "electrical_cost_of_transport": 8.0 + speed}
        result.metrics.update(speed=speed, **costs)
        return result
