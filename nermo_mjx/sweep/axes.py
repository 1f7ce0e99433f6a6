"""How one parameter gets its values: an `Axis` is varied on purpose, a `Draw` is left to chance."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import special

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.sweep.reading import Document, FieldPath, describe, nearest

#: Forms of a varied parameter, with how each is written.
AXIS_FORMS = {
    "linspace": "[from, to, count]",
    "logspace": "[from, to, count]",
    "values": "[a, b, ...]",
    "uniform": "[low, high]",
    "loguniform": "[low, high]",
}
#: Forms of a randomized parameter.
DRAW_FORMS = {"uniform": "[low, high]", "loguniform": "[low, high]", "normal": "[mean, std]"}
_LARGEST_AXIS = 1_000_000


@dataclasses.dataclass(frozen=True)
class Axis:
    """One varied parameter.

    Attributes:
        name: dotted name of the parameter.
        form: a key of `AXIS_FORMS`. `logspace` and `loguniform` are given by their end values, not by exponents.
        numbers: what stood in the list; the count of a linspace or logspace that only bounds a sampler may be absent.
    """

    name: str
    form: str
    numbers: tuple[float, ...]

    def values(self) -> np.ndarray:
        """The values of the axis on a grid, shape (n,)."""
        if self.form == "values":
            return np.asarray(self.numbers, dtype=float)
        space = np.linspace if self.form == "linspace" else np.geomspace
        steps = space(self.numbers[0], self.numbers[1], int(self.numbers[2]))
        # 0.88 and not 0.8799999999999999: a table is searched by such values. The ends stay as they were given.
        steps[1:-1] = [float(f"{step:.12g}") for step in steps[1:-1]]
        return np.asarray(steps, dtype=float)

    def at(self, share: np.ndarray) -> np.ndarray:
        """Values for shares in [0, 1) of the axis, as the samplers draw them; listed values are drawn alike often."""
        if self.form == "values":
            return self.values()[np.floor(share * len(self.numbers)).astype(int)]
        return _between(self.numbers[0], self.numbers[1], share, log=self.form in ("logspace", "loguniform"))

    def written(self) -> dict[str, list[float]]:
        """The axis as it stands in a sweep file."""
        count = [int(self.numbers[2])] if self.form in ("linspace", "logspace") and len(self.numbers) == 3 else []
        return {self.form: [*self.numbers[:2], *count] if self.form != "values" else list(self.numbers)}


@dataclasses.dataclass(frozen=True)
class Draw:
    """One randomized parameter.

    Attributes:
        name: dotted name of the parameter.
        form: a key of `DRAW_FORMS`; a normal distribution is cut off at the parameter's range.
        numbers: (low, high), or (mean, standard deviation).
        low, high: range of the parameter.
    """

    name: str
    form: str
    numbers: tuple[float, float]
    low: float
    high: float

    def at(self, share: np.ndarray) -> np.ndarray:
        """The quantile function of the distribution at shares in [0, 1)."""
        a, b = self.numbers
        if self.form != "normal":
            return _between(a, b, share, log=self.form == "loguniform")
        low, high = special.ndtr((self.low - a) / b), special.ndtr((self.high - a) / b)
        return np.clip(a + b * special.ndtri(low + (high - low) * share), self.low, self.high)

    def written(self) -> dict[str, list[float]]:
        """The draw as it stands in a sweep file."""
        return {self.form: list(self.numbers)}


def read_axis(doc: Document, name: str, value: Any, about: Quantity, *, grid: bool) -> Axis:
    """Read and check the entry `vary.name`; `grid` tells whether the sampler needs listed values or only bounds."""
    path: FieldPath = ("vary", name)
    forms = {form: text for form, text in AXIS_FORMS.items() if not grid or "uniform" not in form}
    if isinstance(value, list):
        value = {"values": value}
    if grid and isinstance(value, dict) and list(value) in (["uniform"], ["loguniform"]):
        doc.fail(path, f"is {next(iter(value))}, which a grid cannot list: give {_choices(forms)}, or a sampler "
                       "such as sample: {sobol: 256}.", name)  # fmt: skip
    form, numbers = _read_form(doc, path, value, forms, "put a fixed value under 'set'")
    path = (*path, form)
    if form == "values":
        if not numbers:
            doc.fail(path, "is an empty list, so the grid is empty: give at least one value.", name)
        if len(set(numbers)) < len(numbers):
            doc.fail(path, f"lists {_first_repeat(numbers):g} twice: every variant would be run twice.", name)
        check_value(doc, path, name, about, numbers)
        return Axis(name, form, tuple(numbers))
    counted = form in ("linspace", "logspace")
    wanted = (3,) if counted and grid else (2, 3) if counted else (2,)
    if len(numbers) not in wanted:
        doc.fail(path, f"is {form} with {len(numbers)} numbers: expected {AXIS_FORMS[form]}.", name)
    check_value(doc, path, name, about, numbers[:2])
    count = numbers[2] if len(numbers) == 3 else 2.0
    if not 1 <= count <= _LARGEST_AXIS or count != int(count):
        empty = ", so the grid is empty" if count == 0 else ""
        doc.fail(path, f"has the count {count:g}{empty}: expected a whole number from 1 to {_LARGEST_AXIS:,}.", name)
    if numbers[0] == numbers[1] and count > 1:
        doc.fail(path, f"runs from {numbers[0]:g} to the same value: every variant would be the same.", name)
    if not grid and numbers[0] > numbers[1]:
        doc.fail(path, f"has the bounds {numbers[0]:g} and {numbers[1]:g}: the lower one comes first.", name)
    if form.startswith("log") and min(numbers[:2]) <= 0:
        doc.fail(path, f"is {form} from {numbers[0]:g} to {numbers[1]:g}: both are end values (not exponents) and "
                       "above 0.", name)  # fmt: skip
    return Axis(name, form, tuple(numbers))


def read_draw(doc: Document, name: str, value: Any, about: Quantity) -> Draw:
    """Read and check the entry `randomize.name`."""
    path: FieldPath = ("randomize", name)
    form, numbers = _read_form(doc, path, value, DRAW_FORMS, "put a fixed value under 'set'")
    path = (*path, form)
    if len(numbers) != 2:
        doc.fail(path, f"is {form} with {len(numbers)} numbers: expected {DRAW_FORMS[form]}.", name)
    a, b = numbers
    if form == "normal":
        check_value(doc, path, name, about, [a])
        if not (0 < b < np.inf):
            doc.fail(path, f"has the standard deviation {b:g}: it must be above 0 and finite.", name)
    else:
        check_value(doc, path, name, about, numbers)
        if a >= b:
            doc.fail(path, f"has the bounds {a:g} and {b:g}: the lower one comes first.", name)
        if form == "loguniform" and a <= 0:
            doc.fail(path, f"is loguniform from {a:g}: both bounds must be above 0.", name)
    return Draw(name, form, (a, b), about.low, about.high)


def check_value(doc: Document, path: FieldPath, name: str, about: Quantity, value: Any) -> None:
    """Fail at `path` unless every number is finite and within the parameter's range."""
    try:
        about.check(name, value)
    except ParameterError as error:
        doc.fail(path, str(error).removeprefix(f"{name} "), name)


