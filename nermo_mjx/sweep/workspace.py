"""Strides and stances that the legs cannot reach are refused with the file's line."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from nermo_mjx.control import control_parameters
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Setup
from nermo_mjx.sweep.axes import Axis, Draw
from nermo_mjx.sweep.reading import Document

#: Values tried of a parameter that is sampled, and combinations tried in all.
_TRIED, _MOST_TRIED = 5, 50_000


def check_workspace(
    doc: Document,
    setup: Setup,
    fixed: Mapping[str, float],
    entries: Mapping[str, Sequence[Axis | Draw]],
    *,
    grid: bool,
) -> None:
    """Fail at the field whose values take a foot out of its leg's workspace.

    Args:
        setup: static choices; the leg's routing decides what it reaches.
        fixed: parameters with one value.
        entries: the parameters with several, by the section of the file that they stand in.
        grid: whether the axes are a grid, of which every value is tried; else a few within the bounds.
    """
    sections = dict.fromkeys(fixed, "set") | {entry.name: name for name in entries for entry in entries[name]}
    named = [name for name in sections if name == "stride" or name.startswith("stance.")]
    if not named:
        return
    values = {name: np.array([fixed[name]]) for name in named if name in fixed}
    for entry in itertools.chain(*entries.values()):
        if entry.name in named:
            listed = isinstance(entry, Axis) and (grid or entry.form == "values")
            # A normal draw has no largest value: all but one in a thousand on either side count.
            bounds = np.linspace(0.001 if entry.form == "normal" else 0.0, 0.999, _TRIED)
            values[entry.name] = entry.values() if isinstance(entry, Axis) and listed else entry.at(bounds)
    while math.prod(map(len, values.values())) > _MOST_TRIED:
        longest = max(values, key=lambda name: len(values[name]))
        values[longest] = values[longest][
            np.linspace(0, len(values[longest]) - 1, len(values[longest]) // 2).astype(int)
        ]
    mesh = dict(zip(values, np.meshgrid(*values.values(), indexing="ij"), strict=True))
    try:
        control_parameters(setup.gait, routing=setup.routing, **mesh)
    except ParameterError as error:
        subject, _, message = str(error).partition(" ")
        name = subject if subject in named else named[0]
        doc.fail((sections[name], name), message if subject == name else f"is refused: {error}", name)
