"""Physical quantities: array fields of a parameter tree, each with its unit, default, range and meaning.

A parameter tree is a frozen dataclass registered as a JAX pytree whose leaves are declared with `quantity`. The
declaration is the only place that states a parameter's unit and range: validation, `--list-parameters` and the
metadata of result tables all use it.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import importlib.util
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import (
    Any,
    Final,
    Literal,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import jax
import numpy as np

T = TypeVar("T")
#: SI unit -> the other units that a number in a text may have, and how many of each make one SI unit: 1 m is 1e3 mm.
_UNIT_FACTORS: Final[Mapping[str, Mapping[str, float]]] = {
    "1": {"%": 1e2},
    "m": {"mm": 1e3, "cm": 1e2},
    "rad": {"deg": math.degrees(1.0)},
    "s": {"ms": 1e3},
    "kg": {"g": 1e3},
    "m/s": {"mm/s": 1e3, "cm/s": 1e2},
    "rad/s": {"deg/s": math.degrees(1.0)},
    "N m": {"N mm": 1e3},
    "A": {"mA": 1e3},
    "A h": {"mA h": 1e3},
}
#: A number within a text.
_NUMBER: Final = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?"


class ParameterError(ValueError):
    """An invalid parameter; the message names the field, its value and the allowed range."""


def require(option: str, library: str, extra: str) -> None:
    """Checks that a library is installed that only an extra of this package installs.

    Call it before any expensive computation.

    >>> require("A walk", "numpy", "drive")

    Args:
        option: Subject of the message: the option, method or field that needs the library.
        library: Name of the library's top-level module.
        extra: Name of the extra.

    Raises:
        ParameterError: The library is not installed; the message contains the command that installs it.
    """
    if importlib.util.find_spec(library) is None:
        raise ParameterError(f'{option} needs {library}: pip install "nermo-mjx[{extra}]".')


def of_type(field: str, value: T, kinds: type | tuple[type, ...], expected: str) -> T:
    """Return the value if it has one of these types. A truth value counts as none of them.

    Raises:
        ParameterError: The value has another type; the message names the field, the value and the expected value.
    """
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise ParameterError(f"{field} is {value!r}: expected {expected}.")
    return value


@dataclasses.dataclass(frozen=True)
class Quantity:
    """The declaration of one parameter.

    Attributes:
        default: Value of the published robot, a float or a tuple (one number for each of `labels`).
        unit: SI unit, "rad", or "1" for a pure number.
        low, high: Bounds of the allowed range; `open_low`/`open_high` exclude the bound itself.
        doc: Meaning in one line.
        labels: Names of the components of a vector quantity; empty for a scalar.
    """

    default: float | tuple[float, ...]
    unit: str
    low: float
    high: float
    doc: str
    open_low: bool = False
    open_high: bool = False
    labels: tuple[str, ...] = ()

    def allowed(self) -> str:
        """The allowed range in words, for error messages and listings."""
        left_bracket = "(" if self.open_low or math.isinf(self.low) else "["
        right_bracket = ")" if self.open_high or math.isinf(self.high) else "]"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{left_bracket}{self.low:g}, {self.high:g}{right_bracket}{unit}"

    @property
    def _in_units(self) -> dict[str, float]:
        """Unit that a number in a text may have -> how many of it make one of this quantity's unit."""
        return ({} if self.unit == "1" else {self.unit: 1.0}) | dict(
            _UNIT_FACTORS.get(self.unit, {})
        )

    @property
    def pattern(self) -> str:
        """The regular expression for a text that contains a number, with one of the units or without a unit."""
        units = "|".join(unit.replace("^", r"\^") for unit in self._in_units)
        return rf"^\s*({_NUMBER})\s*({units})?\s*$"

    @property
    def expected(self) -> str:
        """The expected form of a number, with its units and an example, for error messages."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        *others, last = self._in_units
        units = f"{', '.join(others)} or {last}" if others else last
        unit_note = f" in {units}" if unit else f", or one in {units}"
        return f"expected a number{unit_note}, such as {np.ravel(self.default)[0]:g}{unit}."

    def number(self, text: str) -> float | None:
        """Return the number in a text, in the SI unit, or None if the text contains no number of this quantity.

        >>> Quantity(0.0, "rad", -math.pi, math.pi, "of a swing").number("-45 deg")
        -0.7853981633974483
        """
        match = re.fullmatch(self.pattern, text)
        return None if match is None else float(match[1]) / self._in_units.get(match[4], 1.0)

    def numbers(self, name: str, value: Any) -> Any:
        """Replace each text in a value, which may be a nested list, by its SI number. Other values are unchanged.

        Raises:
            ParameterError: A text is not a number, its unit does not convert, or there is a truth value.
        """
        if isinstance(value, np.ndarray) and value.dtype.kind in "OUb":
            value = value.tolist()
        if isinstance(value, (list, tuple)):
            return [self.numbers(name, element) for element in value]
        number = self.number(value) if isinstance(value, str) else value
        if number is None or isinstance(value, (bool, np.bool_)):
            raise ParameterError(f"{name} is {value!r}: {self.expected}")
        return number

    def check(self, name: str, value: Any) -> None:
        """Raise `ParameterError` unless every number in `value` is finite and in range."""
        try:
            numbers = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            raise ParameterError(
                f"{name} is {value!r}: expected a number in {self.allowed()}."
            ) from None
        # A closed bound includes its own rounding to float32.
        below = numbers <= self.low if self.open_low else numbers < self.low - 1e-6 * abs(self.low)
        above = (
            numbers >= self.high if self.open_high else numbers > self.high + 1e-6 * abs(self.high)
        )
        bad = ~np.isfinite(numbers) | below | above
        if bad.any():
            worst = numbers[bad].flat[0]
            raise ParameterError(f"{name} is {worst:g}: allowed is {self.allowed()}.")


def quantity(
    default: float | tuple[float, ...],
    unit: str,
    low: float = -math.inf,
    high: float = math.inf,
    doc: str = "",
    *,
    open_low: bool = False,
    open_high: bool = False,
    labels: tuple[str, ...] = (),
) -> Any:
    """Declare a field of a parameter tree (see `parameter_tree`) that contains a quantity.

    The arguments are the attributes of `Quantity`.
    """
    if not doc:
        raise TypeError("quantity() has no doc: expected the quantity's meaning in one line")
    declaration = Quantity(default, unit, low, high, doc, open_low, open_high, labels)

    def new_array() -> np.ndarray:
        """Each tree has its own array, because JAX caches by array and would mix up programs in 32 and 64 bits."""
        value = np.array(default, dtype=np.float64)
        value.flags.writeable = False
        return value

    return dataclasses.field(default_factory=new_array, metadata={"quantity": declaration})


@dataclass_transform(frozen_default=True, field_specifiers=(quantity, dataclasses.field))
def parameter_tree(cls: type[T]) -> type[T]:
    """Class decorator: a frozen, keyword-only dataclass that is a JAX pytree.

    >>> @parameter_tree
    ... class Hop:
    ...     height: Any = quantity(0.01, "m", 0.0, 0.03, "of a hop")
    >>> [(name, declaration.allowed()) for name, declaration in quantities(Hop)]
    [('height', '[0, 0.03] m')]
    """
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, kw_only=True)(cls))


def quantities(tree: Any, prefix: str = "") -> Iterator[tuple[str, Quantity]]:
    """Yield (dotted name, quantity) of every scalar parameter of a tree (or tree class), in order.

    A vector quantity yields one entry per component, `name.label`. A sub-tree contributes its field name as prefix.
    Fields that are neither are skipped.
    """
    for name, declaration, _ in _fields(tree, prefix):
        if not declaration.labels:
            yield name, declaration
        for i, label in enumerate(declaration.labels):
            yield f"{name}.{label}", _of_component(declaration, i)


def gathered(declarations: Mapping[str, Quantity]) -> Iterator[tuple[str, Quantity]]:
    """Yield names and quantities for a listing, in which a long vector is one entry.

    More than four entries are a vector if their quantities are equal and their names differ only in the last part.

    >>> alike = Quantity(0.0, "m", 0.0, 1.0, "of a path")
    >>> [name for name, _ in gathered({f"path.y{i}": alike for i in range(6)})]
    ['path.y0 ... path.y5']
    """
    vectors: dict[tuple[str, Quantity], list[str]] = {}
    for name, declaration in declarations.items():
        vectors.setdefault((name.rpartition(".")[0], declaration), []).append(name)
    for name, declaration in declarations.items():
        names = vectors[name.rpartition(".")[0], declaration]
        if len(names) <= 4:
            yield name, declaration
        elif name == names[0]:
            yield f"{name} ... {names[-1]}", declaration


def values_of(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of every scalar parameter of a tree, in the order of `quantities`."""
    for name, declaration, value in _fields(tree, prefix):
        if not declaration.labels:
            yield name, value
        parts = (
            value if isinstance(value, jax.Array) or not declaration.labels else np.asarray(value)
        )
        yield from (
            (f"{name}.{label}", parts[..., i]) for i, label in enumerate(declaration.labels)
        )


