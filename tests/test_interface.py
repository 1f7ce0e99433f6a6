# Tests of lazy.py
"""The public interface: pages use nothing else, former names work for one version, and choices have types."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import nermo_mjx
from nermo_mjx import Setup
from nermo_mjx.control import head_and_tail, parameters, path, stepping, trajectory
from nermo_mjx.robot.parameters import GAIT_PATTERNS, PRESETS
from nermo_mjx.robot.quantity import allowed_names

ROOT = Path(__file__).parents[1]
INTERFACE = (ROOT / "docs" / "reference" / "interface.md").read_text(encoding="utf-8")
#: The modules that the page lists.
MODULES = re.findall(
    r"^\| `(nermo_mjx[.\w]*)` \| [^`]*[a-z]", INTERFACE.partition("## What stays")[0], re.MULTILINE
)
PAGES = [ROOT / "README.md", ROOT / "sweeps" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Scripts that measure, or that make the pages and their results: they may use internal names.
SCRIPTS = ("docs/benchmarks/", "docs/answers/", "docs/howto/terrain/")


def public(module: str) -> set[str]:
    """The names of a public module: `__all__`, or the literal `__all__` of one whose library may be missing."""
    if module.endswith("_door"):
        file = ROOT / f"{module.replace('.', '/')}.py"
        (listed,) = re.findall(
            r"^__all__ = (\[.*\])$", file.read_text(encoding="utf-8"), re.MULTILINE
        )
        return set(ast.literal_eval(listed))
    return set(importlib.import_module(module).__all__)


PUBLIC = {module: public(module) for module in MODULES}


def is_internal(path: str) -> bool:
    """Whether a dotted path leads into the package, but not to a public name, or to what such a name has."""
    module = max(
        (prefix for prefix in MODULES if f"{path}.".startswith(f"{prefix}.")), key=len, default=""
    )
    name = path.removeprefix(module).removeprefix(".").partition(".")[0]
    return module != "" and name != "" and name not in PUBLIC[module]


def internal(code: str) -> list[str]:
    """The names of the package that a piece of code uses, and that are not public."""
    imported_names = list[str]()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            imported_names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imported_names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Attribute):
            imported_names.append(ast.unparse(node))
    return [imported_name for imported_name in imported_names if is_internal(imported_name)]


def pages() -> Iterator[tuple[str, str]]:
    """Name and Python code of each page, each file that a page shows, each notebook, and each public docstring."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for code in re.findall(
            r"^```(?:\{code-block\} )?python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL
        ):
            yield page.relative_to(ROOT).as_posix(), re.sub(r"\A(:.*\n)+", "", code)
    for file in sorted([*(ROOT / "docs" / "howto").rglob("*.py"), *(ROOT / "sweeps").glob("*.py")]):
        if not (name := file.relative_to(ROOT).as_posix()).startswith(SCRIPTS):
            yield name, file.read_text(encoding="utf-8")
    for file in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                yield (
                    file.name,
                    re.sub(r"^(\s*)[!%].*", r"\1pass", "".join(cell["source"]), flags=re.MULTILINE),
                )
    for module in MODULES:
        for name in PUBLIC[module] if not module.endswith("_door") else ():
            text = inspect.getdoc(getattr(importlib.import_module(module), name)) or ""
            for example in doctest.DocTestParser().get_examples(text):
                yield f"{module}.{name}", example.source


def test_pages_notebooks_and_examples_use_public_names_alone() -> None:
    names_of_pages = list(pages())
    assert len({name for name, _ in names_of_pages if name.endswith(".md")}) > 15
    assert len({name for name, _ in names_of_pages if name.endswith(".ipynb")}) == 8
    assert {name: bad for name, code in names_of_pages if (bad := internal(code))} == {}


