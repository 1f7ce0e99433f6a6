"""Engines by name: the choice of an engine that this machine supports, and its construction."""

from __future__ import annotations

import jax

from nermo_mjx import runtime
from nermo_mjx.physics.engine import Engine, Loop
from nermo_mjx.robot import ParameterError, Robot

ENGINES = ("auto", "c", "mjx", "warp")


def resolve_engine(name: str) -> str:
    """The engine that a name selects on this machine.

    `auto` is `c` on a CPU and `mjx` on an accelerator.

    Raises:
        ParameterError: The name is unknown, or the engine cannot run here; the message describes the remedy.
        BackendUnavailable: JAX cannot use the platform in `JAX_PLATFORMS`.
    """
    if name not in ENGINES:
        raise ParameterError(f"engine is {name!r}: allowed is one of {', '.join(ENGINES)}.")
    runtime.start_jax()
    if name == "auto":
        return "c" if jax.default_backend() == "cpu" else "mjx"
    if name == "warp":
        from nermo_mjx.physics.mjx_engine import obstacle

        if (reason := obstacle()) is not None:
            raise ParameterError(f"engine is 'warp': {reason}")
    return name


def make_engine(
    name: str, robot: Robot, loop: Loop, devices: int | None = None, threads: int | None = None
) -> Engine:
    """Build an engine by name.

    >>> from nermo_mjx import ClosedLoop, Setup, load_robot
    >>> robot = load_robot()
    >>> make_engine("c", robot, ClosedLoop(robot, Setup().make_controller())).name
    'c'

    Args:
        name: Name of the engine, see `resolve_engine`.
        robot, loop: Robot and loop to simulate.
        devices: Local devices that share a batch in `mjx` and `warp`; None for `$NERMO_MJX_DEVICES`, or else all.
        threads: Processors that `c` uses; None for `$NERMO_MJX_THREADS`, or else all.

    Raises:
        ParameterError: The engine is unknown or cannot run here, or there are too many devices, or fewer than one thread.
    """
    engine_name = resolve_engine(name)
    if engine_name == "c":
        from nermo_mjx.physics.c_engine import CEngine

        return CEngine(robot, loop, threads)
    if engine_name == "warp":
        from nermo_mjx.physics.mjx_engine import WarpEngine

        return WarpEngine(robot, loop, devices)
    from nermo_mjx.physics.mjx_engine import MjxEngine

    return MjxEngine(robot, loop, devices)
