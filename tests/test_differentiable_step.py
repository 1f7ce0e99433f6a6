"""The differentiable step on small models: derivatives against central differences of MJX, values against MJX and C."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.physics.differentiable import step
from nermo_mjx.physics.mjx_import import mjx

pytestmark = pytest.mark.slow

_OPTION = (
    '<option timestep="0.002" tolerance="1e-14" ls_tolerance="1e-6" cone="{cone}" impratio="3" '
    'integrator="{integrator}"/>'
)
#: Target of the small models' actuators.
CTRL = 0.12
_ROUND = 'friction=".6 .01 .001" solimp="0 .95 .001 .5 2" solref=".02 1"'


@dataclasses.dataclass(frozen=True)
class Small:
    """A model, its start, and the numbers that are differentiated: (field, index) of the model, with a step."""

    body: str
    fields: tuple[tuple[str, tuple[int, ...]], ...]
    qvel: tuple[float, ...]
    steps: int = 50
    cone: str = "pyramidal"
    integrator: str = "Euler"

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
    (("jnt_stiffness", (0,)), ("tendon_stiffness", (0,)), ("tendon_range", (0, 1)), ("body_mass", (1,)),
     ("actuator_gainprm", (0, 0))),
    qvel=(-1.0,), integrator="implicitfast",
)  # fmt: skip
_FLOOR = Small(
    f"""<worldbody><geom type="plane" size="2 2 .1" friction=".6"/>
    <body pos="0 0 .0495"><freejoint/><geom type="sphere" size=".05" mass=".3" {_ROUND}/></body>
    <body pos="1 0 .0495"><freejoint/><geom type="box" size=".05 .04 .05" mass=".3" {_ROUND}/></body></worldbody>""",
    (("geom_friction", (1, 0)), ("geom_friction", (2, 0)), ("body_mass", (1,)), ("body_mass", (2,)),
     ("geom_solimp", (1, 2)), ("geom_solimp", (2, 1)), ("geom_solref", (1, 0))),
    qvel=(0.4, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0, 0.0, 0.3),
)  # fmt: skip
_SPHERE = Small(
    f"""<worldbody><geom type="plane" size="2 2 .1" friction=".6"/>
    <body pos="0 0 .0495"><freejoint/><geom type="sphere" size=".05" mass=".3" {_ROUND}/></body></worldbody>""",
    (("geom_friction", (1, 0)), ("body_mass", (1,)), ("geom_solimp", (1, 2)), ("geom_solref", (1, 0))),
    qvel=(0.4, 0.1, 0.0, 0.0, 0.0, 0.0), cone="elliptic",
)  # fmt: skip
_DRY = Small(
    """<worldbody><body><joint name="j" axis="0 1 0" frictionloss=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".01" mass=".1" contype="0" conaffinity="0"/>
    <body pos="0 0 -.2"><joint name="k" axis="0 1 0" frictionloss=".3"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".05" contype="0" conaffinity="0"/></body></body>
    </worldbody><tendon><fixed name="t" frictionloss=".01"><joint joint="j" coef="1"/><joint joint="k" coef=".5"/>
    </fixed></tendon>""",
    (("dof_frictionloss", (0,)), ("tendon_frictionloss", (0,)), ("body_mass", (1,)),
     ("dof_solref", (1, 0))),
    qvel=(2.0, 0.5),
)  # fmt: skip
MODELS = {
    "a pendulum at its limit": _PENDULUM,
    "a pendulum at its limit, RK4": dataclasses.replace(_PENDULUM, integrator="RK4"),
    "a tendon that pulls a joint, implicitfast": _TENDON,
    "a sphere on a plane, elliptic": _SPHERE,
    "a sphere and a box on a plane, pyramidal": _FLOOR,
    "joints and a tendon with dry friction": _DRY,
}


@pytest.fixture(scope="module", params=MODELS.values(), ids=MODELS.keys())
def small(request):
    """A number that depends on the final state: its derivatives in both modes, and its central differences."""
    case: Small = request.param
    with jax.enable_x64(True):
        model = case.compile()
        device = mjx.put_model(model)
        blank = mjx.make_data(device)
        first = np.array([getattr(model, name)[index] for name, index in case.fields] + [case.qvel[0]])
        weights = jnp.cos(1.0 + jnp.arange(model.nq + model.nv))

        def objective(point):
            changed = device
            for (name, index), value in zip(case.fields, point, strict=False):
                changed = changed.tree_replace({name: getattr(changed, name).at[index].set(value)})
            qvel = jnp.asarray(case.qvel).at[0].set(point[-1])
            data = blank.replace(qpos=jnp.asarray(model.qpos0), qvel=qvel, ctrl=jnp.full(model.nu, CTRL))

            def advance(state, _):
                after = step(changed, data.replace(qpos=state[0], qvel=state[1], qacc_warmstart=state[2]))
                return (after.qpos, after.qvel, after.qacc_warmstart), None

            state = (data.qpos, data.qvel, data.qacc_warmstart)
            (qpos, qvel, _), _ = jax.lax.scan(advance, state, None, length=case.steps)
            end = jnp.concatenate([qpos, qvel])
            return end @ weights, end

        def ahead(point):
            value, slope, end = jax.vmap(lambda way: jax.jvp(objective, (point,), (way,), has_aux=True))(
                np.eye(len(first))
            )
            return value[0], slope, end[0]

        widths = 1e-6 * np.abs(first)
        points = np.concatenate([first[None], first + np.diag(widths), first - np.diag(widths)])
        values, slopes, ends = map(np.asarray, jax.jit(jax.vmap(ahead))(points))
        high, low = np.split(values[1:], 2)
        reverse = np.asarray(jax.jit(jax.grad(lambda point: objective(point)[0]))(first))
    return case, model, ends[0], slopes[0], reverse, (high - low) / (2 * widths)


def test_forward_and_reverse_mode_agree(small):
    """The rule is linear, and JAX transposes it: both modes give the same numbers."""
    _, _, _, ahead, reverse, _ = small
    np.testing.assert_allclose(reverse, ahead, rtol=1e-8, atol=1e-12)


def test_derivatives_are_those_of_the_simulation(small):
    """Central differences of the simulation itself, which know nothing of the rule."""
    _, _, _, ahead, _, differences = small
    np.testing.assert_allclose(ahead, differences, rtol=1e-4, atol=1e-7 * np.abs(differences).max())


def test_no_derivative_vanishes(small):
    """Each number was chosen because it matters; a derivative of zero would be a path that is cut."""
    _, _, _, ahead, _, _ = small
    assert (np.abs(ahead) > 1e-9).all()


def test_values_are_those_of_mujoco(small):
    """The state after all steps is what MuJoCo's C engine gives for the model as it stands."""
    case, model, state, *_ = small
    data = mujoco.MjData(model)
    data.qvel[:] = case.qvel
    data.ctrl[:] = CTRL
    for _ in range(case.steps):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(state, np.concatenate([data.qpos, data.qvel]), rtol=1e-6, atol=1e-8)
