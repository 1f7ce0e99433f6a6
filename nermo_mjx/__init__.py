"""Batched, differentiable digital twin of Nermo, the tendon-driven robotic mouse with a compliant spine."""

from nermo_mjx.runtime import configure as _configure

_configure()  # before JAX and MuJoCo are imported

from nermo_mjx.version import __version__  # noqa: E402

__all__ = ["__version__"]
