"""The documentation site: `sphinx-build docs build/site`. Its tables of names are made from the package itself."""

import os
import pathlib
import re
import sys
import tomllib
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

import nermo_mjx
from nermo_mjx import METRICS, all_parameters
from nermo_mjx.robot.quantity import gathered
from nermo_mjx.rollout.metric_table import HEADINGS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import results

ROOT = pathlib.Path(__file__).parents[1]
REPOSITORY = (
    tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    .get("urls", {})
    .get("Repository")
)
WALKS = ROOT / "docs" / "howto" / "terrain" / "walks"

project = "nermo_mjx"
version = release = nermo_mjx.__version__
author = "the nermo_mjx developers"
project_copyright = author

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_design",
]
source_suffix = {".md": "markdown"}
exclude_patterns: list[str] = []
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 3
smartquotes = False  # they would spoil options
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
suppress_warnings = ["myst.header"]

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "nermo_mjx"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_logo = "_static/mark.svg"
html_favicon = "_static/mark.svg"
html_theme_options = {
    f"{scheme}_css_variables": {
        f"color-brand-{part}": colour for part in ("primary", "content", "visited")
    }
    for scheme, colour in (("light", "#b3440a"), ("dark", "#ff9d5c"))
}
if REPOSITORY is not None:
    html_theme_options |= {
        "source_repository": REPOSITORY,
        "source_branch": "main",
        "source_directory": "docs/",
    }


def parameter_table() -> str:
    """Every parameter that a sweep may name, as Markdown."""
    rows = ["| name | default | unit | allowed | meaning |", "|---|--:|---|---|---|"]
    for name, about in sorted(gathered(all_parameters()), key=lambda each: each[0]):
        allowed = about.allowed().removesuffix(about.unit) if about.unit != "1" else about.allowed()
        name = " … ".join(f"`{each}`" for each in name.split(" ... "))
        rows.append(
            f"| {name} | {float(about.default):.6g} | {about.unit} | {allowed} | {about.doc} |"
        )
    return "\n".join(rows).replace("|a|^t", "\\|a\\|^t") + "\n"


def metric_table() -> str:
    """Every metric of a run, as Markdown."""
    rows = []
    for name, metric in METRICS.items():
        if name in HEADINGS:
            rows += [
                "",
                f"## {HEADINGS[name]}",
                "",
                "| name | unit | better | meaning |",
                "|---|---|---|---|",
            ]
        rows.append(f"| `{name}` | {metric.unit} | {metric.better or ''} | {metric.doc} |")
    return "\n".join(rows) + "\n"


def readme() -> str:
    """README.md below its title, with its links as those of a page of the docs."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n")[2]
    return re.sub(r"\]\((?!https?:|#|docs/)", "](../", text).replace("](docs/", "](")


def fill(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put tables where a page asks for them, and lead links to files that are no pages to the repository, if any.

    A page ends with how its results were made, and whether they are of the present body and code.
    """
    if docname == "index":
        app.env.note_dependency(ROOT / "README.md")
    for mark, table in (
        ("{{parameters}}", parameter_table),
        ("{{metrics}}", metric_table),
        ("{{readme}}", readme),
    ):
        if mark in source[0]:
            source[0] = source[0].replace(mark, table())
    up = "../" * (len(pathlib.Path(app.srcdir, docname).relative_to(ROOT).parts) - 1)
    link = rf"\[([^\]]*)\]\({re.escape(up)}((?:sweeps|notebooks|nermo_mjx|LICENSE|NOTICE|CITATION)\b[^)]*)\)"
    source[0] = re.sub(link, _file, source[0]) + results.footer(f"{docname}.md")


def _file(link: re.Match[str]) -> str:
    """A link to a file, or its text and its path."""
    text, path = link.groups()
    if REPOSITORY is not None:
        return f"[{text}]({REPOSITORY}/blob/main/{path})"
    return text if text.strip("`") in path else f"{text} (`{path}`)"


def formula(translator: Any, node: nodes.Element) -> None:
    """A formula as MathML, which browsers draw themselves, also without a network."""
    block = isinstance(node, nodes.math_block)
    translator.body.append(convert(node.astext(), display="block" if block else "inline"))
    raise nodes.SkipNode


def viewers(app: Sphinx, failure: Exception | None) -> None:
    """Write the pages of the viewer that docs/spine_on_terrain.md leads to: the free spine beside each other one."""
    if failure is not None or app.builder.format != "html":
        return
    courses = sorted(WALKS.glob("*/free.npz"))
    for free in courses[:1] if "NERMO_MJX_SMALL" in os.environ else courses:  # as in the tests
        for other in (free.with_name("stiff.npz"), free.with_name("passive.npz")):
            page = pathlib.Path(app.outdir, "viewer", f"{free.parent.name}-{other.stem}.html")
            if not page.exists() or page.stat().st_mtime < max(
                free.stat().st_mtime, other.stat().st_mtime
            ):
                nermo_mjx.show(free, other).save(page)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
    app.connect("source-read", fill)
    app.connect("build-finished", viewers)