def replace_quantities(tree: T, values: Mapping[str, Any]) -> T:
    """Return a copy of `tree` with the named quantities replaced (names as `quantities` yields them).

    A value may be a number, a numpy array or a traced array, of any batch shape; a component of a vector quantity is
    written into the last axis. Values are not checked: see `check_quantities`.
    """
    unknown = set(values)
    replaced = _replace(tree, values, "", unknown) if values else tree
    if unknown:
        name = sorted(unknown)[0]
        # The names of the class include optional sub-trees that this tree does not have.
        allowed = dict(quantities(tree)) | dict(quantities(type(tree)))
        raise ParameterError(f"{name} is not a parameter{did_you_mean(name, allowed)}")
    return replaced


def check_quantities(tree: Any, prefix: str = "") -> None:
    """Raise `ParameterError` if any quantity of the tree is not finite or out of range."""
    for name, declaration, value in _fields(tree, prefix):
        try:
            declaration.check(name, value)
        except ParameterError:  # for a vector, the error of a component names this component
            for i, label in enumerate(declaration.labels):
                declaration.check(f"{name}.{label}", np.asarray(value)[..., i])
            raise


def _fields(tree: Any, prefix: str) -> Iterator[tuple[str, Quantity, Any]]:
    """Yield dotted name, quantity and value of every field of a tree; a vector is one entry.

    For a class instead of a tree, the values mean nothing.
    """
    for field in dataclasses.fields(tree) if dataclasses.is_dataclass(tree) else ():
        declaration = field.metadata.get("quantity")
        value = getattr(tree, field.name, field.default_factory if declaration is None else None)
        if declaration is None:
            yield from _fields(value, prefix + _prefix(field))
        else:
            yield prefix + field.name, declaration, value


