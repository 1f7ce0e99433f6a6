"""Variation of the robot within a batch: fields of MuJoCo's model from named physical parameters."""

from __future__ import annotations

import copy
import functools
import operator
from collections.abc import Iterable, Mapping
from typing import Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.batch import Batch

from nermo_mjx.dynamics.constants import MassConstants, PlaceConstants
from nermo_mjx.physics.geometry_fields import GeometryFields
from nermo_mjx.physics.lanes import Lanes
from nermo_mjx.physics.servo_play import (
    PLAY_FIELDS,
    SERVO_PLAY,
    UNLIMITED_RANGE_RAD,
    Play,
    without_play,
)
from nermo_mjx.robot import LIMBS, ModelParameters, Robot
from nermo_mjx.robot.equipment import (
    chain_of,
    contact_kinds,
    is_spine_joint,
    pair_of,
    servo_shares,
)
from nermo_mjx.robot.geometry import names_geometry
from nermo_mjx.robot.masses import is_front, mass_values
from nermo_mjx.robot.model_parameters import Build, Contact, gravity_vector, is_shaped
from nermo_mjx.robot.parameters import LEGS
from nermo_mjx.robot.quantity import replace_quantities
from nermo_mjx.robot.scene import scene_geoms
from nermo_mjx.robot.terrains import (
    TERRAINS,
    TerrainShape,
    field_shares,
    geom_names,
    terrain_values,
)
from nermo_mjx.runtime import start_jax
from nermo_mjx.shapes import Array

#: Model fields that each group of body parameters affects, and those that single ones affect in addition.
AFFECTED_FIELDS: Final[dict[str, tuple[str, ...]]] = {
    "servo": ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
    "servo.back_emf": ("dof_damping",),
    "servo.knee_range": ("actuator_ctrlrange",),
    "servo.dead_band": PLAY_FIELDS,
    "servo.backlash": PLAY_FIELDS,
    "contact": ("pair_friction", "pair_solref", "pair_solimp"),
    "stiffness": ("jnt_stiffness",),
    "damping": ("dof_damping",),
    **{f"build.{part}_slack": ("tendon_range",) for part in ("leg", "front", "rear", "spine")},
    "build.front_tilt": ("body_pos", "body_quat", "site_pos"),
    "build.rear_tilt": ("body_pos", "body_quat", "site_pos"),
    "build.tendon_impedance": ("tendon_solimp_lim",),
    "build.asymmetry": ("jnt_stiffness",),
    **{f"build.{part}_softness": ("tendon_solref_lim",) for part in ("front", "rear", "spine")},
    "mass": ("body_mass", "body_inertia"),
    "ground": ("opt.gravity",),
    "terrain": ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "hfield_data"),
    "geometry": (
        "body_pos",
        "body_ipos",
        "body_iquat",
        "body_inertia",
        "site_pos",
        "geom_pos",
        "geom_size",
        "geom_rbound",
        "tendon_range",
    ),
}
#: Parameters that turn the mounts of the legs.
TILTS: Final = ("build.front_tilt", "build.rear_tilt")
#: Model fields that depend on the geometry, or on how the robot is built.
_BUILD_FIELDS: Final = frozenset(
    ("body_pos", "body_quat", "body_ipos", "body_iquat", "site_pos", "tendon_range")
)
#: Fields that the constants below are derived from.
_MASS_AND_POSE_FIELDS: Final = _BUILD_FIELDS - {"tendon_range"} | {"body_mass", "body_inertia"}
#: Constants that MuJoCo derives from masses and positions (`mj_setConst`) and that MJX's step reads.
DERIVED_FIELDS: Final = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_invweight0",
    "actuator_acc0",
)


