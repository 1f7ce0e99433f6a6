"""Loaders of controllers that are data instead of code, by the suffix of their file.

Filled in by the package's face: a policy belongs to a room above the one that loads controllers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

READERS: Final[dict[str, Callable[[str], Any]]] = {}
