"""The documentation: the site is built without a warning, its examples work, its commands are those that exist."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import chromium
import pytest

from nermo_mjx import Recording
from nermo_mjx.cli import main
from nermo_mjx.view import robot_of

pytestmark = [pytest.mark.process, pytest.mark.usefixtures("shared_simulators")]

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
#: Its examples need a sweep, a recording and a servo table: tests/test_tables.py has them.
FILES = ROOT / "docs" / "files.md"


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page that are plainly of a language; those marked `no-test` are not."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


EXAMPLES = [
    pytest.param(page, text, id=f"{page.relative_to(ROOT / 'docs')}-{i}")
    for page in PAGES
    if page != FILES
    for i, text in enumerate(blocks(page, "python"))
]
COMMANDS = [
    pytest.param(line, id=f"{page.relative_to(ROOT / 'docs')}: {line}")
    for page in PAGES
    for block in blocks(page, "sh")
    for line in block.splitlines()
    if line.startswith("nermo-mjx ") and "$" not in line and not line.endswith("\\")
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site; a warning, such as a link that leads nowhere, fails its build."""
    out = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(ROOT / "docs"), str(out)]
    small = os.environ | {"NERMO_MJX_SMALL": "1"}  # one page of the viewer, not fourteen
    done = subprocess.run(words, env=small, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return out


def test_the_site_has_every_name_that_a_user_may_write(site: Path) -> None:
    import nermo_mjx
    from nermo_mjx.robot.quantity import gathered

    text = {page: (site / "reference" / f"{page}.html").read_text() for page in ("python", "parameters", "metrics")}
    for name in nermo_mjx.__all__:
        known = re.search(rf"nermo_mjx\.{name}\b", text["python"])
        assert known or name in ("LIMBS", "METRICS", "SERVOS", "ParameterError", "__version__", "kinematics"), name
    for names, _ in gathered(nermo_mjx.all_parameters()):  # of a row of numbers the first and the last one
        for name in names.split(" ... "):
            assert f">{name}<" in text["parameters"], name
    for name in nermo_mjx.METRICS:
        assert f">{name}<" in text["metrics"], name
    commands = (site / "reference" / "commands.html").read_text()
    for name in main.commands:
        assert f'id="nermo-mjx-{name}"' in commands, name


def test_each_page_is_in_the_site(site: Path) -> None:
    """Under its own name and with its own title: Sphinx writes pages such as search.html itself."""
    for page in PAGES:
        title = re.search(r"^# (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert title is not None, page
        made = (site / page.relative_to(ROOT / "docs")).with_suffix(".html").read_text(encoding="utf-8")
        (heading,) = re.findall(r"<h1>(.*?)<a class=\"headerlink\"", made)
        assert re.sub(r"<[^>]+>", "", heading) == re.sub(r"[`*]", "", title[1]), page


def test_recordings_of_the_pages_are_of_the_robot_that_there_is() -> None:
    paths = sorted((ROOT / "docs").rglob("walks/*/*.npz"))
    assert len(paths) > 10
    for path in paths:
        recording = Recording.load(path)
        recording.check_model(robot_of(recording).model)


def test_a_displayed_formula_has_room(site: Path, browser: chromium.Browser) -> None:
    """Else Chromium scrolls it up and down, with arrows beside it."""
    with browser.tab() as tab:
        tab.open(site / "control.html")
        tab.wait("document.readyState === 'complete' && document.querySelectorAll('.math-wrapper').length")
        heights = tab.evaluate(
            "[...document.querySelectorAll('.math-wrapper')].map(f => [f.scrollHeight, f.clientHeight])"
        )
    assert len(heights) >= 5
    assert [(needed, there) for needed, there in heights if needed > there] == []


def test_examples_were_found() -> None:
    assert len(EXAMPLES) >= 4
    assert len(COMMANDS) >= 8


@pytest.fixture
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """`beside(page)`: work in a folder that holds what the page tells a reader to save."""

    def work(page: Path) -> None:
        monkeypatch.chdir(tmp_path)
        for file in (page.parent / page.stem).glob("*.py"):
            shutil.copy(file, tmp_path)

    return work


@pytest.mark.parametrize(("page", "example"), EXAMPLES)
def test_an_example_works(page: Path, example: str, beside: Callable[[Path], None]) -> None:
    beside(page)
    names: dict[str, Any] = {}
    exec(compile(example, "example", "exec"), names)


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_is_valid(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its options and their values; files that a reader would have by then are put in its place."""
    name, *words = shlex.split(line, comments=True)[1:]
    monkeypatch.chdir(tmp_path)
    for word in words:
        if re.fullmatch(r"[\w/.-]+\.(yaml|npz)", word):
            Path(word).parent.mkdir(parents=True, exist_ok=True)
            Path(word).touch()
    words = ["maze" if (name, word) == ("experiment", "NAME") else word for word in words]
    assert main.commands[name].make_context(name, words) is not None


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page != FILES and blocks(page, "yaml")], ids=lambda page: page.stem
)
def test_a_spec_file_is_valid(page: Path, beside: Callable[[Path], None]) -> None:
    """One of a search has an objective."""
    from nermo_mjx.optimize import Search
    from nermo_mjx.sweep import Sweep

    beside(page)
    for text in blocks(page, "yaml"):
        if text.startswith(("apiVersion", "kind")):
            continue  # for Kubernetes
        if "\nobjective:" in text:
            assert Search.from_text(text).names
        else:
            assert Sweep.from_text(text).variants > 1
