# Tests of dynamics/differentiable.py
"""The stages of a step are MJX's own: these tests fail when a release of MJX adds, drops or reorders one."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from typing import Any

import pytest
from mujoco.mjx._src import forward

from nermo_mjx.dynamics import differentiable

#: What MJX calls with (model, data), in its order.
STAGES = {
    "fwd_position": [
        "kinematics",
        "com_pos",
        "camlight",
        "tendon",
        "crb",
        "tendon_armature",
        "factor_m",
        "collision",
        "make_constraint",
        "transmission",
    ],
    "fwd_velocity": ["com_vel", "passive", "rne", "tendon_bias"],
    "fwd_acceleration": ["xfrc_accumulate", "solve_m"],
    "forward": [
        "fwd_position",
        "sensor_pos",
        "fwd_velocity",
        "sensor_vel",
        "fwd_actuation",
        "fwd_acceleration",
        "solve",
        "sensor_acc",
    ],
    "step": ["forward", "euler", "rungekutta4", "implicit"],
}
#: What stands in place of it here, under names of its own; `passive` and `rne` do not see each other.
OURS = {
    "fwd_position": differentiable.position,
    "fwd_velocity": differentiable.velocity,
    "forward": differentiable._forward,
}
RENAMED = {
    f"fwd_{name}": name for name in ("position", "velocity", "actuation", "acceleration")
} | {"tendon_armature": "with_tendon_inertia"}
UNORDERED = {"passive", "rne"}


def called(function: Callable[..., Any]) -> list[str]:
    """Names of what a function calls with (model, data), in the order of execution."""
    names: list[str] = []

    def visit(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            visit(child)
        if (
            isinstance(node, ast.Call)
            and node.args
            and getattr(node.args[0], "id", "") in {"m", "model"}
        ):
            # MJX wraps one call in the name of its scope: `named_scope(solver.solve)(m, d)`.
            function = node.func.args[0] if isinstance(node.func, ast.Call) else node.func
            names.append(function.attr if isinstance(function, ast.Attribute) else function.id)

    visit(ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(function)))))
    return names


@pytest.mark.parametrize("name", STAGES)
def test_mjx_has_the_stages_that_we_know(name: str) -> None:
    """In the installed MJX, without the branch that hands all over to Warp."""
    assert [stage for stage in called(getattr(forward, name)) if stage != name] == STAGES[name]


@pytest.mark.parametrize("name", OURS)
def test_we_have_the_same_stages_in_the_same_order(name: str) -> None:
    ours = {RENAMED.get(stage, stage) for stage in STAGES[name]}
    order = [stage for stage in called(OURS[name]) if stage in ours]
    expected = [RENAMED.get(stage, stage) for stage in STAGES[name]]
    assert sorted(order) == sorted(expected)
    assert [stage_name for stage_name in order if stage_name not in UNORDERED] == [
        stage_name for stage_name in expected if stage_name not in UNORDERED
    ]
