# Tests of docs/benchmarks/step_matrix.py
"""The studies beside their results in docs/benchmarks: MuJoCo's own models through the step; all can be started."""

from __future__ import annotations

import functools
import importlib
import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from fakes.composites import IN_THEIR_PLACE

from nermo_mjx import Setup, Simulator, compiler_options
from nermo_mjx.dynamics import step
from nermo_mjx.dynamics.mjx_import import Solved

STUDIES = Path(__file__).parents[1] / "docs" / "benchmarks"
sys.path.insert(0, str(STUDIES))
step_matrix, step_models, step_page = map(
    importlib.import_module, ("step_matrix", "step_models", "step_page")
)
profile_step = importlib.import_module("profile_step")

MODELS = dict(step_models.installed_models())


@pytest.mark.release
@pytest.mark.parametrize(
    "name",
    [
        "mjx/actuator/arm21",
        # test_special_states.py has tendons with armature, test_differentiable_step.py contacts and dry friction.
        pytest.param("mjx/tendon/armature", marks=pytest.mark.long),
        pytest.param("mjx/quadratic_frictionloss", marks=pytest.mark.long),
    ],
)
def test_the_gradient_is_that_of_the_differences(name: str) -> None:
    """An arm, a tendon with armature, and a body that slides with contacts and dry friction; states agree with C."""
    result = step_matrix.measure(MODELS[name], "gradient", {})
    assert result["finite"]
    assert result["spread"] < 1e-5
    assert result["error"] < 1e-4
    assert result["end_off_c"] < 1e-9
    assert (result["contacts"] > 0) == (name == "mjx/quadratic_frictionloss")


# test_special_states.py has muscles, balls and welds, test_differentiable_step.py a tendon wound round a cylinder.
@pytest.mark.long
@pytest.mark.parametrize("name", IN_THEIR_PLACE)
def test_the_gradient_of_what_stands_for_composites(name: str, tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(IN_THEIR_PLACE[name])
    result = step_matrix.measure(tmp_path / "model.xml", "gradient", {})
    assert result["finite"]
    assert result["spread"] < 1e-5
    assert result["error"] < 1e-4
    assert result["end_off_c"] < 1e-9


def test_mujocos_models_of_mjx_are_there() -> None:
    assert {
        "mjx/humanoid/humanoid",
        "mjx/shadow_hand/scene_right",
        "mjx/tendon/wrap_sidesite",
    } <= MODELS.keys()
    assert "mjx/shadow_hand/right_hand" not in MODELS, "a part of its scene"


MISSING = """
<mujoco><asset><mesh name="skin" file="skin.obj"/></asset><worldbody><geom type="plane" size="1 1 .1"/>
<body pos="0 0 .1"><freejoint/>{inertia}<geom size=".1"/><geom type="mesh" mesh="skin" {collides}/></body></worldbody>
</mujoco>
"""


def test_a_mesh_that_is_missing_is_left_out_where_it_is_only_drawn(tmp_path: Path) -> None:
    path, inertia = tmp_path / "robot.xml", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    path.write_text(MISSING.format(inertia=inertia, collides='contype="0" conaffinity="0"'))
    assert step_models.load(path).ngeom == 2
    for attributes in ((inertia, ""), ("", 'contype="0" conaffinity="0"')):
        path.write_text(MISSING.format(inertia=attributes[0], collides=attributes[1]))
        with pytest.raises(
            ValueError, match="mesh 'skin' is not there, and it collides or has a mass"
        ):
            step_models.load(path)


def test_lines_become_a_table(tmp_path: Path) -> None:
    """A model's parts are one; what is off has a row, and is bold; what was not measured has its reason."""
    first = {"nv": 2, "contacts": 1, "rows": 4, "finite": True, "spread": 1e-9, "end_off_c": 0.0}
    lines = [
        {"model": "a", "part": "gradient", **first, "error": 2e-8},
        {"model": "b", "part": "gradient", **first, "error": 3e-2},
        {"model": "a", "part": "plain", "plain": "refuses: while_loop"},
        {"model": "c", "part": "gradient", "failed": "ValueError: no file"},
    ]
    (tmp_path / "lines.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    text = step_page.page(tmp_path / "lines.jsonl")
    assert "2 models; the gradients of 2 are finite, and 1 are within 0.0001" in text
    assert (
        "`mjx.step` was differentiated on 1 of them: it refuses 1, and 0 more gradients are wrong or NaN"
        in text
    )
    assert "| b | 2 | 1, 4 | **3e-02** | 1e-09 | 0e+00 |" in text
    assert "end of C's, on 1: a 1.\n" in text
    assert "| c | ValueError: no file |" in text


@pytest.mark.parametrize("name", sorted(path.stem for path in STUDIES.glob("*.py")))
def test_every_study_finds_what_it_imports(name: str) -> None:
    importlib.import_module(name)


@pytest.mark.long
@pytest.mark.release
def test_the_stages_of_a_profile_are_a_step() -> None:
    engine = Simulator(Setup(), "mjx").engine

    def staged(data: Solved) -> Solved:
        return functools.reduce(
            lambda state, stage: stage(engine.model, state), profile_step.MJX_STAGES.values(), data
        )

    options = compiler_options(level=0)
    result = jax.jit(staged, compiler_options=options)(Solved.of(engine.data))
    expected = jax.jit(functools.partial(step, engine.model), compiler_options=options)(engine.data)
    for name in ("qpos", "qvel", "sensordata"):
        np.testing.assert_allclose(
            getattr(result, name), getattr(expected, name), rtol=1e-4, atol=1e-5, err_msg=name
        )
    rows = profile_step.profile("mjx", worlds=2)["stages"]
    assert [row["stage"] for row in rows] == list(profile_step.MJX_STAGES)
    assert all(row["us"] > 0 for row in rows)
