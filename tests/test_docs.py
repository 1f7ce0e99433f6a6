# Tests of version.py, docs, README.md
"""README, documentation and docstrings: examples work, commands and links are valid, the site has all of them."""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import chromium
import pytest
from command import call
from tiers import needs

import nermo_mjx
from nermo_mjx import Recording
from nermo_mjx.cli import main
from nermo_mjx.version import __version__
from nermo_mjx.view import robot_of

pytestmark = pytest.mark.usefixtures("shared_simulators")

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
#: Pages of the site. What one needs for its examples, a sweep and a recording, is in tests/runs/test_tables.py.
PAGES = sorted((ROOT / "docs").rglob("*.md"))
TRIED = [README, *(page for page in PAGES if page != ROOT / "docs" / "files.md")]


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page that are plainly of a language; those marked `no-test` are not."""
    return re.findall(
        rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


EXAMPLES = [
    pytest.param(page, text, id=f"{page.relative_to(ROOT)}-{i}")
    for page in TRIED
    for i, text in enumerate(blocks(page, "python"))
]
LISTED = README.read_text(encoding="utf-8") + (
    ROOT / "docs" / "reference" / "commands.md"
).read_text(encoding="utf-8")
COMMANDS = re.findall(r"`(nermo-mjx [^`\n]+)`", LISTED) + [
    line
    for page in PAGES
    for block in blocks(page, "sh")
    for line in block.splitlines()
    if line.startswith("nermo-mjx ") and "$" not in line and not line.endswith("\\")
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site; a warning, such as a link that leads nowhere, fails its build."""
    needs("sphinx", "furo", "myst_parser")
    out = tmp_path_factory.mktemp("site")
    words = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        str(ROOT / "docs"),
        str(out),
    ]
    # One page of the viewer, not fourteen, and no pages of source code.
    small = os.environ | {"NERMO_MJX_SMALL": "1"}
    process = subprocess.run(words, env=small, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    return out


@pytest.mark.release
def test_the_site_has_each_page_and_every_name_that_a_user_may_write(site: Path) -> None:
    """Pages under their own names and titles: Sphinx writes pages such as search.html itself."""
    from nermo_mjx.robot.quantity import gathered

    text = {
        page.stem: page.read_text(encoding="utf-8") for page in (site / "reference").glob("*.html")
    }
    for name in nermo_mjx.__all__:
        match = re.search(rf"nermo_mjx\.{name}\b", text["python"])
        assert match or name in (
            "LIMBS",
            "METRICS",
            "SERVOS",
            "ParameterError",
            "__version__",
            "kinematics",
        ), name
    # Of a row of numbers the first and the last one.
    parameters = [
        name for names, _ in gathered(nermo_mjx.all_parameters()) for name in names.split(" ... ")
    ]
    marks = {
        "parameters": [f">{name}<" for name in parameters],
        "metrics": [f">{name}<" for name in nermo_mjx.METRICS],
        "commands": [f'id="nermo-mjx-{name}"' for name in main.commands],
    }
    assert {
        page: [mark for mark in names if mark not in text[page]] for page, names in marks.items()
    } == {page: [] for page in marks}
    for page in PAGES:
        title = re.search(r"^# (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert title is not None, page
        page_text = (
            (site / page.relative_to(ROOT / "docs"))
            .with_suffix(".html")
            .read_text(encoding="utf-8")
        )
        (heading,) = re.findall(r"<h1>(.*?)<a class=\"headerlink\"", page_text)
        assert re.sub(r"<[^>]+>", "", heading) == re.sub(r"[`*]", "", title[1]), page


@pytest.mark.release
def test_a_displayed_formula_has_room(site: Path, browser: chromium.Browser) -> None:
    """Else Chromium scrolls it up and down, with arrows beside it."""
    with browser.tab() as tab:
        tab.open(site / "control.html")
        tab.wait(
            "document.readyState === 'complete' && document.querySelectorAll('.math-wrapper').length"
        )
        heights = tab.evaluate(
            "[...document.querySelectorAll('.math-wrapper')].map(f => [f.scrollHeight, f.clientHeight])"
        )
    assert len(heights) >= 5
    assert [(required, available) for required, available in heights if required > available] == []


@pytest.mark.release
def test_recordings_of_the_pages_are_of_the_robot_that_there_is() -> None:
    paths = sorted((ROOT / "docs").rglob("walks/*/*.npz"))
    assert len(paths) > 10
    for path in paths:
        recording = Recording.load(path)
        recording.check_model(robot_of(recording).model)


@pytest.fixture
def page_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """`page_folder(page)`: work in a folder that holds what the page tells a reader to save."""

    def work(page: Path) -> None:
        monkeypatch.chdir(tmp_path)
        for file in (page.parent / page.stem).glob("*.py"):
            shutil.copy(file, tmp_path)

    return work


@pytest.mark.release
@pytest.mark.parametrize(("page", "example"), EXAMPLES)
def test_an_example_works(page: Path, example: str, page_folder: Callable[[Path], None]) -> None:
    """That of the README at a small size."""
    page_folder(page)
    short = example.replace("25)", "3)").replace("Run(cycles=6)", "Run(cycles=1, warmup_cycles=0)")
    assert (short != example) == (page == README)
    exec(compile(short, "example", "exec"), {})


@pytest.mark.parametrize("line", sorted(set(COMMANDS)))
def test_a_command_is_valid(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its options and their values; files that a reader would have by then are put in its place."""
    name, *words = shlex.split(line, comments=True)[1:]
    monkeypatch.chdir(tmp_path)
    for word in words:
        if re.fullmatch(r"[\w/.-]+\.(yaml|npz|csv)", word):
            Path(word).parent.mkdir(parents=True, exist_ok=True)
            Path(word).touch()
    if "--body" in words:
        folder = Path(words[words.index("--body") + 1])
        folder.mkdir(parents=True)
        (folder / "ensemble.csv").write_text("servo.kp,objective,weight\n19,1,1\n")
    words = ["maze" if (name, word) == ("experiment", "NAME") else word for word in words]
    assert main.commands[name].make_context(name, words) is not None


def test_the_pages_name_every_command_and_no_other_option() -> None:
    assert {line.split()[1] for line in COMMANDS} == set(main.commands)
    helps = "".join(call(name, "--help").stdout for name in main.commands)
    for option in re.findall(r"`(--[a-z-]+)", LISTED):
        assert option in helps, option


@pytest.mark.parametrize(
    "page", [page for page in TRIED if blocks(page, "yaml")], ids=lambda page: page.stem
)
def test_a_spec_file_is_valid(page: Path, page_folder: Callable[[Path], None]) -> None:
    """One of a search has an objective, and one of a robot's log channels."""
    from nermo_mjx.hardware.log import LogFields
    from nermo_mjx.optimize import Search
    from nermo_mjx.specs.fields import read
    from nermo_mjx.specs.reading import read_text
    from nermo_mjx.sweep import Sweep

    page_folder(page)
    for text in blocks(page, "yaml"):
        if text.startswith(("apiVersion", "kind")):
            continue  # for Kubernetes
        if "\nchannels:" in text:
            assert read(read_text(text, page.name), LogFields).channels
        elif "\nobjective:" in text:
            assert Search.from_text(text).names
        else:
            assert Sweep.from_text(text).variants > 1


# --- docstrings

PACKAGE = Path(nermo_mjx.__file__).parent
WITH_EXAMPLES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
#: What runs for minutes, needs a directory or a GPU, or draws: notebooks and pages run them.
ELSEWHERE = {
    "find_row",
    "identify_log",
    "read_history",
    "read_table",
    "render",
    "replay_row",
    "run_experiment",
    "run_experiments",
    "run_identification",
    "run_training",
    "run_tuning",
    "show",
    "write_identification",
}


@pytest.mark.release
@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_examples_of_a_module_run(name: str) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(name))
    assert attempted > 0
    assert failed == 0


def test_every_public_function_has_an_example() -> None:
    public = {name: getattr(nermo_mjx, name) for name in nermo_mjx.__all__}
    # The tests' shared simulators stand in for a class here.
    functions = {
        name: function
        for name, function in public.items()
        if inspect.isfunction(function) and "nermo" in function.__module__
    }
    without = {
        name for name, function in functions.items() if ">>> " not in (function.__doc__ or "")
    }
    assert without - {"quantity"} == ELSEWHERE  # `parameter_tree` shows both


# --- README


def test_ci_runs_the_two_commands_that_a_fresh_machine_needs() -> None:
    from nermo_mjx.sweep import Sweep

    lines = README.read_text(encoding="utf-8").splitlines()
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    patterns = dict(
        re.findall(r"^(job|tests)=\$\(grep -E '(.*)' README\.md\)$", script, re.MULTILINE)
    )
    fresh = [
        line
        for line in "".join(blocks(README, "sh")).splitlines()
        if line.startswith("python3 -m venv")
    ]
    commands = [
        [line for line in lines if re.search(patterns[name], line)] for name in ("job", "tests")
    ]
    assert commands == [[line] for line in fresh]
    assert fresh[0].endswith("nermo-mjx sweep sweeps/quickstart.yaml --out runs/quickstart")
    assert fresh[1].endswith("-m pytest")
    parts = dict(re.findall(r"^([\w-]+)\(\) \{\n(.*?)^\}$", script, re.MULTILINE | re.DOTALL))
    for part, line in {
        "main_job": 'eval "${job/python3/$python}"',
        "default_tests": 'eval "${tests/python3/$python}"',
        "readme": "main_job python3",
        "release": "pytest -m '(release or extra) and not long'",
        "wheel": ".ci/wheel",
        "other-pythons": 'default_tests "$python"',
        "style": "ruff format --check",
    }.items():
        assert line in parts[part]
    assert "default_tests python3" in parts["readme"]
    assert 'main_job "$python"' in parts["other-pythons"]
    assert ".ci/size" in parts["style"]
    assert ".ci/names" in parts["style"]
    for name in ("run", "wheel"):
        subprocess.run(["bash", "-n", str(ROOT / ".ci" / name)], check=True)
    assert Sweep.from_file(ROOT / "sweeps" / "quickstart.yaml").variants == 240
    (example,) = blocks(README, "yaml")
    sweep = Sweep.from_text(example)
    assert (sweep.variants, sweep.repeats) == (9 * 13 * 3, 3)


def test_the_readme_is_short_and_its_links_lead_somewhere() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.split()) <= 1800
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    anchors = {
        "#" + re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings
    }
    for target in re.findall(r'(?:\]\((?!https?:)|blob/main/|src=")([^)"\s]+)', text):
        assert target in anchors or (ROOT / target.partition("#")[0]).exists(), target
    assert [anchor for anchor in anchors if f"]({anchor})" not in text] == []


def test_one_version_everywhere() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text()
