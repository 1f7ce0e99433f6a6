# Tests of rollout/metric_table.py, cli/kinds.py, hardware/log.py, recording.py
"""One record each for the columns of tables, logs and recordings, the kinds of directories, and the units of metrics."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import nermo_mjx
from nermo_mjx.cli.kinds import KINDS
from nermo_mjx.experiments.cases import texts
from nermo_mjx.hardware.log import CHANNEL_PARTS, QUANTITIES
from nermo_mjx.plotting.shown import shown
from nermo_mjx.recording import ARRAYS
from nermo_mjx.rollout.metric_table import METRICS, RUN_COLUMNS, TRANSITION

PACKAGE = Path(nermo_mjx.__file__).parent
#: Files in which a name of a metric has another meaning, and a unit of its own.
HOMONYMS = {
    "learn/task.py": "rewards, and fields of a task",
    "rollout/run.py": "arguments of a run",
    "view/recorded.py": "curves of a page",
}


def modules(*records: str) -> Iterator[tuple[str, ast.Module]]:
    """The modules of the package, except the records."""
    for path in sorted(PACKAGE.rglob("*.py")):
        place = str(path.relative_to(PACKAGE))
        if place not in records and "vendor" not in path.parts:
            yield place, ast.parse(path.read_text())


def texts_in(node: ast.AST) -> set[str]:
    """The texts that a dict, tuple, list, set or call contains directly; of a dict, its keys and values."""
    match node:
        case ast.Dict():
            parts = [*node.keys, *node.values]
        case ast.Tuple() | ast.List() | ast.Set():
            parts = [*node.elts]
        case ast.Call():
            parts = [*node.args, *(keyword.value for keyword in node.keywords)]
        case _:
            return set()
    return {
        part.value
        for part in parts
        if isinstance(part, ast.Constant) and isinstance(part.value, str)
    }


def constants(tree: ast.Module) -> Iterator[ast.AST]:
    """All parts of the values that a module assigns outside of functions."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value:
            yield from ast.walk(statement.value)


def test_columns_of_tables_and_arrays_of_recordings_are_declared_in_one_place() -> None:
    """No other constant lists four of the columns, or all arrays."""
    wrong = [
        f"{place}:{node.lineno}"
        for place, tree in modules("rollout/metric_table.py", "recording.py")
        for node in constants(tree)
        if len(texts_in(node) & RUN_COLUMNS.keys()) > 3 or texts_in(node) >= ARRAYS.keys()
    ]
    assert wrong == []


def test_the_units_and_the_parts_of_a_quantity_are_declared_in_one_place() -> None:
    """No collection or call of a subpackage that uses logs contains a quantity, and one of its units or its part."""
    described = {
        name: {*units, CHANNEL_PARTS.get(name, "")} - {"g"} for name, units in QUANTITIES.items()
    }
    wrong = [
        f"{place}:{node.lineno} {name}"
        for place, tree in modules("hardware/log.py")
        if place.startswith(("cli", "hardware", "identify", "live"))
        for node in ast.walk(tree)
        if (texts := texts_in(node))
        for name in texts & QUANTITIES.keys()
        if texts & described[name]
    ]
    assert wrong == []


def test_kinds_of_directories_are_declared_in_one_place() -> None:
    """Every job makes a known kind, and no other constant lists three kinds."""
    names, wrong = set[str](), list[str]()
    for place, tree in modules("cli/kinds.py", "runs/directory.py"):
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Name("RunDirectory"), args=[_, ast.Constant(name), *_]):
                    names.add(name)
        wrong += [
            f"{place}:{node.lineno}"
            for node in constants(tree)
            if len(texts_in(node) & KINDS.keys()) > 2
        ]
    assert wrong == []
    assert names
    assert names <= KINDS.keys()


def test_units_of_metrics_are_declared_in_one_place() -> None:
    """No other collection or call contains a metric and a unit of metrics, and no experiment declares the unit again."""
    metrics = METRICS | TRANSITION
    units = {metric.unit for metric in metrics.values()}
    units = (units | {shown("", unit, 1.0).unit for unit in units}) - {"", "1"}
    places = {
        place
        for place, tree in modules("rollout/metric_table.py")
        for node in ast.walk(tree)
        if texts_in(node) & metrics.keys() and texts_in(node) & units
    }
    assert places == HOMONYMS.keys()
    for experiment, columns in texts("columns").items():
        # A stand has no walk: its `speed` is its own measurement.
        assert experiment.endswith("-stand") or not columns.keys() & metrics.keys()
