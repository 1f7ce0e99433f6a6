"""The examples in docstrings run, and every public function has one."""

from __future__ import annotations

import doctest
import importlib
import inspect
from pathlib import Path

import pytest

import nermo_mjx

pytestmark = [pytest.mark.compiles, pytest.mark.usefixtures("shared_simulators")]

PACKAGE = Path(nermo_mjx.__file__).parent
WITH_EXAMPLES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
#: What runs for minutes, needs a directory or a GPU, or draws: the notebooks and the pages of docs/ run them.
ELSEWHERE = {
    "read_history", "read_table", "render", "run_experiment", "run_experiments", "run_landscape", "run_tuning", "show",
}  # fmt: skip


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_examples_of_a_module_run(name: str) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(name))
    assert attempted > 0
    assert failed == 0


def test_every_public_function_has_an_example() -> None:
    public = {name: getattr(nermo_mjx, name) for name in nermo_mjx.__all__}
    # The tests' shared simulators stand in for a class here.
    functions = {name: each for name, each in public.items() if inspect.isfunction(each) and "nermo" in each.__module__}
    without = {name for name, each in functions.items() if ">>> " not in (each.__doc__ or "")}
    assert without - {"quantity"} == ELSEWHERE  # `parameter_tree` shows both