def _prefix(field: dataclasses.Field[Any]) -> str:
    """The beginning of the names of a sub-tree's quantities; empty for a field that `flat` declares."""
    return "" if field.metadata.get("flat") else field.name + "."


@functools.cache
def _of_component(declaration: Quantity, component: int) -> Quantity:
    """The quantity of one component of a vector."""
    assert isinstance(declaration.default, tuple)
    return dataclasses.replace(declaration, default=declaration.default[component], labels=())


def _replace(tree: Any, values: Mapping[str, Any], prefix: str, unknown: set[str]) -> Any:
    """Replace the values whose names begin with the prefix of a tree, and remove their names from `unknown`."""
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(tree) if dataclasses.is_dataclass(tree) else ():
        declaration, value = field.metadata.get("quantity"), getattr(tree, field.name)
        if declaration is None:
            sub = _replace(value, values, prefix + _prefix(field), unknown)
            changes |= {} if sub is value else {field.name: sub}
        elif prefix + field.name in values and not declaration.labels:
            changes[field.name] = values[prefix + field.name]
            unknown.discard(prefix + field.name)
        elif declaration.labels and any(
            f"{prefix}{field.name}.{label}" in values for label in declaration.labels
        ):
            names = [f"{prefix}{field.name}.{label}" for label in declaration.labels]
            parts = [values.get(name, value[..., i]) for i, name in enumerate(names)]
            xp = jax.numpy if any(isinstance(part, jax.Array) for part in parts) else np
            changes[field.name] = xp.stack(xp.broadcast_arrays(*parts), axis=-1)
            unknown.difference_update(names)
    return dataclasses.replace(tree, **changes) if changes else tree


def flat(sub: type[T]) -> Any:
    """Declare a sub-tree whose quantities are named without the field's name (`frequency`, not `gait.frequency`)."""
    return dataclasses.field(default_factory=sub, metadata={"flat": True})


