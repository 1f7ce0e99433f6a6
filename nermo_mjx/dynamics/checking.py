"""The gradient of a model's steps against central differences, for any model."""

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

from nermo_mjx.dynamics import differentiable
from nermo_mjx.dynamics.integration import positions
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.shapes import Array, Scalar

#: Half-widths of the differences; each point is moved by that share of its unit (m, rad, m/s, ...; 1 for factors).
WIDTHS: Final = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
#: Most entries of each group that are moved, evenly chosen.
MOST: Final = 12
#: A group whose differences are below this share of all is compared with that share.
FLOOR: Final = 1e-6


class Point(NamedTuple):
    """What is differentiated: changes, zero at the state itself.

    Attributes:
        position, velocity: of the state, in the tangent space, (nv,) each.
        activation, control: `act` and `ctrl`.
        factors: masses and inertias, and frictions, are taken 1 + so much.
    """

    position: Array
    velocity: Array
    activation: Array
    control: Array
    factors: Array


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """What `check_gradient` found; arrays over the entries that were moved, in the order of `Point`.

    Attributes:
        group: which field of `Point` each entry is of.
        gradient: by reverse mode.
        differences: central differences by width, (len(WIDTHS), n).
        end: positions and velocities after the last step.
    """

    group: np.ndarray
    gradient: Float[np.ndarray, " n"]
    differences: Float[np.ndarray, "widths n"]
    end: Float[np.ndarray, " m"]

    @property
    def is_finite(self) -> bool:
        """Whether gradient and end are."""
        return bool(np.isfinite(self.gradient).all() and np.isfinite(self.end).all())

    @property
    def errors(self) -> list[float]:
        """Of the gradient against the differences of each width, see `distance`."""
        return [distance(self.group, self.gradient, each) for each in self.differences]

    @property
    def chosen(self) -> int:
        """Which width counts: its differences are closest to those of a neighbour; the gradient has no say."""
        apart = self._apart
        first = int(np.argmin(apart))
        outer = apart[first - 1] if first > 0 else np.inf
        return first + (first + 1 < len(apart) and apart[first + 1] < outer)

    @property
    def error(self) -> float:
        """Of the gradient against the differences that count."""
        return self.errors[self.chosen]

    @property
    def spread(self) -> float:
        """By how much the differences of neighbouring widths differ at least: what can be known of the error."""
        return min(self._apart)

    @property
    def _apart(self) -> list[float]:
        pairs = zip(self.differences[:-1], self.differences[1:], strict=True)
        return [distance(self.group, one, other) for one, other in pairs]


def distance(group: np.ndarray, found: np.ndarray, expected: np.ndarray) -> float:
    """Of two vectors: |found - expected| / |expected| in the group where it is largest; inf where one is not finite.

    >>> group = np.array([0, 0, 1])
    >>> round(distance(group, np.array([3.0, 4.0, 1.0]), np.array([3.0, 4.0, 2.0])), 3)
    0.5

    Args:
        group: of each entry; units within one are alike.
        found, expected: the vectors.
    """
    if not (np.isfinite(found).all() and np.isfinite(expected).all()):
        return float("inf")
    least = FLOOR * np.linalg.norm(expected)
    shares = [0.0]
    for each in np.unique(group):
        among = group == each
        scale = max(np.linalg.norm(expected[among]), least)
        shares.append(float(np.linalg.norm((found - expected)[among]) / scale) if scale else 0.0)
    return max(shares)


def check_gradient(
    model: mujoco.MjModel,
    data: mujoco.MjData | None = None,
    steps: int = 5,
    options: dict[str, Any] | None = None,
) -> GradientCheck:
    """Reverse mode through some steps of a model, against central differences, in float64.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint axis="0 1 0" range="-1 1"/>
    ... <geom size=".1" pos="0 0 -1"/></body></worldbody></mujoco>''')
    >>> data = mujoco.MjData(model)
    >>> data.qpos[0], data.qvel[0] = 1.001, 2.0  # past its limit
    >>> check_gradient(model, data).error < 1e-6
    True

    One number is differentiated, a sum of the last positions, velocities and activations with fixed weights, by all
    that `Point` names. Whether differences mean anything is seen in `spread`: where a contact opens or closes within
    the width, they do not.

    Args:
        model: that MJX-JAX can step.
        data: the state to start from, and `ctrl`; the model's own start if None.
        steps: how many.
        options: of the compiler.
    """
    with jax.enable_x64(True):
        run = trial(model, data, steps)
        value = jax.jit(run.value, compiler_options=options)
        slopes = jax.jit(jax.grad(lambda point: run.value(point)[0]), compiler_options=options)(run.zero)
        return compared(run, slopes, value)


