# Tests of pyproject.toml
"""pyproject.toml declares every import of the package, and no requirement that the package does not import."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: Module -> the requirement that installs it, if their names differ.
REQUIREMENTS = {
    "mujoco.mjx": "mujoco-mjx",
    "mujoco_playground": "playground",
    "orbax": "orbax-checkpoint",
    "paho": "paho-mqtt",
    "ruamel": "ruamel-yaml",
    "warp": "mujoco-mjx[warp]",
}
#: Extras for tests, pages and GPUs: the package imports nothing of them.
OTHER_EXTRAS = ("test", "test-all", "dev", "docs", "cuda", "gpu-plan")


def imported(code: str) -> Iterator[str]:
    """Dotted names of the modules of other packages that Python code imports, at its top or later."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func).endswith("import_module")
            and node.args
        ):
            beginning = next(ast.walk(node.args[0]), None)
            beginning = beginning.values[0] if isinstance(beginning, ast.JoinedStr) else beginning
            if isinstance(beginning, ast.Constant):
                yield str(beginning.value).rstrip(".")


def normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirement_of(module: str) -> str | None:
    """The requirement that installs a module; None for Python's own and the package's own modules."""
    parts = module.split(".")
    if parts[0] == "nermo_mjx" or parts[0] in sys.stdlib_module_names:
        return None
    beginnings = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next(
        (REQUIREMENTS[beginning] for beginning in beginnings if beginning in REQUIREMENTS),
        normalized(parts[0]),
    )


def declared(requirements: Iterable[str]) -> set[str]:
    """Names of requirements, with their extras, without versions."""
    matches = (re.match(r"([\w.-]+)(\[[\w,-]+\])?", requirement) for requirement in requirements)
    return {
        normalized(match[1]) + (match[2] or "")
        for match in matches
        if match and match[1] != PROJECT["name"]
    }


def faults(modules: Iterable[str], project: Mapping[str, Any]) -> dict[str, set[str]]:
    """Requirements that are imported but not declared, and the other way round."""
    requirements = {
        requirement for module in modules if (requirement := requirement_of(module)) is not None
    }
    extras = project["optional-dependencies"].items()
    ours = [entry for name, extra in extras if name not in OTHER_EXTRAS for entry in extra]
    required, optional = declared(project["dependencies"]), declared(ours)
    return {
        "undeclared": requirements - required - optional,
        "unused": (required | optional) - requirements,
    }


@pytest.mark.release
def test_every_import_is_declared_and_every_requirement_is_imported() -> None:
    modules = {
        name for path in (ROOT / "nermo_mjx").rglob("*.py") for name in imported(path.read_text())
    }
    modules.add("warp")  # MJX imports it for models with impl="warp"
    assert faults(modules, PROJECT) == {"undeclared": set(), "unused": set()}


@pytest.mark.parametrize(
    ("code", "requirements", "expected"),
    [
        ("def late():\n    import yaml", ["numpy"], ({"yaml"}, {"numpy"})),
        ("from mujoco import mjx", ["mujoco>=3"], ({"mujoco-mjx"}, {"mujoco"})),
        ("import mujoco.viewer\nfrom . import yaml", ["mujoco>=3"], (set(), set())),
        ("importlib.import_module('jaxlib.xla_client')", ["jax>=0.9"], ({"jaxlib"}, {"jax"})),
        (
            "importlib.import_module(f'mujoco.{backend}')\nimport os.path",
            ["mujoco>=3"],
            (set(), set()),
        ),
        (
            "from ruamel.yaml import YAML\nfrom paho.mqtt import client",
            ["ruamel.yaml>=0.18"],
            ({"paho-mqtt"}, set()),
        ),
        ("import warp", ["mujoco-mjx[warp]==3.17.0"], (set(), set())),
    ],
)
def test_a_missing_and_an_unused_declaration_are_found(
    code: str, requirements: list[str], expected: Any
) -> None:
    project = {"dependencies": requirements, "optional-dependencies": {"docs": ["sphinx"]}}
    assert tuple(faults(imported(code), project).values()) == expected


def test_modules_come_from_the_requirements_that_this_file_names() -> None:
    """As far as they are installed here."""
    installed = importlib.metadata.packages_distributions()
    for module, requirement in REQUIREMENTS.items():
        owners = {normalized(name) for name in installed.get(module.partition(".")[0], ())}
        if owners and "[" not in requirement:
            assert requirement in owners, module
    files = importlib.metadata.files("mujoco-mjx") or ()
    assert "mujoco/mjx/__init__.py" in map(str, files)
    assert "mujoco/mjx/__init__.py" not in map(str, importlib.metadata.files("mujoco") or ())


def test_ci_installs_the_lowest_version_of_each_requirement() -> None:
    """Of those whose version is not another one's."""
    (command,) = re.findall(r"sed -nE .* pyproject\.toml(?= >)", (ROOT / ".ci" / "run").read_text())
    lowest = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    floors = (
        re.match(r"([\w.-]+)[=>]=([\d.]+)", requirement) for requirement in PROJECT["dependencies"]
    )
    assert lowest.split() == [f"{match[1]}=={match[2]}" for match in floors if match]
    without = declared(PROJECT["dependencies"]) - declared(lowest.split())
    assert without == {"jaxlib", "pydantic-core"}, "JAX and pydantic fix these"


def test_all_that_tests_need_is_in_one_extra() -> None:
    """`test-all` brings each extra of the package, except those for a GPU and those with a large framework."""
    extras = PROJECT["optional-dependencies"]
    brought, new = set(), {"test-all"}
    while new:
        brought |= new
        matches = (re.match(r"nermo-mjx\[(.*)\]", entry) for name in new for entry in extras[name])
        new = {extra for match in matches if match for extra in match[1].split(",")} - brought
    assert extras.keys() - brought == {
        "dev",
        "cuda",
        "gpu-plan",
        "warp",
        "playground",
        "stable-baselines3",
    }