class Variation:
    """Writes `ModelParameters` into model fields; ids are resolved once."""

    def __init__(self, robot: Robot) -> None:
        model = robot.physical
        self.model, self._hinges = model, robot.config.hinges
        #: One object for each combination of names of lengths.
        self._geometry = functools.cache(functools.partial(GeometryFields, robot))
        self._batched = functools.cache(
            lambda lengths: Lanes(functools.partial(self.fields, lengths=lengths))
        )
        names = [model.joint(i).name for i in range(model.njnt)]
        dof = {name: int(model.jnt_dofadr[i]) for i, name in enumerate(names)}

        def joints(end: str, start: str = "") -> np.ndarray:
            joint_ids = [
                i
                for i, name in enumerate(names)
                if chain_of(name).endswith(end) and name.startswith(start)
            ]
            return np.array(joint_ids, int)

        spine = np.array([i for i, name in enumerate(names) if is_spine_joint(name)])
        self._springs = {
            "front_knee": joints("_knee", "front"),
            "rear_knee": joints("_knee", "rear"),
            "ankle": joints("_ankle"),
            "spine": spine,
        }
        dampers = {
            "hip": joints("_hip"),
            "knee": joints("_knee"),
            "ankle": joints("_ankle"),
            "spine": spine,
        }
        dampers["pulley"] = np.concatenate([joints("_pulley"), joints("neck"), joints("head_tilt")])
        self._dampers = {
            key: np.array([dof[names[i]] for i in ids]) for key, ids in dampers.items()
        }
        self._spine_servo = np.array(
            [model.actuator(i).name == "spine_servo" for i in range(model.nu)]
        )
        config = robot.config
        self._gain_shares, self._torque_shares = servo_shares(
            robot.servos, config.robot, "servos" in config.simplified
        ).T
        self._servo_dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        left = np.array(["left" in names[i] for i in range(model.njnt)])
        knees = np.concatenate([self._springs["front_knee"], self._springs["rear_knee"]])
        self._knees = {1.0: knees[left[knees]], -1.0: knees[~left[knees]]}
        self._tendons = {
            pair: np.array(
                [i for i in range(model.ntendon) if pair_of(model.tendon(i).name) == pair], int
            )
            for pair in ("front", "rear", "spine")
        }
        self._mounts = {
            pair: [_mount(model, limb) for limb in LIMBS if limb.startswith(pair)] for pair in LEGS
        }
        self._scene = str(robot.config.scene)
        self._terrain = np.array([model.geom(name).id for name in geom_names(self._scene)], int)
        self._pairs = contact_kinds(model, scene_geoms(str(robot.config.scene)))
        self._front = np.array([i > 0 and is_front(model.body(i).name) for i in range(model.nbody)])

    def fields(
        self, parameters: ModelParameters, lengths: tuple[str, ...] = ()
    ) -> dict[str, Float[Array, ...]]:
        """Model fields of one world, named and shaped as in `mujoco.MjModel`; pure JAX, differentiable.

        Args:
            parameters: Parameters, leaves of shape ().
            lengths: Names of the parameters of the geometry, and in `TILTS`, that can differ from the published values.
        """
        p, model = parameters, self.model
        # With explicit dtypes: JAX caches the dtype that it chose for a NumPy array, even across precisions.
        kp = p.servo.kp * self._gain_shares
        gain = jnp.asarray(model.actuator_gainprm, float).at[:, 0].set(kp)
        bias = (
            jnp.asarray(model.actuator_biasprm, float).at[:, 1].set(-kp).at[:, 2].set(-p.servo.kv)
        )
        share = jnp.where(self._spine_servo, p.servo.spine_torque, self._torque_shares)
        force = (p.servo.stall_torque * share)[:, None] * jnp.array([-1.0, 1.0])

        mass = jnp.asarray(model.body_mass, float)
        front = model.body_mass[self._front].sum()
        rear = model.body_mass[1:][~self._front[1:]].sum()
        scale = jnp.where(self._front, p.mass.front / front, p.mass.rear / rear)
        geometry = tuple(name for name in lengths if name not in TILTS)
        placed = self._geometry(geometry)(p.geometry) if geometry else {}
        inertia = placed.pop("body_inertia", jnp.asarray(model.body_inertia, float))
        reach = placed.pop("tendon_range", jnp.asarray(model.tendon_range, float))
        return (
            placed
            | self._contacts(p.contact)
            | self._joints(p)
            | self._strings(p.build, reach)
            | {
                "actuator_gainprm": gain,
                "actuator_biasprm": bias,
                "actuator_forcerange": force,
                **(self._tilted(p.build, placed) if set(lengths) & set(TILTS) else {}),
                "body_mass": mass * scale,
                "body_inertia": inertia * scale[:, None],
                "opt.gravity": gravity_vector(
                    p.ground.gravity, p.ground.slope, p.ground.direction, jnp
                ),
                SERVO_PLAY: Play.of(p.servo).packed,
                "actuator_ctrlrange": jnp.full(model.actuator_ctrlrange.shape, UNLIMITED_RANGE_RAD)
                * jnp.array([-1.0, 1.0]),
                **self._shaped(p.terrain, placed),
            }
        )

    def _contacts(self, contact: Contact) -> dict[str, Float[Array, ...]]:
        """Fields of the contact pairs."""
        model, pairs = self.model, self._pairs
        friction = jnp.asarray(model.pair_friction, float)
        for kind, value in (
            ("sole", contact.friction),
            ("tail", contact.tail_friction),
            ("trunk", contact.trunk_friction),
            ("obstacle", contact.obstacle_friction),
        ):
            friction = friction.at[pairs[kind], :2].set(value)
        soles = np.concatenate([pairs["sole"], pairs["tail"]])
        solref = (
            jnp.asarray(model.pair_solref, float)
            .at[soles]
            .set(jnp.stack([jnp.asarray(contact.time_constant), contact.damping_ratio]))
        )
        solimp = (
            jnp.asarray(model.pair_solimp, float)
            .at[soles, 1]
            .set(contact.impedance)
            .at[soles, 2]
            .set(contact.width)
        )
        return {"pair_friction": friction, "pair_solref": solref, "pair_solimp": solimp}

    def _joints(self, p: ModelParameters) -> dict[str, Float[Array, ...]]:
        """Fields of springs and dampers."""
        model = self.model
        stiffness = jnp.asarray(model.jnt_stiffness, float)
        damping = jnp.asarray(model.dof_damping, float)
        for name, ids in self._springs.items():
            stiffness = stiffness.at[ids].set(self._hinges * getattr(p.stiffness, name))
        for name, ids in self._dampers.items():
            hinges = self._hinges if name in ("knee", "ankle", "spine") else 1
            damping = damping.at[ids].set(hinges * getattr(p.damping, name))
        damping = damping.at[self._servo_dofs].add(p.servo.brake)
        for side, ids in self._knees.items():
            stiffness = stiffness.at[ids].multiply(
                1.0 + side * p.build.asymmetry, unique_indices=True
            )
        return {"jnt_stiffness": stiffness, "dof_damping": damping}

    def _strings(self, build: Build, reach: Float[Array, ...]) -> dict[str, Float[Array, ...]]:
        """Fields of the tendons, whose published range is `reach`."""
        model = self.model
        held = jnp.asarray(model.tendon_solref_lim, float)
        for pair, ids in self._tendons.items():
            reach = reach.at[ids, 1].add(build.slack(pair))
            softer = jnp.sqrt(getattr(build, f"{pair}_softness"))
            held = held.at[ids, 0].multiply(softer, unique_indices=True)
        legs = np.concatenate([self._tendons[pair] for pair in LEGS])
        taut = jnp.asarray(model.tendon_solimp_lim, float).at[legs, 0].set(build.tendon_impedance)
        return {"tendon_range": reach, "tendon_solref_lim": held, "tendon_solimp_lim": taut}

    def _tilted(self, build: Build, placed: Mapping[str, Array]) -> dict[str, Float[Array, ...]]:
        """Fields of the legs, which turn about the axes of their hips with their pulleys and the sites of their tendons."""
        model = self.model
        fields = {
            name: jnp.asarray(getattr(model, name), float)
            for name in ("body_pos", "body_quat", "site_pos")
        }
        fields |= {name: field for name, field in placed.items() if name in fields}
        for pair, limbs in self._mounts.items():
            angle = jnp.asarray(getattr(build, f"{pair}_tilt"), float)
            cosine, sine = jnp.cos(angle / 2), jnp.sin(angle / 2)
            for hip, cross, bodies, sites in limbs:
                centre = fields["body_pos"][hip]
                turn = (
                    jnp.eye(3) + jnp.sin(angle) * cross + (1.0 - jnp.cos(angle)) * (cross @ cross)
                )
                for name, ids in (("body_pos", bodies), ("site_pos", sites)):
                    fields[name] = (
                        fields[name].at[ids].set(centre + (fields[name][ids] - centre) @ turn.T)
                    )
                quat = fields["body_quat"][bodies]
                across = quat[:, np.array([1, 0, 3, 2])] * jnp.array([-1.0, 1.0, 1.0, -1.0])
                fields["body_quat"] = (
                    fields["body_quat"].at[bodies].set(cosine * quat + sine * across)
                )
        return fields

    def _shaped(
        self, shape: TerrainShape, placed: Mapping[str, Array]
    ) -> dict[str, Float[Array, ...]]:
        """Fields of the geoms that the shape of a terrain moves, merged with the fields of the robot; empty in other scenes."""
        model, geoms = self.model, self._terrain
        if not len(geoms):
            return {}
        kind = TERRAINS[self._scene]
        pos, quat, size = (jnp.asarray(part, float) for part in kind.layout(shape, jnp))
        fields = {"geom_pos": pos, "geom_quat": quat}
        if kind.geom == mujoco.mjtGeom.mjGEOM_HFIELD:
            # As shares of the compiled height, which MJX knows at trace time.
            highest = model.hfield_size[model.geom_dataid[geoms[0]], 2]
            fields.pop("geom_quat")
            heights = {
                "hfield_data": jnp.asarray(field_shares().ravel(), float) * (shape.height / highest)
            }
        else:
            bound = (
                jnp.linalg.norm(size, axis=-1)
                if kind.geom == mujoco.mjtGeom.mjGEOM_BOX
                else size.sum(axis=-1)
            )
            fields |= {"geom_size": size, "geom_rbound": bound}
            heights = {}
        return heights | {
            name: placed.get(name, jnp.asarray(getattr(model, name), float)).at[geoms].set(value)
            for name, value in fields.items()
        }

    def batch(
        self, parameters: ModelParameters, worlds: int, named: Iterable[str]
    ) -> dict[str, np.ndarray]:
        """The fields that the named parameters affect, (worlds, ...) each; the others keep the model's values.

        With `servo.dead_band` or `servo.backlash` two of them are `PLAY_FIELDS`, which are for the engines alone.

        Which fields are returned depends on the names alone, so that new values never change a compiled program.

        Args:
            parameters: Parameters, leaves of shape () or (worlds,).
            worlds: Size of the batch.
            named: Names such as `contact.friction`; other names than model parameters are ignored.
        """
        named = tuple(named)
        reached = _reached(named)
        if not reached:
            return {}
        leaves = jax.tree.map(
            lambda leaf: np.broadcast_to(np.asarray(leaf, float), (worlds,)), parameters
        )
        start_jax()
        with jax.enable_x64(True):
            fields = self._batched(_lengths(named))(leaves)
        return {name: np.asarray(fields[name], float) for name in reached if name in fields}

    def differentiable(
        self, parameters: ModelParameters, named: Iterable[str]
    ) -> dict[str, Float[Array, ...]]:
        """The same fields of one world in pure JAX, and the constants that MuJoCo derives from masses and positions.

        Args:
            parameters: Parameters, leaves of shape ().
            named: Names, as for `batch`.
        """
        named = tuple(named)
        reached, lengths = _reached(named), _lengths(named)
        fields = {
            name: value
            for name, value in self.fields(parameters, lengths).items()
            if name in reached
        }
        if lengths:
            fields |= self._place_constants(fields)
        elif "body_mass" in fields:
            fields |= self._mass_constants(fields["body_mass"], fields["body_inertia"])
        return fields

    @functools.cached_property
    def _mass_constants(self) -> MassConstants:
        return MassConstants(self.model)

    @functools.cached_property
    def _place_constants(self) -> PlaceConstants:
        return PlaceConstants(self.model)


