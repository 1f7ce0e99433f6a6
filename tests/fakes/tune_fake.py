"""A problem that answers at once, in closed form, for tests of everything around it."""

from __future__ import annotations

import os
import pickle
import sys
import time
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from fakes.sweep_fake import HELD
from nermo_mjx.optimize import Evaluation, Tuning
from nermo_mjx.robot import load_robot

SPEC = {
    "spine": "stride_extension",
    "run": {"cycles": 4, "warmup_cycles": 1},
    "set": {"frequency": 0.8},
    "tune": {
        "spine.amplitude": {"bounds": [0.0, 0.4], "start": 0.05},
        "spine.phase": {"bounds": [-3.14159, 3.14159], "start": 2.5, "periodic": True},
    },
    "objective": [
        {"maximize": "speed", "scale": 0.1},
        {"minimize": "roll_std", "weight": 0.1, "scale": 0.05},
    ],
    "optimizer": {"name": "adam", "learning_rate": 0.2},
    "iterations": 6,
    "plots": False,
    "starts": 2,
    "seed": 3,
}
#: The amplitude and phase at which the fake robot is fastest.
BEST = (0.25, -0.6)


def speed(amplitude, phase=BEST[1]):
    """Speed of the fake robot [m/s]: 0.1 at best."""
    return 0.1 - 0.5 * (amplitude - BEST[0]) ** 2 - 0.02 * (1 - jnp.cos(phase - BEST[1]))


def nobody(points):
    """No world falls."""
    return jnp.zeros(len(points), bool)


class FakeProblem:
    """Metrics in closed form.

    Attributes:
        batches: (number of worlds, with gradient) of each call; compiled: how often the program was traced.
        falls: tells from points (n, p) which worlds fall; their numbers are NaN.
        stop_at: raises `KeyboardInterrupt` in this call (counted from 0).
        hold_at: this call waits for the signal that ends the process, however slow the machine is.
        delay: seconds that each call takes; log: a file that gets a line a call, the process and the number of worlds.
    """

    simulated_seconds, gradient_cost = 5.0, 3.0

    def __init__(self, tuning, falls=nobody, stop_at=None, delay=0.0, log=None, hold_at=None):
        self._made_of = tuning, falls, stop_at, delay, log
        self.hold_at = hold_at
        self.names, self.objective, self.stop_at, self.delay, self.log = (
            tuning.names,
            tuning.objective,
            stop_at,
            delay,
            log,
        )
        self.batches, self.compiled = [], 0

        def metrics(point):
            errors = {"trajectory_error": (point[0] - BEST[0]) ** 2} if tuning.recording else {}
            return {"speed": speed(*point[:2]), "roll_std": 0.1 + 0.1 * point[0] ** 2} | errors

        def value(point):
            values_of_metrics = metrics(point)
            return self.objective.value(values_of_metrics), values_of_metrics

        def program(points, gradient):
            self.compiled += 1
            fell = falls(points)
            (values, values_of_metrics), slope = jax.vmap(jax.value_and_grad(value, has_aux=True))(
                points
            )
            bad = lambda leaf: jnp.where(fell.reshape(-1, *[1] * (leaf.ndim - 1)), jnp.nan, leaf)  # noqa: E731
            return Evaluation(
                bad(values),
                bad(slope) if gradient else None,
                jax.tree.map(bad, values_of_metrics),
                ~fell,
            )

        self._program = jax.jit(program, static_argnums=1)

    def __reduce__(self):
        return FakeProblem, self._made_of

    def evaluate(self, points, gradient):
        if len(self.batches) == self.stop_at:
            raise KeyboardInterrupt
        self.batches.append((len(points), gradient))
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{os.getpid()} {len(points)}\n")
        time.sleep(HELD if len(self.batches) - 1 == self.hold_at else self.delay)
        return self._program(points, gradient)


class FakeWalker:
    """A simulator of what pictures show, with the metrics of `FakeProblem`; recorded, the robot glides along.

    Attributes:
        batches: (number of worlds, recorded) of each call that pictures make.
        again: number of worlds of each call from other starts, as what is best is walked again.
        falls: tells from named values which worlds fall.
        error: raised in each call, if it is one.
    """

    def __init__(self, falls=lambda values: False, error=None):
        self.batches, self.again, self.falls, self.error = [], [], falls, error
        self.engine = "c"

    def run(self, values, run, record=False, *, progress=None, notify=None):
        if self.error is not None:
            raise self.error
        sizes = {len(column) for column in values.values()}
        assert len(sizes) == 1, "every parameter comes as an array of one length"
        n = sizes.pop()
        if "start.yaw" in values:
            self.again.append(n)
        else:
            self.batches.append((n, record))
        if progress:
            progress(1.0)
        amplitude, phase = values["spine.amplitude"], values.get("spine.phase", np.full(n, BEST[1]))
        fell = np.broadcast_to(self.falls(values), n)
        pace = np.asarray(speed(amplitude, phase))
        metrics = {"speed": np.where(fell, np.nan, pace), "roll_std": 0.1 + 0.1 * amplitude**2}
        trace = _glide(pace, run.duration) if record else None
        return types.SimpleNamespace(
            metrics=metrics, status=np.where(fell, "fell", "ok"), engine="c", trace=trace, steps=1
        )


def _glide(pace, seconds):
    """Robots in their first pose that move ahead at a pace each."""
    model = load_robot().model
    time = 0.01 * (1 + np.arange(round(seconds / 0.01)))
    qpos = np.tile(model.qpos0, (len(pace), len(time), 1))
    qpos[:, :, 1] -= pace[:, None] * time
    still = (np.zeros((len(pace), len(time), size)) for size in (model.nv, model.nu))
    return types.SimpleNamespace(
        time=time, qpos=qpos, qvel=next(still), ctrl=next(still), sensors={}
    )


if __name__ == "__main__":  # a process to be killed: tune_fake.py OUT LOG
    from nermo_mjx.optimize import run_tuning
    from nermo_mjx.runs import Interrupted

    Path(sys.argv[2]).write_text("")
    try:
        run_tuning(
            SPEC,
            sys.argv[1],
            problem=FakeProblem(Tuning.from_dict(SPEC), log=sys.argv[2], hold_at=3),
        )
    except Interrupted as stopped:
        print(stopped, flush=True)
        os._exit(3)


class Three:
    """Three workers in this process, of which the last one is the first to be done."""

    parts = 3

    def begin(self, computer):
        self.computer = pickle.loads(pickle.dumps(computer))
        return self.computer.stamp()

    def results(self, tasks, tell):
        return [(key, self.computer(task)) for key, task in reversed(list(tasks))]
