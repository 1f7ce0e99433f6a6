"""Physics: engines behind one small protocol, variation of the body within a batch, and a step that can be derived."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nermo_mjx.physics.engine import ENGINES, Engine, Session, Trace, make_engine, resolve_engine
from nermo_mjx.physics.variation import Variation

if TYPE_CHECKING:
    from nermo_mjx.physics.differentiable import forward, step

__all__ = [
    "ENGINES", "Engine", "Session", "Trace", "Variation", "forward", "make_engine", "resolve_engine", "step",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """`step` and `forward` bring MJX, which the engine `c` can do without."""
    if name in ("step", "forward"):
        from nermo_mjx.physics import differentiable

        return getattr(differentiable, name)
    raise AttributeError(f"module 'nermo_mjx.physics' has no attribute {name!r}")