def _reached(named: Iterable[str]) -> list[str]:
    """Model fields that the named parameters affect."""
    keys = {key for name in named for key in (name.split(".")[0], name)} & set(AFFECTED_FIELDS)
    return list(dict.fromkeys(field for key in sorted(keys) for field in AFFECTED_FIELDS[key]))


def _lengths(named: Iterable[str]) -> tuple[str, ...]:
    """The named parameters that affect the positions of bodies and sites."""
    return tuple(sorted(name for name in named if names_geometry([name]) or name in TILTS))


def _mount(model: mujoco.MjModel, limb: str) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """The body on a leg's axis, the matrix of the cross product with that axis, and the bodies and sites that turn
    about it with the leg's mount."""
    hip, along = model.body(f"{limb}_upper").id, np.zeros(3)
    mujoco.mju_rotVecQuat(along, np.array([1.0, 0.0, 0.0]), model.body_quat[hip])
    trunk = model.body_parentid[hip]
    bodies = [
        i
        for i in range(model.nbody)
        if model.body_parentid[i] == trunk and model.body(i).name.startswith(limb)
    ]
    sites = [
        i
        for i in range(model.nsite)
        if model.site_bodyid[i] == trunk and model.site(i).name.startswith(limb)
    ]
    return hip, np.cross(along, np.eye(3)).T, np.array(bodies), np.array(sites, int)