@pytest.mark.parametrize(
    ("code", "bad"),
    [
        ("from nermo_mjx.sweep.replay import find_row", ["nermo_mjx.sweep.replay.find_row"]),
        ("import nermo_mjx.rollout.setup", ["nermo_mjx.rollout.setup"]),
        ("import nermo_mjx\nnermo_mjx.control.Swatch", ["nermo_mjx.control.Swatch"]),
        ("from nermo_mjx import runtime, Setup", ["nermo_mjx.runtime"]),
        ("from nermo_mjx.physics import step", ["nermo_mjx.physics.step"]),
        ("import nermo_mjx\nnermo_mjx.Tuning.from_file", []),
        (
            "from nermo_mjx.kinematics import leg\nimport nermo_mjx.learn.playground_door as door",
            [],
        ),
    ],
)
def test_an_internal_name_is_found(code: str, bad: list[str]) -> None:
    assert internal(code) == bad


def test_texts_of_pages_write_public_names_alone() -> None:
    """The table of former names is the exception; a colon follows the module of a directive."""
    wrong = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8").partition("| former name |")[0]
        names_of_page = re.findall(
            r"(?<![\w/])nermo_mjx(?:\.[A-Za-z_]+)+\b(?!:)", text.replace("nermo_mjx.zip", "")
        )
        wrong |= {page.name: bad} if (bad := [*filter(is_internal, names_of_page)]) else {}
    assert wrong == {}


def test_the_page_lists_every_public_module_and_each_has_its_names() -> None:
    rooms = [
        path.parent
        for path in (ROOT / "nermo_mjx").glob("*/__init__.py")
        if "__all__" in path.read_text()
    ]
    doors = {
        f"nermo_mjx.learn.{file.stem}" for file in (ROOT / "nermo_mjx" / "learn").glob("*_door.py")
    }
    assert set(MODULES) == {"nermo_mjx", *(f"nermo_mjx.{room.name}" for room in rooms), *doors}
    for module in set(MODULES) - doors:
        namespace: dict[str, object] = {}
        exec(f"from {module} import *", namespace)
        names = importlib.import_module(module).__all__
        assert set(names) == namespace.keys() - {"__builtins__"}
        assert len(set(names)) == len(names)
    for name in re.findall(
        r"`(\w+)`", INTERFACE.partition("| `nermo_mjx.kinematics` |")[2].partition("\n")[0]
    ):
        assert name in nermo_mjx.kinematics.__all__


@pytest.mark.parametrize(
    ("former", "present"), re.findall(r"^\| `(nermo_mjx\.\S+)` \| `(\S+)` \|$", INTERFACE, re.M)
)
def test_a_former_name_works_and_warns(former: str, present: str) -> None:
    room, _, name = former.rpartition(".")
    home, _, new = present.rpartition(".")
    with pytest.warns(
        DeprecationWarning, match=rf"{re.escape(former)} is a former name.*: use {present}\.$"
    ) as caught:
        value = getattr(importlib.import_module(room), name)
    assert value is getattr(importlib.import_module(home), new)
    assert caught[0].filename == __file__, "the warning names the line that uses the name"
    assert name not in importlib.import_module(room).__all__
    with pytest.warns(DeprecationWarning, match=re.escape(former)):
        exec(f"from {room} import {name}")


def test_the_page_lists_every_former_name_of_a_module() -> None:
    listed = set(
        re.findall(
            r"^\| `(nermo_mjx\.\S+)` \|", INTERFACE.partition("| former name |")[2], re.MULTILINE
        )
    )
    rooms = [importlib.import_module(module) for module in MODULES if not module.endswith("_door")]
    former = {
        room.__name__: inspect.getclosurevars(room.__getattr__).nonlocals["former"] or ()
        for room in rooms
        if hasattr(room, "__getattr__")
    }
    assert len(former) == 4
    assert {f"{room}.{name}" for room, names in former.items() for name in names} == listed


def test_an_unknown_name_is_an_attribute_error() -> None:
    for module in ("nermo_mjx", "nermo_mjx.dynamics"):
        with pytest.raises(AttributeError, match=f"module '{module}' has no attribute 'unknown'"):
            getattr(importlib.import_module(module), "unknown")  # noqa: B009
    assert dir(nermo_mjx) == sorted(nermo_mjx.__all__)


