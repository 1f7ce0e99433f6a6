"""The type checker of the annotated shapes, on while testing only (see `addopts` in pyproject.toml)."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

#: An int is accepted where a float is asked for, as type checkers do.
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check what a function is called with and what it returns.

    A pytree is not checked where it is made: JAX makes it anew with leaves of a whole batch, or with none.
    """
    return function if function.__qualname__.endswith("__init__") else _check(function)
