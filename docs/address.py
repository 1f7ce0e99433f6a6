"""Where the code is published: `Repository` under `[project.urls]` in pyproject.toml, the single place that defines it.

The line on how to get the code, the links to Colab, the badges of the notebooks and what they install follow from it:
`python docs/address.py` writes them, or removes them if there is no address. A test fails when they are out of date.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
UNPUBLISHED = (
    "The code has not been published yet: it comes as a folder or an archive. Run the commands in its top-level folder."
)


def repository(root: Path = ROOT) -> str | None:
    """The address in `pyproject.toml`; None as long as the code is not published.

    Raises:
        ValueError: it is no repository on GitHub, from which Colab opens notebooks.
    """
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address = project.get("urls", {}).get("Repository")
    if address is not None and not re.fullmatch(r"https://github\.com/[\w.-]+/[\w.-]+", address):
        raise ValueError(f"pyproject.toml: Repository is '{address}': expected https://github.com/OWNER/NAME.")
    return address


def source(address: str) -> str:
    """Where the repository shows its files."""
    return f"{address}/blob/main"


def texts(address: str | None, root: Path = ROOT) -> dict[Path, str]:
    """Every file that depends on the address, with its expected text."""
    notebooks = sorted((root / "notebooks").glob("*.ipynb"))
    contents = {path: json.loads(path.read_text(encoding="utf-8")) for path in notebooks}
    code = (
        UNPUBLISHED
        if address is None
        else f"Get the code: `git clone {address}`. Run the commands below in its folder."
    )
    links = ", ".join(f"[{_title(content)}]({_colab(address, path)})" for path, content in contents.items() if address)
    found = {path: _notebook(content, path, address) for path, content in contents.items()}
    for path in (root / "README.md", root / "docs" / "howto" / "colab.md"):
        text = _region(path.read_text(encoding="utf-8"), "code", f"\n{code}\n")
        found[path] = _region(text, "colab", f" Open one: {links}." if links else "")
    citation = root / "CITATION.cff"
    text = re.sub(r"^repository-code: .*\n", "", citation.read_text(encoding="utf-8"), flags=re.MULTILINE)
    line = "" if address is None else f"repository-code: {address}\n"
    found[citation] = re.sub(r"^license: .*\n", lambda match: match[0] + line, text, flags=re.MULTILINE)
    return found


def _notebook(content: dict[str, Any], path: Path, address: str | None) -> str:
    """A notebook with its badge below the title and the address in its install cell."""
    about, install = (content["cells"][place]["source"] for place in (0, 1))
    if about[2].startswith("[![Open in Colab]"):
        del about[2:4]
    if address is not None:
        badge = "https://colab.research.google.com/assets/colab-badge.svg"
        about[2:2] = [f"[![Open in Colab]({badge})]({_colab(address, path)})\n", "\n"]
    (place,) = (i for i, line in enumerate(install) if line.startswith("SOURCE = "))
    comment = install[place].partition("  # ")[2]
    install[place] = f'SOURCE = "{"" if address is None else f"git+{address}"}"  # {comment}'
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _title(content: dict[str, Any]) -> str:
    return content["cells"][0]["source"][0].removeprefix("# ").strip()


def _colab(address: str | None, path: Path) -> str:
    place = str(address).removeprefix("https://github.com/")
    return f"https://colab.research.google.com/github/{place}/blob/main/notebooks/{path.name}"


def _region(text: str, name: str, content: str) -> str:
    """A page with other content between the comments `name` and `/name`; a line that begins with one is no Markdown."""
    pattern = rf"(<!-- {name} -->).*?(<!-- /{name} -->)"
    return re.sub(pattern, lambda match: match[1] + content + match[2], text, flags=re.DOTALL)


if __name__ == "__main__":
    for path, text in texts(repository()).items():
        if text != path.read_text(encoding="utf-8"):
            path.write_text(text, encoding="utf-8")
            print(f"{path.relative_to(ROOT)} written")
