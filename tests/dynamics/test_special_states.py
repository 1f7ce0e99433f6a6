# Tests of dynamics/differentiable.py, dynamics/impedance.py, dynamics/jacobians.py
"""The step at rest, without controls, at limits, aligned and coincident: values and derivatives of MuJoCo C."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from fakes import special_states
from fakes.special_states import CASES

from nermo_mjx.dynamics import forward, make_data, put_model, rows, step
from nermo_mjx.dynamics.differentiable import make_constraint
from nermo_mjx.dynamics.jacobians import segment_direction, segment_length
from nermo_mjx.dynamics.mjx_copy import adapted
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.runtime import compiler_options

#: Copies of MJX's modules, in which functions of this package replace some of MJX's.
collision_sdf, constraint, math, support = (
    adapted.collision_sdf,
    adapted.constraint,
    adapted.math,
    adapted.support,
)
#: One of each kind, those of the same options in one model; the others run with `-m long`.
CHOSEN = {
    "Euler": (
        "ball spring, polynomial",
        "ball servo in the parent's frame",
        "limit, deeper than width, power 1.5",
        "tendon's force zero of two",
        "weld of a spinning body",
    ),
    "implicitfast": (
        "servo beyond its force, implicitfast",
        "muscle that lengthens, implicitfast",
        "early filter, implicitfast",
        "the same, implicitfast",
        "spinning, off its centre, implicitfast",
    ),
    "no springs": ("no springs",),
}
#: C has no derivative there: three contacts turn with the tilt, however small. `approximated` says so.
WITHOUT_DERIVATIVE = ("cylinder stands",)


def _is_right(*names: str) -> str:
    """What is wrong with cases in one model, or nothing."""
    result = special_states.check(*(CASES[name] for name in names))
    right = result.value < 1e-9 and (result.slope < 1e-4 or names[0] in WITHOUT_DERIVATIVE)
    return "" if right and result.is_finite else f"{names}: {result}"


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("kind", CHOSEN)
def test_special_states_are_those_of_c(kind: str) -> None:
    assert _is_right(*CHOSEN[kind]) == ""


@pytest.mark.long
def test_all_special_states_are_those_of_c() -> None:
    assert [wrong for name in CASES if (wrong := _is_right(name))] == []


FROM_ZERO = """<mujoco><worldbody><body name="b"><joint name="j" axis="0 1 0"/><geom type="box" size=".1 .05 .02"
pos=".2 0 0"
mass="1"/></body><body pos="0 1 0"><joint name="k" axis="0 1 0"/><geom size=".02" pos=".2 0 0"
mass="1"/></body></worldbody>
<tendon><fixed name="t"><joint joint="k" coef="1"/></fixed></tendon></mujoco>"""
#: Fields that MJX decides on when a model is put, here of value zero: (field, index, the share of C's forward
#: difference).
FIELDS = (
    ("dof_frictionloss", 0, 1.0),
    ("tendon_frictionloss", 0, 0.5),
    ("body_gravcomp", 1, 1.0),
    ("opt.density", (), 1.0),
    ("opt.viscosity", (), 1.0),
)


@pytest.mark.release
def test_a_field_that_was_zero_has_its_derivative() -> None:
    """Of a tendon's friction, which C has where it is positive, the mean of both sides."""
    model = mujoco.MjModel.from_xml_string(FROM_ZERO)
    model.opt.tolerance = 0.0
    velocity = np.array([2.0, 1.0])

    def in_c(field: str, index: Any, value: float) -> np.ndarray:
        changed = mujoco.MjModel.from_xml_string(FROM_ZERO)
        changed.opt.tolerance, changed.flg_gravcomp = 0.0, True
        if field.startswith("opt."):
            setattr(changed.opt, field[4:], value)
        else:
            getattr(changed, field)[index] = value
        data = mujoco.MjData(changed)
        data.qvel[:] = velocity
        for _ in range(2):
            mujoco.mj_step(changed, data)
        return np.array(data.qvel)

    with jax.enable_x64(True):
        device = put_model(model)
        start = make_data(device).replace(qvel=jnp.asarray(velocity))

        def end(values: Any) -> Any:
            """The velocity after two steps, twice: one is the value that comes with the derivative."""
            fields = {}
            for value, (field, index, _) in zip(values, FIELDS, strict=True):
                home = device.opt if field.startswith("opt.") else device
                fields[field] = (
                    jnp.asarray(getattr(home, field.removeprefix("opt."))).at[index].set(value)
                )
            changed = device.tree_replace(fields)

            def advance(state: Any, _: None) -> Any:
                new_data = step(
                    changed, start.replace(qpos=state[0], qvel=state[1], qacc_warmstart=state[2])
                )
                return (new_data.qpos, new_data.qvel, new_data.qacc_warmstart), None

            state = start.qpos, start.qvel, start.qacc_warmstart
            velocity = jax.lax.scan(advance, state, None, length=2)[0][1]
            return velocity, velocity

        slopes, values = jax.jit(
            jax.jacrev(end, has_aux=True), compiler_options=compiler_options()
        )(jnp.zeros(len(FIELDS)))
    still = in_c("dof_frictionloss", 0, 0.0)
    np.testing.assert_allclose(values, still, atol=1e-12)
    for slope, (field, index, share) in zip(np.asarray(slopes).T, FIELDS, strict=True):
        difference = (in_c(field, index, 1e-6) - still) / 1e-6
        assert np.abs(difference).max() > 1e-5, field
        np.testing.assert_allclose(
            slope, share * difference, atol=1e-5 * np.abs(difference).max(), err_msg=field
        )


