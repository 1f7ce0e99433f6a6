"""The comparison that a sweep file may request of the finished table."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field

from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.specs.fields import Fields, Refused, optional
from nermo_mjx.specs.reading import Document, describe

#: A value of a varied column.
Value = float | str


def _names(given: Any) -> Any:
    if isinstance(given, str):
        return [given]
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        raise Refused(f"is {describe(given)}: expected a list of varied parameters.")
    return given


class CompareFields(Fields):
    """The section `compare` of a sweep file."""

    what: ClassVar = "a field of a comparison"
    example: ClassVar = "by: NAME, of a varied column"
    by: str = Field(description="the varied column whose values are compared")
    base: float | str = optional("the baseline value; by default none, or the first")
    groups: Annotated[list[str], BeforeValidator(_names)] = Field(
        [], alias="for", description="varied columns: an interval for each combination of their values"
    )


@dataclasses.dataclass(frozen=True)
class AskedComparison:
    """A comparison that a sweep makes when it is complete; see `nermo_mjx.compare`.

    Attributes:
        by: the varied column whose values are compared.
        base: the baseline value; None for `none`, or the first.
        groups: the columns that make groups.
    """

    by: str
    base: Value | None
    groups: tuple[str, ...]

    def written(self) -> dict[str, Any]:
        """As written in a sweep file."""
        return {"by": self.by} | ({} if self.base is None else {"base": self.base}) | {"for": list(self.groups)}


def read_comparison(
    doc: Document, fields: CompareFields | None, varied: Mapping[str, Sequence[Value] | None]
) -> AskedComparison | None:
    """Check the section `compare`.

    Args:
        varied: the values of each varied column; None where they are drawn between bounds.
    """
    if fields is None:
        return None
    for path, name in ((("compare", "by"), fields.by), *((("compare", "for"), name) for name in fields.groups)):
        if name not in varied:
            doc.fail(path, f"names {name!r}, which is not varied{did_you_mean(name, varied)} Varied: "
                           f"{', '.join(varied) or 'nothing'}.")  # fmt: skip
        if varied[name] is None:
            doc.fail(path, f"names {name!r}, which is drawn between bounds, so that no two variants share a value: "
                           "list its values.")  # fmt: skip
    values = list(varied[fields.by] or ())
    if len(values) < 2:
        doc.fail(("compare", "by"), f"names {fields.by!r}, which has one value: there is nothing to compare.")
    if fields.by in fields.groups:
        doc.fail(("compare", "for"), f"names {fields.by!r}, whose values are compared: name other columns.")
    if fields.base is not None and fields.base not in values:
        listed = [value if isinstance(value, str) else f"{value:g}" for value in values]
        doc.fail(("compare", "base"), f"is {describe(fields.base)}, no value of {fields.by}; allowed are "
                                      f"{', '.join(listed)}{did_you_mean(str(fields.base), listed)}")  # fmt: skip
    return AskedComparison(fields.by, fields.base, tuple(dict.fromkeys(fields.groups)))
