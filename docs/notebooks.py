"""Runs the notebooks and stores their outputs: `python docs/notebooks.py [NOTEBOOK...]`, all of them by default.

A stored notebook is small. Figures have at most 256 colours. A film becomes one frame and a link to a film of the docs.
Pages and MP4 films are omitted, because no host of notebooks plays them. A digest of the code cells is stored in each
notebook, so that a test finds outputs of other code.
"""

from __future__ import annotations

import ast
import base64
import hashlib
import io
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbformat.v4 import new_output
from pictures import encode_png
from PIL import Image

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
#: Longer outputs in HTML are pages and videos; tables are shorter.
MOST_HTML = 50_000
LEFT_OUT = (
    "*Run this cell to see the page or film. The [gallery](../docs/gallery.md) shows similar ones.*"
)
FILM = "*One frame of the film. Run this cell to see the film, or watch [a similar one](../docs/images/walk.webp).*"


def code_digest(notebook: Any) -> str:
    """Names the code of a notebook, without its layout, its text and the first cell, which installs the package."""
    cells = [cell.source for cell in notebook.cells if cell.cell_type == "code"][1:]
    trees = [
        ast.dump(ast.parse(re.sub(r"(?m)^(\s*)([!%].*)$", r"\1r\"\"\"\2\"\"\"", code)))
        for code in cells
    ]
    return hashlib.sha256("\0".join(trees).encode()).hexdigest()[:16]


def shrink(notebook: Any) -> None:
    """Make the outputs of a notebook small."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [small for output in cell.outputs for small in _small(output)]


def _small(output: Any) -> list[Any]:
    """The outputs that are stored instead of one."""
    if output.get("name") == "stderr":  # progress is for who waits
        return []
    data = output.get("data", {})
    if len(data.get("text/html", "")) > MOST_HTML:
        output["data"] = {"text/markdown": LEFT_OUT, "text/plain": LEFT_OUT}
    for kind in ("image/gif", "image/png"):
        if kind in data:
            image = Image.open(io.BytesIO(base64.b64decode(data.pop(kind))))
            image.seek(getattr(image, "n_frames", 1) // 2)
            data["image/png"] = base64.b64encode(encode_png(image)).decode()
            if kind == "image/gif":
                return [
                    output,
                    new_output("display_data", {"text/markdown": FILM, "text/plain": FILM}),
                ]
    return [output]


def run(path: Path) -> None:
    """Run a notebook in an empty folder and store it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=3600, resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    shrink(notebook)
    notebook.metadata["code_digest"] = code_digest(notebook)
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for each in map(Path, sys.argv[1:] or sorted(NOTEBOOKS.glob("*.ipynb"))):
        run(each)
        print(f"{each.name}: {each.stat().st_size / 1e3:.0f} kB")
