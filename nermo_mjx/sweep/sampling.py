"""How a parameter gets its values: axes that are varied, draws at random, and designs of several axes."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final, Self

import numpy as np
from pydantic import AfterValidator, Field, PrivateAttr
from scipy import special

from nermo_mjx.robot.quantity import Quantity, require
from nermo_mjx.specs.fields import Fields, OneOf, Refused, optional
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.values import QUANTITY_SCHEMA, Numbers, Whole, check_value

# ---
# How one parameter gets its values: an `Axis` is varied systematically, a `Draw` at random.


_LARGEST_AXIS: Final = 1_000_000
_MAX_TRIES: Final = 5
_MEAN_SHARES: Final = 4096
_Steps = Annotated[list[float], Numbers("[from, to, count]", 2, 3)]
_Bounds = Annotated[list[float], Numbers("[low, high]", 2, 2)]


def settled(value: float) -> float:
    """A number without what arithmetic left in its last digits, so that equal variants are one.

    >>> settled(7 * 0.1), settled(1 / 3)
    (0.7, 0.3333333333333333)
    """
    short = float(f"{value:.12g}")
    return short if abs(value - short) <= 4 * math.ulp(value) else value


class _Values(OneOf):
    """How a file gives the parameter `name` its values: `form` is the given field, and `numbers` its list."""

    other: ClassVar = "has the form {name!r}"
    _name: str = PrivateAttr("")
    _range: tuple[float, float] = PrivateAttr((-np.inf, np.inf))
    _implied: bool = PrivateAttr(False)

    def of(self, name: str, declaration: Quantity, implied: bool = False) -> Self:
        """With what its section's key says, and the range of the parameter."""
        self._name, self._range, self._implied = name, (declaration.low, declaration.high), implied
        return self

    name = property(lambda self: self._name)
    form = property(lambda self: self.chosen[0])
    numbers = property(lambda self: tuple(self.chosen[1]))


class Axis(_Values):
    """A varied parameter; with a sampler, `linspace` and `logspace` need no count."""

    expected: ClassVar = (
        "{linspace: [from, to, count]} or {logspace: [from, to, count]} or {values: [a, b, ...]}, with a sampler also "
        "{uniform: [low, high]} or {loguniform: [low, high]}; put a fixed value under 'set'"
    )
    short: ClassVar = ({"type": "array", "items": QUANTITY_SCHEMA, "minItems": 1},)
    linspace: _Steps = optional("evenly spaced, both ends included")
    logspace: _Steps = optional("evenly in the logarithm; the ends are values, not exponents")
    values: Annotated[
        list[float],
        Numbers("[a, b, ...]", 1),
        AfterValidator(lambda listed: [*map(settled, listed)]),
    ] = optional("these")
    uniform: _Bounds = optional("between the bounds, with a sampler")
    loguniform: _Bounds = optional("evenly in the logarithm, with a sampler")

    @classmethod
    def written_out(cls, value: Any) -> Any:
        return {"values": value} if isinstance(value, list) else super().written_out(value)

    def listed(self) -> np.ndarray:
        """The values of the axis on a grid, shape (n,)."""
        if self.form == "values":
            return np.asarray(self.numbers, dtype=float)
        space = np.linspace if self.form == "linspace" else np.geomspace
        steps = space(self.numbers[0], self.numbers[1], int(self.numbers[2]))
        # 0.88 and not 0.8799999999999999, 0 and not 4e-16: users filter tables by such values. The ends stay as given.
        steps[1:-1] = [float(f"{step:.12g}") for step in steps[1:-1]]
        steps[1:-1][np.abs(steps[1:-1]) < 1e-12 * np.abs(steps).max()] = 0.0
        return np.asarray(steps, dtype=float)

    def at(self, share: np.ndarray) -> np.ndarray:
        """Values for shares in [0, 1) of the axis, as the samplers draw them; listed values are drawn equally often."""
        if self.form == "values":
            return self.listed()[np.floor(share * len(self.numbers)).astype(int)]
        return _between(
            self.numbers[0], self.numbers[1], share, log=self.form in ("logspace", "loguniform")
        )

    def tried(self, *, grid: bool) -> np.ndarray:
        """Values to try before a sweep begins: all of a grid, else a few within the bounds."""
        return (
            self.listed()
            if grid or self.form == "values"
            else self.at(np.linspace(0.0, 0.999, _MAX_TRIES))
        )

    def written(self) -> dict[str, list[float]]:
        """The axis as written in a sweep file."""
        count = (
            [int(self.numbers[2])]
            if self.form in ("linspace", "logspace") and len(self.numbers) == 3
            else []
        )
        return {
            self.form: [*self.numbers[:2], *count] if self.form != "values" else list(self.numbers)
        }


