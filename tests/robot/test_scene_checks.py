# Tests of robot/scene.py
"""Checks of a scene before MuJoCo compiles it: size, files, and settings that are not accepted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command import refused
from fakes.strangers import SPECIAL, bounded, special, write_text

from nermo_mjx import Setup, load_robot
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.scene import resolve_scene


def scene(inside: str) -> str:
    floor = '<worldbody><geom name="floor" type="plane" size="1 1 1"/></worldbody>'
    return f"<mujoco model='theirs'>{inside}{floor}</mujoco>"


def nested(count: int, depth: int) -> str:
    return f'<replicate count="{count}">' * depth + '<geom size="1"/>' + "</replicate>" * depth


HUGE = {
    "texture": scene(
        '<asset><texture name="a" type="2d" builtin="flat" width="30000" height="30000"/></asset>'
    ),
    "cube": scene(
        '<asset><texture name="a" type="cube" builtin="flat" width="9000" height="54000"/></asset>'
    ),
    "hfield": scene('<asset><hfield name="a" nrow="20000" ncol="20000" size="1 1 1 1"/></asset>'),
    "user numbers": scene('<size nuser_geom="200000000"/>'),
    "keyframes": scene('<size nkey="2000000000"/>'),
    "numeric": scene('<custom><numeric name="a" size="2000000000"/></custom>'),
    "replicate": scene(f"<worldbody>{nested(100, 3)}</worldbody>"),
    "deep replicate": scene(f"<worldbody>{nested(10, 30)}</worldbody>"),
    "composite": scene('<worldbody><composite type="cable" count="999 1 1"/></worldbody>'),
}


@pytest.mark.parametrize("name", HUGE)
def test_a_scene_that_asks_for_more_than_fits_is_refused(name: str, tmp_path: Path) -> None:
    """As text, and as a file that another one includes."""
    with pytest.raises(
        ParameterError,
        match=r"asks for [\d,]+ (bytes|elements): allowed are|only the robot may move",
    ):
        resolve_scene(HUGE[name])
    write_text(
        tmp_path / "inner.xml",
        HUGE[name]
        .replace("<mujoco model='theirs'>", "<mujocoinclude>")
        .replace("</mujoco>", "</mujocoinclude>"),
    )
    outer = write_text(tmp_path / "outer.xml", '<mujoco><include file="inner.xml"/></mujoco>')
    with pytest.raises(ParameterError, match=r"allowed are|only the robot may move"):
        resolve_scene(str(outer))


def test_a_picture_with_many_pixels_is_refused(tmp_path: Path) -> None:
    size = (50_000).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + size + size + bytes(9)
    )
    text = scene('<asset><texture name="a" type="2d" file="a.png"/></asset>')
    with pytest.raises(
        ParameterError, match=r"a\.png takes 10,000,000,000 bytes: allowed are 134,217,728"
    ):
        resolve_scene(str(write_text(tmp_path / "a.xml", text)))


@SPECIAL
@pytest.mark.parametrize(
    "inside",
    [
        '<include file="{0}"/>',
        '<asset><model name="m" file="{0}"/></asset>',
        '<asset><mesh name="m" file="{0}" content_type="model/stl"/></asset>',
        '<asset><texture name="t" type="2d" file="{0}" content_type="image/png"/></asset>',
        '<asset><hfield name="h" size="1 1 1 1" file="{0}" content_type="image/png"/></asset>',
        '<asset><model name="m" file="{1}/nested.xml"/></asset>',
    ],
)
def test_a_special_file_in_a_scene_is_refused(inside: str, kind: str, tmp_path: Path) -> None:
    """As a file and as text, as in a recording; and one that a model beside it names from its own folder."""
    (tmp_path / "under").mkdir()
    file = special(tmp_path / "under" / "a", kind)
    write_text(tmp_path / "a", scene(""))  # of that name there is another one, which is right
    write_text(
        tmp_path / "under" / "nested.xml", scene('<asset><model name="n" file="a"/></asset>')
    )
    text = scene(inside.format(file, tmp_path / "under"))
    for source in (text, str(write_text(tmp_path / "a.xml", text))):
        with (
            bounded(),
            pytest.raises(ParameterError, match=r"cannot be read \(not a regular file\)"),
        ):
            resolve_scene(source)


def yard(option: str = "", elements: str = "") -> str:
    floor = '<geom name="floor" type="plane" size="0 0 0.1"/>'
    return f"<mujoco>{option}<worldbody>{floor}{elements}</worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            yard('<option density="1000" viscosity="0.001"/>'),
            "its option has density 1000.*only gravity is taken",
        ),
        (yard('<option wind="1 0 0"/>'), "its option has wind"),
        (yard('<option viscosity="0.1"/>'), "its option has viscosity"),
        (
            yard('<option><flag contact="disable" gravity="disable"/></option>'),
            "its option has flags",
        ),
        (yard('<option><flag override="enable"/></option>'), "its option has flags"),
        (
            yard().replace('0.1"/>', '0.1" pos="0 0 nan"/>'),
            "numbers that are not finite, in geom_pos",
        ),
        (yard(elements='<camera name="track_side"/>'), "track_side"),
    ],
)
def test_a_scene_says_what_of_it_is_not_taken(text: str, message: str) -> None:
    refused(lambda: Setup(scene=text), message)


def test_a_scenes_solver_is_warned_of_and_its_gravity_taken() -> None:
    option = '<option timestep="0.01" integrator="RK4" gravity="0 0 -1.62" cone="elliptic"/>'
    with pytest.warns(
        UserWarning, match="its option has cone 1, integrator 1, timestep 0.01, which is not taken"
    ):
        model = Setup(scene=yard(option)).load().model
    assert (model.opt.timestep, model.opt.gravity[2], model.opt.integrator) == (0.002, -1.62, 0)


@pytest.mark.parametrize("name", ["imu", "torso", "front_left_axis"])
def test_a_scene_may_have_names_of_the_robot(name: str) -> None:
    """On sites and bodies, which nothing of a scene refers to; the robot stands where it does without them."""
    box = '<geom type="box" size="0.1 0.1 0.1"/>'
    model = (
        Setup(
            scene=yard(
                elements=f'<site name="{name}"/><body name="{name}" pos="3 0 0">{box}</body>'
            )
        )
        .load()
        .model
    )
    plain = load_robot().model
    assert model.nbody == plain.nbody
    np.testing.assert_allclose(model.body("torso").pos, plain.body("torso").pos)
    np.testing.assert_allclose(model.geom_pos[1], [3, 0, 0])
