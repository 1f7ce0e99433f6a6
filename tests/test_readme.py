"""What the README promises: its commands are those that CI runs, its examples work, its links lead somewhere."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from nermo_mjx.cli import main
from nermo_mjx.version import __version__

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def test_a_fresh_machine_needs_two_commands_of_one_line_each() -> None:
    fresh = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("python3 -m venv")]
    assert len(fresh) == 2
    assert fresh[0].endswith("nermo-mjx sweep sweeps/quickstart.yaml --out runs/quickstart")
    assert fresh[1].endswith("-m pytest")


def test_ci_runs_both_commands_of_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    patterns = dict(re.findall(r"^(job|tests)=\$\(grep -E '(.*)' README\.md\)$", script, re.MULTILINE))
    fresh = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("python3 -m venv")]
    for name, command in zip(("job", "tests"), fresh, strict=True):
        assert [line for line in README.splitlines() if re.search(patterns[name], line)] == [command]
    assert 'eval "$tests"' in script
    assert 'eval "${job/python3/$python}"' in script
    assert "\n.ci/wheel\n.ci/size\n" in script
    for name in ("run", "wheel", "size"):
        subprocess.run(["bash", "-n", str(ROOT / ".ci" / name)], check=True)


def test_the_sweep_of_the_first_command_and_the_example_are_valid() -> None:
    from nermo_mjx.sweep import Sweep

    assert Sweep.from_file(ROOT / "sweeps" / "quickstart.yaml").variants == 240
    (example,) = blocks("yaml")
    sweep = Sweep.from_text(example)
    assert sweep.variants == 9 * 13 * 3
    assert sweep.repeats == 3


def test_commands_of_the_readme_are_valid() -> None:
    table = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    assert {line.split()[0] for line in re.findall(r"nermo-mjx ([^`\n]+)", table)} == set(main.commands)
    for line in re.findall(r"nermo-mjx ([^`\n]+)", README + table):
        name, *words = [
            word.replace("FILE.npz", __file__)
            .replace("FILE.csv", __file__)
            .replace("NAME=X", "a=1")
            .replace("DIR", "docs")
            for word in line.split()
        ]
        words = ["maze" if (name, word) == ("experiment", "NAME") else word for word in words]
        assert main.commands[name].make_context(name, words) is not None
    for option in re.findall(r"`(--[a-z-]+)", README + table):
        helps = [CliRunner().invoke(main, [name, "--help"]).stdout for name in main.commands]
        assert any(option in text for text in helps), option


@pytest.mark.slow
def test_the_python_example_works() -> None:
    (example,) = blocks("python")
    short = example.replace("25)", "3)").replace("Run(cycles=6)", "Run(cycles=1, warmup_cycles=0)")
    assert short != example
    ast.parse(short)
    names: dict[str, Any] = {}
    exec(short, names)
    assert names["best"] in names["phases"]


def test_it_is_short() -> None:
    assert len(README.split()) <= 1300


def test_links_inside_the_repository_lead_somewhere() -> None:
    headings = re.findall(r"^## (.*)$", README, re.MULTILINE)
    anchors = {"#" + re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", README):
        assert target in anchors or (ROOT / target).exists(), target
    assert [anchor for anchor in anchors if f"]({anchor})" not in README] == []
    for target in re.findall(r"blob/main/([^)\s]+)", README):
        assert (ROOT / target).exists(), target


def test_one_version_everywhere() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text()
