# Tests of dynamics/differentiable.py, dynamics/forces.py, dynamics/integration.py, dynamics/constraint.py
"""The differentiable step on small models: values and derivatives against those of MuJoCo's C engine.

Central differences of plain MJX are noise: its line search compares costs, so that elliptic contacts are solved to 1e-8
and no better, and a difference over 1e-8 of a value is wrong by up to a half. MuJoCo C solves them to 1e-13.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics.differentiable import step
from nermo_mjx.dynamics.mjx_copy import make_data, put_model
from nermo_mjx.runtime import compiler_options

_OPTION = (
    '<option timestep="0.002" tolerance="1e-14" ls_tolerance="1e-6" cone="{cone}" impratio="3" '
    'integrator="{integrator}"/>'
)
#: Target of the small models' actuators.
CTRL = 0.12
_ROUND = 'friction=".6 .01 .001" solimp="0 .95 .001 .5 2" solref=".02 1"'


@dataclasses.dataclass(frozen=True)
class Small:
    """A model, its start, and the fields that are differentiated."""

    body: str
    fields: tuple[tuple[str, tuple[int, ...]], ...]
    qvel: tuple[float, ...]
    steps: int = 50
    cone: str = "pyramidal"
    integrator: str = "Euler"
    #: Velocities that are differentiated.
    speeds: tuple[int, ...] = (0,)

    @property
    def point(self) -> np.ndarray:
        """The numbers that are differentiated: the fields', and velocities."""
        model = self.compile()
        return np.array(
            [getattr(model, name)[index] for name, index in self.fields]
            + [self.qvel[i] for i in self.speeds]
        )

    def compile(self) -> mujoco.MjModel:
        option = _OPTION.format(cone=self.cone, integrator=self.integrator)
        return mujoco.MjModel.from_xml_string(f"<mujoco>{option}{self.body}</mujoco>")


