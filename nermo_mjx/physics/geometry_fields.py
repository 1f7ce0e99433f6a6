"""Geometry within a batch: fields of MuJoCo's model from lengths and positions.

All positions in the model are linear in the geometry, because its zero pose keeps its angles (`robot.assembly`). Their
slopes are therefore computed from models compiled at both ends of a parameter's range, so that a world's fields equal
those of its own model, by construction. The nonlinear ones have a closed form here: inertias, bounding spheres, and the
limits of tendons.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any, Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.robot import LIMBS, Robot, RobotConfig, load_robot
from nermo_mjx.robot.geometry import Geometry, leg_geometry
from nermo_mjx.robot.quantity import quantities, replace_quantities, values_of
from nermo_mjx.shapes import Array

#: Fields that are linear in the geometry.
_LINEAR_FIELDS: Final[tuple[str, ...]] = (
    "body_pos",
    "body_ipos",
    "site_pos",
    "geom_pos",
    "geom_size",
)


class GeometryFields:
    """Model fields of a robot as functions of some parameters of its geometry; the others are the published ones."""

    def __init__(self, robot: Robot, names: Iterable[str]) -> None:
        """
        Args:
            robot: Robot, from which two models are compiled for each name.
            names: Names such as `geometry.hip.x`.
        """
        self.names = tuple(sorted(names))
        self.model = robot.physical
        declarations = {
            f"geometry.{name}": declaration for name, declaration in quantities(Geometry)
        }
        self._start = np.array([float(declarations[name].default) for name in self.names])  # type: ignore[arg-type]
        ends = (
            np.array([(declarations[name].low, declarations[name].high) for name in self.names])
            - self._start[:, None]
        )
        base = _Read.of(self.model)
        reads = [_at_ends(robot.config, name) for name in self.names]
        self._linear = {
            name: (base.linear[name], slopes)
            for name in base.linear
            if np.abs(
                slopes := np.stack(
                    [
                        (high.linear[name] - low.linear[name]) / (b - a)
                        for (low, high), (a, b) in zip(reads, ends, strict=True)
                    ]
                )
            ).max()
            > 1e-12
        }
        self._inertia = (
            base.inertia,
            *(
                np.stack(declaration)
                for declaration in zip(
                    *(
                        _parabola(a, low.inertia - base.inertia, b, high.inertia - base.inertia)
                        for (low, high), (a, b) in zip(reads, ends, strict=True)
                    ),
                    strict=True,
                )
            ),
        )
        self._turn = base.turn
        self._bodies = np.flatnonzero(np.abs(self._inertia[1]).max(axis=(0, 2, 3)) > 1e-15)
        self._legs = {limb: self.model.tendon(f"{limb}_tendon").id for limb in LIMBS}
        others = set(range(self.model.ntendon)) - set(self._legs.values())
        self._tendons = [_Antagonist.of(self.model, tendon) for tendon in sorted(others)]

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields that differ between worlds; they depend on the parameters' names alone."""
        field_names = [name for name in _LINEAR_FIELDS if name in self._linear]
        field_names += ["geom_rbound"] * ("geom_size" in field_names) + ["body_inertia"] * bool(
            len(self._bodies)
        )
        field_names += ["body_iquat"] * bool(self._turning) + ["tendon_range"]
        return tuple(field_names)

    @functools.cached_property
    def _turning(self) -> dict[int, int]:
        """Bodies whose principal axes turn, and the axis that they turn about: the hip, with the tail that is fixed to
        it."""
        _, slope, curve = self._inertia
        change = np.abs(
            np.einsum("bji,pbjk,bkl->pbil", self._turn, np.concatenate([slope, curve]), self._turn)
        )
        joint_of_body: dict[int, int] = {}
        for first, second in ((0, 1), (0, 2), (1, 2)):
            turned = np.flatnonzero(change[:, :, first, second].max(axis=0) > 1e-12)
            assert not joint_of_body.keys() & set(turned.tolist()), (
                "a body turns about more than one of its axes"
            )
            joint_of_body |= dict.fromkeys(turned.tolist(), 3 - first - second)
        return joint_of_body

    def __call__(self, geometry: Geometry) -> dict[str, Float[Array, ...]]:
        """The fields of one world, in JAX, shaped as in `mujoco.MjModel`.

        Args:
            geometry: Geometry, leaves of shape ().
        """
        values = {f"geometry.{name}": value for name, value in values_of(geometry)}
        change = jnp.stack([jnp.asarray(values[name], float) for name in self.names]) - jnp.asarray(
            self._start, float
        )
        fields = {
            name: jnp.asarray(base, float) + jnp.tensordot(change, jnp.asarray(slopes, float), 1)
            for name, (base, slopes) in self._linear.items()
        }
        places = {
            name: fields.get(name, jnp.asarray(getattr(self.model, name), float))
            for name in _LINEAR_FIELDS
        }
        world: dict[str, Array] = {
            name: fields.pop(name) for name in ("site_xpos", "geom_xpos") if name in fields
        }
        if "geom_size" in fields:
            fields["geom_rbound"] = self._bounds(fields["geom_size"])
        if len(self._bodies):
            fields |= self._inertias(change, places["body_ipos"])
        fields["tendon_range"] = self._limits(geometry, places["geom_size"], world)
        return fields

    def _bounds(self, size: Float[Array, "ngeom 3"]) -> Float[Array, " ngeom"]:
        """Radii of bounding spheres of the geoms whose size varies."""
        kind, kinds = self.model.geom_type, mujoco.mjtGeom
        varied = np.abs(self._linear["geom_size"][1]).max(axis=(0, 2)) > 1e-12
        radius = jnp.where(kind == int(kinds.mjGEOM_CAPSULE), size[:, 0] + size[:, 1], size[:, 0])
        tall = (kind == int(kinds.mjGEOM_CYLINDER)) & varied
        wide = jnp.where(tall[:, None], size[:, :2], 1.0)
        radius = jnp.where(tall, jnp.sqrt(jnp.sum(wide**2, axis=-1)), radius)
        return jnp.where(varied, radius, jnp.asarray(self.model.geom_rbound, float))

    def _inertias(
        self, change: Float[Array, " p"], com: Float[Array, "nbody 3"]
    ) -> dict[str, Float[Array, ...]]:
        """Principal moments, and the axes that turn, from inertia tensors about the bodies' origins.

        The tensors are quadratic in the parameters: masses are constant, and positions linear.
        """
        base, slope, curve = (jnp.asarray(term, float) for term in self._inertia)
        about_origin = base + jnp.tensordot(change, slope, 1) + jnp.tensordot(change**2, curve, 1)
        mass, turn = jnp.asarray(self.model.body_mass, float), jnp.asarray(self._turn, float)
        tensor = about_origin - _of_point(mass, com, jnp)
        # In the axes of the published body.
        tensors = jnp.einsum("bji,bjk,bkl->bil", turn, tensor, turn)
        moments = (
            jnp.asarray(self.model.body_inertia, float)
            .at[self._bodies]
            .set(jnp.diagonal(tensors, axis1=1, axis2=2)[self._bodies])
        )
        quat = jnp.asarray(self.model.body_iquat, float)
        for body, fixed in self._turning.items():
            pair, turned, angle = _principal(tensors[body], fixed)
            moments = moments.at[body, pair].set(turned)
            quat = quat.at[body].set(_turned(quat[body], fixed, angle))
        return {"body_inertia": moments} | ({"body_iquat": quat} if self._turning else {})

    def _limits(
        self, geometry: Geometry, size: Float[Array, "ngeom 3"], world: Mapping[str, Array]
    ) -> Float[Array, "ntendon 2"]:
        limits = jnp.asarray(self.model.tendon_range, float)
        published = Geometry()
        for pair in ("front", "rear"):
            leg, published_leg = (
                leg_geometry(geometry, pair, jnp),
                leg_geometry(published, pair, np),
            )
            ids = np.array([i for limb, i in self._legs.items() if limb.startswith(pair)])
            limits = limits.at[ids, 1].add(
                leg.tendon_length - jnp.asarray(published_leg.tendon_length, float)
            )
        for tendon in self._tendons:
            places = {
                name: world.get(name, jnp.asarray(tendon.places[name], float))
                for name in tendon.places
            }
            longer = tendon.length(places, size) - tendon.length(
                {name: jnp.asarray(position, float) for name, position in tendon.places.items()},
                jnp.asarray(self.model.geom_size, float),
            )
            limits = limits.at[tendon.id, 1].add(longer)
        return limits


