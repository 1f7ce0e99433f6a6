"""Named array shapes of the package; tests check them, see `tests/shapes.py`.

An array is JAX's or NumPy's, or one number: functions of JAX take all of them. `*batch` stands for any leading
dimensions, the same in all arguments of a call; where they are only broadcast, they are `*#batch`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    from jax import Array
else:
    Array = jax.Array | np.ndarray | np.generic | float

#: One number, one truth value, one whole number.
Scalar = Float[Array, ""]
Truth = Bool[Array, ""]
Count = Int[Array, ""]
#: One number per world.
Scalars = Float[Array, "*batch"]
#: One number per world, of arguments that are broadcast against each other.
Broadcastable = Float[Array, "*#batch"]
#: Points in the sagittal plane (y, z), or on the ground (x, y).
Planar = Float[Array, "*batch 2"]
#: Points and vectors in space.
Spatial = Float[Array, "*batch 3"]
#: Quaternions (w, x, y, z).
Quaternion = Float[Array, "*batch 4"]
#: One number, or one truth value, for each limb, in the order of `LIMBS`.
PerLimb = Float[Array, "*batch 4"]
TruthPerLimb = Bool[Array, "*batch 4"]
#: A point in the sagittal plane for each limb.
PlanarPerLimb = Float[Array, "*batch 4 2"]
#: Of generalized velocities or forces, and of the rows of the constraints.
Dofs = Float[Array, " nv"]
Efc = Float[Array, " nefc"]