def read_number(doc: Document, path: FieldPath, value: Any, field: str | None = None) -> float:
    """A number, and not a truth value, a text or a list."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        doc.fail(path, f"is {describe(value)}: expected a number.", field)
    return float(value)


def _read_form(
    doc: Document, path: FieldPath, value: Any, forms: dict[str, str], otherwise: str
) -> tuple[str, list[float]]:
    """The single `form: [numbers]` of an entry."""
    name = str(path[-1])
    if not isinstance(value, dict) or len(value) != 1:
        doc.fail(path, f"is {describe(value)}: expected {_choices(forms)}; {otherwise}.", name)
    form, numbers = next(iter(value.items()))
    if form not in forms:
        doc.fail((*path, form), f"has the form '{form}': expected {_choices(forms)}{nearest(form, forms)}", name)
    if not isinstance(numbers, list):
        doc.fail((*path, form), f"is {form} of {describe(numbers)}: expected the list {forms[form]}.", name)
    return form, [read_number(doc, (*path, form, i), number, name) for i, number in enumerate(numbers)]


def _choices(forms: dict[str, str]) -> str:
    return " or ".join(f"{{{form}: {text}}}" for form, text in forms.items())


def _first_repeat(numbers: list[float]) -> float:
    return next(number for i, number in enumerate(numbers) if number in numbers[:i])


def _between(a: float, b: float, share: np.ndarray, *, log: bool) -> np.ndarray:
    value = a * (b / a) ** share if log else a + (b - a) * share
    return np.clip(value, min(a, b), max(a, b))
