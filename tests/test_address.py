# Tests of docs/address.py
"""The address of the published code is defined in one place; everything that depends on it follows."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
ADDRESS = "https://github.com/someone/nermo_mjx"
#: What users read, beside the files that depend on the address.
READ = [
    ROOT / "pyproject.toml",
    ROOT / "CHANGELOG.md",
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "sweeps").glob("*.[my]*"),
]


@pytest.fixture(scope="module")
def address() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))
        import address

        yield address
    sys.modules.pop("address")


@pytest.fixture
def copy(tmp_path: Path, address: ModuleType) -> Path:
    """All files that depend on the address, to change them."""
    for path in (ROOT / "pyproject.toml", *address.texts(None)):
        target = tmp_path / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    return tmp_path


def test_what_depends_on_the_address_is_up_to_date(address: ModuleType) -> None:
    """Else `python docs/address.py` is due."""
    for path, text in address.texts(address.repository()).items():
        assert path.read_text(encoding="utf-8") == text, path


def test_no_other_address_is_named_anywhere(address: ModuleType) -> None:
    """While the code is not published, there is none but the author's."""
    known = {"OWNER", "a-rohr", *(address.repository() or "").split("/")[-2:-1]}
    for path in (*READ, *address.texts(None)):
        for owner in re.findall(r"github(?:\.com)?/([\w.-]+)/nermo", path.read_text(encoding="utf-8")):
            assert owner in known, path


def test_an_address_brings_badges_links_and_what_notebooks_install(address: ModuleType, copy: Path) -> None:
    texts = {path.relative_to(copy).as_posix(): text for path, text in address.texts(ADDRESS, copy).items()}
    notebooks = {name: json.loads(text)["cells"] for name, text in texts.items() if name.startswith("notebooks/")}
    assert len(notebooks) == 8
    for name, (about, install, *_) in notebooks.items():
        opened = f"https://colab.research.google.com/github/someone/nermo_mjx/blob/main/{name})"
        assert opened in "".join(about["source"])
        assert f'SOURCE = "git+{ADDRESS}"' in "".join(install["source"])
        assert opened in texts["README.md"]
        assert opened in texts["docs/howto/colab.md"]
    assert f"git clone {ADDRESS}`" in texts["README.md"]
    assert address.UNPUBLISHED not in texts["README.md"]
    assert f"\nrepository-code: {ADDRESS}\n" in texts["CITATION.cff"]


def test_an_address_can_be_changed_and_taken_back(address: ModuleType, copy: Path) -> None:
    """Byte for byte, independent of the previous content."""
    before = address.texts(None, copy)
    for each in (ADDRESS.replace("someone", "else"), ADDRESS, ADDRESS):
        for path, text in address.texts(each, copy).items():
            path.write_text(text, encoding="utf-8")
        assert f"repository-code: {each}\n" in (copy / "CITATION.cff").read_text()
    assert address.texts(None, copy) == before


def test_the_address_is_read_from_pyproject(address: ModuleType, copy: Path) -> None:
    project = copy / "pyproject.toml"
    text = re.sub(r"^\[project.urls\]\n(.+\n)*", "", project.read_text(), flags=re.MULTILINE)
    project.write_text(text)
    assert address.repository(copy) is None
    project.write_text(f'{text}\n[project.urls]\nRepository = "{ADDRESS}"\n')
    assert address.repository(copy) == ADDRESS
    project.write_text(f'{text}\n[project.urls]\nRepository = "github.com/someone"\n')
    with pytest.raises(ValueError, match=r"Repository is 'github.com/someone': expected https://github.com/OWNER/NAME"):
        address.repository(copy)