def moves_constants(fields: Iterable[str]) -> bool:
    """Whether `DERIVED_FIELDS` depend on any of these model fields."""
    return not _MASS_AND_POSE_FIELDS.isdisjoint(fields)


def compile_model(robot: Robot, values: Mapping[str, float]) -> mujoco.MjModel:
    """A copy of the robot's whole model with the named body parameters, for rendering or for any `mj_` function."""
    variation = Variation(robot)
    standing = mass_values(robot.config.robot) | terrain_values(str(robot.config.scene))
    parameters = replace_quantities(ModelParameters(), standing | dict(values))
    # Built with its geometry, so that its meshes match.
    model = (
        robot.with_geometry(parameters.geometry, parameters.build)
        if is_shaped(values)
        else copy.copy(robot.model)
    )
    for name, field in variation.batch(parameters, 1, values).items():
        if name in _BUILD_FIELDS or name in PLAY_FIELDS:
            continue
        if name.startswith("geom_"):
            # Geoms have different ids than in the model that engines step; all other ids are the same.
            names = geom_names(str(robot.config.scene))
            ours, theirs = (
                [source_model.geom(geom_name).id for geom_name in names]
                for source_model in (model, variation.model)
            )
            getattr(model, name)[ours] = field[0][theirs]
        elif name == "hfield_data":
            set_heights(model, robot.model, field[0])
        else:
            operator.attrgetter(name)(model)[...] = field[0]
    knees = [servo.endswith("_knee") for servo in robot.servos]
    model.actuator_ctrlrange[knees] += float(parameters.servo.knee_range) * np.array([-1.0, 1.0])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def set_heights(
    model: mujoco.MjModel, compiled: mujoco.MjModel, data: Float[np.ndarray, " points"]
) -> None:
    """Write the heights of the only height field: MuJoCo looks for contacts up to the field's height.

    Args:
        model: Model to modify.
        compiled: Model from which it was copied.
        data: Heights, as shares of the height in `compiled`.
    """
    highest = max(float(data.max()), 1e-9)
    model.hfield_data[:] = data / highest
    model.hfield_size[0, 2] = compiled.hfield_size[0, 2] * highest


