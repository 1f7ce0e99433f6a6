# Tests of dynamics/own_derivative.py, dynamics/differentiable.py
"""Second derivatives of the step, and of what it is made of: symmetric, and equal to differences of the gradient."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import math
from mujoco.mjx._src.collision_types import GeomInfo

from nermo_mjx.dynamics import (
    collision,
    differentiable,
    jacobians,
    make_data,
    put_model,
    solver,
    step,
)
from nermo_mjx.dynamics.integration import positions
from nermo_mjx.dynamics.own_derivative import own_derivative
from nermo_mjx.dynamics.rows import ConstraintProblem, Layout
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.runtime import compiler_options


def _length_of_slope(f: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The gradient of the length of the gradient, a penalty as those on a slope."""
    return jax.grad(lambda x: jnp.sqrt(jnp.sum(jax.grad(f)(x) ** 2)))


#: Ways to second derivatives.
WAYS: dict[str, Callable[[Callable[[Any], Any]], Callable[[Any], Any]]] = {
    "jacfwd(jacrev)": lambda f: jax.jacfwd(jax.jacrev(f)),
    "jacrev(jacfwd)": lambda f: jax.jacrev(jax.jacfwd(f)),
    "grad of a norm": _length_of_slope,
}


def errors(
    f: Callable[[Any], Any],
    point: np.ndarray,
    modes: tuple[str, ...] = tuple(WAYS),
    width: float = 1e-5,
) -> dict[str, float]:
    """Of second derivatives of f in float64, against differences of its gradient, as a share of the largest; and by
    how much f curves."""
    with jax.enable_x64(True):
        slopes = jax.jit(jax.grad(f), compiler_options=compiler_options())
        wide, narrow = (
            np.stack(
                [
                    np.subtract(slopes(point + h * direction), slopes(point - h * direction))
                    / (2 * h)
                    for direction in np.eye(len(point))
                ]
            )
            for h in (width, width / 4)
        )
        expected = (16 * narrow - wide) / 15  # without the term of second order in the width
        slope = np.asarray(slopes(point))
        scale = np.abs(expected).max()
        deviations = {}
        for mode in modes:
            result = np.asarray(jax.jit(WAYS[mode](f), compiler_options=compiler_options())(point))
            expected_part = (
                expected if result.ndim == 2 else expected @ slope / np.linalg.norm(slope)
            )
            deviations[mode] = float(np.abs(result - expected_part).max() / scale)
            if result.ndim == 2:
                deviations[f"{mode}, not symmetric"] = float(
                    np.abs(result - result.T).max() / scale
                )
    assert scale > 1e-6
    return deviations


# ---
# The rows of a constraint problem.

SIZE, NUMBERS = 7, 5
#: Rows of equalities, of dry friction, that push, and of cones of two dimensions; the random start puts them in several
#: zones.
EQUALITY, DRY, PUSHES, CONES = 2, 6, 6, ((3, 4), (6, 2))


def _problems() -> tuple[Layout, Callable[[Any], ConstraintProblem]]:
    """A layout, and a random problem all of whose arrays depend on some numbers."""
    rows, random = (
        EQUALITY + DRY + PUSHES + sum(dim * count for dim, count in CONES),
        np.random.default_rng(3),
    )
    lower = random.normal(size=(SIZE, SIZE))
    is_friction = (np.arange(rows) >= EQUALITY) & (np.arange(rows) < EQUALITY + DRY)
    first = ConstraintProblem(
        lower @ lower.T + np.eye(SIZE),
        random.normal(size=SIZE),
        random.normal(size=(rows, SIZE)),
        random.normal(size=rows),
        random.uniform(0.5, 20.0, rows),
        np.where(is_friction, random.uniform(0.2, 2.0, rows), 0.0),
        random.uniform(0.3, 1.5, (sum(count for _, count in CONES), 6)),
    )
    directions = jax.tree.map(lambda leaf: random.normal(size=(NUMBERS, *leaf.shape)), first)

    def problem(numbers: Any) -> ConstraintProblem:
        changes = jax.tree.map(
            lambda direction: jnp.tensordot(0.1 * jnp.sin(numbers), direction, 1), directions
        )
        turned = changes.inertia @ changes.inertia.T
        changed = jax.tree.map(lambda leaf, change: leaf * jnp.exp(change), first, changes)
        return changed._replace(
            inertia=first.inertia + turned, smooth=first.smooth + changes.smooth
        )

    return Layout(EQUALITY, DRY, CONES), problem


@pytest.mark.long
@pytest.mark.release
def test_second_derivatives_of_the_rows() -> None:
    """By every array of the problem at once."""
    layout, problem = _problems()

    def value(numbers: Any) -> Any:
        constants = problem(numbers)
        solution = solver.minimum(layout, *jax.lax.stop_gradient((constants, jnp.zeros(SIZE))))
        last = differentiable._newton(layout, solution.qacc, jax.lax.stop_gradient(constants))
        return jnp.sum(
            jnp.sin(differentiable._solution(last.qacc, last.residual, constants, static=layout))
        )

    modes = ("jacfwd(jacrev)", "grad of a norm")
    deviations = errors(value, np.linspace(-0.5, 0.7, NUMBERS), modes)
    assert max(deviations.values()) < 1e-6, deviations


