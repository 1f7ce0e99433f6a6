# Tests of __init__.py
"""One word, one thing: no two files define a class or a public function of the same name, or a metric's direction."""

import ast
import importlib
from collections import defaultdict
from pathlib import Path

import pytest

import nermo_mjx
from nermo_mjx.rollout.metric_table import METRICS, SIDES


def test_no_name_stands_for_two_things():
    """Not guessable from an import or a traceback otherwise."""
    package, places = Path(nermo_mjx.__file__).parent, defaultdict(list)
    for path in package.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                places[node.name].append(path.relative_to(package).as_posix())
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def directions(source):
    """The metrics whose better direction a source declares: in a mapping, in a pair, or as a `Metric`."""
    words, words_of_values = {*SIDES, *SIDES.values()}, set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
        elif isinstance(node, ast.Tuple | ast.List) and len(node.elts) == 2:
            pairs = [node.elts]
        else:
            continue
        for name, value in pairs:
            words_of_description = {
                constant.value for constant in ast.walk(value) if isinstance(constant, ast.Constant)
            } & words
            if isinstance(name, ast.Constant) and name.value in METRICS and words_of_description:
                words_of_values.add(name.value)
    return words_of_values


def test_one_place_declares_which_direction_of_a_metric_is_better():
    package = Path(nermo_mjx.__file__).parent
    assert directions(
        '{"speed": "max"}, [("slip", "low")], {"roll_std": Metric("rad", "", "low")}'
    ) == {*("speed", "slip", "roll_std")}
    declaring = {
        path for path in package.rglob("*.py") if directions(path.read_text(encoding="utf-8"))
    }
    assert declaring == {package / "rollout" / "metric_table.py"}


@pytest.mark.parametrize(
    ("module", "name"), [("nermo_mjx", "run_landscape"), ("nermo_mjx.learn", "ShortHorizon")]
)
def test_a_name_of_an_earlier_release_says_what_replaces_it(module, name):
    with pytest.raises(ImportError, match=rf"^{module}\.{name} was removed: ."):
        exec(f"from {module} import {name}")
    assert name not in importlib.import_module(module).__all__
