# Tests of .ci/run
"""The files of an open project: licences, decisions of the owner, changelog, issue forms, and the hosted CI."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML
from tiers import needs

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
DECISIONS = ("Copyright holder", "Repository address", "DOI", "Security contact", "Release date")


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def yaml(name: str) -> Any:
    return YAML(typ="safe").load(text(name))


def test_the_licence_covers_the_vendored_code() -> None:
    assert PROJECT["license"] == "Apache-2.0 AND MIT"
    carried = {path for pattern in PROJECT["license-files"] for path in ROOT.glob(pattern)}
    assert {ROOT / "LICENSE", ROOT / "NOTICE"} <= carried
    vendor = ROOT / "nermo_mjx" / "view" / "web" / "vendor"
    versions = dict(
        re.findall(r"\b(three|meshoptimizer)@([\d.]+)", text("nermo_mjx/view/web/vendor/build.sh"))
    )
    folders = [path for path in vendor.iterdir() if path.is_dir()]
    assert {path.name for path in folders} == set(versions)
    for folder in folders:
        assert folder / "LICENSE" in carried
        assert folder.relative_to(ROOT).as_posix() in text("NOTICE")
        assert versions[folder.name] in text("NOTICE")
        (holder,) = re.findall(
            r"^Copyright (?:©|\(c\)) (.*)$", (folder / "LICENSE").read_text(), re.MULTILINE
        )
        assert f"Copyright {holder}." in text("NOTICE")


def test_each_decision_of_the_owner_is_one_line_and_its_files_exist() -> None:
    rows = re.findall(r"^\| (.+?) \| (.+?) \| .+? \| (.+) \|$", text("OWNER.md"), re.MULTILINE)[1:]
    assert tuple(name for name, _, _ in rows) == DECISIONS
    for _, _, files in rows:
        for file in re.findall(r"`(.+?)`", files):
            assert (ROOT / file).is_file(), file
    for name in ("SECURITY.md", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md"):
        assert "](OWNER.md)" in text(name)


def test_what_is_undecided_appears_nowhere() -> None:
    values = dict(re.findall(r"^\| (.+?) \| (.+?) \|", text("OWNER.md"), re.MULTILINE))
    undecided = {name for name in DECISIONS if values[name] == "undecided"}
    citation = text("CITATION.cff")
    for name, key in {
        "Repository address": "repository-code",
        "DOI": "doi",
        "Release date": "date-released",
    }.items():
        assert (re.search(f"^{key}:", citation, re.MULTILINE) is None) == (name in undecided), key
    assert ("urls" not in PROJECT) == ("Repository address" in undecided)
    assert ("not released" in text("CHANGELOG.md")) == ("Release date" in undecided)
    owners = {"OWNER", "a-rohr", *PROJECT.get("urls", {}).get("Repository", "").split("/")[-2:-1]}
    names = (
        "README.md",
        "CHANGELOG.md",
        "CONTRIBUTING.md",
        "SECURITY.md",
        "NOTICE",
        "CITATION.cff",
        "pyproject.toml",
    )
    for path in (
        *map(ROOT.joinpath, names),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "notebooks").glob("*.ipynb"),
    ):
        for owner in re.findall(
            r"github(?:\.com)?/([\w.-]+)/nermo", path.read_text(encoding="utf-8")
        ):
            assert owner in owners, path


def test_the_changelog_is_short_and_has_the_usual_headings() -> None:
    lines = text("CHANGELOG.md").splitlines()
    assert len(lines) <= 60
    assert {line for line in lines if line.startswith("###")} <= {
        f"### {name}" for name in ("Added", "Changed", "Deprecated", "Removed", "Fixed", "Security")
    }


@pytest.mark.parametrize("name", ["bug", "feature"])
def test_an_issue_form_asks_and_requires(name: str) -> None:
    form = yaml(f".github/ISSUE_TEMPLATE/{name}.yml")
    assert set(form) == {"name", "description", "labels", "body"}
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields)
    assert all(field["attributes"]["label"] for field in fields)
    assert any(field.get("validations", {}).get("required") for field in fields)


def test_the_hosted_ci_runs_each_part_and_the_parts_are_those_of_the_script() -> None:
    script = text(".ci/run")
    (listed,) = re.findall(r"^parts=\((.*)\)$", script, re.MULTILINE)
    parts = listed.split()
    assert set(parts) <= set(re.findall(r"^([\w-]+)\(\) \{$", script, re.MULTILINE))
    jobs = yaml(".github/workflows/ci.yml")["jobs"]
    matrix = jobs["part"]["strategy"]["matrix"]
    called = [*matrix["part"], *(entry["part"] for entry in matrix["include"]), "other-pythons"]
    assert sorted(called) == sorted(parts)
    assert jobs["part"]["steps"][-1]["run"] == ".ci/run ${{ matrix.part }}"
    assert jobs["other-pythons"]["steps"][-1]["run"] == ".ci/run other-pythons"
    admitted = {
        classifier.rsplit(" ", 1)[1]
        for classifier in PROJECT["classifiers"]
        if re.search(r":: 3\.\d+$", classifier)
    }
    assert set(matrix["python"]) == admitted
    versions = jobs["other-pythons"]["steps"][1]["with"]["python-version"].split()
    assert set(versions) == admitted


def test_a_part_that_does_not_exist_is_rejected_before_any_part_runs() -> None:
    process = subprocess.run(
        [ROOT / ".ci" / "run", "style", "moon"], capture_output=True, text=True
    )
    assert process.returncode == 2
    assert process.stdout == ""
    assert "no part moon: allowed are readme " in process.stderr


def test_pre_commit_runs_the_two_commands_of_the_ci() -> None:
    (repository,) = yaml(".pre-commit-config.yaml")["repos"]
    entries = [hook["entry"] for hook in repository["hooks"]]
    assert [entry.split()[:2] for entry in entries] == [["ruff", "check"], ["ruff", "format"]]
    floor = {name for hook in repository["hooks"] for name in hook["additional_dependencies"]}
    assert floor <= set(PROJECT["optional-dependencies"]["dev"])


@pytest.mark.extra
def test_the_site_leads_to_files_of_the_repository_once_its_address_is_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    needs("docutils", "latex2mathml", "sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    conf = importlib.import_module("conf")
    link = re.fullmatch(r"\[(.*)\]\((.*)\)", "[licence](LICENSE)")
    assert PROJECT.get("urls", {}).get("Repository") == conf.REPOSITORY
    monkeypatch.setattr(conf, "REPOSITORY", None)
    assert conf._file(link) == "licence (`LICENSE`)"
    monkeypatch.setattr(conf, "REPOSITORY", "https://github.com/someone/nermo_mjx")
    assert conf._file(link) == "[licence](https://github.com/someone/nermo_mjx/blob/main/LICENSE)"
    for name in ("conf", "results"):
        sys.modules.pop(name)
