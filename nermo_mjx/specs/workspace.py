"""Strides and stances that the legs cannot reach are refused with the file's line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from nermo_mjx.control import control_parameters
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Setup
from nermo_mjx.specs.reading import Document

#: Combinations of values tried in all.
_MOST_TRIED: Final = 50_000


def check_workspace(
    doc: Document, setup: Setup, fixed: Mapping[str, float], tried: Mapping[str, Mapping[str, np.ndarray]]
) -> None:
    """Fail at the field whose values move a foot out of its leg's workspace.

    Args:
        setup: static choices; the leg's routing decides what it reaches.
        fixed: parameters with one value.
        tried: values to try of the others, by the section of the file and by name.
    """
    if setup.controller is not None:
        return  # it checks its own workspace when it is simulated
    parts = {"set": {name: np.array([value]) for name, value in fixed.items()}, **tried}
    sections = {name: section for section, names in parts.items() for name in names if _of_legs(name)}
    if not sections:
        return
    values = {name: parts[section][name] for name, section in sections.items()}
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
        name = subject if subject in sections else next(iter(sections))
        doc.fail((sections[name], name), message if subject == name else f"is refused: {error}", name)


def _of_legs(name: str) -> bool:
    return name == "stride" or name.startswith(("stance.", "geometry.front_leg.", "geometry.rear_leg."))