_PENDULUM = Small(
    """<worldbody><body><joint name="j" axis="0 1 0" damping=".01" stiffness=".2" limited="true" range="-20 20"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2"/></body></worldbody>""",
    (
        ("jnt_stiffness", (0,)),
        ("dof_damping", (0,)),
        ("body_mass", (1,)),
        ("jnt_range", (0, 1)),
        ("jnt_solref", (0, 0)),
    ),
    qvel=(6.0,),
)
_TENDON = Small(
    """<worldbody><site name="a" pos="0 0 .1"/><geom name="drum" type="cylinder" size=".03 .05" pos=".02 0 .02"
    euler="90 0 0" contype="0" conaffinity="0"/>
    <body pos="0 0 0"><joint name="j" axis="0 1 0" damping=".002" stiffness=".05"/>
    <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" mass=".1" contype="0" conaffinity="0"/>
    <site name="b" pos=".12 0 .01"/></body></worldbody>
    <tendon><spatial name="t" limited="true" range="0 .151" stiffness="3" damping=".05">
    <site site="a"/><geom geom="drum"/><site site="b"/></spatial></tendon>
    <actuator><position tendon="t" kp="20" forcerange="-1 1"/></actuator>""",
    (
        ("jnt_stiffness", (0,)),
        ("tendon_stiffness", (0,)),
        ("tendon_range", (0, 1)),
        ("body_mass", (1,)),
        ("actuator_gainprm", (0, 0)),
    ),
    qvel=(-1.0,),
    integrator="implicitfast",
)
_FLOOR = Small(
    f"""<worldbody><geom type="plane" size="2 2 .1" friction=".6"/>
    <body pos="0 0 .0495"><freejoint/><geom type="sphere" size=".05" mass=".3" {_ROUND}/></body>
    <body pos="1 0 .0495"><freejoint/><geom type="box" size=".05 .04 .05" mass=".3" {_ROUND}/></body></worldbody>""",
    (
        ("geom_friction", (1, 0)),
        ("geom_friction", (2, 0)),
        ("body_mass", (1,)),
        ("body_mass", (2,)),
        ("geom_solimp", (1, 2)),
        ("geom_solimp", (2, 1)),
        ("geom_solref", (1, 0)),
    ),
    qvel=(0.4, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0, 0.0, 0.3),
)
#: What holds joints and bodies, at once: the limit of `_PENDULUM`, dry friction, and equalities.
_HELD = Small(
    """<default><geom contype="0" conaffinity="0"/></default>
    <worldbody><body><joint axis="0 1 0" damping=".01" stiffness=".2" limited="true" range="-20 20"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2"/></body>
    <body><joint name="p" axis="0 1 0" frictionloss=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".01" mass=".1"/>
    <body pos="0 0 -.2"><joint name="q" axis="0 1 0" frictionloss=".3"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".05"/></body></body>
    <body name="one"><joint name="j" axis="0 1 0" damping=".01"/>
    <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" mass=".1"/></body>
    <body name="two" pos=".2 0 -.2"><joint name="k" axis="0 1 0" stiffness=".3"/>
    <geom type="capsule" fromto="0 0 0 0 0 .2" size=".01" mass=".1"/></body>
    <body name="three" pos=".5 0 0"><joint name="l" axis="0 1 0" damping=".01"/>
    <geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".1"/></body>
    <body name="four" pos="1 0 .1"><freejoint/><geom type="box" size=".05 .03 .02" mass=".2"/></body></worldbody>
    <tendon><fixed name="t" frictionloss=".01"><joint joint="p" coef="1"/><joint joint="q" coef=".5"/></fixed></tendon>
    <equality><connect body1="one" body2="two" anchor=".2 0 0"/><joint joint1="k" joint2="l" polycoef="0 1.5 .3 0 0"/>
    <weld body1="four" solref=".05 .4"/></equality>""",
    (
        ("jnt_stiffness", (0,)),
        ("dof_damping", (0,)),
        ("body_mass", (1,)),
        ("jnt_range", (0, 1)),
        ("jnt_solref", (0, 0)),
        ("dof_frictionloss", (1,)),
        ("tendon_frictionloss", (0,)),
        ("body_mass", (2,)),
        ("dof_solref", (2, 0)),
        ("jnt_stiffness", (4,)),
        ("body_mass", (4,)),
        ("eq_data", (1, 1)),
        ("eq_solref", (0, 0)),
        ("dof_damping", (5,)),
        ("body_mass", (7,)),
        ("eq_solref", (2, 0)),
        ("eq_data", (2, 2)),
    ),
    qvel=(6.0, 2.0, 0.5, 1.0, 0.5, 0.2, 0.1, 0.0, 0.3, 0.2, 0.0, 0.0),
    speeds=(0, 1, 3),
)
MODELS = {
    "a pendulum at its limit, RK4": dataclasses.replace(_PENDULUM, integrator="RK4"),
    "a tendon that pulls a joint, implicitfast": _TENDON,
    "a sphere and a box on a plane, elliptic": dataclasses.replace(_FLOOR, cone="elliptic"),
    "a sphere and a box on a plane, pyramidal": _FLOOR,
    "a joint at its limit, dry friction, a linkage and a weld": _HELD,
}
#: Half-width of the central differences, as a share of a value; of a value of 0, of 0.01.
SHARE = 1e-6


def _in_c(case: Small, points: np.ndarray) -> np.ndarray:
    """Final states (n, nq + nv) of MuJoCo C."""
    ends = []
    for point in points:
        model = case.compile()
        # Constants that stand for the mass of a free body would hide that it has changed.
        model.body_simple[:], model.dof_simplenum[:] = 0, 0
        for (name, index), value in zip(case.fields, point, strict=False):
            getattr(model, name)[index] = value
        data = mujoco.MjData(model)
        data.qvel[:], data.ctrl[:] = case.qvel, CTRL
        data.qvel[list(case.speeds)] = point[len(case.fields) :]
        for _ in range(case.steps):
            mujoco.mj_step(model, data)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(ends)


