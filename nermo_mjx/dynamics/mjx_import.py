"""MJX, imported once and quietly: on import it prints to stdout that warp is missing, which would spoil `--json`."""

# No `from __future__ import annotations`: MJX reads the types of a class's fields.
import contextlib
import io as standard_io

import jax

with contextlib.redirect_stdout(standard_io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, math
    from mujoco.mjx._src.collision_types import GeomInfo

__all__ = ["GeomInfo", "Model", "Solved", "collision_driver", "math", "mjx"]


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
        return cls(**vars(data) | {"residual": jax.numpy.zeros((), data.qpos.dtype)})

    def plain(self) -> mjx.Data:
        """The data alone."""
        return mjx.Data(**{name: value for name, value in vars(self).items() if name != "residual"})
