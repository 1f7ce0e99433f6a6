"""The protocol of the physics engines.

An engine advances a batch of worlds by control ticks. In each tick the *loop* (controller and metrics, pure functions
that do not depend on the engine) reads the sensors of the previous tick and sets the servos; then the physics runs
`steps_per_tick` steps. The loop is the same code in every engine: traced into the scan (`mjx`, `warp`), or jitted and
called between ticks (`c`).
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Loop(Protocol):
    """Computation between two ticks of physics, in one world; pure, jittable functions of pytrees."""

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per control tick."""

    def init(self, params: Any, sensordata: Any) -> Any:
        """Initial state of the loop, from the parameters and the sensors (n_sensordata,) at rest."""

    def step(self, params: Any, state: Any, sensordata: Any) -> tuple[Any, Any]:
        """New state and `ctrl` (n_servos,) from the last tick's sensors, (steps_per_tick, n_sensordata)."""


@runtime_checkable
class DrivenLoop(Loop, Protocol):
    """A loop that receives inputs before some of its ticks, and returns observations after them."""

    def input(self, params: Any) -> Any:
        """The input array (k,) among the parameters."""

    def observe(self, params: Any, state: Any, sensordata: Any) -> Any:
        """Observations after a tick, any pytree, from the state before its `step` and the tick's sensors."""


@dataclasses.dataclass(frozen=True)
class Trace:
    """The data of a recorded run, world first, one entry per tick.

    Attributes:
        qpos, qvel: state at the end of each tick, (n, ticks, nq) and (n, ticks, nv).
        ctrl: servo targets during the tick, (n, ticks, n_servos).
        sensordata: of the tick's last step, (n, ticks, n_sensordata).
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensordata: np.ndarray


@runtime_checkable
class Session(Protocol):
    """A batch of worlds being simulated."""

    @property
    def loop_state(self) -> Any:
        """State of the loop, leaves with a leading world axis."""

    @property
    def unsolved(self) -> np.ndarray:
        """Number of steps of each world (n,) in which the constraint solver did not converge, if the solver reports
        it."""

    def advance(self, ticks: int) -> None:
        """Run all worlds for `ticks` control ticks."""

    def record(self, ticks: int) -> Trace:
        """Like `advance`, and return the recorded data."""

    def retire(self, done: np.ndarray) -> None:
        """Declare the worlds in the mask (n,) finished: their physics need not be stepped from now on."""


@runtime_checkable
class Engine(Protocol):
    """Opens sessions for one robot and one loop, which share compiled programs."""

    name: str

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> Session:
        """Start a batch at rest.

        Args:
            params: parameters of the loop, every leaf with a leading world axis (n, ...).
            qpos: initial positions, (n, nq).
            fields: model fields that differ between worlds, (n, ...) each (see `Variation`).
        """
