# Tests of dynamics/coverage.py, dynamics/preparing.py
"""What MJX leaves out of a model is brought back, refused in a sentence, or has no effect, and nothing is forgotten."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import fitted, forward, make_data, not_simulated, put_model, step
from nermo_mjx.dynamics.mjx_import import mjx

#: Fields of MuJoCo's model that MJX's lacks, or that no line of MJX reads, by what we do about them, or the reason why
#: they have no effect on `step`: patterns of whole names.
KNOWN = {
    "our code brings back": r"""actuator_(armature|damping|dampingpoly|actearly)
        |(jnt_stiffness|dof_damping|tendon_stiffness|tendon_damping)poly""",
    "a model with them is refused": r"""actuator_(delay|plugin|ctrlnum|outnum|group)|flg_surfacevel
        |geom_(adhesion|fluid|plugin|surfacevel)|(jnt|tendon)_springyield|pair_adhesion
        |sensor_(delay|interval|plugin)|body_plugin|opt\.(noslip_iterations|disableactuator)""",
    "sizes and addresses of what is refused or counted elsewhere": r"n[A-Za-z0-9_]+|\w+_\w*adr|\w+_\w*num|paths",
    "matrices' sparsity, which MJX has in its own form": r"[BDM]_\w+|map\w+|ten_J_\w+|flex\w+_J_\w+|efm[0C]\w*",
    "derived by C, and by MJX or not needed": r"""body_(simple|sameframe|treeid|contype|conaffinity
        |margin|jntnum)|dof_(M0|simplenum|treeid|length)|geom_(aabb|sameframe)|site_sameframe|pair_signature
        |tree_\w+|tendon_tree\w+
        |tendon_type|stat|jnt_actuatorid|tendon_actuatorid|flg_adhesion|eq_active0|actuator_length0
        |mesh_\w+|bvh_\w+|oct_\w+""",
    "of history and plugins, which are refused": r"(actuator|sensor)_history|plugin\w*|actuator_ctrlspec",
    "MJX refuses flexes": r"flex\w+",
    "MJX refuses slider-cranks": "actuator_cranklength",
    "pictures": r"(cam|light|mat|tex|skin)_\w+|vis|geom_castshadow|(site|tendon)_(matid|rgba|width)|site_dataid",
    "users' own, keyframes and groups": r"\w+_user|key_\w+|numeric_size|text_\w+|tuple_\w+|(jnt|site|tendon)_group",
    "noise is the user's to add": "sensor_noise",
    "a contact within the gap has no force, in MJX as in C": r"(geom|pair)_gap",
    "C's collision detection, not MJX's": r"opt\.(ccd_iterations|ccd_tolerance|sdf_iterations)",
    "without the flag sleep, which is refused, or noslip": r"opt\.(sleep_tolerance|noslip_tolerance)",
}


def unread() -> set[str]:
    """Fields of `MjModel` and `MjOption` that `mjx.Model` lacks, or that no line of MJX's step reads."""
    home = Path(mjx.__file__).parent / "_src"
    others = ("types", "render", "render_util", "bvh", "test_util", "io", "inverse")
    text = "".join(
        path.read_text()
        for path in home.glob("*.py")
        if not path.stem.endswith("_test") and path.stem not in others
    )

    def fields(kind: type) -> set[str]:
        return {
            name
            for name in vars(kind)
            if not name.startswith("_") and not callable(getattr(kind, name))
        }

    has = {field.name for field in mjx.Model.fields()}
    named_fields = {name for name in has if re.search(rf"\b{name}\b", text)}
    options = {field.name for field in mjx.Option.fields()}
    named_fields |= {f"opt.{name}" for name in options} | {
        "opt.o_margin",
        "opt.o_solref",
        "opt.o_solimp",
        "opt.o_friction",
    }
    every = fields(mujoco.MjModel) | {f"opt.{name}" for name in fields(mujoco.MjOption)}
    return every - named_fields - {"opt.sdf_initpoints"}


def test_no_field_of_mujoco_is_forgotten() -> None:
    """A new MuJoCo with a new field fails here: implement it, refuse it, or say why it has no effect."""
    known_patterns = re.compile("|".join(re.sub(r"\s+", "", pattern) for pattern in KNOWN.values()))
    assert sorted(name for name in unread() if not known_patterns.fullmatch(name)) == []


