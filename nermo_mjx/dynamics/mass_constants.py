"""Constants that MuJoCo derives from masses in `mj_setConst`, as a differentiable function of the masses.

MJX reads them, in the regularisation of its constraints among others, but cannot make them. All follow from the inertia
matrix in the reference pose, which is linear in masses and inertias: its coefficients are taken from MuJoCo's Jacobians
once, so that a batch, or a gradient, needs no second kinematics.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.shapes import Array

#: Joint types whose degrees of freedom share one inverse weight, in groups of three.
_GROUPED = {int(mujoco.mjtJoint.mjJNT_FREE): 2, int(mujoco.mjtJoint.mjJNT_BALL): 1}


class MassConstants:
    """Maps the masses and inertias of a model's bodies to the constants; the rest of the model stays."""

    def __init__(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_forward(model, data)
        jacobians = np.zeros((model.nbody, 2, 3, model.nv))
        for body in range(model.nbody):
            mujoco.mj_jacBodyCom(model, data, jacobians[body, 0], jacobians[body, 1], body)
        self._jacobian = jacobians
        # Rotations about the principal axes of each body.
        self._principal = np.einsum("bij,bik->bjk", data.ximat.reshape(-1, 3, 3), jacobians[:, 1])
        tendon = np.zeros((model.ntendon, model.nv))
        if model.ntendon:
            mujoco.mju_sparse2dense(tendon, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        self._tendon = tendon
        moment = np.zeros((model.nu, model.nv))
        if model.nu:
            mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr,
                                    data.moment_colind)  # fmt: skip
        self._moment = moment
        self._armature = np.diag(model.dof_armature) + np.einsum(
            "t,ti,tj->ij", model.tendon_armature, self._tendon, self._tendon
        )
        below = np.eye(model.nbody)
        for body in range(model.nbody - 1, 0, -1):
            below[model.body_parentid[body]] += below[body]
        self._below = below
        self._moves = model.body_weldid != 0
        self._group = _groups(model)

    def __call__(
        self, body_mass: Float[Array, " nbody"], body_inertia: Float[Array, "nbody 3"]
    ) -> dict[str, Float[Array, ...]]:
        """The fields of `DERIVED_FIELDS`, shaped as in `mujoco.MjModel`.

        Args:
            body_mass: [kg].
            body_inertia: principal moments [kg m^2].
        """
        linear, angular = (jnp.asarray(self._jacobian[:, i], float) for i in range(2))
        principal = jnp.asarray(self._principal, float)
        inertia = (
            jnp.einsum("b,bki,bkj->ij", body_mass, linear, linear)
            + jnp.einsum("bk,bki,bkj->ij", body_inertia, principal, principal)
            + jnp.asarray(self._armature, float)
        )
        inverse = jnp.linalg.inv(inertia)

        def weight(jacobian: Array) -> Array:
            return jnp.einsum("...i,ij,...j->...", jacobian, inverse, jacobian)

        body = jnp.stack([weight(part).mean(axis=-1) for part in (linear, angular)], axis=-1)
        acceleration = jnp.asarray(self._moment, float) @ inverse
        return {
            "body_subtreemass": jnp.asarray(self._below, float) @ body_mass,
            "body_invweight0": jnp.where(self._moves[:, None], body, 0.0),
            "dof_invweight0": jnp.asarray(self._group, float) @ jnp.diag(inverse),
            "dof_M0": jnp.diag(inertia),
            "tendon_invweight0": weight(jnp.asarray(self._tendon, float)),
            "actuator_acc0": jnp.sqrt(jnp.sum(acceleration**2, axis=-1)),
        }


def _groups(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Averages the degrees of freedom that share an inverse weight."""
    average = np.eye(model.nv)
    for kind, first in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        for group in range(_GROUPED.get(int(kind), 0)):
            span = slice(first + 3 * group, first + 3 * group + 3)
            average[span, span] = 1.0 / 3.0
    return average
