"""The protocol of the physics engines, and their selection.

An engine advances a batch of worlds by control ticks. In each tick the *loop* (controller and metrics, pure functions
that do not depend on the engine) reads the sensors of the previous tick and sets the servos; then the physics runs
`steps_per_tick` steps. The loop is the same code in every engine: traced into the scan (`mjx`, `warp`), or jitted and
called between ticks (`c`).
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np

from nermo_mjx import runtime
from nermo_mjx.robot import ParameterError, Robot

ENGINES = ("auto", "c", "mjx", "warp")


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


def resolve_engine(name: str) -> str:
    """The engine that a name selects on this machine.

    `auto` is `c` on a CPU, `warp` on an NVIDIA GPU where Warp is installed, and `mjx` on any other accelerator.

    Raises:
        ParameterError: an unknown name, or an engine that cannot run here; the message names the remedy.
        BackendUnavailable: JAX cannot use the platform in `JAX_PLATFORMS`.
    """
    if name not in ENGINES:
        raise ParameterError(f"engine is {name!r}: allowed is one of {', '.join(ENGINES)}.")
    runtime.start_jax()
    if name == "auto" and jax.default_backend() == "cpu":
        return "c"
    if name not in ("auto", "warp"):
        return name
    from nermo_mjx.physics.warp_engine import obstacle

    found = obstacle()
    if name == "auto":
        return "warp" if found is None else "mjx"
    if found is not None:
        raise ParameterError(f"engine is 'warp': {found}")
    return name


def make_engine(name: str, robot: Robot, loop: Loop, devices: int | None = None, threads: int | None = None) -> Engine:
    """Build an engine by name.

    >>> from nermo_mjx import Setup, load_robot
    >>> from nermo_mjx.rollout.loop import ClosedLoop
    >>> robot = load_robot()
    >>> make_engine("c", robot, ClosedLoop(robot, Setup().make_controller())).name
    'c'

    Args:
        name: see `resolve_engine`.
        robot, loop: what runs.
        devices: local devices that share a batch in `mjx` and `warp`; None for `$NERMO_MJX_DEVICES`, or else all.
        threads: processors that `c` uses; None for `$NERMO_MJX_THREADS`, or else all.

    Raises:
        ParameterError: an unknown engine, one that cannot run here, too many devices, or no thread.
    """
    chosen = resolve_engine(name)
    if chosen == "c":
        from nermo_mjx.physics.c_engine import CEngine

        return CEngine(robot, loop, threads)
    if chosen == "warp":
        from nermo_mjx.physics.warp_engine import WarpEngine

        return WarpEngine(robot, loop, devices)
    from nermo_mjx.physics.mjx_engine import MjxEngine

    return MjxEngine(robot, loop, devices)