class Draw(_Values):
    """A randomized parameter."""

    expected: ClassVar = (
        "{uniform: [low, high]} or {loguniform: [low, high]} or {normal: [mean, std]};"
        " put a fixed value under 'set'"
    )
    uniform: _Bounds = optional("between the bounds")
    loguniform: _Bounds = optional("evenly in the logarithm")
    normal: Annotated[list[float], Numbers("[mean, std]", 2, 2)] = optional(
        "truncated to the range"
    )
    #: Whether no file names it: with repeats the start is perturbed, except for the first repeat.
    implied = property(lambda self: self._implied)

    def at(self, share: np.ndarray) -> np.ndarray:
        """The quantile function of the distribution at shares in [0, 1)."""
        a, b = self.numbers
        if self.form != "normal":
            return _between(a, b, share, log=self.form == "loguniform")
        low, high = (special.ndtr((end - a) / b) for end in self._range)
        return np.clip(a + b * special.ndtri(low + (high - low) * share), *self._range)

    def mean(self) -> float:
        """Mean of the distribution."""
        return float(self.at((np.arange(_MEAN_SHARES) + 0.5) / _MEAN_SHARES).mean())

    def tried(self) -> np.ndarray:
        """A few values within the bounds; for a normal draw, all but one in a thousand on either side."""
        return self.at(np.linspace(0.001 if self.form == "normal" else 0.0, 0.999, _MAX_TRIES))

    def written(self) -> dict[str, list[float]]:
        """The draw as written in a sweep file."""
        return {self.form: list(self.numbers)}


def read_axis(doc: Document, name: str, axis: Axis, declaration: Quantity, *, grid: bool) -> Axis:
    """Check the entry `vary.name`; `grid` tells whether the sampler needs listed values or only bounds."""
    form, numbers = axis.chosen
    path = ("vary", name, form)
    if grid and form in ("uniform", "loguniform"):
        doc.fail(
            path,
            f"is {form}, which a grid cannot list: give {{linspace: [from, to, count]}}, or a sampler "
            "such as sample: {sobol: 256}.",
            name,
        )
    if form == "values":
        if not numbers:
            doc.fail(path, "is an empty list, so the grid is empty: give at least one value.", name)
        if len(set(numbers)) < len(numbers):
            twice = next(number for i, number in enumerate(numbers) if number in numbers[:i])
            doc.fail(path, f"lists {twice:g} twice: every variant would be run twice.", name)
        check_value(doc, path, name, declaration, numbers)
        return axis.of(name, declaration)
    if grid and len(numbers) != 3:
        doc.fail(path, f"is {form} with {len(numbers)} numbers: expected [from, to, count].", name)
    check_value(doc, path, name, declaration, numbers[:2])
    count = numbers[2] if len(numbers) == 3 else 2.0
    if not 1 <= count <= _LARGEST_AXIS or count != int(count):
        empty = ", so the grid is empty" if count == 0 else ""
        doc.fail(
            path,
            f"has the count {count:g}{empty}: expected a whole number from 1 to {_LARGEST_AXIS:,}.",
            name,
        )
    if numbers[0] == numbers[1] and count > 1:
        doc.fail(
            path,
            f"runs from {numbers[0]:g} to the same value: every variant would be the same.",
            name,
        )
    if not grid and numbers[0] > numbers[1]:
        doc.fail(
            path,
            f"has the bounds {numbers[0]:g} and {numbers[1]:g}: the lower one comes first.",
            name,
        )
    if form.startswith("log") and min(numbers[:2]) <= 0:
        doc.fail(
            path,
            f"is {form} from {numbers[0]:g} to {numbers[1]:g}: both are end values (not exponents) and above 0.",
            name,
        )
    return axis.of(name, declaration)


