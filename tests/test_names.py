# Tests of __init__.py
"""One word, one thing: no two files define a class or a public function of the same name."""

import ast
from collections import defaultdict
from pathlib import Path

import nermo_mjx


def test_no_name_stands_for_two_things():
    """Not guessable from an import or a traceback otherwise."""
    package, places = Path(nermo_mjx.__file__).parent, defaultdict(list)
    for path in package.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                places[node.name].append(path.relative_to(package).as_posix())
    assert {name: files for name, files in places.items() if len(files) > 1} == {}
