"""Building controller parameters: names, ranges and reachable strides are checked here only."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from nermo_mjx.control import trajectory
from nermo_mjx.control.parameters import ControlParameters, Stance
from nermo_mjx.control.published import published_values, with_gait_factor
from nermo_mjx.kinematics.leg import four_legs, inverse
from nermo_mjx.robot.geometry import Geometry, geometry_of, names_geometry
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.parameters import LIMBS
from nermo_mjx.robot.quantity import ParameterError, check_quantities, quantities, replace_quantities, values_of
from nermo_mjx.runtime import start_jax
from nermo_mjx.shapes import Array

#: Points of each half-cycle at which the nominal foot path is checked, and steps of the search for the longest stride.
_PATH_POINTS, _STRIDE_STEPS = 9, 41


def control_parameters(
    gait: str = "trt", *, steering: str | None = None, profile: str = "exact", routing: str = "type3", **values: Any
) -> ControlParameters:
    """Checked parameters of a published gait with some values changed.

    >>> params = control_parameters("lat", frequency=0.8, **{"spine.amplitude": 0.3})
    >>> float(params.gait.duty), float(params.spine.amplitude)
    (0.68, 0.3)

    Args:
        gait: "trt", "trt1" or "lat". Give duty and offsets in `values` for a custom gait; the gait factor follows
            the duty factor unless it is given.
        steering: "leg", "spine" or "mix"; by default that of the profile.
        profile: one of `PROFILES`.
        routing: knee tendon routing, for the check of the workspace.
        values: parameters by name, as `quantities(ControlParameters)` lists them, and lengths and places of the robot
            (`Geometry`); pass names with a dot as `**{"spine.amplitude": 0.3}`. Numbers, or arrays whose axes are
            batch axes. They are checked, so they cannot be traced: inside a transformed function use
            `replace_quantities`.

    Raises:
        ParameterError: an unknown name, a number out of range, or a stride outside the legs' workspace.
    """
    named: dict[str, Any] = {**published_values(gait, steering=steering, profile=profile)}
    start = ControlParameters(geometry=Geometry() if names_geometry(values) else None)
    known = dict(quantities(start))
    for name, value in values.items():
        known[choice("parameter", name, known)].check(name, value)
    named |= with_gait_factor({name: np.asarray(value, float) for name, value in values.items()})
    params = replace_quantities(start, {name: np.asarray(value, float) for name, value in named.items()})
    check_workspace(params, routing=routing)
    return params


def check(params: ControlParameters, *, routing: str = "type3") -> None:
    """Reject parameters that are not finite, out of range, or step outside the legs' workspace.

    Args:
        params: concrete (not traced) parameters; leaves may carry leading batch axes.
        routing: knee tendon routing.

    Raises:
        ParameterError: with the field's name, its value and what is allowed.
    """
    check_quantities(params)
    check_workspace(params, routing=routing)


def check_workspace(params: ControlParameters, *, routing: str = "type3") -> None:
    """Reject strides, heights and amplitudes whose nominal foot path leaves a leg's workspace; see `check`."""
    stride = np.asarray(params.gait.stride, float) * np.asarray(params.stance.max_stride, float)
    paths = _distinct(_Paths(params.stance, geometry_of(params), stride))
    start_jax()
    reached = np.asarray(_reachable(paths, routing))
    if reached.all():
        return
    row, limb = np.argwhere(~reached)[0]
    one = jax.tree.map(lambda leaf: leaf[row], paths)
    raise ParameterError(_sentence(one, params, int(limb), routing))


class _Paths(NamedTuple):
    """The inputs of the nominal foot paths, and whether legs reach them; leaves of one shape, (batch,)."""

    stance: Stance
    geometry: Geometry
    stride: Any


def _distinct(paths: _Paths) -> _Paths:
    """The distinct combinations of a batch: usually one, because most sweeps vary other things."""
    leaves, structure = jax.tree.flatten(paths)
    columns = np.stack(
        [leaf.reshape(-1) for leaf in np.broadcast_arrays(*(np.asarray(each, float) for each in leaves))]
    )
    distinct: _Paths = jax.tree.unflatten(structure, np.unique(columns, axis=1))
    return distinct


@partial(jax.jit, static_argnames="routing")
def _reachable(paths: _Paths, routing: str) -> Bool[Array, "batch 4"]:
    """Whether each limb's nominal stance and swing paths lie in its workspace."""
    stance, geometry, stride = paths
    progress = jnp.linspace(0.0, 1.0, _PATH_POINTS)[:, None, None]
    each = jnp.broadcast_to(stride[:, None], (stride.size, len(LIMBS)))
    down = jnp.asarray([True, False])[:, None, None]
    points = trajectory.nominal_points(stance, jnp.broadcast_to(down, (2, *each.shape)), each)
    path = trajectory.position(points[:, None], progress)
    return jnp.all(inverse(four_legs(geometry), path, routing).reachable, axis=(0, 1))


def _sentence(paths: _Paths, params: ControlParameters, limb: int, routing: str) -> str:
    axle, stance, stride = LIMBS[limb].split("_")[0], paths.stance, float(paths.stride)
    height = float(getattr(stance, f"{axle}_z"))
    strides = np.linspace(0.0, stride, _STRIDE_STEPS)
    batch = jax.tree.map(lambda leaf: np.full(_STRIDE_STEPS, leaf), paths)._replace(stride=strides)
    reached = np.asarray(_reachable(batch, routing))[:, limb]
    links = _links(paths.geometry, axle)
    if not reached[0]:
        behind, up, down = getattr(stance, f"{axle}_y"), stance.swing_amplitude, stance.stance_amplitude
        return (
            f"stance.{axle}_z is {height:g} m: with stance.{axle}_y {behind:g} m, raised by {up:g} m and lowered by "
            f"{down:g} m, the {axle} foot leaves its leg's workspace even without a stride{links}."
        )
    longest = strides[np.argmin(reached) - 1]
    scale = float(stance.max_stride)
    varied = np.any(np.asarray(params.gait.stride) != 1.0) and scale > 0.0
    name, value, most, unit = (
        ("stride", stride / scale, longest / scale, "") if varied else ("stance.max_stride", stride, longest, " m")
    )
    return (
        f"{name} is {value:g}{unit}: with stance.{axle}_z {height:g} m the {axle} feet reach a stride of "
        f"{longest:.3f} m{links}, so allowed is [0, {most:.3f}]{unit}."
    )


def _links(geometry: Geometry, axle: str) -> str:
    """The links of a pair of legs that are not the published ones, in words."""
    name = f"{axle}_leg"
    published = dict(values_of(getattr(Geometry(), name)))
    own = [f"geometry.{name}.{link} {float(length):g} m" for link, length in values_of(getattr(geometry, name))
           if abs(float(length) - float(published[link])) > 1e-9]  # fmt: skip
    return f", with {' and '.join(own)}" if own else ""
