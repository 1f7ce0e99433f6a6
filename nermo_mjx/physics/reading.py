"""Skips sensors that are not read: an accelerometer alone takes a pass over the whole tree and back."""

from __future__ import annotations

import dataclasses

import numpy as np
from jax.extend.core import ClosedJaxpr, Var
from jaxtyping import Bool

from nermo_mjx.dynamics.mjx_import import mjx


def read_entries(program: ClosedJaxpr, size: int) -> Bool[np.ndarray, " size"]:
    """The entries of its last argument that a program's results depend on.

    Args:
        program: its last argument is (..., size); any use other than slicing counts as reading all of it.
        size: length of that argument's last axis.
    """
    last, read = program.jaxpr.invars[-1], np.zeros(size, bool)
    needed = {var for var in program.jaxpr.outvars if isinstance(var, Var)}
    for step in reversed(program.jaxpr.eqns):
        if not (step.effects or needed.intersection(step.outvars)):
            continue
        needed.update(var for var in step.invars if isinstance(var, Var))
        if step.primitive.name == "slice" and step.invars[0] is last:
            read[step.params["start_indices"][-1] : step.params["limit_indices"][-1]] = True
        elif any(var is last for var in step.invars):
            read[:] = True
    read |= last in program.jaxpr.outvars
    return read


def with_sensors(model: mjx.Model, read: Bool[np.ndarray, " nsensordata"]) -> mjx.Model:
    """The model with only the sensors whose entries are read; the entries keep their positions."""
    if read.all():
        return model
    kept = np.array(
        [read[start : start + size].any() for start, size in zip(model.sensor_adr, model.sensor_dim, strict=True)], bool
    )
    fields = {
        field.name: np.asarray(getattr(model, field.name))[kept]
        for field in dataclasses.fields(model)
        if field.name.startswith("sensor_")
    }
    return model.replace(nsensor=int(kept.sum()), **fields)
