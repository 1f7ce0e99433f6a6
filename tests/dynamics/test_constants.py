# Tests of dynamics/constants.py
"""The constants that MuJoCo derives from masses and positions, on every model at hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import MassConstants, PlaceConstants
from nermo_mjx.robot import load_robot

GEOM = '<geom size=".1" pos="{} 0 0" mass="{}"/>'
HINGES = (
    f'<worldbody><body name="one"><joint name="a" axis="0 1 0"/>{GEOM.format(0.2, 2)}<body pos=".3 0 0">'
    f'<joint name="c" axis="0 1 .2"/>{GEOM.format(0.1, 1)}</body></body>'
    f'<body pos="1 0 0"><joint name="b" axis="0 1 0" armature=".01"/>{GEOM.format(0.3, 1)}</body></worldbody>'
)
TENDON = (
    '<tendon><fixed name="t" armature="{}"><joint joint="a" coef="1"/>'
    '<joint joint="{}" coef="1.5"/></fixed></tendon>'
)
#: What these constants were wrong for, and its relatives.
OWN = {
    "a ball with two slides": '<worldbody><body pos="0 0 .05"><joint type="slide" axis="1 0 0"/>'
    '<joint type="slide" axis="0 0 1"/><geom size=".05" mass=".1"/></body></worldbody>',
    "one slide": '<worldbody><body><joint type="slide" axis="1 0 0"/><geom size=".05" mass="2"/></body></worldbody>',
    "three slides with armature": '<worldbody><body><joint type="slide" axis="1 0 0" armature=".3"/>'
    '<joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/><geom size=".05" mass="2"/></body>'
    "</worldbody>",
    "a slide that carries a hinge": '<worldbody><body><joint type="slide" axis="0 0 1"/><geom size=".05" mass="2"/>'
    f'<body><joint axis="0 1 0"/>{GEOM.format(0.2, 1)}</body></body></worldbody>',
    "an oblique slide": '<worldbody><body euler="10 20 30"><joint type="slide" axis="1 1 0"/>'
    '<geom type="box" size=".1 .05 .02" mass="2"/></body></worldbody>',
    "motors with armature": HINGES
    + '<actuator><motor joint="a" gear="5" armature=".02"/><motor joint="a" gear="2" armature=".01"/>'
    '<motor jointinparent="b" gear="3" armature=".03"/></actuator>',
    "a motor of a tendon with armature": HINGES
    + TENDON.format("0", "c")
    + '<actuator><motor tendon="t" gear="3" armature=".04"/></actuator>',
    "a tendon with armature across branches": HINGES + TENDON.format(".5", "b"),
    "a ball joint's motor with armature": f'<worldbody><body><joint name="a" type="ball"/>{GEOM.format(0.2, 2)}</body>'
    '</worldbody><actuator><motor joint="a" gear="1 2 3 0 0 0" armature=".02"/></actuator>',
}


#: Models whose inertia has no inverse: several joints move a body alike.
SINGULAR = ("general_dyntype.xml",)


def _files() -> list[Path]:
    """Models of MuJoCo's, MJX's and Gymnasium's packages; of the files of n humanoids, one."""
    gymnasium = pytest.importorskip("gymnasium")
    homes = [Path(mujoco.__file__).parent, Path(gymnasium.__file__).parent / "envs"]
    return sorted(
        file
        for home in homes
        for file in home.rglob("*.xml")
        if "humanoids" not in file.name or "03" in file.name
    )


def _models() -> dict[str, Callable[[], mujoco.MjModel]]:
    custom = {name: f"<mujoco>{xml}</mujoco>" for name, xml in OWN.items()}
    makers: dict[str, Callable[[], mujoco.MjModel]] = {
        name: lambda xml=xml: mujoco.MjModel.from_xml_string(xml) for name, xml in custom.items()
    }
    makers["this robot"] = lambda: load_robot().model
    return makers | {
        str(file): lambda file=file: mujoco.MjModel.from_xml_path(str(file)) for file in _files()
    }


def _wrong(fields: dict[str, Any], model: mujoco.MjModel) -> list[str]:
    """The constants that are not the model's own fields."""
    return [
        f"{name} {np.asarray(values).ravel()[:6]}, not {getattr(model, name).ravel()[:6]}"
        for name, values in fields.items()
        if getattr(model, name).size
        and not np.abs(np.asarray(values) - getattr(model, name)).max()
        <= 1e-8 * np.abs(getattr(model, name)).max()
    ]


@pytest.mark.long
@pytest.mark.release
def test_constants_of_every_model_at_hand_are_mujocos() -> None:
    """With the masses they were compiled with, the models' own fields; with others, those of `mj_setConst`."""
    wrong, tried = [], 0
    for name, make in _models().items():
        try:
            model = make()
        except ValueError:  # files that MuJoCo 4 no longer loads
            continue
        if not model.nv or Path(name).name in SINGULAR:
            continue
        constants = MassConstants(model)
        scaled = model.__copy__()
        scale = np.random.default_rng(tried).uniform(0.3, 3.0, model.nbody)
        scaled.body_mass[:] *= scale
        scaled.body_inertia[:] *= scale[:, None]
        mujoco.mj_setConst(scaled, mujoco.MjData(scaled))
        with jax.enable_x64(True):
            for variant in (model, scaled):
                wrong += [
                    f"{name}: {message}"
                    for message in _wrong(
                        constants(variant.body_mass, variant.body_inertia), variant
                    )
                ]
        tried += 1
    assert wrong == []
    assert tried > 40


@pytest.mark.release
def test_constants_by_mjxs_kinematics_are_mujocos() -> None:
    """Of the models above, and with bodies elsewhere."""
    for name, xml in OWN.items():
        model = mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>")
        shifted = model.__copy__()
        shifted.body_pos[1:] += 0.07
        mujoco.mj_setConst(shifted, mujoco.MjData(shifted))
        with jax.enable_x64(True):
            constants = jax.jit(PlaceConstants(model))
            assert _wrong(constants({}), model) == [], name
            assert _wrong(constants({"body_pos": shifted.body_pos}), shifted) == [], name


def test_a_model_without_an_inverse_inertia_is_refused() -> None:
    """MuJoCo warns of it, and puts 1e15 in the place of infinity."""
    twice = '<mujoco><worldbody><body><joint/><joint/><geom size=".1" pos="1 0 0"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match="no inverse"):
        MassConstants(mujoco.MjModel.from_xml_string(twice))
