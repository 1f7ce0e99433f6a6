# Tests of dynamics/mjx_copy.py, dynamics/mjx_import.py
"""One file lists the private attributes of JAX, MJX and Ray in use, and the installed releases have them."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

PACKAGE = Path(__file__).parents[1] / "nermo_mjx"
LINES = Path(__file__).with_name("private_attributes.txt").read_text().splitlines()
LISTED = [line for line in LINES if not line.startswith("#")]
LIBRARIES = ("jax", "jaxlib", "mujoco", "ray")
#: Public methods of named tuples.
PUBLIC = {"_asdict", "_fields", "_make", "_replace"}


def _private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


class Uses(ast.NodeVisitor):
    """Dotted names in `found`, and in `members` names of private attributes of objects that are of another package.

    An attribute of an object is of another package if no file of this package defines its name.
    """

    def __init__(self, package_names: set[str]) -> None:
        self.own, self.found, self.members = package_names, set[str](), set[str]()
        self._scopes: list[dict[str, str]] = [{}]

    def _add(self, name: str) -> None:
        """Note a name that is private, down to its first class."""
        parts = name.split(".")
        if parts[0] == "jaxlib" or any(_private(part) for part in parts):
            classes = [i for i, part in enumerate(parts) if part[:1].isupper()]
            self.found.add(".".join(parts[: classes[0] + 1] if classes else parts))

    def _bind(self, name: str, alias: str | None) -> None:
        if name.partition(".")[0] in LIBRARIES:
            self._scopes[-1][alias or name.partition(".")[0]] = (
                name if alias else name.partition(".")[0]
            )
            self._add(name)

    def _name(self, node: ast.AST) -> str | None:
        """What an expression such as `math.norm` means, by the imports that it sees."""
        if isinstance(node, ast.Name):
            return next(
                (scope[node.id] for scope in reversed(self._scopes) if node.id in scope), None
            )
        prefix = self._name(node.value) if isinstance(node, ast.Attribute) else None
        return prefix and f"{prefix}.{node.attr}"  # type: ignore[attr-defined]

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._bind(alias.name, alias.asname)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        for alias in node.names if not node.level else ():
            self._bind(f"{node.module}.{alias.name}", alias.asname or alias.name)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._scopes.append({})
        self.generic_visit(node)
        self._scopes.pop()

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if (name := self._name(node)) is not None:
            self._add(name)
            return
        if _private(node.attr) and node.attr not in self.own | PUBLIC:
            self.members.add(node.attr)
        self.generic_visit(node)

    def _pair(self, nodes: list[ast.expr]) -> None:
        """`module, "name"`, in a tuple or a call."""
        if (
            len(nodes) > 1
            and isinstance(nodes[1], ast.Constant)
            and (name := self._name(nodes[0])) is not None
        ):
            self._add(f"{name}.{nodes[1].value}")

    def visit_Tuple(self, node: ast.Tuple) -> None:
        self._pair(node.elts)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        self._pair(node.args)
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str) and re.fullmatch(
            rf"({'|'.join(LIBRARIES)})(\.\w+)+", node.value
        ):
            self._add(node.value)


def uses_of(code: str, package_names: set[str] | None = None) -> Uses:
    uses = Uses(package_names or set())
    uses.visit(ast.parse(code))
    uses.found = {
        name
        for name in uses.found
        if not any(longer.startswith(f"{name}.") for longer in uses.found)
    }
    return uses


def exists(name: str) -> bool:
    """Whether a dotted name of the list is there: a module, its attribute, or a field of its class."""
    parts = name.split(".")
    part_value: Any = None
    for i, part in enumerate(parts):
        inside = getattr(part_value, part, None)
        if inside is None:
            if part in getattr(part_value, "__dataclass_fields__", {}):
                return True
            try:
                inside = importlib.import_module(".".join(parts[: i + 1]))
            except ModuleNotFoundError:
                return False
        part_value = inside
    return True


def test_the_list_is_complete() -> None:
    """If it fails: edit tests/private_attributes.txt as the message says, or use a public attribute."""
    codes = {
        path.relative_to(PACKAGE).as_posix(): path.read_text() for path in PACKAGE.rglob("*.py")
    }
    package_names = {
        name
        for code in codes.values()
        for name in re.findall(r"(?:self\.|cls\.|def |class |^ *)(_\w+)", code, re.M)
    }
    files_by_name = dict[str, str]()
    for file, code in codes.items():
        uses = uses_of(code, package_names)
        files_by_name |= dict.fromkeys(uses.found, file)
        for member in uses.members:
            listed = [name for name in LISTED if name.rpartition(".")[2] == member]
            files_by_name |= dict.fromkeys(listed or [f"(some class).{member}"], file)
    missing_names = [
        f"{name}  # {files_by_name[name]}" for name in sorted(files_by_name.keys() - set(LISTED))
    ]
    unused_names = sorted(set(LISTED) - files_by_name.keys())
    assert (missing_names, unused_names) == ([], []), "\n".join(
        ["add:", *missing_names, "remove:", *unused_names]
    )
    assert sorted(set(LISTED)) == LISTED


@pytest.mark.parametrize(
    "library", ["jax", "jaxlib", "mujoco", pytest.param("ray", marks=pytest.mark.release)]
)
def test_the_installed_releases_have_what_the_list_names(library: str) -> None:
    pytest.importorskip(library)
    assert [name for name in LISTED if name.partition(".")[0] == library and not exists(name)] == []


def test_a_private_attribute_is_found_wherever_it_is_used() -> None:
    code = """
from mujoco.mjx._src import math as theirs
import jax
def late():
    from mujoco.mjx._src import forward as theirs
    import jaxlib.xla_client
    theirs._next(0)
    patched = {(theirs, "_other"): 1}
    getattr(jax, "_hidden")
    mine._known, yours._impl, yours._replace(a=1)
theirs.norm(sys.modules["jax._src.core"], theirs.Kind.PLANE)
jax.numpy.zeros(3).__class__
"""
    uses = uses_of(code, {"_known"})
    assert uses.found == {
        "jax._hidden",
        "jax._src.core",
        "jaxlib.xla_client",
        "mujoco.mjx._src.forward._next",
        "mujoco.mjx._src.forward._other",
        "mujoco.mjx._src.math.Kind",
        "mujoco.mjx._src.math.norm",
    }
    assert uses.members == {"_impl"}


def test_an_attribute_that_a_release_no_longer_has_is_noticed() -> None:
    assert exists("jax._src.core")
    assert exists("mujoco.mjx.Model._impl")
    assert not exists("jax._src.core.of_tomorrow")
    assert not exists("mujoco.mjx.Model._of_tomorrow")
