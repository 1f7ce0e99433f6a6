"""Physics: engines behind one small protocol, variation of the body within a batch, and differentiable motions.

Names are imported on first use: `trajectory` does not depend on the robot, and works without MJX, as the engine `c`
does. The differentiable step of any model is in `nermo_mjx.dynamics`.
"""

# ruff: noqa: I001  (one statement for each module)
from __future__ import annotations

from typing import TYPE_CHECKING

from nermo_mjx.lazy import lazy_names

if TYPE_CHECKING:
    from nermo_mjx.physics.engine import Engine as Engine, Session as Session, Trace as Trace
    from nermo_mjx.physics.making import (
        ENGINES as ENGINES,
        make_engine as make_engine,
        resolve_engine as resolve_engine,
    )
    from nermo_mjx.physics.open_loop import Trajectory as Trajectory, trajectory as trajectory
    from nermo_mjx.physics.variation import Variation as Variation
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        forward="nermo_mjx.dynamics:forward",
        step="nermo_mjx.dynamics:step",
        step_with_verdict="nermo_mjx.dynamics:step_with_verdict",
    )