def _geometry(name: str, value: float) -> Geometry:
    return replace_quantities(Geometry(), {name.removeprefix("geometry."): np.asarray(value)})


@dataclasses.dataclass(frozen=True)
class _Read:
    """Quantities of a model in its zero pose.

    Attributes:
        linear: Fields, and world positions of sites and geoms.
        inertia: Tensors about the bodies' origins, in the bodies' frames (nbody, 3, 3).
        turn: Principal axes in the bodies' frames (nbody, 3, 3).
    """

    linear: dict[str, np.ndarray]
    inertia: np.ndarray
    turn: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel) -> _Read:
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        linear = {name: getattr(model, name).copy() for name in _LINEAR_FIELDS}
        linear |= {"site_xpos": data.site_xpos.copy(), "geom_xpos": data.geom_xpos.copy()}
        turn = np.zeros((model.nbody, 9))
        for body in range(model.nbody):
            mujoco.mju_quat2Mat(turn[body], model.body_iquat[body])
        axes = turn.reshape(-1, 3, 3)
        about_com = np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes)
        tensor = about_com + _of_point(model.body_mass, model.body_ipos, np)
        return cls(linear, tensor, axes)


@functools.lru_cache(maxsize=256)  # a tenth of a second each
def _at_ends(config: RobotConfig, name: str) -> tuple[_Read, _Read]:
    """Quantities of the models at both ends of the range of a parameter; many simulators share them."""
    robot, declaration = (
        load_robot(config),
        dict(quantities(Geometry))[name.removeprefix("geometry.")],
    )
    start = float(declaration.default)  # type: ignore[arg-type]
    low, high = (
        _Read.of(robot.physical_with_geometry(_geometry(name, start + (end - start))))
        for end in (declaration.low, declaration.high)
    )
    return low, high