def vary(
    batch: Batch,
    model: mujoco.MjModel,
    fields: Mapping[str, np.ndarray],
    models: list[mujoco.MjModel] | None = None,
    worlds: np.ndarray | None = None,
) -> list[mujoco.MjModel] | None:
    """Set the fields of single worlds in a batch of MuJoCo's C engine, and the constants derived from them.

    Args:
        batch: Batch of n worlds.
        model: Model of the batch.
        fields: Fields, (k, ...) each.
        models: Previous result of this function for the same batch.
        worlds: Indices (k,) of the worlds; all worlds by default.

    Returns:
        A model for each world, if a batch cannot vary one of the fields; otherwise None.
    """
    fields = without_play(fields)
    world_indices = np.arange(batch.nsim) if worlds is None else worlds
    if "hfield_data" not in fields:
        for name, values in fields.items():
            batch.expand(name)[world_indices] = values
        if moves_constants(fields):
            batch.set_const()
        return None
    models = [copy.copy(model) for _ in range(batch.nsim)] if models is None else models
    data = mujoco.MjData(model)
    for row, world in enumerate(world_indices):
        world_model = models[world]
        for name, values in fields.items():
            if name == "hfield_data":
                set_heights(world_model, model, values[row])
            else:
                operator.attrgetter(name)(world_model)[...] = values[row]
        if moves_constants(fields):
            mujoco.mj_setConst(world_model, data)
    batch.set_models(models)
    return models
