# Tests of notebooks, docs/notebooks.py
"""Notebooks run from top to bottom, at a small size, and carry the outputs of their code."""

from __future__ import annotations

import base64
import importlib
import importlib.util
import io
import json
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

from IPython.core.inputtransformer2 import TransformerManager  # noqa: E402
from nbclient import NotebookClient  # noqa: E402
from nbformat.v4 import new_code_cell, new_notebook, new_output  # noqa: E402
from PIL import Image  # noqa: E402

pytestmark = pytest.mark.extra

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
sys.path.append(str(ROOT / "docs"))
notebooks = importlib.import_module("notebooks")

INSTALL = nbformat.read(NOTEBOOKS[0], as_version=4).cells[1].source


#: As for other tests (conftest.py): few lanes for few worlds, and figures at half their size. An identification has
#: fewer starts and steps, and predicts walks of fewer bodies.
QUICK = """
import gc
import jax
from nermo_mjx.identify import identification, report
from nermo_mjx.physics import c_engine
from nermo_mjx.plotting import files
c_engine.BLOCK_WORLDS, files._FILE_DPI = 8, 100
identification.START_COUNT, identification.SCANNED_POINTS, identification.GAUSS_NEWTON_STEPS = 2, 8, 4
report.ENSEMBLE_SIZE = 8
gc.set_threshold(50_000, 20, 10)
jax.config.update("jax_traceback_in_locations_limit", 0)
"""


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NotebookClient]:
    """One kernel for all notebooks: it imports the package, and compiles what several use, once."""
    resources = {"metadata": {"path": tmp_path_factory.mktemp("kernel")}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NERMO_MJX_SMALL", "1")
        client = NotebookClient(
            new_notebook(), timeout=300, kernel_name="python3", resources=resources
        )
        with client.setup_kernel():
            client.nb = new_notebook(cells=[new_code_cell(QUICK)])
            client.execute(cleanup_kc=False)
            yield client


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, kernel: NotebookClient) -> None:
    """In a folder of its own, without any name of another notebook."""
    kernel.nb = notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, new_code_cell(f"%reset -f\n%cd -q {tmp_path}"))
    kernel.execute(cleanup_kc=False)
    outputs = [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]
    kinds = {kind for output in outputs for kind in output.get("data", {})}
    assert "image/png" in kinds, "a figure is shown"
    errors = "".join(
        output.text
        for output in outputs
        if output.output_type == "stream" and output.name == "stderr"
    )
    # Progress, the end of its line, and that something compiles, which depends on the cache.
    assert not [
        line for line in errors.splitlines() if not re.search(r"^$|^[a-z, ]+: \d+%|compiling", line)
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_shows_what_its_code_gave_and_installs_as_the_others_do(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.cells[1].source == INSTALL
    assert notebook.metadata.get("code_digest") == notebooks.code_digest(notebook), (
        "run docs/notebooks.py, look at the outputs"
    )
    outputs = [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert {output.output_type for output in outputs} <= {
        "stream",
        "execute_result",
        "display_data",
    }
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert path.stat().st_size < 500_000
    assert {kind for output in outputs for kind in output.get("data", {}) if "/" in kind} & {
        "image/gif",
        "video/mp4",
    } == set()
    assert not re.search(
        r"/(tmp|home|root|work)/", "".join(json.dumps(output.get("text", "")) for output in outputs)
    )


def test_a_film_is_stored_as_one_frame_and_a_link_and_a_figure_with_few_colours() -> None:
    film = io.BytesIO()
    first, *others = (Image.new("RGB", (8, 6), (40 * i, 0, 0)) for i in range(5))
    first.save(film, "gif", save_all=True, append_images=others)
    figure = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(figure, "png")
    outputs = [
        {"image/gif": base64.b64encode(film.getvalue()).decode(), "text/plain": "film"},
        {"image/png": base64.b64encode(figure.getvalue()).decode()},
        {"text/html": "<video>" + 60_000 * "x"},
    ]
    cell = new_code_cell("", outputs=[new_output("display_data", data) for data in outputs])
    cell.outputs.insert(0, new_output("stream", name="stderr", text="10%"))
    notebook = new_notebook(cells=[cell])
    notebooks.shrink(notebook)
    still, link, small, page = (output["data"] for output in notebook.cells[0].outputs)
    assert set(still) == {"image/png", "text/plain"}
    with Image.open(io.BytesIO(base64.b64decode(still["image/png"]))) as image:
        assert image.size == (8, 6)
        assert image.convert("RGB").getpixel((0, 0)) == (80, 0, 0)
    for text in (link["text/markdown"], page["text/markdown"]):
        for target in re.findall(r"\]\((.*?)\)", text):
            assert (ROOT / "notebooks" / target).resolve().exists(), target
    with Image.open(io.BytesIO(base64.b64decode(small["image/png"]))) as image:
        assert image.size == (50, 40)
        assert len(image.convert("RGB").getcolors()) <= 256


def installed(source: str = "") -> list[str]:
    """The commands that an install cell with a `SOURCE` would run."""
    ran: list[str] = []
    names: dict[str, Any] = {}
    shell = types.SimpleNamespace(
        run_line_magic=lambda name, line: ran.append(f"{name} {line.format(**names)}"),
        system=ran.append,
    )
    names["get_ipython"] = lambda: shell
    cell = INSTALL.replace('SOURCE = ""', f'SOURCE = "{source}"')
    exec(TransformerManager().transform_cell(cell), names)
    return ran


def test_a_notebook_installs_its_checkout_or_its_source_or_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = "git+https://example.org/a"
    assert installed(source) == [], "the package is there"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.chdir(ROOT / "notebooks")
    assert installed(source) == [f'pip install -q "{ROOT}" cma']
    monkeypatch.chdir(tmp_path)
    assert installed(source) == [f'pip install -q "{source}" cma']
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: name if name == "jax_cuda12_plugin" else None
    )
    assert installed(source) == [f'pip install -q "{source}" cma "jax[cuda12]"'], (
        "JAX keeps its GPU"
    )
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        RuntimeError,
        match="nermo_mjx is not installed: set SOURCE above, or open the notebook in a",
    ):
        installed()
    # In Colab an archive of the checkout or a wheel is chosen in the file dialogue.
    colab = types.ModuleType("google.colab")
    colab.files = types.SimpleNamespace(upload=lambda: {"nermo_mjx.zip": b""})
    monkeypatch.setitem(sys.modules, "google", types.ModuleType("google"))
    monkeypatch.setitem(sys.modules, "google.colab", colab)
    draw = "apt-get -qq install -y libosmesa6 > /dev/null"
    assert installed() == ['pip install -q "nermo_mjx.zip" cma', draw]
    assert installed("https://example.org/a.whl") == [
        'pip install -q "https://example.org/a.whl" cma',
        draw,
    ]
    colab.files.upload = dict  # the dialogue was closed
    with pytest.raises(RuntimeError, match="set SOURCE"):
        installed()
