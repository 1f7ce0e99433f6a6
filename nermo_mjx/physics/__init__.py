"""Physics: engines behind one small protocol, and variation of the body within a batch."""

from nermo_mjx.physics.engine import ENGINES, Engine, Session, Trace, make_engine, resolve_engine
from nermo_mjx.physics.variation import Variation

__all__ = ["ENGINES", "Engine", "Session", "Trace", "Variation", "make_engine", "resolve_engine"]