def _of_point(mass: Any, point: Any, xp: Any) -> Any:
    """Inertia tensors (n, 3, 3) about the origin of point masses (n,) at positions (n, 3)."""
    square = xp.sum(point**2, axis=-1)[:, None, None] * xp.eye(3)
    return mass[:, None, None] * (square - point[:, :, None] * point[:, None, :])


def _parabola(
    a: float, at_a: np.ndarray, b: float, at_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slope and curvature at 0 of parabolas through the origin, from their values at a < 0 and b > 0."""
    curve = (at_b / b - at_a / a) / (b - a)
    return at_a / a - curve * a, curve


def _principal(
    tensor: Float[Array, "3 3"], fixed: int
) -> tuple[np.ndarray, Float[Array, " 2"], Array]:
    """Principal moments of an inertia tensor with one principal axis known.

    Returns:
        The indices of the other two axes, their moments, and the angle about the fixed one to the principal axes.
    """
    first, second = (fixed + 1) % 3, (fixed + 2) % 3
    a, b, c = tensor[first, first], tensor[first, second], tensor[second, second]
    # The axes keep their order and turn by less than 45 degrees.
    angle = 0.5 * jnp.arctan2(2.0 * b * jnp.sign(a - c), jnp.abs(a - c))
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    moments = jnp.stack(
        [
            cosine**2 * a + 2.0 * cosine * sine * b + sine**2 * c,
            sine**2 * a - 2.0 * cosine * sine * b + cosine**2 * c,
        ]
    )
    return np.array([first, second]), moments, angle


def _turned(quat: Float[Array, " 4"], axis: int, angle: Array) -> Float[Array, " 4"]:
    """An orientation turned about one of its own axes."""
    turn = jnp.zeros(4).at[0].set(jnp.cos(angle / 2)).at[1 + axis].set(jnp.sin(angle / 2))
    w, v = quat[0], quat[1:]
    vector = w * turn[1:] + turn[0] * v + jnp.cross(v, turn[1:])
    return jnp.concatenate([(w * turn[0] - v @ turn[1:])[None], vector])


@dataclasses.dataclass(frozen=True)
class _Antagonist:
    """A tendon through sites that wraps around one pulley: its length with all joints straight.

    Attributes:
        id: Id of the tendon.
        sites: Ids of the sites, in order.
        pulley: Id of the geom of the pulley.
        span: Index of the first of the two sites on either side of the pulley.
        frame: Axes of the pulley in the world, columns.
        turn: +1 or -1, the sense about the pulley's axis in which the tendon wraps around it.
        places: World positions of all sites and geoms of the published robot.
    """

    id: int
    sites: np.ndarray
    pulley: int
    span: int
    frame: np.ndarray
    turn: float
    places: dict[str, np.ndarray]

    @classmethod
    def of(cls, model: mujoco.MjModel, tendon: int) -> _Antagonist:
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        span = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        kinds, ids = model.wrap_type[span], model.wrap_objid[span]
        (index,) = np.flatnonzero(kinds == int(mujoco.mjtWrap.mjWRAP_CYLINDER))
        places = {"site_xpos": data.site_xpos.copy(), "geom_xpos": data.geom_xpos.copy()}
        frame = data.geom_xmat[ids[index]].reshape(3, 3).copy()
        antagonist = cls(
            tendon, np.delete(ids, index), int(ids[index]), int(index) - 1, frame, 1.0, places
        )
        candidates = [dataclasses.replace(antagonist, turn=turn) for turn in (1.0, -1.0)]
        size = np.asarray(model.geom_size)
        return min(
            candidates,
            key=lambda candidate: abs(
                float(candidate.length(places, size, np)) - model.tendon_length0[tendon]
            ),
        )

    def length(self, places: Mapping[str, Any], size: Any, xp: Any = jnp) -> Any:
        """Length [m] from world positions and the geoms' sizes."""
        points = places["site_xpos"][self.sites]
        spans = xp.sqrt(xp.sum((points[1:] - points[:-1]) ** 2, axis=-1))
        ends = (points[self.span : self.span + 2] - places["geom_xpos"][self.pulley]) @ xp.asarray(
            self.frame
        )
        radius, distance = size[self.pulley, 0], xp.sqrt(xp.sum(ends[:, :2] ** 2, axis=-1))
        angle = xp.arctan2(ends[:, 1], ends[:, 0])
        arc = (self.turn * (angle[1] - angle[0]) - xp.sum(xp.arccos(radius / distance))) % (
            2.0 * np.pi
        )
        flat = xp.sum(xp.sqrt(distance**2 - radius**2)) + radius * arc
        # Unrolled, the path around a cylinder is straight.
        wrapped = xp.sqrt(flat**2 + (ends[1, 2] - ends[0, 2]) ** 2)
        return xp.sum(spans) - spans[self.span] + wrapped