def _in_mjx(case: Small):
    """point -> final state (nq + nv,), by the step."""
    model = case.compile()
    device = put_model(model)
    blank = make_data(device)

    def end(point):
        changed = device
        for (name, index), value in zip(case.fields, point, strict=False):
            changed = changed.tree_replace({name: getattr(changed, name).at[index].set(value)})
        qvel = jnp.asarray(case.qvel).at[jnp.array(case.speeds)].set(point[len(case.fields) :])
        data = blank.replace(
            qpos=jnp.asarray(model.qpos0), qvel=qvel, ctrl=jnp.full(model.nu, CTRL)
        )

        def advance(state, _):
            new_data = step(
                changed, data.replace(qpos=state[0], qvel=state[1], qacc_warmstart=state[2])
            )
            return (new_data.qpos, new_data.qvel, new_data.qacc_warmstart), None

        state = (data.qpos, data.qvel, data.qacc_warmstart)
        (qpos, qvel, _), _ = jax.lax.scan(advance, state, None, length=case.steps)
        return jnp.concatenate([qpos, qvel])

    return end


@dataclasses.dataclass(frozen=True)
class Measured:
    """Final state, and the slopes of one number made of it: in both modes, and by central differences."""

    state: np.ndarray
    ahead: np.ndarray
    reverse: np.ndarray
    expected_state: np.ndarray
    differences: np.ndarray


#: Cases that resemble another one: another integrator of the same joint, another cone of the same contacts.
LONG = ("a pendulum at its limit, RK4", "a sphere and a box on a plane, pyramidal")
#: With contacts, which is what a walk needs.
EVERY_TIME = "a sphere and a box on a plane, elliptic"


def marked(name: str) -> list[pytest.MarkDecorator]:
    return [pytest.mark.long if name in LONG else pytest.mark.release] if name != EVERY_TIME else []


@pytest.fixture(
    scope="module",
    params=[pytest.param(case, id=name, marks=marked(name)) for name, case in MODELS.items()],
)
def small(request):
    case: Small = request.param
    with jax.enable_x64(True):
        end = _in_mjx(case)
        first = case.point
        weights = np.cos(1.0 + np.arange(jax.eval_shape(end, first).shape[0]))

        def both(point):
            """State, slopes (n, nq + nv), and those of the weighted state: `jvp` and `grad` of one trace."""
            state, push = jax.linearize(end, point)
            return (
                state,
                jax.vmap(push)(jnp.eye(len(first))),
                *jax.linear_transpose(push, point)(jnp.asarray(weights)),
            )

        jit = functools.partial(jax.jit, compiler_options=compiler_options())
        state, slopes, reverse = map(np.asarray, jit(both)(first))
        widths = SHARE * np.maximum(np.abs(first), 0.01)
        points = np.concatenate([first[None], first + np.diag(widths), first - np.diag(widths)])
        ends = _in_c(case, points)
    high, low = np.split(ends[1:] @ weights, 2)
    return Measured(state, slopes @ weights, reverse, ends[0], (high - low) / (2 * widths))


@pytest.mark.long
@pytest.mark.release
def test_forward_and_reverse_mode_agree(small):
    """The rule is linear, and JAX transposes it: both modes give the same numbers."""
    np.testing.assert_allclose(small.reverse, small.ahead, rtol=1e-8, atol=1e-12)


@pytest.mark.release
def test_derivatives_are_those_of_the_simulation(small):
    """Central differences of another implementation, which knows nothing of the rule."""
    scale = np.abs(small.differences).max()
    np.testing.assert_allclose(small.ahead, small.differences, rtol=1e-4, atol=1e-8 * scale)


@pytest.mark.release
def test_no_derivative_vanishes(small):
    """Each number was chosen because it matters; a derivative of zero would be a path that is cut."""
    assert (np.abs(small.ahead) > 1e-9).all()


@pytest.mark.release
def test_values_are_those_of_the_other_engine(small):
    np.testing.assert_allclose(small.state, small.expected_state, rtol=1e-6, atol=1e-8)
