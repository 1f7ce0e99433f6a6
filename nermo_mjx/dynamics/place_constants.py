"""Constants that MuJoCo derives in `mj_setConst`, as differentiable functions of positions and masses.

The Jacobians of the reference pose come from MJX's kinematics with the given fields; `mass_constants` computes the
rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics import rows, tree
from nermo_mjx.dynamics.jacobians import point_jacobian, with_point_jacobians
from nermo_mjx.dynamics.mass_constants import Constants, Jacobians
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.shapes import Array

#: Prefixes of the fields that the reference pose depends on.
_PLACES: Final = ("body_", "site_", "geom_")


class PlaceConstants:
    """Maps a model's fields of positions and masses to the constants, with MJX's kinematics."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = mjx.put_model(model)
        self._constants = Constants(model)

    def __call__(self, fields: Mapping[str, Float[Array, ...]]) -> dict[str, Float[Array, ...]]:
        """The fields of `DERIVED_FIELDS`, shaped as in `mujoco.MjModel`.

        Args:
            fields: those of bodies, sites and geoms that differ from the model's.
        """
        model = self._model.tree_replace({name: each for name, each in fields.items() if name.startswith(_PLACES)})
        data = mjx.make_data(self._model)
        data = self._placed(model, data.replace(qpos=jnp.asarray(self._model.qpos0, data.qpos.dtype)))
        bodies = np.arange(model.nbody)
        linear, angular = jax.vmap(lambda point, body: point_jacobian(model, data, point, body))(data.xipos, bodies)
        linear, angular = jnp.swapaxes(linear, 1, 2), jnp.swapaxes(angular, 1, 2)
        principal = jnp.einsum("bij,bik->bjk", data.ximat, angular)
        tendon, moment = rows.inner(data).ten_J, rows.inner(data).actuator_moment
        jacobians = Jacobians(linear, angular, principal, tendon, moment)
        return self._constants(model.body_mass, model.body_inertia, jacobians)

    @staticmethod
    @with_point_jacobians
    def _placed(model: mjx.Model, data: mjx.Data) -> mjx.Data:
        return mjx.transmission(model, mjx.tendon(model, tree.com_pos(model, tree.kinematics(model, data))))
