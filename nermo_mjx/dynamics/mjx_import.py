"""MJX, imported once and quietly: on import it prints to stdout that warp is missing, which would spoil `--json`.

A model put after this import also has what MJX leaves out and the step brings back, and says what the step does not.
Its contacts are those of `collision`, whose number `mjx.make_data` has to know.
"""

# No `from __future__ import annotations`: MJX reads the types of a class's fields.
import contextlib
import io as standard_io
from typing import Any

import jax
import mujoco
import numpy as np

from nermo_mjx.dynamics.coverage import approximated, not_simulated, refused, side_sites

with contextlib.redirect_stdout(standard_io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, io, math

    from nermo_mjx.dynamics import collision

__all__ = ["Model", "Solved", "collision_driver", "mjx"]


class Model(mjx.Model):
    """A model of MJX with more of MuJoCo's fields, of the same names and shapes.

    Attributes:
        actuator_armature, actuator_damping, actuator_dampingpoly: that actuators give their joints and tendons.
        not_simulated, approximated: what the step leaves out, and does otherwise than C, see `coverage`.
    """

    actuator_armature: jax.Array
    actuator_damping: jax.Array
    actuator_dampingpoly: jax.Array
    not_simulated: tuple[str, ...]
    approximated: tuple[str, ...]


class Solved(mjx.Data):
    """Data within a step, with how well the constraint problem was solved.

    Attributes:
        residual: see `differentiable.Verdict`.
    """

    residual: jax.Array

    @classmethod
    def of(cls, data: mjx.Data) -> "Solved":
        """The data before a solve."""
        return cls(**_fields(data), residual=jax.numpy.zeros((), data.qpos.dtype))

    def plain(self) -> mjx.Data:
        """The data alone."""
        return mjx.Data(**_fields(self))


def _fields(data: mjx.Data) -> dict[str, Any]:
    return {field.name: getattr(data, field.name) for field in mjx.Data.fields()}


_put = io._put_model_jax


def _put_model(model: mujoco.MjModel, device: jax.Device | None = None) -> Model:
    """As MJX's `_put_model_jax`, which every `mjx.put_model` calls; what MJX refuses is said in a sentence."""
    for what in refused(model):
        raise NotImplementedError(f"{what}.")
    ours = _put(model, device)
    fields = {field.name: getattr(ours, field.name) for field in mjx.Model.fields()}
    more = {name: getattr(model, name) for name in ("actuator_armature", "actuator_damping", "actuator_dampingpoly")}
    wraps = np.isin(model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    within = np.zeros(model.nwrap, bool)
    for side in side_sites(model):
        within[side.wrap] = side.most < side.radius
    fields["_impl"] = ours._impl.replace(is_wrap_inside=within[wraps])
    said = {"not_simulated": tuple(not_simulated(model)), "approximated": tuple(approximated(model))}
    return Model(**fields, **jax.device_put(more, device), **said)


io._put_model_jax = _put_model
collision_driver._COLLISION_FUNC.update(collision.OURS)
math.closest_segment_point = collision.closest_on_segment