# ---
# Points that are found by iteration: where an ellipsoid is closest, and where a tendon touches a ring from inside.


def _turned(numbers: Any) -> Any:
    quaternion = jnp.concatenate([jnp.ones(1), numbers])
    return math.quat_to_mat(quaternion / jnp.linalg.norm(quaternion))


@pytest.mark.release
@pytest.mark.parametrize(
    ("collider", "sizes"),
    [
        # The side of a capsule, and its end, which is a sphere.
        (collision.capsule_ellipsoid, [[0.05, 0.3, 0.0], [0.05, 0.02, 0.0]]),
        (collision.ellipsoid_ellipsoid, [[0.05, 0.08, 0.06]]),
    ],
    ids=["capsule", "ellipsoid"],
)
def test_second_derivatives_of_an_ellipsoids_closest_point(
    collider: Any, sizes: list[list[float]]
) -> None:
    """By places, orientations and sizes: of depth, position and normal."""

    def value(numbers: Any) -> Any:
        def of_size(size: Any) -> Any:
            first = GeomInfo(numbers[1:4] * 0.1, _turned(numbers[1:4]), size * jnp.exp(numbers[0]))
            second = GeomInfo(
                jnp.array([0.02, 0.03, 0.12]), _turned(numbers[4:]), jnp.array([0.1, 0.07, 0.05])
            )
            dist, pos, frame = collider.of(first, second)
            return 5.0 * dist + jnp.sum(jnp.sin(10.0 * pos)) + frame[0] @ jnp.array([0.3, 0.2, 0.5])

        return jnp.sum(jax.vmap(of_size)(jnp.array(sizes)))

    deviations = errors(value, np.array([0.1, 0.3, -0.2, 0.1, 0.2, 0.4, -0.3]), ("jacfwd(jacrev)",))
    assert max(deviations.values()) < 1e-6, deviations


@pytest.mark.release
def test_second_derivatives_of_a_tendon_inside_a_ring() -> None:
    """By both ends and the radius: of the point that it touches."""

    def value(numbers: Any) -> Any:
        length, points = jacobians.wrap_inside(numbers[:4], numbers[4], 20, 1e-12, 1.0 - 1e-7)
        return jnp.sum(jnp.sin(3.0 * points)) + length[0]

    deviations = errors(value, np.array([2.0, 1.5, -2.0, 1.7, 1.0]))
    assert max(deviations.values()) < 1e-6, deviations


# ---
# Steps of models with all kinds of rows.