BOX = """<mujoco><option cone="{}"/><worldbody><geom type="plane" size="3 3 .1"/><body pos="0 0 .05"><freejoint/><geom
type="box"
size=".05 .05 .05" mass="1"/></body></worldbody></mujoco>"""


@pytest.mark.release
@pytest.mark.parametrize(("cone", "double"), [("pyramidal", True), ("elliptic", False)], ids=str)
def test_the_solver_is_quick_at_rest(cone: str, double: bool) -> None:
    """Where an acceleration is rounding, no step is small beside it: it made all rounds, and said it had not
    converged."""
    with jax.enable_x64(double):
        model = put_model(mujoco.MjModel.from_xml_string(BOX.format(cone)))
        data = make_data(model)

        def advance(state: Any, _: None) -> Any:
            new_data = step(
                model, data.replace(qpos=state[0], qvel=state[1], qacc_warmstart=state[2])
            )
            return (new_data.qpos, new_data.qvel, new_data.qacc_warmstart), rows.inner(
                new_data
            ).solver_niter

        start = data.qpos, data.qvel, data.qacc_warmstart
        run = jax.jit(
            lambda state: jax.lax.scan(advance, state, None, length=200),
            compiler_options=compiler_options(),
        )
        (_, velocity, _), rounds = run(start)
    assert np.max(rounds) <= 3
    assert np.abs(velocity).max() < 1e-3


SIGHT = """<mujoco><worldbody><geom type="plane" size="3 3 .1"/><body pos="0 0 .3"><freejoint/><geom size=".05"
mass="1"/><site
name="d" pos="0 0 -.06" zaxis="0 0 -1"/><site name="u"/></body></worldbody><sensor><rangefinder site="d"/><rangefinder
site="u"/>
</sensor></mujoco>"""


def test_a_rangefinder_needs_no_material() -> None:
    """MJX looks one up in an empty table: an error of JAX while the program is traced."""
    model = mujoco.MjModel.from_xml_string(SIGHT)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        device = put_model(model)
        sensordata = jax.jit(lambda state: forward(device, state).sensordata)(make_data(device))
    np.testing.assert_allclose(sensordata, data.sensordata, atol=1e-9)


def _impedances(x: Any) -> Any:
    model = put_model(mujoco.MjModel.from_xml_string(BOX.format("elliptic")))
    return jnp.stack(
        [
            jnp.stack(
                constraint._kbi(
                    model, jnp.array([0.02, 1.0]), jnp.array([0.5, 0.9, x[1], x[2], power]), x[0]
                )
            )
            for power in (1.0, 1.5, 2.0, 3.3)
        ]
    )


RANGE = jnp.array([0.0, 1.0])
MUSCLE = jnp.array([0.75, 1.05, 10.0, 200.0, 0.5, 1.6, 1.5, 1.3, 1.2])
#: Functions of MJX and ours that a step is made of, by name: inputs where a norm, a quotient, a power or a root is
#: singular.
SINGULAR: dict[str, tuple[Callable[[Any], Any], list[list[float]]]] = {
    "rotation vector": (
        lambda q: jnp.multiply(*math.quat_to_axis_angle(q)),
        [[1, 0, 0, 0], [-1, 0, 0, 0], [0.6, 0.8, 0, 0]],
    ),
    "difference of rotations": (
        lambda q: math.quat_sub(q[:4], q[4:]),
        [[1, 0, 0, 0] * 2, [0.6, 0.8, 0, 0] * 2],
    ),
    "impedance": (
        _impedances,
        [[d, 0.01, 0.5] for d in (0.0, 0.005, 0.01, 0.02, -0.01)]
        + [[0.01, 1e-15, 0.5], [0.02, 0.01, 0.0]],
    ),
    "tendon's segment": (
        lambda v: segment_length(v) * segment_direction(v, segment_length(v)),
        [[0, 0, 0], [1, 0, 0]],
    ),
    "normal": (math.normalize, [[0, 0, 1], [1e-9, 0, 1]]),
    "frame": (math.make_frame, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0.5, 0.75**0.5]]),
    "segments": (
        lambda x: jnp.concatenate(
            math.closest_segment_to_segment_points(x[:3], x[3:6], x[6:9], x[9:])
        ),
        [
            [0, 0, 0, 0, 0, 1, 1, 0, 0, 1, 0, 1],
            [0, 0, 0, 0, 0, 1] * 2,
            [0, 0, -1, 0, 0, 1, 1, 0, 0, -1, 0, 0],
        ],
    ),
    "muscle": (
        lambda x: (
            support.muscle_gain(x[0], x[1], RANGE, x[2], MUSCLE)
            + support.muscle_bias(x[0], RANGE, x[2], MUSCLE)
        ),
        [[length, rate, 1.0] for length in (0.0, 0.5, 0.8333333, 1.0) for rate in (-5.0, 0.0, 1.0)]
        + [[0.5, 0.0, 0.0]],
    ),
    "activation": (
        lambda x: support.muscle_dynamics(x[0], x[1], jnp.array([0.01, 0.04, x[2]])),
        [[0, 0, 0], [0.4, 0.4, 0.0], [0.4, 0.4, 0.2], [1, 1, 0.2]],
    ),
    "arc": (
        lambda x: jnp.concatenate(
            [angles.ravel() for angles in support.wrap_circle(x[:4], x[4:6], x[6] > 0, x[6])]
        ),
        [
            [*ends, 0, 1, radius]
            for *ends, radius in (
                [-2, 1, 2, 1, 1],
                [2, 0, 2, 0, 1],
                [-2, 0, 2, 0, 1],
                [-2, 0, 2, 0, 0],
                [0.5, 0, 2, 0, 1],
            )
        ],
    ),
    "cylinder": (
        lambda x: collision_sdf._cylinder(x[:3], x[3:]),
        [[*point, 1, 2, 0] for point in ([0, 0, 0], [1, 0, 2], [0, 0, 3], [1, 0, 0])],
    ),
    "drag's box": (lambda x: jnp.abs(x) * x, [[0, 0, 0]]),
}


