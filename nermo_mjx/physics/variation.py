"""Variation of the body within a batch: from named physical parameters to the fields of MuJoCo's model."""

from __future__ import annotations

from typing import Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.robot import ModelParameters, Robot
from nermo_mjx.robot.masses import is_front

#: Constants that MuJoCo derives from masses (`mj_setConst`) and that MJX's step reads.
DERIVED_FIELDS: Final = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "tendon_invweight0", "actuator_acc0")


class Variation:
    """Writes `ModelParameters` into model fields; ids are resolved once."""

    def __init__(self, robot: Robot) -> None:
        model = robot.model
        self.model = model
        names = [model.joint(i).name for i in range(model.njnt)]
        dof = {name: int(model.jnt_dofadr[i]) for i, name in enumerate(names)}

        def joints(end: str, start: str = "") -> np.ndarray:
            return np.array([i for i, name in enumerate(names) if name.endswith(end) and name.startswith(start)])

        spine = np.array([i for i, name in enumerate(names) if name.startswith("spine_joint")])
        self._springs = {
            "front_knee": joints("_knee", "front"),
            "rear_knee": joints("_knee", "rear"),
            "ankle": joints("_ankle"),
            "spine": spine,
        }
        dampers = {"hip": joints("_hip"), "knee": joints("_knee"), "ankle": joints("_ankle"), "spine": spine}
        dampers["pulley"] = np.concatenate([joints("_pulley"), joints("neck")])
        self._dampers = {key: np.array([dof[names[i]] for i in ids]) for key, ids in dampers.items()}
        self._soles = np.array([i for i in range(model.npair) if model.pair(i).name.endswith(("left_contact", "right_contact"))])
        self._front = np.array([i > 0 and is_front(model.body(i).name) for i in range(model.nbody)])

    def fields(self, parameters: ModelParameters) -> dict[str, Float[Array, "..."]]:
        """Model fields of one world, shaped as in `mujoco.MjModel`; pure JAX, differentiable.

        Args:
            parameters: leaves of shape ().
        """
        p, model = parameters, self.model
        gain = jnp.asarray(model.actuator_gainprm).at[:, 0].set(p.servo.kp)
        bias = jnp.asarray(model.actuator_biasprm).at[:, 1].set(-p.servo.kp).at[:, 2].set(-p.servo.kv)
        limit = jnp.asarray(p.servo.torque_limit)
        force = jnp.broadcast_to(jnp.stack([-limit, limit]), model.actuator_forcerange.shape)

        soles, contact = self._soles, p.contact
        friction = jnp.asarray(model.pair_friction).at[soles, :2].set(contact.friction)
        solref = jnp.asarray(model.pair_solref).at[soles].set(jnp.stack([jnp.asarray(contact.time_constant), contact.damping_ratio]))
        solimp = jnp.asarray(model.pair_solimp).at[soles, 1].set(contact.impedance).at[soles, 2].set(contact.width)

        stiffness, damping = jnp.asarray(model.jnt_stiffness), jnp.asarray(model.dof_damping)
        for name, ids in self._springs.items():
            stiffness = stiffness.at[ids].set(getattr(p.stiffness, name))
        for name, ids in self._dampers.items():
            damping = damping.at[ids].set(getattr(p.damping, name))

        mass = jnp.asarray(model.body_mass)
        front, rear = model.body_mass[self._front].sum(), model.body_mass[1:][~self._front[1:]].sum()
        scale = jnp.where(self._front, p.mass.front / front, p.mass.rear / rear)
        return {
            "actuator_gainprm": gain, "actuator_biasprm": bias, "actuator_forcerange": force, "pair_friction": friction,
            "pair_solref": solref, "pair_solimp": solimp, "jnt_stiffness": stiffness, "dof_damping": damping,
            "body_mass": mass * scale, "body_inertia": jnp.asarray(model.body_inertia) * scale[:, None],
        }  # fmt: skip

    def batch(self, parameters: ModelParameters, worlds: int) -> dict[str, np.ndarray]:
        """Fields that differ from the model's in any world, (worlds, ...) each; empty where nothing varies.

        Args:
            parameters: leaves of shape () or (worlds,).
        """
        leaves = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf, float), (worlds,)), parameters)
        default = jax.tree.leaves(ModelParameters())
        if all(np.all(leaf == value) for leaf, value in zip(jax.tree.leaves(leaves), default, strict=True)):
            return {}
        fields = {name: np.asarray(values, float) for name, values in _batched(self, leaves).items()}
        return {name: values for name, values in fields.items() if _differs(values, getattr(self.model, name))}


def _batched(variation: Variation, leaves: ModelParameters) -> dict[str, Array]:
    with jax.enable_x64(True):
        return jax.jit(jax.vmap(variation.fields))(leaves)


def _differs(values: np.ndarray, base: np.ndarray) -> bool:
    return not np.allclose(values, base, rtol=1e-9, atol=0.0)


def compile_model(robot: Robot, parameters: ModelParameters) -> mujoco.MjModel:
    """A model with these parameters (leaves of shape ()), for rendering or for any `mj_` function."""
    import copy

    model = copy.copy(robot.model)
    fields = Variation(robot).batch(parameters, 1)
    for name, values in fields.items():
        getattr(model, name)[...] = values[0]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
