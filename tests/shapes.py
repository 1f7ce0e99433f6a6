"""The type checker of the annotated shapes, on while testing only (see `addopts` in pyproject.toml)."""

import collections
import functools
import inspect
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

#: An int is accepted where a float is asked for, as type checkers do.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
#: Calls of a function that are checked in each test. A step of MJX makes hundreds of each, all alike.
MOST = 20
#: Calls of each function in this test; `conftest.py` clears it.
calls: collections.Counter[Callable[..., Any]] = collections.Counter()
_jaxtyped = jaxtyping.jaxtyped


def _jaxtyped_first_calls(function: Any = None, *, typechecker: Any) -> Any:
    """Check what a function is called with and what it returns, as jaxtyping does.

    A function within a function is not checked: it would be prepared anew, for a millisecond, whenever the other runs.
    Nor is a pytree where it is made: JAX makes it anew with leaves of a whole batch, or with none.
    The check of a function is prepared at its first call, because a process of tests calls a part of all functions.
    """
    if function is None:
        return functools.partial(_jaxtyped_first_calls, typechecker=typechecker)
    if isinstance(function, type) or "<locals>" in getattr(function, "__qualname__", ""):
        return function
    if not inspect.isfunction(function):  # a property, for example
        return _jaxtyped(function, typechecker=typechecker)

    @functools.cache
    def prepared() -> Callable[..., Any]:
        return _jaxtyped(function, typechecker=typechecker)

    @functools.wraps(function)
    def first_calls(*arguments: Any, **keywords: Any) -> Any:
        calls[function] += 1
        return (prepared() if calls[function] <= MOST else function)(*arguments, **keywords)

    return first_calls


jaxtyping.jaxtyped = _jaxtyped_first_calls