class Trial(NamedTuple):
    """What is differentiated.

    Attributes:
        value: point -> the number, and the last positions and velocities.
        zero: where.
    """

    value: Callable[[Point], tuple[Scalar, Array]]
    zero: Point


def trial(
    model: mujoco.MjModel,
    data: mujoco.MjData | None,
    steps: int,
    step: Callable[[mjx.Model, mjx.Data], mjx.Data] = differentiable.step,
) -> Trial:
    """Some steps as a function of a point; see `check_gradient`.

    Args:
        model, data, steps: as there.
        step: whose steps.
    """
    start = mujoco.MjData(model) if data is None else data
    device = mjx.put_model(model)
    blank = mjx.make_data(device)
    if model.nmocap:
        blank = blank.replace(mocap_pos=jnp.asarray(start.mocap_pos), mocap_quat=jnp.asarray(start.mocap_quat))
    state = [jnp.asarray(each, float) for each in (start.qpos, start.qvel, start.act, start.ctrl)]
    width = jnp.zeros(0).dtype
    zero = Point(*(jnp.zeros(size, width) for size in (model.nv, model.nv, model.na, model.nu, 2)))

    def value(point: Point) -> tuple[Array, Array]:
        heavier, rougher = 1.0 + point.factors  # what MuJoCo derives from masses for its constraints stays
        changed = device.replace(
            body_mass=device.body_mass * heavier, body_inertia=device.body_inertia * heavier,
            body_subtreemass=device.body_subtreemass * heavier,
            geom_friction=device.geom_friction * rougher, pair_friction=device.pair_friction * rougher,
        )  # fmt: skip
        qpos, qvel, act, ctrl = state
        first = positions(device, qpos, point.position), qvel + point.velocity, act + point.activation
        ctrl = ctrl + point.control

        def advance(carried: Any, _: None) -> tuple[Any, None]:
            qpos, qvel, act, warm = carried
            after = step(changed, blank.replace(qpos=qpos, qvel=qvel, act=act, ctrl=ctrl, qacc_warmstart=warm))
            return (after.qpos, after.qvel, after.act, after.qacc_warmstart), None

        (qpos, qvel, act, _), _ = jax.lax.scan(advance, (*first, jnp.zeros_like(qvel)), None, length=steps)
        # Weights without a pattern of their own.
        ends = jnp.concatenate([qpos, qvel, act])
        return ends @ jnp.cos(1.0 + jnp.arange(ends.size)), ends[: model.nq + model.nv]

    return Trial(value, zero)


def compared(run: Trial, slopes: Point, value: Callable[[Point], tuple[Array, Array]]) -> GradientCheck:
    """A gradient beside differences.

    Args:
        run: what was differentiated.
        slopes: the gradient.
        value: `run.value`, compiled.
    """
    flat, point_of = jax.flatten_util.ravel_pytree(run.zero)
    group, moved = entries(run.zero)

    def at(entry: np.integer, change: float) -> float:
        return float(value(point_of(flat.at[entry].set(change)))[0])

    differences = [[(at(each, width) - at(each, -width)) / (2.0 * width) for each in moved] for width in WIDTHS]
    return GradientCheck(group, moved_entries(slopes), np.array(differences), np.asarray(value(run.zero)[1]))


def entries(point: Point) -> tuple[np.ndarray, np.ndarray]:
    """Which entries of a point are moved: the field each is of, and its place in all of them."""
    fields, places, first = [], [], 0
    for field, size in enumerate(each.size for each in point):
        chosen = np.unique(np.linspace(0, size - 1, min(size, MOST)).round().astype(int)) if size else np.zeros(0, int)
        fields.append(np.full(len(chosen), field))
        places.append(first + chosen)
        first += size
    return np.concatenate(fields), np.concatenate(places)


def moved_entries(slopes: Point) -> Float[np.ndarray, " n"]:
    """Those entries of a gradient."""
    flat = np.concatenate([np.ravel(each) for each in slopes])
    return flat[entries(slopes)[1]]