def test_every_flag_of_mujoco_is_known() -> None:
    """Flags that MJX neither refuses nor reads: with one of them off or on, C moves no model otherwise, or we refuse
    it."""
    kinds = (mujoco.mjtDisableBit, mjx.DisableBit), (mujoco.mjtEnableBit, mjx.EnableBit)
    disable, enable = (
        {
            name
            for name, flag in theirs.__members__.items()
            if name[:3] != "mjN" and int(flag) not in set(ours)
        }
        for theirs, ours in kinds
    )
    assert disable <= {
        f"mjDSBL_{name}" for name in ("MIDPHASE", "AUTORESET", "NATIVECCD", "ISLAND", "MULTICCD")
    }
    assert all(
        f"mjENBL_{flag.name}" in enable | {"mjENBL_INVDISCRETE", "mjENBL_SLEEP", "mjENBL_IPC"}
        for flag in mjx.EnableBit
    )


HINGE = '<body name="b"><joint name="j" axis="0 1 0"/><geom name="g" size=".05" pos="0 0 -.3"/><site name="s"/></body>'
BALL = '<geom name="f" type="plane" size="1 1 .1"/><body pos="0 0 .1"><freejoint/><geom name="g" size=".1" {}/></body>'


def model_of(inside: str, elements: str = "", option: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{inside}</worldbody>{elements}</mujoco>"
    )


