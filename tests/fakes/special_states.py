"""Small models in special states: at rest, without controls, exactly at a limit, aligned, coincident, depth = width.

Norms, powers and quotients have no derivative there, and everybody's simulation begins there. `check` compares values
and
derivatives with those of MuJoCo C.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from nermo_mjx.dynamics.differentiable import step
from nermo_mjx.dynamics.integration import positions
from nermo_mjx.dynamics.mjx_copy import make_data, put_model
from nermo_mjx.runtime import compiler_options


class Case(NamedTuple):
    """A model and the state it starts from; what is None is the model's own.

    `body` is the inside of `<worldbody>` up to `</worldbody>`, and what follows it.
    """

    body: str
    option: str = ""
    qpos: Any = None
    qvel: Any = None
    act: Any = None
    ctrl: Any = None
    steps: int = 3


class Found(NamedTuple):
    """The comparison of one case.

    Attributes:
        value: largest difference of the end state from C's, over the larger of 1 and the state's size.
        slope: largest difference of an entry of the gradient from C's differences, over the larger of 1 and the
        largest of its case.
        kinks: entries for which C has no two-sided derivative, but a one-sided one, which the gradient equals or is
        between.
        jumps: entries for which C's differences converge on neither side.
        is_finite: whether value and gradient are.
    """

    value: float
    slope: float
    kinks: int
    jumps: int
    is_finite: bool


PLANE = '<geom type="plane" size="3 3 .1"/>'
FAST = 'integrator="implicitfast"'


def _free(geom: str, position: str = "0 0 .05", attributes: str = "") -> str:
    return f'<body pos="{position}" {attributes}><freejoint/><geom {geom} mass="1"/></body>'


def _hinge(joint: str = "", elements: str = "", mass: str = "1") -> str:
    return (
        f'<body name="b"><joint name="j" axis="0 1 0" {joint}/><geom size=".05" pos="0 0 -.3" mass="{mass}" '
        f'contype="0" conaffinity="0"/>{elements}</body></worldbody>'
    )


def _slide(joint: str = "", geom: str = 'size=".05"') -> str:
    return f'<body pos="0 0 .05"><joint name="j" type="slide" axis="0 0 1" {joint}/><geom {geom} mass="1"/></body>'


_BALL = '<body name="b"><joint name="j" type="ball" {}/><geom size=".05" pos="0 0 -.2" mass="1"/>{}</body></worldbody>'
_ARM = (
    '<site name="o" pos="{o}"/><body><joint name="j" axis="0 1 0"/><geom size=".02" pos=".2 0 0" mass="1" contype="0"/>'
    '<site name="s" pos=".1 0 0"/></body></worldbody>'
)
_SPATIAL = '<tendon><spatial name="t" {}><site site="o"/><site site="s"/></spatial></tendon>'
_TWO = (
    '<body><joint name="j" axis="0 1 0"/><geom size=".02" pos=".2 0 0" mass="1" contype="0"/></body>'
    '<body pos="0 1 0"><joint name="k" axis="0 1 0"/><geom size=".02" pos=".2 0 0" mass="2" '
    'contype="0"/></body></worldbody>'
)
_FIXED = '<tendon><fixed name="t" {}><joint joint="j" coef="1"/></fixed></tendon>'
_COUPLED = '<tendon><fixed name="t" {}><joint joint="j" coef="1"/><joint joint="k" coef="-.5"/></fixed></tendon>'
_LINKS = (
    '<body name="p"><joint name="j" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" mass=".2" '
    'contype="0"/><body name="q" pos=".2 0 0"><joint name="k" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 '
    '0 -.1" '
    'size=".01" mass=".2" contype="0"/></body></body><body name="r" pos=".4 0 0"><joint name="l" axis="0 1 0"/>'
    '<geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".2" contype="0"/></body></worldbody>'
)
_CONNECT = '<equality><connect body1="q" body2="r" anchor=".2 0 -.1"/></equality>'
_PAIR = (
    '<body name="a" pos="0 0 .5"><freejoint/><geom size=".05" pos=".1 0 0" mass="1" contype="0"/><site name="sa" '
    'pos="0 .1 0" '
    'euler="10 20 30"/></body><body name="c" pos=".3 0 .5"><joint name="w" type="ball"/><geom size=".05" pos="0 .1 0" '
    'mass=".5" contype="0"/><site name="sc" pos=".1 0 0"/></body></worldbody>'
)
_SPIN = [0.1, 0.2, 0.3, 1.0, 2.0, 0.5]

CASES: dict[str, Case] = {
    # Rotations at the identity.
    "ball spring": Case(_BALL.format('stiffness="5" damping=".1"', "")),
    "ball spring, polynomial": Case(_BALL.format('stiffness="5 3 2" damping=".1 .2 .1"', "")),
    "ball spring, half a turn": Case(
        _BALL.format('stiffness="5"', ""), qpos=[0.001, 1.0, 0.0, 0.0]
    ),
    "free joint with a spring": Case(
        '<body pos="0 0 1"><joint type="free" stiffness="5 1 2"/><geom type="box" size=".1 .05 .02" '
        'mass="1"/></body></worldbody>'
    ),
    "ball servo in the parent's frame": Case(
        _BALL.format("", "")
        + '<actuator><general joint="j" gear="1 0 0" gainprm="5" biastype="affine" biasprm="0 '
        '-5 -.1"/>'
        '<position jointinparent="j" gear="0 1 0" kp="5"/></actuator>'
    ),
    "ball at its limit": Case(
        _BALL.format('range="0 30"', ""),
        qpos=[np.cos(np.pi / 12), np.sin(np.pi / 12), 0, 0],
        qvel=[0.5, 0.1, 0.0],
    ),
    "site servo about another site": Case(
        '<site name="o"/><body><joint type="ball"/><geom size=".05" pos="0 0 -.2" mass="1"/><site '
        'name="s"/></body></worldbody>'
        '<actuator><position site="s" refsite="o" gear="0 0 0 1 0 0" kp="5"/><position site="s" refsite="o" '
        'gear="0 1 0 0 .5 0" kp="5" kv=".1"/></actuator>'
    ),
    # Limits.
    "hinge exactly at its limit": Case(_hinge('range="-30 0"'), qvel=[0.1]),
    "hinge at its limit, leaving": Case(_hinge('range="-30 0"'), qvel=[-0.1]),
    "limit, depth = width, power 1": Case(
        _hinge('range="-30 0" solimplimit=".5 .9 .01 .5 1"'), qpos=[0.01]
    ),
    "limit, deeper than width, power 1.5": Case(
        _hinge('range="-30 0" solimplimit=".5 .9 .01 .5 1.5"'), qpos=[0.02]
    ),
    "limit, at the midpoint, power 3": Case(
        _hinge('range="-30 0" solimplimit=".5 .9 .01 .5 3"'), qpos=[0.005]
    ),
    "limit, constant impedance without width": Case(
        _hinge('range="-30 0" solimplimit=".5 .9 0 .5 2"'), qpos=[0.02]
    ),
    "tendon exactly at its limit": Case(
        _ARM.format(o="0 0 .1") + _SPATIAL.format(f'range="0 {0.02**0.5}"'), qvel=[0.5]
    ),
    # Contacts.
    "sphere touches": Case(PLANE + _slide()),
    "contact, depth = width": Case(
        PLANE + _slide(geom='size=".05" solimp=".5 .9 .01 .5 2.5"'), qpos=[-0.01]
    ),
    "contact, deeper, power 1": Case(
        PLANE + _slide(geom='size=".05" solimp=".5 .9 .01 .2 1"'), qpos=[-0.02]
    ),
    "contact, at its margin": Case(
        PLANE + _slide(geom='size=".05" margin=".01" gap=".002"'), qpos=[0.01], qvel=[-0.1]
    ),
    "box at rest": Case(PLANE + _free('type="box" size=".05 .05 .05"', "0 0 .0499")),
    "box at rest, elliptic": Case(
        PLANE + _free('type="box" size=".05 .05 .05"', "0 0 .0499"), 'cone="elliptic"'
    ),
    "box at rest, six dimensions": Case(
        PLANE + _free('type="box" size=".05 .05 .05" condim="6"', "0 0 .0499"), 'cone="elliptic"'
    ),
    "sphere at rest, torsion": Case(
        PLANE + _free('size=".05" condim="4"', "0 0 .0499"), 'cone="elliptic"'
    ),
    "sphere without friction": Case(PLANE + _free('size=".05" condim="1"', "0 0 .0499")),
    "capsule lies": Case(PLANE + _free('type="capsule" size=".05 .1" euler="0 90 0"', "0 0 .0499")),
    "capsule stands": Case(PLANE + _free('type="capsule" size=".05 .1"', "0 0 .1499")),
    "cylinder stands": Case(PLANE + _free('type="cylinder" size=".05 .1"', "0 0 .0999")),
    "cylinder lies": Case(
        PLANE + _free('type="cylinder" size=".05 .1" euler="0 90 0"', "0 0 .0499")
    ),
    "ellipsoid": Case(PLANE + _free('type="ellipsoid" size=".05 .04 .03"', "0 0 .0299")),
    "spheres aligned": Case(_free('size=".05"', "0 0 0") + _free('size=".05"', "0 0 .0999")),
    "spheres coincide": Case(
        _free('size=".05"', "0 0 0") + _free('size=".05"', "0 0 0"), qvel=[0.1] * 12, steps=1
    ),
    "capsules parallel": Case(
        _free('type="capsule" size=".05 .1"', "0 0 0")
        + _free('type="capsule" size=".05 .1"', ".0999 0 0.03")
    ),
    "capsules cross": Case(
        _free('type="capsule" size=".05 .1"', "0 0 0")
        + _free('type="capsule" size=".05 .1" euler="90 0 0"', ".0999 0 0")
    ),
    "capsules parallel, of two lengths, head to tail": Case(
        _free('type="capsule" size=".05 .1"', "0 0 0")
        + _free('type="capsule" size=".03 .04" euler="180 0 0"', ".0799 0 .1")
    ),
    "sphere in a capsule": Case(
        _free('type="capsule" size=".05 .1"', "0 0 0")
        + _free('size=".05" euler="90 0 0"', "0 0 .03"),
        steps=1,
    ),
    "sphere on the end of a cylinder": Case(
        _free('type="cylinder" size=".05 .1"', "0 0 0") + _free('size=".05"', "0 0 .1499")
    ),
    "sphere beside a cylinder": Case(
        _free('type="cylinder" size=".05 .1"', "0 0 0") + _free('size=".05"', ".0999 0 0")
    ),
    "sphere on an ellipsoid": Case(
        _free('type="ellipsoid" size=".05 .04 .03"', "0 0 0") + _free('size=".05"', "0 0 .0799")
    ),
    "box on its edge": Case(
        PLANE + _free('type="box" size=".05 .05 .05" euler="45 0 0"', "0 0 .0706")
    ),
    "box on its edge, deep": Case(
        PLANE + _free('type="box" size=".05 .05 .05" euler="30 5 0"', "0 0 .05")
    ),
    "sphere on a box": Case(
        _free('type="box" size=".05 .05 .05"', "0 0 0") + _free('size=".05"', "0 0 .0999")
    ),
    "capsule on a box": Case(
        '<geom type="box" size=".2 .2 .05"/>'
        + _free('type="capsule" size=".05 .1" euler="0 90 0"', "0 0 .0999")
    ),
    "box on a box": Case(
        '<geom type="box" size=".2 .2 .05"/>' + _free('type="box" size=".05 .05 .05"', "0 0 .0999")
    ),
    # Tendons.
    "tendon of length zero": Case(
        _ARM.format(o=".1 0 0") + _SPATIAL.format('stiffness="10" damping=".1"')
    ),
    "tendon straight, at its slack length": Case(
        _ARM.format(o="-.1 0 0") + _SPATIAL.format('stiffness="10 5 3" springlength="0 .2"'),
        qpos=[0.3],
        qvel=[0.0],
    ),
    "tendon tangent to its cylinder": Case(
        '<geom name="g" type="cylinder" size=".05 .1" euler="90 0 0" contype="0" conaffinity="0"/><site name="o" '
        'pos="-.2 0 .05"/>'
        '<body pos="0 0 .05"><joint axis="0 1 0"/><geom size=".02" pos=".2 0 0" mass="1" contype="0"/><site name="s" '
        'pos=".2 0 0"/></body></worldbody><tendon><spatial stiffness="10"><site site="o"/><geom geom="g"/><site '
        'site="s"/>'
        "</spatial></tendon>",
        qvel=[0.1],
    ),
    "tendon with dry friction at rest": Case(_TWO + _COUPLED.format('frictionloss=".1"')),
    "tendon with polynomials, implicitfast": Case(
        _TWO + _COUPLED.format('stiffness="1 20 3" damping=".1 1 .5" springlength="0"'),
        FAST,
        qvel=[0.5, 1.0],
    ),
    "tendon's force at its range": Case(
        _TWO
        + _COUPLED.format('actuatorfrcrange="-1 1"')
        + '<actuator><motor tendon="t"/><motor tendon="t" gear="2"/></actuator>',
        ctrl=[0.7, 0.3],
    ),
    "tendon's force zero of two": Case(
        _TWO
        + _COUPLED.format('actuatorfrcrange="-1 1"')
        + '<actuator><motor tendon="t"/><motor tendon="t"/></actuator>',
        ctrl=[0.5, -0.5],
    ),
    "tendon at its spring's length": Case(
        _TWO + _COUPLED.format('stiffness="100" damping=".1" springlength="0"'), qvel=[0.0, 0.0]
    ),
    # Actuators.
    "motor without control": Case(
        _hinge() + '<actuator><motor joint="j" ctrlrange="0 1" ctrllimited="true"/></actuator>'
    ),
    "servo beyond its force, implicitfast": Case(
        _hinge('armature=".01"')
        + '<actuator><position joint="j" kp="100" kv="10" forcerange="-2 2"/></actuator>',
        FAST,
        qvel=[1.0],
        ctrl=[1.0],
    ),
    "damper that follows its control, implicitfast": Case(
        _hinge() + '<actuator><damper joint="j" kv="3" ctrlrange="0 1"/></actuator>',
        FAST,
        qvel=[1.0],
        ctrl=[0.5],
    ),
    "muscle at rest": Case(
        _hinge() + '<actuator><muscle joint="j" lengthrange="-1 1" force="10"/></actuator>'
    ),
    "muscle, activation = control, implicitfast": Case(
        _hinge()
        + '<actuator><muscle joint="j" lengthrange="-1 1" force="10" tausmooth=".2"/></actuator>',
        FAST,
        qvel=[0.0],
        act=[0.4],
        ctrl=[0.4],
    ),
    "muscle that lengthens, implicitfast": Case(
        _hinge() + '<actuator><muscle joint="j" lengthrange="-1 1" force="30"/></actuator>',
        FAST,
        qvel=[2.0],
        act=[0.7],
        ctrl=[0.9],
    ),
    "early filter, implicitfast": Case(
        _hinge()
        + '<actuator><general joint="j" dyntype="filterexact" dynprm=".05" gaintype="affine" gainprm="10 '
        '0 -3" '
        'biastype="affine" biasprm="0 -10 -1" actearly="true"/><intvelocity joint="j" kp="5" actrange="-.1 '
        '.1"/></actuator>',
        FAST,
        qvel=[0.5],
        act=[0.2, 0.1],
        ctrl=[1.0, 0.5],
    ),
    "actuators' inertia and damping": Case(
        _TWO
        + _COUPLED.format("")
        + '<actuator><motor joint="j" gear="3" armature=".01" damping=".1 .2 '
        '.1"/><motor joint="j" '
        'armature=".02"/><motor tendon="t" gear="2" armature=".03" damping=".05 '
        '.1"/></actuator>',
        qvel=[1.0, -1.0],
        ctrl=[1, 0, 1],
    ),
    "the same, implicitfast": Case(
        _TWO
        + _COUPLED.format("")
        + '<actuator><motor joint="j" gear="3" armature=".01" damping=".1 .2 '
        '.1"/><motor tendon="t" '
        'gear="2" armature=".03" damping=".05 .1"/></actuator>',
        FAST,
        qvel=[1.0, -1.0],
        ctrl=[1, 1],
    ),
    # Passive forces.
    "polynomial spring and damper at rest": Case(_hinge('stiffness="0 5 3" damping="0 1 2"')),
    "polynomial damper, RK4": Case(
        _hinge('stiffness="1 5 3" damping=".1 1 2"'), 'integrator="RK4"', qpos=[-0.5], qvel=[2.0]
    ),
    "no springs": Case(
        _hinge('stiffness="3" damping=".5 .1"'), '><flag spring="disable"/', qpos=[0.5], qvel=[2.0]
    ),
    "no dampers": Case(
        _hinge('stiffness="3" damping=".5 .1"'), '><flag damper="disable"/', qpos=[0.5], qvel=[2.0]
    ),
    "no dampers, implicitfast": Case(
        _hinge('stiffness="3" damping=".5"') + _FIXED.format('damping="1"'),
        f'{FAST}><flag damper="disable"/',
        qvel=[2.0],
    ),
    "gravity compensation of the actuators": Case(
        '<body gravcomp=".7"><joint name="j" axis="0 1 0" actuatorgravcomp="true" actuatorfrcrange="-1 1"/><geom '
        'size=".05" '
        'pos=".1 0 -.3" mass="1"/></body></worldbody><actuator><motor joint="j"/></actuator>'
    ),
    "drag at rest": Case(
        _free('type="box" size=".1 .05 .02"'), 'density="1000" viscosity=".1" wind="0 0 0"'
    ),
    "wind": Case(
        _free('type="box" size=".1 .05 .02"'), 'density="100" viscosity=".1" wind="1 0 0"'
    ),
    "dry friction at rest": Case(_hinge('frictionloss="5"'), qpos=[0.2]),
    "dry friction that slides": Case(_hinge('frictionloss=".1"'), qvel=[1.0]),
    # Free bodies and implicitfast.
    "box that spins, implicitfast": Case(
        _free('type="box" size=".1 .05 .02"'), FAST, qvel=_SPIN, steps=10
    ),
    "spinning, off its centre, implicitfast": Case(
        _free('type="box" size=".1 .05 .02" pos=".1 .05 0" euler="10 20 30"'),
        FAST,
        qvel=_SPIN,
        steps=10,
    ),
    "box at rest, implicitfast": Case(
        PLANE + _free('type="box" size=".05 .05 .05"', "0 0 .0499"), FAST
    ),
    "body with a child, implicitfast": Case(
        '<body><freejoint/><geom type="box" size=".1 .05 .02" mass="1"/><body pos=".1 0 0"><joint axis="0 1 0" '
        'damping=".1"/><geom '
        'size=".02" pos=".1 0 0" mass=".2"/></body></body>',
        FAST,
        qvel=[*_SPIN, 1.0],
    ),
    # Equalities.
    "connect at rest": Case(_LINKS + _CONNECT),
    "connect in motion": Case(_LINKS + _CONNECT, qpos=[0.05, -0.03, 0.02], qvel=[1.0, 0.5, -0.3]),
    "weld of a spinning body": Case(
        _PAIR + '<equality><weld body1="a" body2="c" torquescale=".7"/></equality>',
        qvel=[*_SPIN, 0.3, 0.2, 0.1],
    ),
    "weld of sites": Case(
        _PAIR + '<equality><weld site1="sa" site2="sc"/></equality>', qvel=[*_SPIN, 0.3, 0.2, 0.1]
    ),
    "connect of sites, and inactive": Case(
        _PAIR
        + '<equality><connect site1="sa" site2="sc"/><weld body1="a" active="false"/></equality>',
        qvel=[*_SPIN, 0.3, 0.2, 0.1],
    ),
    "connect, deeper than width, power 1.5": Case(
        _PAIR
        + '<equality><connect body1="a" body2="c" anchor=".1 0 0" solimp=".5 .9 .01 .5 1.5"/></equality>',
        qpos=[0.05, 0, 0.5, 1, 0, 0, 0, 1, 0, 0, 0],
    ),
    "joint and tendon equalities at zero": Case(
        _TWO
        + _COUPLED.format("")
        + '<equality><joint joint1="j" joint2="k" polycoef="0 1 .5 .2 .1"/><tendon '
        'tendon1="t" '
        'polycoef="0 .5 .2 0 0"/></equality>',
        qvel=[0.5, 0.2],
    ),
    "everything off": Case(_hinge('range="-30 0"'), '><flag constraint="disable"/', qpos=[0.1]),
}


def _xml(option: str, body: str = "") -> str:
    end, close = (
        "" if "</worldbody>" in body else "</worldbody>",
        "></option>" if ">" in option else "/>",
    )
    return f"<mujoco><option {option}{close}<worldbody>{body}{end}</mujoco>"


def compiled(cases: Sequence[Case]) -> mujoco.MjModel:
    """One model of all cases, which have the same options, with C's solver converged.

    Several cases are trees without contacts: contacts are off, so that no case touches another one.
    """
    if len(cases) == 1:
        model = mujoco.MjModel.from_xml_string(_xml(cases[0].option, cases[0].body))
    else:
        assert len({case.option for case in cases}) == 1
        combined_spec = mujoco.MjSpec.from_string(_xml(cases[0].option))
        for index, case in enumerate(cases):
            single_model = compiled([case])
            data = mujoco.MjData(single_model)
            mujoco.mj_forward(single_model, data)
            assert data.ncon == 0
            part = mujoco.MjSpec.from_string(_xml(case.option, case.body))
            combined_spec.attach(
                part, prefix=f"{index}_", frame=combined_spec.worldbody.add_frame()
            )
        model = combined_spec.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.iterations, model.opt.tolerance, model.opt.ls_tolerance = 200, 0, 1e-10
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-13, 1000
    return model


def check(*cases: Case, width: float = 1e-6) -> Found:
    """One case against C, or several in one model; see `Found`."""
    model, steps = compiled(cases), max(case.steps for case in cases)
    starts, owners, state_owners = [], [], []
    for index, case in enumerate(cases):
        single_model = compiled([case])
        data = mujoco.MjData(single_model)
        starts.append(
            [
                np.array(getattr(data, name) if arrays is None else arrays, float)
                for name, arrays in (
                    ("qpos", case.qpos),
                    ("qvel", case.qvel),
                    ("act", case.act),
                    ("ctrl", case.ctrl),
                )
            ]
        )
        owners.append(
            [
                np.full(n, index)
                for n in (single_model.nv, single_model.nv, single_model.na, single_model.nu)
            ]
        )
        state_owners.append(
            [np.full(n, index) for n in (single_model.nq, single_model.nv, single_model.na)]
        )
    start = [np.concatenate(parts) for parts in zip(*starts, strict=True)]
    owner, state_owner = (
        np.concatenate([np.concatenate(parts) for parts in zip(*parts, strict=True)])
        for parts in (owners, state_owners)
    )
    cuts = np.cumsum([model.nv, model.nv, model.na])
    size = cuts[-1] + model.nu
    weights = np.cos(1.0 + np.arange(model.nq + model.nv + model.na))

    def in_c(point: np.ndarray) -> np.ndarray:
        dq, dv, da, du = np.split(point, cuts)
        data = mujoco.MjData(model)
        data.qpos[:] = start[0]
        mujoco.mj_integratePos(model, data.qpos, dq, 1.0)
        data.qvel[:], data.act[:], data.ctrl[:] = start[1] + dv, start[2] + da, start[3] + du
        for _ in range(steps):
            mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel, data.act])

    with jax.enable_x64(True):
        device = put_model(model)
        blank = make_data(device)

        def ends(point: Any) -> Any:
            dq, dv, da, du = jnp.split(point, cuts)

            def advance(state: Any, _: None) -> Any:
                new_data = step(
                    device,
                    blank.replace(qpos=state[0], qvel=state[1], act=state[2], ctrl=start[3] + du),
                )
                return (new_data.qpos, new_data.qvel, new_data.act), None

            first = positions(device, jnp.asarray(start[0]), dq), start[1] + dv, start[2] + da
            return jnp.concatenate(jax.lax.scan(advance, first, None, length=steps)[0])

        values_and_slopes = jax.jit(
            jax.value_and_grad(lambda z: (lambda e: (weights @ e, e))(ends(z)), has_aux=True),
            compiler_options=compiler_options(),
        )
        (_, end), slopes = values_and_slopes(np.zeros(size))
    end, slopes, reference = np.asarray(end), np.asarray(slopes), in_c(np.zeros(size))
    value = max(
        np.abs(end - reference)[is_of_case].max() / max(1.0, np.abs(reference[is_of_case]).max())
        for is_of_case in (state_owner == index for index in range(len(cases)))
    )
    # Differences to both sides, at two widths.
    sides = np.array(
        [
            [
                [
                    weights @ (in_c(sign * h * direction) - reference) / (sign * h)
                    for direction in np.eye(size)
                ]
                for h in (width, width / 4)
            ]
            for sign in (1, -1)
        ]
    )
    middle = sides[:, 0].mean(axis=0)
    scale = np.array([max(1.0, np.abs(middle[owner == case_index]).max()) for case_index in owner])
    error = np.abs(slopes - middle) / scale
    converged = np.abs(sides[:, 0] - sides[:, 1]) < 1e-2 * np.maximum(1.0, np.abs(sides[:, 0]))
    jump = ~converged.any(axis=0)
    # At a kink: the derivative of one side, or between both.
    beyond = np.maximum(np.minimum(*sides[:, 0]) - slopes, slopes - np.maximum(*sides[:, 0]))
    difference = np.where(converged, np.abs(slopes - sides[:, 0]), np.inf).min(axis=0)
    settled = (
        np.minimum(difference, np.where(converged.all(axis=0), np.maximum(beyond, 0.0), np.inf))
        / scale
    )
    kink = ~jump & (error > 1e-4) & (settled < 1e-4)
    error = np.where(jump, 0.0, np.where(kink, settled, error))
    finite = bool(np.isfinite(end).all() and np.isfinite(slopes).all())
    return Found(
        float(value), float(error.max(initial=0.0)), int(kink.sum()), int(jump.sum()), finite
    )


if __name__ == "__main__":
    import sys

    words = sys.argv[1:] or [""]
    for name, case in CASES.items():
        if any(word in name for word in words):
            try:
                print(name, *(f"{number:.1e}" for number in check(case)), flush=True)
            except Exception as error:
                print(name, type(error).__name__, str(error)[:300], flush=True)