def group(sub: type[T]) -> Any:
    """Declare a sub-tree whose quantities are named `field.quantity`."""
    return dataclasses.field(default_factory=sub)


# ---
# Choices made before anything compiles: a field of a frozen dataclass, with its meaning; its type lists the names.


def static(default: Any, doc: str) -> Any:
    """Declare a dataclass field that holds a choice, a name or an object, made before anything compiles.

    The type of the field states the allowed names, as a `Literal`: see `allowed_names`.

    Args:
        default: Default value.
        doc: Meaning.
    """
    return dataclasses.field(default=default, metadata={"doc": doc})


@functools.cache
def allowed_names(cls: type) -> dict[str, tuple[str, ...]]:
    """Return the allowed names of each field of a class whose type is a `Literal`, or a `Literal` or None.

    >>> class Mat:
    ...     pile: Literal["short", "long"]
    ...     width: float
    >>> allowed_names(Mat)
    {'pile': ('short', 'long')}
    """
    return {
        name: get_args(kind)
        for name, hint in get_type_hints(cls).items()
        for kind in (hint, *get_args(hint))
        if get_origin(kind) is Literal
    }


def with_attributes(cls: type[T]) -> type[T]:
    """Class decorator: the docstring of a dataclass lists the fields that `static` declares."""
    lines, allowed = [], allowed_names(cls)  # type: ignore[arg-type]
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        names = allowed.get(field.name, ())
        lines.append(
            f"{field.name}: {field.metadata['doc']}{'; one of ' * bool(names)}{', '.join(names)}."
        )
    cls.__doc__ = "\n        ".join((f"{cls.__doc__}\n    Attributes:", *lines)) + "\n"
    return cls


# ---
# Checks of names, and suggestions for misspelled names.


#: Minimum similarity of a suggestion: the fraction of letters that both names have in the same order.
MIN_SIMILARITY: Final = 0.6


def nearest(name: str, allowed: Iterable[str]) -> str | None:
    """Return the allowed name that is most similar to `name`, as a whole or in its last parts, or None.

    >>> nearest("foot_radius", ["contact.friction", "foot", "geometry.foot.radius"])
    'geometry.foot.radius'
    >>> nearest("spine.ampl", ["gait.amplitude", "spine.amplitude"])
    'spine.amplitude'
    """
    # A longer name is similar to none, and the time of a comparison is proportional to the lengths of both names.
    name_parts = _parts(name[:100])

    def similarity(full: str) -> tuple[float, float]:
        """The largest similarity of the compared parts, and the similarity of the whole names."""
        parts = _parts(full)
        # The name is compared with as many last parts as it has, with one more (because a missing separator joins two
        # parts), with all parts in alphabetical order, and with all parts in their order.
        pairs = [(name_parts, parts[-count:]) for count in (len(name_parts), len(name_parts) + 1)]
        pairs += [(sorted(name_parts), sorted(parts)), (name_parts, parts)]
        ratios = [
            difflib.SequenceMatcher(None, ".".join(name_part), ".".join(candidate_part)).ratio()
            for name_part, candidate_part in pairs
        ]
        return max(ratios), ratios[-1]

    ranked = sorted(
        ((similarity(full), full) for full in allowed),
        key=lambda candidate: candidate[0],
        reverse=True,
    )
    return ranked[0][1] if ranked and ranked[0][0][0] >= MIN_SIMILARITY else None


def _parts(name: str) -> list[str]:
    return re.split(r"[._\- ]+", name.lower())


def did_you_mean(name: str, allowed: Iterable[str]) -> str:
    """The end of a message: `; did you mean 'x'?` for the nearest allowed name, or a full stop if there is none."""
    suggestions = nearest(name, allowed)
    return f"; did you mean {suggestions!r}?" if suggestions else "."


def choice(field: str, name: str, options: Iterable[str]) -> str:
    """Return `name` if it is one of `options`.

    Raises:
        ParameterError: The name is not allowed; the message contains the field, the name, the nearest option and all
            options.
    """
    names = list(options)
    if name in names:
        return name
    near = nearest(str(name), names)
    hint = f"did you mean {near!r}? " if near else ""
    allowed = (
        ", ".join(names)
        if len(names) <= 12
        else f"{', '.join(names[:4])}, ... ({len(names)} names)"
    )
    raise ParameterError(f"{field} is {name!r}: {hint}allowed is one of {allowed}.")