PID = """<extension><plugin plugin="mujoco.pid"><instance name="p"><config key="kp" value="10"/></instance></plugin>
</extension>"""
CABLE = '<extension><plugin plugin="mujoco.elasticity.cable"/></extension>'
ROPE = """<body name="cB_first"><freejoint/><plugin plugin="mujoco.elasticity.cable"><config key="twist" value="1e7"/>
<config key="bend" value="4e6"/></plugin><geom type="capsule" size=".02" fromto="0 0 0 .1 0 0"/></body>"""
REFUSALS: dict[str, tuple[Any, str]] = {
    "delayed actuator": (
        (HINGE, '<actuator><motor name="a" joint="j" delay=".01" nsample="4"/></actuator>'),
        "actuator 'a' has a delay",
    ),
    "delayed sensor": (
        (HINGE, '<sensor><jointpos name="p" joint="j" delay=".01" nsample="4"/></sensor>'),
        "sensor 'p' has a delay",
    ),
    "sensor at an interval": (
        (HINGE, '<sensor><jointpos joint="j" interval=".01" nsample="2"/></sensor>'),
        "sensor 0 is read at an interval",
    ),
    "conveyor": ((BALL.format('surfacevel="1 0 0"'),), "geom 'g' has a surface velocity"),
    "magnet": ((BALL.format('adhesion="1"'),), "geom 'g' is adhesive"),
    "magnetic pair": (
        (BALL.format(""), '<contact><pair geom1="f" geom2="g" adhesion="2"/></contact>'),
        "pair 0 is adhesive",
    ),
    "swimmer": (
        (BALL.format('fluidshape="ellipsoid"'), "", '<option viscosity=".1"/>'),
        "geom 'g' has fluidshape='ellipsoid'",
    ),
    "PID": (
        (
            HINGE,
            '<actuator><plugin name="a" joint="j" plugin="mujoco.pid" instance="p"/></actuator>',
            PID,
        ),
        "actuator 'a' is run by",
    ),
    "cable": ((ROPE, "", CABLE), "body 'cB_first' is run by a plugin"),
    "disabled group": (
        (
            HINGE,
            '<actuator><motor name="a" joint="j" group="2"/></actuator>',
            '<option actuatorgroupdisable="2"/>',
        ),
        "actuator 'a' is in a disabled group",
    ),
    "noslip": ((HINGE, "", '<option noslip_iterations="3"/>'), "noslip_iterations is 3"),
    "sleep": ((HINGE, "", '<option><flag sleep="enable"/></option>'), "flag sleep is enabled"),
    "side site": (
        (
            '<geom name="w" type="cylinder" size=".25 .1" contype="0" conaffinity="0"/><site name="o" pos="-.3 0 0"/>'
            + HINGE.replace('"s"', '"s" pos=".1 0 0" ').replace("axis", 'pos=".2 0 0" axis'),
            '<tendon><spatial name="t"><site site="o"/><geom geom="w" sidesite="s"/>'
            '<site site="s"/></spatial></tendon>',
        ),
        "tendon 't' has the side site 's', now inside geom 'w', now outside, as joints turn: put it on the same body",
    ),
    "range of a cylinder": (
        (
            HINGE + '<geom name="c" type="cylinder" size=".1 .1" contype="0" conaffinity="0"/>',
            '<sensor><rangefinder site="s"/></sensor>',
        ),
        "geom 'c' is not seen by rangefinders: allowed are shapes other than cylinder, hfield, sdf.",
    ),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_not_simulated_is_said_of_the_element(name: str) -> None:
    """By the function for a model of MuJoCo's, and by the step and the forward dynamics of MJX's."""
    if name == "cable" and mujoco.__version__ >= "4":
        pytest.skip("MuJoCo 4 has no such plugin")
    elements, message = REFUSALS[name]
    model = model_of(*elements)
    assert not_simulated(model)[0].startswith(message)
    device = put_model(model)
    for function in (step, forward):
        with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
            function(device, make_data(device))


MESH = '<asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>'
#: What MJX itself refuses to put, or to make data of, and the sentence.
PUT: dict[str, tuple[tuple[str, ...], str]] = {
    "integrator": (
        (HINGE, "", '<option integrator="implicit"/>'),
        "integrator is implicit, which MJX lacks: allowed are e",
    ),
    "solver": (
        (HINGE, "", '<option solver="PGS"/>'),
        "solver is pgs, which MJX lacks: allowed are cg, newton.",
    ),
    "flag": (
        (HINGE, "", '<option><flag energy="enable"/></option>'),
        "flag energy is enabled, which MJX lacks: disable",
    ),
    "fluid": (
        (HINGE, "", '<option integrator="implicitfast" wind="1 0 0"/>'),
        "integrator is implicitfast, in a fluid",
    ),
    "slider-crank": (
        (
            HINGE,
            '<actuator><general name="a" cranksite="s" slidersite="s" cranklength=".1"/></actuator>',
        ),
        "trntype of actuator 'a' is slidercrank, which MJX lacks: allowed are joint,",
    ),
    "sensor of energy": (
        (HINGE, '<sensor><e_kinetic name="p"/></sensor>'),
        "type of sensor 'p' is e_kinetic, which MJX",
    ),
    "flex": (
        (
            HINGE
            + '<flexcomp name="x" type="grid" count="2 2 1" spacing=".1 .1 .1" dim="2" radius=".01"/>',
        ),
        "flex 'x' is soft",
    ),
    "bodies' contacts": (
        (HINGE, '<sensor><contact name="p" body1="b"/></sensor>'),
        "sensor 'p' matches contacts by body, which MJX cannot: allowed are geoms.",
    ),
    "net force": (
        (BALL.format(""), '<sensor><contact name="p" geom1="g" reduce="netforce"/></sensor>'),
        "sensor 'p' has the reduction netforce: allowed are none, mindist, maxforce.",
    ),
    "box and cylinder": (
        (
            BALL.format('type="cylinder"')
            .replace('type="plane"', 'type="box"')
            .replace('".1"', '".1 .1"'),
        ),
        "geom 'g' and geom 'f' are cylinder and box, which MJX cannot collide: exclude them, or see fitted.",
    ),
    "margin of a mesh": (
        (BALL.format('type="mesh" mesh="m" margin=".1"'), "", MESH),
        "geom 'f' and geom 'g' have a margin, which MJX lacks for meshes and height fields: set it to 0, or",
    ),
    "condim 1": (
        (
            BALL.format('condim="1"').replace("/>", ' condim="1"/>', 1),
            "",
            '<option cone="elliptic"/>',
        ),
        "geom 'f' has condim 1 with elliptic cones, which MJX lacks: take condim 3, or see fitted.",
    ),
    "condim 1 of a priority": (
        (BALL.format('condim="1" priority="1"'), "", '<option cone="elliptic"/>'),
        "geom 'g' has condim 1 with elliptic cones",
    ),
    "condim 1 of a pair": (
        (
            BALL.format(""),
            '<contact><pair name="p" geom1="f" geom2="g" condim="1"/></contact>',
            '<option cone="elliptic"/>',
        ),
        "pair 'p' has condim 1 with elliptic cones",
    ),
}


@pytest.mark.parametrize("name", PUT)
def test_what_mjx_refuses_is_said_of_the_element(name: str) -> None:
    """With the remedy; and MJX does refuse it."""
    elements, message = PUT[name]
    model = model_of(*elements)
    with pytest.raises(NotImplementedError, match=f"^{re.escape(message)}"):
        put_model(model)
    assert not_simulated(model)[0].startswith(message)
    with pytest.raises(NotImplementedError):
        mjx.make_data(mjx.put_model(model))


@pytest.mark.release
@pytest.mark.parametrize("name", ["condim 1", "condim 1 of a priority", "condim 1 of a pair"])
def test_contacts_without_friction_are_made_fit(name: str) -> None:
    """They get so little friction that they move as in C, which has none."""
    model = model_of(*PUT[name][0])
    ours, changes = fitted(model)
    assert changes
    assert all("has condim 3 and next to no friction, no condim 1." in change for change in changes)
    data = mujoco.MjData(model)
    data.qpos[2] -= 0.001
    data.qvel[:3] = 0.3, 0.1, -0.1
    with jax.enable_x64(True):
        device = put_model(ours)
        start = make_data(device).replace(qpos=jnp.asarray(data.qpos), qvel=jnp.asarray(data.qvel))
        velocity = jax.jit(step)(device, start).qvel
    mujoco.mj_step(model, data)
    assert data.ncon == 1
    np.testing.assert_allclose(velocity, data.qvel, atol=1e-4)


def test_what_is_simulated_is_not_refused() -> None:
    """The same words without an effect: ellipsoids without a fluid, a group that is not disabled."""
    still = model_of(BALL.format('fluidshape="ellipsoid"'))
    articulated = model_of(
        HINGE,
        '<actuator><motor joint="j" group="3"/></actuator>',
        '<option actuatorgroupdisable="2"/>',
    )
    assert not_simulated(still) == not_simulated(articulated) == []


def test_a_fluid_that_comes_later_is_refused_as_well() -> None:
    device = put_model(model_of(BALL.format('fluidshape="ellipsoid"')))
    thick = device.tree_replace({"opt.density": jnp.asarray(1000.0)})
    with pytest.raises(ValueError, match=r"^density or viscosity is not known to be 0, and a geom"):
        step(thick, make_data(device))


def test_a_model_of_mjx_is_refused_with_the_function_that_puts_it() -> None:
    """MJX does not report what it has omitted."""
    plain = mjx.put_model(model_of(HINGE))
    for function in (step, forward):
        with pytest.raises(
            ValueError, match=r"^model is of mujoco\.Model: .*nermo_mjx\.dynamics\.put_model; mjx\."
        ):
            function(plain, mjx.make_data(plain))


SMALL = """<mujoco><option solver="PGS" noslip_iterations="2"><flag energy="enable"/></option><asset>
<mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody><geom name="f" type="box" size="1 1 .1"/>
<body pos="0 0 .3"><freejoint/><geom name="can" type="cylinder" size=".1 .2"/></body>
<body pos="1 0 .3"><freejoint/><geom name="egg" type="ellipsoid" size=".1 .3 .05"/></body>
<body pos="2 0 .3"><freejoint/><geom name="rock" type="mesh" mesh="m" margin=".01"/></body></worldbody></mujoco>"""


def test_a_model_is_made_fit_for_mjx() -> None:
    """Each change is named, the model that was given stays as it is, and so do masses and what nobody collides with."""
    model = mujoco.MjModel.from_xml_string(SMALL)
    ours, changes = fitted(model)
    text = "\n".join(changes)
    for part in (
        "solver is Newton, no PGS",
        "flag energy is disabled",
        "noslip_iterations is 0, no 2",
        "geom 'can' is a capsule, no cylinder: MJX cannot collide it with geom 'f'",
        "geom 'egg' is a capsule, no ellipsoid",
        "margin of geom 'rock' is 0, no 0.01",
    ):
        assert part in text
    assert len(changes) == 6
    assert model.geom("can").type == mujoco.mjtGeom.mjGEOM_CYLINDER
    np.testing.assert_array_equal(ours.body_inertia, model.body_inertia)
    np.testing.assert_allclose(ours.geom("can").size[:2], [0.1, 0.1])
    # The longest axis of the ellipsoid is its y.
    axis = np.zeros(9)
    mujoco.mju_quat2Mat(axis, ours.geom("egg").quat)
    assert abs(axis.reshape(3, 3)[1, 2]) == pytest.approx(1.0)
    assert ours.geom("egg").size[:2].sum() == pytest.approx(0.3)
    assert fitted(ours)[1] == []


def test_what_cannot_be_made_fit_is_said() -> None:
    model = model_of(HINGE, '<actuator><adhesion body="b" ctrlrange="0 1" gain="1"/></actuator>')
    with pytest.raises(
        ValueError,
        match=r"^MJX refuses the model also after 0 changes: trntype of actuator 0 is body, ",
    ):
        fitted(model)


#: Models that MJX refuses as they are; they come with `pip install dm_control`.
WALKERS = "locomotion/walkers/assets"
ANIMALS = (f"{WALKERS}/rodent.xml", f"{WALKERS}/dog_v2/dog.xml", "suite/dog.xml", "suite/fish.xml")


@pytest.mark.long
def test_animals_are_made_fit_for_mjx() -> None:
    """They are put, and the fish, which touches nothing, moves as in C."""
    home = Path(
        pytest.importorskip(
            "dm_control", reason="needs the models of dm_control: pip install dm_control"
        ).__file__
    ).parent
    for path in ANIMALS:
        model = mujoco.MjModel.from_xml_path(str(home / path))
        with pytest.raises(NotImplementedError):
            put_model(model)
        ours, changes = fitted(model)
        assert changes
        assert not_simulated(ours) == []
    data = mujoco.MjData(ours)
    device = put_model(ours)
    result = jax.jit(step)(device, make_data(device).replace(ctrl=jnp.full(ours.nu, 0.3)))
    data.ctrl[:] = 0.3
    mujoco.mj_step(ours, data)
    np.testing.assert_allclose(result.qvel, data.qvel, atol=1e-5)
