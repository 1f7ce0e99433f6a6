"""Run the notebooks and keep what they show: `python docs/notebooks.py [NOTEBOOK...]`, all of them by default.

Pages and videos are left out, as each weighs megabytes and no host of notebooks plays them. A digest of the code cells
stands in each notebook, so that a test finds outputs of other code.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
#: Longer outputs in HTML are pages and videos; tables are shorter.
MOST_HTML = 50_000
LEFT_OUT = "*Run this cell to see the page or video; it is left out of the stored notebook.*"


def code_digest(notebook: Any) -> str:
    """Names the code of a notebook, without its text and the first cell, which installs the package."""
    code = "\0".join([cell.source for cell in notebook.cells if cell.cell_type == "code"][1:])
    return hashlib.sha256(code.encode()).hexdigest()[:16]


def run(path: Path) -> None:
    """Run a notebook in an empty folder and store it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=3600, resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":  # progress is for who waits
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        for output in cell.get("outputs", []):
            if len(output.get("data", {}).get("text/html", "")) > MOST_HTML:
                output["data"] = {"text/markdown": LEFT_OUT, "text/plain": LEFT_OUT}
    notebook.metadata["code_digest"] = code_digest(notebook)
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for each in map(Path, sys.argv[1:] or sorted(NOTEBOOKS.glob("*.ipynb"))):
        run(each)
        print(f"{each.name}: {each.stat().st_size / 1e3:.0f} kB")