def read_draw(doc: Document, name: str, draw: Draw, declaration: Quantity) -> Draw:
    """Check the entry `randomize.name`."""
    form, (a, b) = draw.chosen
    path = ("randomize", name, form)
    check_value(doc, path, name, declaration, [a] if form == "normal" else [a, b])
    if form == "normal" and not 0 < b < np.inf:
        doc.fail(path, f"has the standard deviation {b:g}: it must be above 0 and finite.", name)
    if form != "normal" and a >= b:
        doc.fail(path, f"has the bounds {a:g} and {b:g}: the lower one comes first.", name)
    if form == "loguniform" and a <= 0:
        doc.fail(path, f"is loguniform from {a:g}: both bounds must be above 0.", name)
    return draw.of(name, declaration)


def _between(a: float, b: float, share: np.ndarray, *, log: bool) -> np.ndarray:
    value = a * (b / a) ** share if log else a + (b - a) * share
    return np.clip(value, min(a, b), max(a, b))


# ---
# Saltelli's design: the sample from which Sobol indices are found, by SALib, whose designs and estimators match each
# other, and which provides the intervals.


_MAX_AXIS_POINTS = 2**20


def _power_of_two(points: int) -> int:
    if points & (points - 1):
        near = 2 ** (points.bit_length() - 1)
        raise Refused(
            f"is {points}: expected a power of two, such as {near} or {2 * near}, because no other number of "
            "points of a Sobol sequence is balanced."
        )
    return points


class Saltelli(Fields):
    """The sampler `saltelli` of a sweep file: a number of points, or a mapping."""

    what: ClassVar = "a field of saltelli"
    expected: ClassVar = "a power of two, or {points: N, second_order: true}"
    example: ClassVar = "points: N, a power of two"
    short: ClassVar = ({"type": "integer", "minimum": 2, "maximum": _MAX_AXIS_POINTS},)
    points: Annotated[int, Whole(2, _MAX_AXIS_POINTS), AfterValidator(_power_of_two)] = Field(
        description="points of a Sobol sequence, a power of two; with p parameters they make points x (p + 2) variants"
    )
    second_order: bool = Field(
        False, description="indices of pairs, too, from points x (2 p + 2) variants"
    )

    @classmethod
    def written_out(cls, value: Any) -> Any:
        return (
            {"points": value}
            if isinstance(value, int | float) and not isinstance(value, bool)
            else value
        )


def saltelli_size(parameters: int, second_order: bool) -> int:
    """Variants for each point of the sequence."""
    return 2 * parameters + 2 if second_order else parameters + 2


def saltelli_points(parameters: int, points: int, second_order: bool, seed: int) -> np.ndarray:
    """The design in the unit cube, (points x `saltelli_size`, parameters).

    Twice as many points begin with the same ones. Each point gives a block of rows: itself, itself with one parameter
    after the other from a second point, and that second point (Saltelli et al., Comput. Phys. Commun. 181, 2010).
    """
    require("sample: saltelli", "SALib", "sensitivity")
    from SALib.sample import sobol  # takes a second or more, as it brings pandas

    design: np.ndarray = sobol.sample(
        unit_problem(parameters), points, calc_second_order=second_order, seed=seed
    )
    return design


def unit_problem(parameters: int) -> dict[str, Any]:
    """The unit cube as SALib describes it."""
    return {
        "num_vars": parameters,
        "names": [f"x{i}" for i in range(parameters)],
        "bounds": [[0, 1]] * parameters,
    }
