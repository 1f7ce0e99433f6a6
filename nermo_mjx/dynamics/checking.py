"""Comparison of the gradient of several steps with central differences, for any model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

import nermo_mjx.dynamics
from nermo_mjx.dynamics.integration import positions
from nermo_mjx.shapes import Array, Scalar

#: Half-widths of the differences, in the unit of each entry (m, rad, m/s, ...; 1 for factors).
DIFFERENCE_WIDTHS: Final = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
#: Maximum number of entries moved per group, evenly spaced.
MAX_GROUP_ENTRIES: Final = 12
#: Floor of a group's differences in comparisons, as a share of all differences.
DIFFERENCE_FLOOR: Final = 1e-6


class Point(NamedTuple):
    """The inputs of the derivative: changes, zero at the state itself.

    Attributes:
        position, velocity: Changes of the state in the tangent space, (nv,) each.
        activation, control: Changes of `act` and `ctrl`.
        factors: Changes of masses and inertias, and of frictions, which are multiplied by 1 + factor.
    """

    position: Array
    velocity: Array
    activation: Array
    control: Array
    factors: Array


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """The result of `check_gradient`; arrays over the entries that were moved, in the order of `Point`.

    Attributes:
        group: Index of the field of `Point` of each entry.
        gradient: Gradient by reverse mode.
        differences: Central differences by width, (len(DIFFERENCE_WIDTHS), n).
        end: Positions and velocities after the last step.
    """

    group: np.ndarray
    gradient: Float[np.ndarray, " n"]
    differences: Float[np.ndarray, "widths n"]
    end: Float[np.ndarray, " m"]

    @property
    def is_finite(self) -> bool:
        """Whether the gradient and the end state are finite."""
        return bool(np.isfinite(self.gradient).all() and np.isfinite(self.end).all())

    @property
    def errors(self) -> list[float]:
        """Error of the gradient against the differences of each width, see `distance`."""
        return [distance(self.group, self.gradient, difference) for difference in self.differences]

    @property
    def chosen(self) -> int:
        """The width to compare with: its differences are closest to a neighbour's; independent of the gradient."""
        apart = self._apart
        first = int(np.argmin(apart))
        outer = apart[first - 1] if first > 0 else np.inf
        return first + (first + 1 < len(apart) and apart[first + 1] < outer)

    @property
    def error(self) -> float:
        """Error of the gradient against the differences of the chosen width."""
        return self.errors[self.chosen]

    @property
    def spread(self) -> float:
        """Smallest distance between the differences of neighbouring widths: the resolution of the error."""
        return min(self._apart)

    @property
    def _apart(self) -> list[float]:
        pairs = zip(self.differences[:-1], self.differences[1:], strict=True)
        return [distance(self.group, left, right) for left, right in pairs]


def distance(group: np.ndarray, gradient: np.ndarray, expected: np.ndarray) -> float:
    """Largest |gradient - expected| / |expected| of a group of entries; inf if one of them is not finite.

    >>> group = np.array([0, 0, 1])
    >>> round(distance(group, np.array([3.0, 4.0, 1.0]), np.array([3.0, 4.0, 2.0])), 3)
    0.5

    Args:
        group: Group of each entry; all entries of a group have the same unit.
        gradient, expected: Vectors to compare.
    """
    if not (np.isfinite(gradient).all() and np.isfinite(expected).all()):
        return float("inf")
    floor = DIFFERENCE_FLOOR * np.linalg.norm(expected)
    shares = [0.0]
    for index in np.unique(group):
        in_group = group == index
        scale = max(np.linalg.norm(expected[in_group]), floor)
        shares.append(
            float(np.linalg.norm((gradient - expected)[in_group]) / scale) if scale else 0.0
        )
    return max(shares)


def check_gradient(
    model: mujoco.MjModel,
    data: mujoco.MjData | None = None,
    steps: int = 5,
    options: dict[str, Any] | None = None,
) -> GradientCheck:
    """Compare reverse mode through several steps of a model with central differences, in float64.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint axis="0 1 0" range="-1 1"/>
    ... <geom size=".1" pos="0 0 -1"/></body></worldbody></mujoco>''')
    >>> data = mujoco.MjData(model)
    >>> data.qpos[0], data.qvel[0] = 1.001, 2.0  # past its limit
    >>> check_gradient(model, data).error < 1e-6
    True

    Differentiates a scalar, a sum of the last positions, velocities and activations with fixed weights, with respect to
    the fields of `Point`. `spread` shows whether the differences are meaningful: they are not if a contact opens or
    closes within the width.

    Args:
        model: Model that MJX-JAX supports.
        data: Initial state, and `ctrl`; None for the initial state of the model.
        steps: Number of steps.
        options: Compiler options.
    """
    with jax.enable_x64(True):
        run = trial(model, data, steps)
        value = jax.jit(run.value, compiler_options=options)
        slopes = jax.jit(jax.grad(lambda point: run.value(point)[0]), compiler_options=options)(
            run.zero
        )
        return compare_gradient(run, slopes, value)