@pytest.mark.release(cases=("impedance", "arc"))
@pytest.mark.parametrize("name", SINGULAR)
def test_a_singular_input_has_a_finite_derivative(name: str) -> None:
    """In both modes, which agree; and that of a rotation at the identity is the identity, not zero."""
    function, points = SINGULAR[name]
    with jax.enable_x64(True):
        all_of = jax.jit(lambda x: (function(x), jax.jacfwd(function)(x), jax.jacrev(function)(x)))
        for point in points:
            value, ahead, back = all_of(jnp.asarray(point, float))
            assert np.isfinite(value).all(), point
            assert np.isfinite(ahead).all(), point
            np.testing.assert_allclose(back, ahead, rtol=1e-9, atol=1e-12, err_msg=str(point))
            if name in ("rotation vector", "tendon's segment") and point[:3] in (
                [1, 0, 0],
                [0, 0, 0],
            ):
                np.testing.assert_allclose(
                    ahead[:, -3:],
                    2 * np.eye(3) if name == "rotation vector" else np.eye(3),
                    atol=1e-9,
                )


# --- the contacts' rows, against MJX's own

BALL = """
<mujoco>
  <option timestep="0.01"> <flag refsafe="{refsafe}"/> </option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body pos="0 0 .0998"> <freejoint/> <geom name="ball" size=".1"/> </body>
  </worldbody>
  <contact> <pair geom1="floor" geom2="ball" solref="{solref}" solimp="0.1 0.9 0.0005 0.5 2"/> </contact>
</mujoco>
"""


@jax.jit
def at_contact(model: Any, data: Any) -> Any:
    return mjx.collision(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))


@functools.partial(jax.jit, static_argnums=0)
def made(make: Callable[..., Any], model: Any, data: Any, largest: Any) -> tuple[Any, Any]:
    """The contacts' rows with such an impedance: stiffness and reference acceleration."""
    solimp = rows.inner(data).contact.solimp.at[:, 1].set(largest)
    constraints = rows.inner(make(model, data.tree_replace({"_impl.contact.solimp": solimp})))
    return constraints.efc_D, constraints.efc_aref


@pytest.mark.release
@pytest.mark.parametrize("solref", ["0.005 1", "0.03 1.5", "-3000 -40"])
@pytest.mark.parametrize("refsafe", ["enable", "disable"])
def test_slopes_are_those_of_mjxs_rows(refsafe: str, solref: str) -> None:
    """A time constant of half a step, which MuJoCo takes for two unless told not to; a longer one; and stiffness.

    The oracle is a difference of `mjx.make_constraint` in float64.
    """
    with jax.enable_x64(True):
        model = put_model(
            mujoco.MjModel.from_xml_string(BALL.format(refsafe=refsafe, solref=solref))
        )
        data = at_contact(
            model, make_data(model).replace(qvel=jnp.array([0.1, 0.0, -0.2, 0.0, 0.0, 0.0]))
        )
        slopes = jax.jvp(
            lambda largest: made(make_constraint, model, data, largest), (0.9,), (1.0,)
        )[1]
        above, below = (
            made(mjx.make_constraint, model, data, 0.9 + step) for step in (1e-6, -1e-6)
        )
    assert np.any(above[1] != below[1])
    for slope, high, low in zip(slopes, above, below, strict=True):
        np.testing.assert_allclose(
            slope, (high - low) / 2e-6, rtol=1e-5, atol=1e-6 * np.abs(high).max()
        )
