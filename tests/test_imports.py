# Tests of __init__.py
"""The modules of the package import one another without a cycle, also inside of functions."""

from __future__ import annotations

import ast
import graphlib
from collections.abc import Collection, Iterator
from pathlib import Path

import pytest

import nermo_mjx

PACKAGE = Path(nermo_mjx.__file__).parent


def imported(node: ast.AST, module_names: Collection[str]) -> Iterator[str]:
    """The modules that a source imports, but for the annotations of type checkers. `from PACKAGE import MODULE` imports
    the module."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        if isinstance(child, ast.ImportFrom):
            full = {f"{child.module}.{name.name}" for name in child.names}
            yield from {name if name in module_names else str(child.module) for name in full}
        elif isinstance(child, ast.Import):
            yield from (name.name for name in child.names)
        yield from imported(child, module_names)


def graph(sources: dict[str, str]) -> dict[str, set[str]]:
    """By module: the modules that its source imports."""
    return {
        name: {*imported(ast.parse(text), sources)} & {*sources} - {name}
        for name, text in sources.items()
    }


def modules() -> dict[str, str]:
    """By name: the source of each module, and of each package."""
    files = {
        path: path.relative_to(PACKAGE.parent).with_suffix("").parts
        for path in PACKAGE.rglob("*.py")
    }
    return {
        ".".join(parts).removesuffix(".__init__"): path.read_text(encoding="utf-8")
        for path, parts in files.items()
    }


def test_no_import_leads_back() -> None:
    module_names = modules()
    imports = graph(module_names)
    assert "nermo_mjx.cli.kinds" in imports["nermo_mjx.cli.view"]
    graphlib.TopologicalSorter(imports).prepare()


def test_a_cycle_of_function_imports_is_found() -> None:
    sources = {
        "a": "from b import f",
        "b": "def f():\n    import c",
        "c": "if TYPE_CHECKING:\n    import d\nelse:\n    pass\nimport a",
        "d": "import c",
    }
    with pytest.raises(graphlib.CycleError) as caught:
        graphlib.TopologicalSorter(graph(sources)).prepare()
    assert {*caught.value.args[1]} == {"a", "b", "c"}