FREE = '<body pos="{}"><freejoint/><geom {} mass="{}"/></body>'
#: Equalities, dry friction, limits and tendons: of trees apart from each other, without contacts.
HELD = """<option timestep=".002"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body><joint axis="0 1 0" damping=".01" stiffness=".2" range="-20 20"/>
<geom type="capsule" fromto="0 0 0 .1 0 -.2" size=".02" mass=".2"/></body>
<body><joint type="ball" range="0 20"/><geom size=".05" pos=".1 0 -.2" mass=".3"/></body>
<body><joint name="p" axis="0 1 0" frictionloss=".02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".01" mass=".1"/>
<body pos="0 0 -.2"><joint name="q" axis="0 1 0" frictionloss=".3"/>
<geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".05"/></body></body>
<body name="one"><joint name="j" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" mass=".1"/></body>
<body name="two" pos=".2 0 -.2"><joint name="k" axis="0 1 0" stiffness=".3"/>
<geom type="capsule" fromto="0 0 0 0 0 .2" size=".01" mass=".1"/></body>
<body name="four" pos="1 0 .1"><freejoint/><geom type="box" size=".05 .03 .02" mass=".2"/></body>
<site name="a" pos="2 0 .1"/><geom name="drum" type="cylinder" size=".03 .05" pos="2.02 0 .02" euler="90 0 0"/>
<body pos="2 0 0"><joint name="s" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" mass=".1"/>
<site name="b" pos=".12 0 .01"/></body></worldbody>
<tendon><fixed name="t" frictionloss=".01"><joint joint="p" coef="1"/><joint joint="q" coef=".5"/></fixed>
<fixed name="u"><joint joint="k" coef="1"/></fixed>
<spatial limited="true" range="0 .151" stiffness="3"><site site="a"/><geom geom="drum"/><site site="b"/></spatial>
</tendon>
<equality><connect body1="one" body2="two" anchor=".2 0 0"/><joint joint1="k" joint2="s" polycoef="0 .5 .3 0 0"/>
<weld body1="four" solref=".05 .4"/><tendon tendon1="u" tendon2="t" polycoef="0 .3 .2 0 0"/></equality>"""
_TOUCH = """<option timestep=".002" cone="{}" impratio="3"/>
<default><geom solimp=".5 .95 .01 .4 2" friction=".6 .01 .001"/>
</default><worldbody><geom type="plane" size="3 3 .1"/>"""
#: Contacts of all dimensions, some that stick and some that slide.
TOUCHING = (
    _TOUCH
    + FREE.format("0 0 .0495", 'size=".05"', ".3")
    + FREE.format(
        "1 0 .0395", 'type="ellipsoid" size=".06 .05 .04" condim="4" euler="5 10 0"', ".2"
    )
    + FREE.format("0 1 .0495", 'type="capsule" size=".05 .1" euler="0 80 0" condim="6"', ".2")
    + "</worldbody>"
)
SLIDING = """<worldbody><geom type="plane" size="3 3 .1"/><body pos="0 0 .0995"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 0 1"/><joint axis="0 1 0" stiffness="1"/><geom size=".1" mass="1" pos=".01 0 0"/></body>
</worldbody>"""
MODELS = {
    "a contact": SLIDING,
    "equalities, dry friction, limits, tendons": HELD,
    "pyramids": TOUCHING.format("pyramidal"),
    "elliptic cones": TOUCHING.format("elliptic"),
}


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "a contact" else pytest.mark.long) for name in MODELS],
)
def test_second_derivatives_of_a_step(name: str) -> None:
    """By positions and velocities along some directions."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{MODELS[name]}</mujoco>")
    random = np.random.default_rng(0)
    shifts, pushed = random.normal(size=(2, 4, model.nv))
    with jax.enable_x64(True):
        device = put_model(model)
        data = make_data(device)

        def value(numbers: Any) -> Any:
            velocity = jnp.asarray(pushed[0]) + numbers @ pushed
            start = data.replace(
                qpos=positions(device, data.qpos, 1e-2 * (numbers @ shifts)), qvel=velocity
            )
            end = step(device, start)
            return jnp.sum(jnp.sin(end.qvel)) + jnp.sum(end.qpos)

        deviations = errors(value, np.array([0.02, -0.03, 0.01, 0.03]), ("jacfwd(jacrev)",), 1e-5)
    assert max(deviations.values()) < 1e-5, deviations


@pytest.mark.long
def test_second_derivatives_of_several_steps() -> None:
    """Of where a sphere comes to that slides and rolls, in a loop, whose body JAX linearizes on its own."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{SLIDING}</mujoco>")
    with jax.enable_x64(True):
        device = put_model(model)
        data = make_data(device)

        def place(pushed: Any) -> Any:
            start = data.replace(qvel=data.qvel.at[: len(pushed)].set(pushed))
            end = jax.lax.scan(lambda state, _: (step(device, state), None), start, None, length=5)[
                0
            ]
            return jnp.sum(jnp.sin(end.qvel)) + jnp.sum(end.qpos)

        deviations = errors(place, np.array([0.3, -0.2]), ("jacfwd(jacrev)",))
    assert max(deviations.values()) < 1e-6, deviations


@pytest.mark.release
@pytest.mark.parametrize("mode", WAYS)
@pytest.mark.parametrize("looped", [False, True])
def test_a_derivative_of_ones_own_holds_in_loops_and_batches(mode: str, looped: bool) -> None:
    """A square root that is known from elsewhere, against the square root."""
    root = own_derivative("root", lambda _, value, arguments, changes: changes[0] / (2.0 * value))

    def roots(numbers: Any, is_custom: bool) -> Any:
        def one(number: Any) -> Any:
            estimate = jnp.sqrt(number)
            return root(jax.lax.stop_gradient(estimate), number) if is_custom else estimate

        def after(state: Any, _: Any) -> Any:
            return 1.0 + jax.vmap(one)(state), None

        return jnp.sum(
            jnp.sin(
                jax.lax.scan(after, numbers, None, length=3)[0]
                if looped
                else after(numbers, None)[0]
            )
        )

    points = jnp.array([0.3, 2.0, 5.0])
    result, expected = (
        jax.jit(WAYS[mode](functools.partial(roots, is_custom=is_custom_root)))(points)
        for is_custom_root in (True, False)
    )
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.long
def test_the_second_derivative_of_a_walk() -> None:
    """Of its speed by an amplitude, forward over forward, against differences of the slope."""
    with jax.enable_x64(True):
        rollout = Rollout(Setup(spine="stride_extension"), Run(duration=0.02, warmup=0.0), "mjx")

        def slope(amplitude: Any) -> Any:
            return jax.jvp(
                lambda value: rollout({"spine.amplitude": value})["speed"], (amplitude,), (1.0,)
            )[1]

        # At its usual level XLA does not end within ten minutes.
        options = compiler_options(level=0)
        first = jax.jit(slope, compiler_options=options)
        second = jax.jit(
            lambda argument: jax.jvp(slope, (argument,), (1.0,))[1], compiler_options=options
        )
        result, expected = float(second(0.2)), float(first(0.2 + 1e-5) - first(0.2 - 1e-5)) / 2e-5
    assert abs(result - expected) < 1e-6 * abs(expected)
