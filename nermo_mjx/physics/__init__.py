"""Physics: engines behind one small protocol, and variation of the body within a batch."""

from nermo_mjx.physics.engine import ENGINES, Engine, Session, Trace, make_engine, resolve_engine
from nermo_mjx.physics.variation import Variation
from nermo_mjx.runtime import configure_dispatch

configure_dispatch()  # before the first program runs

__all__ = ["ENGINES", "Engine", "Session", "Trace", "Variation", "make_engine", "resolve_engine"]
