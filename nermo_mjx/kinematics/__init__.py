"""Legs, spine and body as pure geometry: JAX functions that broadcast over leading axes and import only `robot`."""

# ruff: noqa: I001  (one statement for each module)
from __future__ import annotations

from typing import TYPE_CHECKING

from nermo_mjx.lazy import lazy_names

if TYPE_CHECKING:
    from nermo_mjx.kinematics import body as body, leg as leg, spine as spine
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