class Trial(NamedTuple):
    """The function to differentiate.

    Attributes:
        value: Function of a point, which returns the scalar, and the last positions and velocities.
        zero: Point at which to differentiate.
    """

    value: Callable[[Point], tuple[Scalar, Array]]
    zero: Point


def trial(
    model: mujoco.MjModel,
    data: mujoco.MjData | None,
    steps: int,
    library: Any = nermo_mjx.dynamics,
) -> Trial:
    """Some steps as a function of a point; see `check_gradient`.

    Args:
        model, data, steps: Arguments of `check_gradient`.
        library: Module with `put_model`, `make_data` and `step`, such as `mujoco.mjx`.
    """
    start = mujoco.MjData(model) if data is None else data
    device = library.put_model(model)
    blank = library.make_data(device)
    if model.nmocap:
        blank = blank.replace(
            mocap_pos=jnp.asarray(start.mocap_pos), mocap_quat=jnp.asarray(start.mocap_quat)
        )
    state = [jnp.asarray(leaf, float) for leaf in (start.qpos, start.qvel, start.act, start.ctrl)]
    width = jnp.zeros(0).dtype
    zero = Point(*(jnp.zeros(size, width) for size in (model.nv, model.nv, model.na, model.nu, 2)))

    def value(point: Point) -> tuple[Array, Array]:
        heavier, rougher = (
            1.0 + point.factors
        )  # constants that MuJoCo derives from masses are not updated
        changed = device.replace(
            body_mass=device.body_mass * heavier,
            body_inertia=device.body_inertia * heavier,
            body_subtreemass=device.body_subtreemass * heavier,
            geom_friction=device.geom_friction * rougher,
            pair_friction=device.pair_friction * rougher,
        )
        qpos, qvel, act, ctrl = state
        first = (
            positions(device, qpos, point.position),
            qvel + point.velocity,
            act + point.activation,
        )
        ctrl = ctrl + point.control

        def advance(carried: Any, _: None) -> tuple[Any, None]:
            qpos, qvel, act, warm = carried
            after = library.step(
                changed,
                blank.replace(qpos=qpos, qvel=qvel, act=act, ctrl=ctrl, qacc_warmstart=warm),
            )
            return (after.qpos, after.qvel, after.act, after.qacc_warmstart), None

        (qpos, qvel, act, _), _ = jax.lax.scan(
            advance, (*first, jnp.zeros_like(qvel)), None, length=steps
        )
        # Weights without a regular pattern.
        ends = jnp.concatenate([qpos, qvel, act])
        return ends @ jnp.cos(1.0 + jnp.arange(ends.size)), ends[: model.nq + model.nv]

    return Trial(value, zero)


def compare_gradient(
    run: Trial, slopes: Point, value: Callable[[Point], tuple[Array, Array]]
) -> GradientCheck:
    """Compare a gradient with differences.

    Args:
        run: Differentiated function.
        slopes: Gradient.
        value: Compiled `run.value`.
    """
    flat, point_of = jax.flatten_util.ravel_pytree(run.zero)
    group, directions = entries(run.zero)

    def at(entry: np.integer, change: float) -> float:
        return float(value(point_of(flat.at[entry].set(change)))[0])

    differences = [
        [(at(direction, width) - at(direction, -width)) / (2.0 * width) for direction in directions]
        for width in DIFFERENCE_WIDTHS
    ]
    return GradientCheck(
        group, moved_entries(slopes), np.array(differences), np.asarray(value(run.zero)[1])
    )


def entries(point: Point) -> tuple[np.ndarray, np.ndarray]:
    """The entries of a point that the differences change: their fields, and their indices among all entries."""
    fields, places, first = [], [], 0
    for field, size in enumerate(leaf.size for leaf in point):
        selected = (
            np.unique(np.linspace(0, size - 1, min(size, MAX_GROUP_ENTRIES)).round().astype(int))
            if size
            else np.zeros(0, int)
        )
        fields.append(np.full(len(selected), field))
        places.append(first + selected)
        first += size
    return np.concatenate(fields), np.concatenate(places)


def moved_entries(slopes: Point) -> Float[np.ndarray, " n"]:
    """The entries of a gradient that `entries` selects."""
    flat = np.concatenate([np.ravel(slope) for slope in slopes])
    return flat[entries(slopes)[1]]
