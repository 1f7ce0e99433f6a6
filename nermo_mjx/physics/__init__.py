"""Physics: engines behind one small protocol, variation of the body within a batch, differentiable steps and motions.

Names are imported on first use: `step` and `forward`, from `nermo_mjx.dynamics`, and `trajectory` do not depend on the
robot; the engine `c` and `trajectory` work without MJX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nermo_mjx.dynamics import forward, step, step_with_verdict
    from nermo_mjx.physics.engine import Engine, Session, Trace
    from nermo_mjx.physics.making import ENGINES, make_engine, resolve_engine
    from nermo_mjx.physics.open_loop import Trajectory, trajectory
    from nermo_mjx.physics.variation import Variation

_HOMES = {
    "nermo_mjx.dynamics": ("forward", "step", "step_with_verdict"),
    "nermo_mjx.physics.engine": ("Engine", "Session", "Trace"),
    "nermo_mjx.physics.making": ("ENGINES", "make_engine", "resolve_engine"),
    "nermo_mjx.physics.open_loop": ("Trajectory", "trajectory"),
    "nermo_mjx.physics.variation": ("Variation",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["ENGINES", "Engine", "Session", "Trace", "Trajectory", "Variation", "forward", "make_engine"]
__all__ += ["resolve_engine", "step", "step_with_verdict", "trajectory"]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'nermo_mjx.physics' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)
