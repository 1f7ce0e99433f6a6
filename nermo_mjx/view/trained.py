"""The page of a training's directory: its curves, its evaluation, and a walk of its policy in 3D."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib import rc_context

from nermo_mjx.learn.directory import EVALUATION_FILE, POLICY_FILE, SPEC_FILE
from nermo_mjx.learn.evaluation import POLICY, record_walks, summarize_walks
from nermo_mjx.learn.own import custom_code_file
from nermo_mjx.learn.plots import training_figures
from nermo_mjx.learn.policy import evaluation_physics, load_policy
from nermo_mjx.learn.spec import Training
from nermo_mjx.plotting.files import Figures, lay_out
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.robot.scene import scene_name
from nermo_mjx.runs.files import content_of, parquet_table
from nermo_mjx.runtime import start_jax
from nermo_mjx.trust import CODE_EXECUTION
from nermo_mjx.view.clip import page_of
from nermo_mjx.view.page import Page, web_file

_TABLE_HEADINGS: Final = (
    "",
    "",
    "success [%]",
    "speed [mm/s]",
    "distance [m]",
    "cost, mechanical",
    "cost, electrical",
)
#: Of a walk in the evaluation's summary: factor and digits.
_NUMBER_FORMATS: Final = {
    "success": (100.0, 0),
    "speed": (1e3, 1),
    "distance": (1.0, 2),
    "cost_of_transport": (1.0, 2),
    "electrical_cost_of_transport": (1.0, 1),
}


def trained(path: Path, *, engine: str = "c", reload: float | None = None) -> Page:
    """The page of a training, which may be unfinished; the directory is only read.

    With `reload` a browser loads the page anew after so many seconds.

    The policy walks once on each scene of the evaluation, from its first unseen start, on its first unseen body.

    Raises:
        SpecError: its training.yaml cannot be read.
        DirectoryError: no section of it is finished, or it cannot be read.
    """
    start_jax()
    training, figures = Training.from_file(path / SPEC_FILE), training_figures(path)
    name, parts, samples = html.escape(path.resolve().name), list[str](), 0
    code = custom_code_file(training.task.observe)
    if code and not CODE_EXECUTION.get():
        code_name = html.escape(Path(code).name)
        parts.append(
            f"<p>The policy observes functions of {code_name}, which a command that only reads does not run.</p>"
        )
    elif (path / POLICY_FILE).exists():
        for scene, recording in record_walks(
            training, load_policy(path / POLICY_FILE, code), engine
        ):
            page = page_of([recording], ["A"], 520)
            parts.append(f"<h2>The policy on {html.escape(scene)}</h2>{page._repr_html_()}")
            samples = max(samples, page.samples)
    if (content := content_of(path / EVALUATION_FILE)) is not None:
        judged = evaluation_physics(training.evaluated()[0][0])
        conditions = f"On {training.evaluation.bodies:,} unseen bodies and starts, in physics {judged['physics']}; medians."
        table = _table(summarize_walks(parquet_table(content)))
        parts.append(
            f'<h2>Evaluation</h2><p>{conditions}</p><div class="wide"><table>{table}</table></div>'
        )
    if reload is not None:
        parts.insert(0, f'<meta http-equiv="refresh" content="{reload:g}">')
    return Page(offline_page(name, "a training", parts, figures), 680, samples)


def offline_page(name: str, what: str, parts: Sequence[str], figures: Figures) -> str:
    """A self-contained page of a directory: its parts, HTML each, and then its figures by name.

    Args:
        name: of the directory, escaped.
        what: is in it.
    """
    parts = list(parts)
    with rc_context(STYLE):
        for title, figure in figures:
            lay_out(figure)
            file = io.BytesIO()
            figure.savefig(file, format="svg", metadata={"Date": None})
            parts.append(image(title, file.getvalue()))
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    )
    head += f"<title>Nermo: {name}, {what}</title><style>{web_file('trained.css')}</style>"
    body = f"<header><h1>{name}</h1></header><main>{''.join(parts)}</main>"
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>'


def image(title: str, svg: bytes) -> str:
    """The part of a page that shows an SVG image below its title."""
    source = f"data:image/svg+xml;base64,{base64.b64encode(svg).decode('ascii')}"
    return f'<h2>{title.capitalize()}</h2><img alt="{html.escape(title)}" src="{source}">'


def _table(results: dict[str, Any]) -> str:
    """The evaluation: shares of successes, and medians."""
    rows = ["".join(f"<th>{heading}</th>" for heading in _TABLE_HEADINGS)]
    for scene, walkers in results.items():
        for walker, numbers in walkers.items():
            cells = [
                f"{factor * numbers[key]:.{digits}f}"
                for key, (factor, digits) in _NUMBER_FORMATS.items()
            ]
            called = "policy" if walker == POLICY else "controller alone"
            rows.append(
                "".join(
                    f"<td>{html.escape(heading)}</td>"
                    for heading in (scene_name(scene), called, *cells)
                )
            )
    return "".join(f"<tr>{row}</tr>" for row in rows)
