"""By which method a tuning steps: along exact gradients, along differences, or by CMA-ES."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, ClassVar, Final

from nermo_mjx.specs.fields import Fields, OneOf, optional
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.values import Choice, Positive, Whole

#: Fraction of a parameter's bounds between a point and its neighbours: secants of this width are useful.
STEP: Final = 0.02
#: First standard deviation of CMA-ES, in coordinates u.
SIGMA: Final = 2.0
#: Fields of a tuning file that only some methods read.
_READ_BY: Final = {
    "optimizer": ("gradient", "differences"), "estimator": ("gradient",), "mode": ("gradient",),
    "starts": ("gradient", "differences"),
}  # fmt: skip


class CmaFields(Fields):
    what: ClassVar = "an option of 'cma'"
    sigma: Positive = optional("first standard deviation, in coordinates u, by default 2")
    population: Annotated[int, Whole(4, 100_000)] = optional("points of a generation, by default what fills two cores")


class DifferencesFields(Fields):
    what: ClassVar = "an option of 'differences'"
    scheme: Annotated[str, Choice(("central", "forward"))] = optional("on which sides a slope is measured")
    step: Positive = optional("to the neighbours, as a share of the bounds, by default 0.02")


class MethodFields(OneOf):
    """How an iteration finds its step, as written in a file."""

    alone: ClassVar = ("gradient", "cma", "differences")
    expected: ClassVar = "gradient, cma or differences as a name, or {name: {option: value}}"
    other: ClassVar = "is not a method"
    other_name: ClassVar = "is {name!r}"
    gradient: None = optional("exact derivatives, from MJX")
    cma: CmaFields | None = optional("CMA-ES, on MuJoCo C")
    differences: DifferencesFields | None = optional("differences between neighbours, on MuJoCo C")


@dataclasses.dataclass(frozen=True)
class Method:
    """A method by name.

    Attributes:
        name: `gradient`, `cma` or `differences`.
        sigma, population: of `cma`.
        scheme, step: of `differences`.
    """

    name: str = "gradient"
    sigma: float = SIGMA
    population: int = 16
    scheme: str = "central"
    step: float = STEP

    @property
    def engine(self) -> str:
        """Name of the engine that evaluates."""
        return "mjx" if self.name == "gradient" else "c"

    @property
    def has_gradient(self) -> bool:
        """Whether its history has gradients."""
        return self.name != "cma"

    def neighbours(self, parameters: int) -> int:
        """Runs beside that of a point itself, for differences."""
        return parameters * (2 if self.scheme == "central" else 1)

    def written(self) -> dict[str, Any]:
        """As written in a tuning file; omitted for `gradient`."""
        if self.name == "gradient":
            return {}
        names = ("sigma", "population") if self.name == "cma" else ("scheme", "step")
        return {"method": {self.name: {name: getattr(self, name) for name in names}}}


def reads(method: str, field: str) -> bool:
    """Whether a method reads a field of a tuning file."""
    return method in _READ_BY.get(field, (method,))


def read_method(doc: Document, given: MethodFields | None) -> Method:
    """The method; a field that it does not read is refused."""
    if given is None:
        return Method()
    name, options = given.chosen
    for field, readers in _READ_BY.items():
        if field in doc.data and name not in readers:
            hint = "; give method: {cma: {population: N}}" if field == "starts" else ""
            doc.fail((field,), f"is not read by the method {name}, but by {' and '.join(readers)} alone{hint}.")
    return Method(name, **({} if options is None else options.model_dump(exclude_unset=True)))