def test_a_module_may_be_lazy_from_a_zip_archive(tmp_path: Path) -> None:
    """Its source is read through its loader."""
    import zipfile

    with zipfile.ZipFile(tmp_path / "room.zip", "w") as archive:
        archive.writestr(
            "room/__init__.py",
            "from typing import TYPE_CHECKING\nfrom nermo_mjx.lazy import lazy_names\nif TYPE_CHECKING:\n"
            "    from math import pi as pi, tau\n    from room import wing as wing\nelse:\n"
            "    __getattr__, __dir__, __all__ = lazy_names(__name__, half='math:pi')\n",
        )
        archive.writestr("room/wing.py", "")
    script = (
        f"import sys, warnings; sys.path.insert(0, {str(tmp_path / 'room.zip')!r}); import room; print(room.__all__);"
        "from room import *; print(pi, wing.__name__); warnings.simplefilter('error'); print(room.pi)\n"
        "try: room.half\nexcept DeprecationWarning as told: print(told)"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert process.stdout.splitlines() == [
        "('pi', 'wing')",
        "3.141592653589793 room.wing",
        "3.141592653589793",
        "room.half is a former name, which the next minor version will not accept: use math.pi.",
    ], process.stderr


# --- choices


def test_each_name_of_a_choice_is_implemented() -> None:
    """The names are those of the types, and the tables have an entry for each."""
    allowed = allowed_names(Setup)
    tables = {
        "gait": GAIT_PATTERNS,
        "physics": PRESETS,
        "steering": parameters.STEERING,
        "head": head_and_tail._HEAD_MODES,
        "tail_motion": head_and_tail._TAIL_MODES,
        "trajectory": (*trajectory.FORMS, stepping.FREE_TRAJECTORY),
        "pilot": ("open_loop", *path.PATHS, "waypoints", "external"),
    }
    assert {name: set(table) for name, table in tables.items()} == {
        name: set(allowed[name]) for name in tables
    }
    others = {
        "waypoints": {"waypoints": ((0.0, 0.0), (0.0, -1.0), (0.2, -2.0))},
        "external": {"command": lambda t: t},
    }
    for field, names in allowed.items():
        for name in names:
            tail = {"tail": "articulated"} if field == "tail_motion" else {}
            Setup(**{field: name}, **tail, **others.get(name, {}))
    assert allowed["robot"] == ("nermo_lite", "nermo_41", "author")
    assert set(allowed) == {
        *("robot", "tail", "routing", "cone", "physics", "feet"),
        *("gait", "steering", "profile", "pilot", "trajectory", "head", "tail_motion"),
    }


TYPED = """
from nermo_mjx import RobotConfig, Run, Setup, Simulator, load_robot
from nermo_mjx.control import Switch
Setup(gait="lateral_walk", spine="stride_extension", pilot="arc", physics="fast", tail="articulated")
Setup(gait="trott")
Setup(tail="articulate")
Setup(pilot="circle")
RobotConfig(feet="sphere")
load_robot(tail="rigid", cone="round")
Switch(1.0, head="glaze")
Simulator(Setup(head="gaze")).run({"frequency": 0.8}, Run(cycles=2)).metrics["speed"].mean()
"""


@pytest.mark.release
def test_a_type_checker_rejects_an_unknown_choice(tmp_path: Path) -> None:
    """In the lines with a wrong name, and nowhere else."""
    (tmp_path / "typed.py").write_text(TYPED)
    words = [sys.executable, "-m", "mypy", "--no-error-summary", str(tmp_path / "typed.py")]
    process = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    wrong = {
        int(line): message
        for line, message in re.findall(r"typed\.py:(\d+): error: (.*)", process.stdout)
    }
    expected = [
        number
        for number, line in enumerate(TYPED.splitlines(), 1)
        if re.search('trott|late"|circ|sphere|rou|gla', line)
    ]
    assert sorted(wrong) == expected, process.stdout + process.stderr
    assert all('expected "Literal[' in message for message in wrong.values())
