"""Models and data for the step, and copies of MJX's functions that call functions of this package.

MJX has no option for other contacts, or for other derivatives of the functions that its stages call. The copies in
`adapted` share the code of MJX's functions, but look names up in dictionaries of this module, where functions of this
package replace some of MJX's. The modules of MJX stay unchanged, so that other models in the same process, and other
threads, get the results of MJX.
"""

from __future__ import annotations

import functools
import importlib
from types import CellType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, Final

import jax
import mujoco
import numpy as np

from nermo_mjx.dynamics import collision, jacobians, spatial
from nermo_mjx.dynamics.coverage import approximated, not_simulated, refused, side_sites
from nermo_mjx.dynamics.impedance import stiffness_damping_impedance
from nermo_mjx.dynamics.mjx_import import Model, mjx

_COPIED_MODULES: Final = "math support smooth constraint passive forward collision_convex collision_sdf collision_driver io"
#: Name of each copied module -> its copy.
_COPIES: Final = {f"mujoco.mjx._src.{name}": SimpleNamespace() for name in _COPIED_MODULES.split()}


def _copied(value: Any) -> Any:
    """A value of one of these modules; modules and functions become copies, which call each other."""
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, ModuleType):
        return _COPIES.get(value.__name__, value)
    if not isinstance(value, FunctionType) or value.__globals__["__name__"] not in _COPIES:
        return value
    names = vars(_COPIES[value.__globals__["__name__"]])
    cells = tuple(CellType(_copied(cell.cell_contents)) for cell in value.__closure__ or ())
    return functools.update_wrapper(
        FunctionType(value.__code__, names, None, value.__defaults__, cells), value
    )


for _name, _copy in _COPIES.items():
    vars(_copy).update(_copied(vars(importlib.import_module(_name))))
#: Copies of MJX's modules, for example `adapted.smooth` with the function `adapted.smooth.tendon`.
adapted: Final[Any] = SimpleNamespace(
    **dict(zip(_COPIED_MODULES.split(), _COPIES.values(), strict=True))
)
vars(adapted.math).update(
    closest_segment_point=collision.closest_on_segment, quat_to_axis_angle=jacobians.axis_and_angle
)
vars(adapted.support).update(
    jac=jacobians.point_jacobian,
    wrap_circle=functools.partial(jacobians.circle, adapted.support.wrap_circle),
    wrap_inside=jacobians.wrap_inside,
    _length_circle=jacobians.arc_length,
    muscle_dynamics_timescale=jacobians.muscle_time_constant,
)
#: In `smooth`, `norm` and `safe_div` compute the lengths and directions of tendons' segments only.
adapted.smooth.math = SimpleNamespace(
    **vars(adapted.math)
    | {"norm": jacobians.segment_length, "safe_div": jacobians.segment_direction}
)
adapted.constraint._kbi = stiffness_damping_impedance
adapted.collision_sdf._cylinder = spatial.cylinder_distance
adapted.collision_driver._COLLISION_FUNC.update(collision.CONTACT_FUNCTIONS)


def put_model(model: mujoco.MjModel, device: jax.Device | None = None) -> Model:
    """Put a model of MuJoCo on a device, for `step` and `forward` of this package.

    The result is an `mjx.Model` with additional fields of MuJoCo, which `mjx.put_model` omits. MJX's functions accept
    it, too, with data of `mjx.make_data`.

    >>> ball = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
    ... <body pos="0 0 .2"><freejoint/><geom size=".1"/></body></worldbody></mujoco>''')
    >>> model = put_model(ball)
    >>> make_data(model).qpos.shape
    (7,)

    Args:
        model: Model, compiled by MuJoCo.
        device: Device of JAX; the first one by default.

    Raises:
        NotImplementedError: MJX does not support a part of the model; the message names this part and a remedy.
    """
    for message in refused(model):
        raise NotImplementedError(f"{message}.")
    ours = mjx.put_model(model, device, "jax")
    extra_fields = {
        name: getattr(model, name)
        for name in ("actuator_armature", "actuator_damping", "actuator_dampingpoly")
    }
    wraps = np.isin(model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    is_inside = np.zeros(model.nwrap, bool)
    for side in side_sites(model):
        is_inside[side.wrap] = side.most < side.radius
    reasons = {
        "not_simulated": tuple(not_simulated(model)),
        "approximated": tuple(approximated(model)),
    }
    fields = vars(ours) | {"_impl": ours._impl.replace(is_wrap_inside=is_inside[wraps])}
    return Model(**fields, **jax.device_put(extra_fields, device), **reasons)


def make_data(model: mjx.Model | mujoco.MjModel, device: jax.Device | None = None) -> mjx.Data:
    """Make the data of one world, in the initial state of a model, with as many contacts as `step` computes.

    `mjx.step` computes MJX's contacts, and needs data of `mjx.make_data`.

    >>> rods = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom type="capsule" size=".1 .2"/>
    ... <body pos="0 0 1"><freejoint/><geom type="capsule" size=".1 .2"/></body></worldbody></mujoco>''')
    >>> make_data(put_model(rods)).ncon, mjx.make_data(rods).ncon  # parallel capsules touch at two points
    (2, 1)

    Args:
        model: Result of `put_model`, or its model of MuJoCo.
        device: Device of JAX; the first one by default.

    Raises:
        NotImplementedError: MJX does not support the contacts of the model.
    """
    data_jax: mjx.Data = adapted.io.make_data(model, device, "jax")
    return data_jax


def put_data(
    model: mujoco.MjModel, data: mujoco.MjData, device: jax.Device | None = None
) -> mjx.Data:
    """Put data of MuJoCo on a device, with as many contacts as `step` computes.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint/><geom size=".1"/></body></worldbody>
    ... </mujoco>''')
    >>> data = mujoco.MjData(model)
    >>> data.qpos[0] = 0.5
    >>> float(put_data(model, data).qpos[0])
    0.5

    Args:
        model, data: Model of MuJoCo, and data of the same model.
        device: Device of JAX; the first one by default.

    Raises:
        ValueError: MuJoCo has more contacts than MJX computes for this model.
    """
    data_jax: mjx.Data = adapted.io.put_data(model, data, device, "jax")
    return data_jax
