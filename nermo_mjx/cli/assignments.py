"""`--set NAME=X`: a parameter's name and its value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from nermo_mjx.cli.group import WrongUse

if TYPE_CHECKING:
    from nermo_mjx.robot import Quantity

LISTED = "is not a parameter; `nermo-mjx sweep --list-parameters` prints all."


def assigned(texts: Iterable[str], known: Mapping[str, Quantity], unknown: str) -> dict[str, float]:
    """Names and values of every NAME=X, where NAME may be a pattern; ranges are not checked. The last one wins.

    Args:
        texts: as given.
        known, unknown: see `_assignment`.

    Raises:
        WrongUse: a text is something else.
    """
    from nermo_mjx.specs.patterns import is_pattern, matches

    values: dict[str, float] = {}
    for text in texts:
        pattern, equals, number = text.partition("=")
        names = matches(pattern.strip(), known) if equals and is_pattern(pattern) else [pattern]
        if not names:
            raise WrongUse(f"--set {text}: {pattern.strip()} matches no parameter; `nermo-mjx sweep --list-parameters` "
                           "prints all.")  # fmt: skip
        values |= dict(_assignment(name + equals + number, known, unknown) for name in names)
    return values


def _assignment(text: str, known: Mapping[str, Quantity], unknown: str) -> tuple[str, float]:
    """Name and number of NAME=X; its range is not checked.

    Args:
        known: the parameters that may be named.
        unknown: the message for another name if none is similar: what it is not, and what is allowed, joined by ";".

    Raises:
        WrongUse: the text is something else.
    """
    name, equals, number = text.partition("=")
    name = name.strip()
    if not equals:
        example = next(iter(known.items()))
        raise WrongUse(f"--set {text}: expected NAME=VALUE, such as {example[0]}={example[1].default:g}.")
    if name not in known:
        from nermo_mjx.robot.nearest import nearest

        near = nearest(name, known)
        what, _, hint = unknown.partition("; ")
        raise WrongUse(f"--set {text}: {name} {what}; {f'did you mean {near}?' if near else hint}")
    try:
        return name, float(number)
    except ValueError:
        raise WrongUse(f"--set {text}: {number!r} is not a number; allowed is {known[name].allowed()}.") from None
