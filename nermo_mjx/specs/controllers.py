"""Custom controllers and metrics in spec files: what a file names, and the copies in a directory."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from nermo_mjx.control.protocol import FORM as CONTROLLER_FORM
from nermo_mjx.control.protocol import controller_digest, data_of
from nermo_mjx.control.schedule import MOST, Schedule
from nermo_mjx.files import MOST_ARRAYS, read_bytes
from nermo_mjx.robot.quantity import ParameterError, quantities
from nermo_mjx.rollout import Setup, all_metrics
from nermo_mjx.rollout.custom_metrics import FORM, KEPT, kept_metrics, metrics_digest, source_of
from nermo_mjx.specs.reading import Document, describe
from nermo_mjx.specs.values import MEASURED, NAMES

#: The copies of the files of a controller and of metrics in a directory.
KEPT_CONTROLLER: Final = "controller.py"
KEPT_METRICS: Final = "metrics.py"


def named_controller(doc: Document) -> str | None:
    """The field `controller`; paths are relative to the document's folder."""
    given = doc.data.get("controller")
    if given is None:
        return None
    if not isinstance(given, str):
        doc.fail(("controller",), f"is {describe(given)}: expected {CONTROLLER_FORM}.")
    return code_beside(doc, given)


def code_beside(doc: Document, where: str) -> str:
    """Custom code that a document names, with the path of its file, which is relative to the document's folder."""
    if (data := data_of(where)) is not None:
        path, code = data
        return f"{_beside(doc, path)}:{code_beside(doc, code)}" if code else str(_beside(doc, path))
    if where.endswith(".py"):
        return str(_beside(doc, where))
    source, colon, name = where.rpartition(":")
    return f"{_beside(doc, source)}{colon}{name}" if source.endswith(".py") else where


def named_metrics(doc: Document) -> tuple[str, ...]:
    """The field `metrics`; paths are relative to the document's folder."""
    given = doc.data.get("metrics")
    listed = [] if given is None else [given] if isinstance(given, str) else given
    if not isinstance(listed, list) or not all(isinstance(each, str) for each in listed):
        doc.fail(("metrics",), f"is {describe(given)}: expected {FORM}, or a list of such.")
    found = []
    for each in listed:
        try:
            source_of(each)
        except ParameterError as error:
            doc.fail(("metrics",), str(error).removeprefix("metrics "))
        found.append(code_beside(doc, each))
    return tuple(found)


def _beside(doc: Document, source: str) -> Path:
    """A file named in a document, relative to the document's folder."""
    return (Path(doc.source).parent / source if doc.lines else Path(source)).expanduser().resolve()


@contextlib.contextmanager
def known_names(doc: Document) -> Iterator[None]:
    """While it is read, a document may name the parameters of its controller, and no others, and its own metrics."""
    where, measured = named_controller(doc), named_metrics(doc)
    given = doc.data.get("schedule")
    switches = range(1, min(len(given), MOST) + 1) if isinstance(given, list) else ()
    if where is None and not measured and not switches:
        yield
        return
    try:
        own = Setup(controller=where, metrics=measured)
    except ParameterError as error:
        field, _, message = str(error).partition(" ")
        doc.fail((field,), message)
    known = dict(quantities(own.world({}))) if where is not None else NAMES.get()
    times = {
        f"schedule.{name}": about
        for name, about in quantities(Schedule)
        if int(name.split(".")[1]) in switches
    }
    names = NAMES.set({**known, **times})
    metrics = MEASURED.set(all_metrics(own))
    try:
        yield
    finally:
        NAMES.reset(names)
        MEASURED.reset(metrics)


def code_identity(setup: Setup) -> dict[str, str]:
    """The custom code of a setup that affects results: names and content of the files of its controller and metrics."""
    identity = {}
    if setup.controller is not None:
        where = written_controller(setup)
        name = where.rpartition(":")[2] if data_of(where) is None else "policy"
        identity["controller"] = f"{name} {controller_digest(where)}"
    if setup.metrics:
        names = ", ".join(each.name for each in setup.own_metrics)
        identity["metrics"] = f"{names} {' '.join(map(metrics_digest, written_metrics(setup)))}"
    return identity


def written_controller(setup: Setup, folder: Path | None = None) -> str:
    """A setup's controller as written in a file of a folder.

    Raises:
        ParameterError: it was given as an object, which no file can name.
    """
    if not isinstance(setup.controller, str):
        kind = type(setup.controller).__name__
        raise ParameterError(
            f"controller is a {kind}: name it as {CONTROLLER_FORM}, as a file can."
        )
    return written_code(setup.controller, folder)


def written_metrics(setup: Setup, folder: Path | None = None) -> list[str]:
    """A setup's custom metrics as written in a file of a folder.

    Raises:
        ParameterError: one was given as an object, which no file can name.
    """
    for each in setup.metrics:
        if not isinstance(each, str):
            raise ParameterError(
                f"metrics has {each.place}: name it as FILE.py:NAME or MODULE:NAME, as a file can."
            )
    return [written_code(str(each), folder) for each in setup.metrics]


def written_code(where: str, folder: Path | None) -> str:
    """Custom code as written in a file of a folder."""
    source, name = _split(where)
    if name and data_of(where) is not None:  # the code of a policy
        name = written_code(name, folder)
    path = Path(source).name if Path(source).parent == folder else source
    return f"{path}:{name}" if name else path


def with_code_copied(setup: Setup, folder: Path, write: Callable[[str, bytes], Any]) -> Setup:
    """The setup with the files of its controller and its metrics in a directory, so that it can be moved.

    Args:
        setup: with any controller and metrics.
        folder: the directory, resolved.
        write: puts content under a name there.
    """
    if isinstance(setup.controller, str):
        setup = dataclasses.replace(
            setup, controller=kept_code(setup.controller, KEPT_CONTROLLER, folder, write)
        )
    named = written_metrics(setup)
    if named:
        write(KEPT, kept_metrics(named))
    metrics = tuple(kept_code(each, KEPT_METRICS, folder, write) for each in named)
    return dataclasses.replace(setup, metrics=metrics) if metrics else setup


def kept_code(where: str, called: str, folder: Path, write: Callable[[str, bytes], Any]) -> str:
    """The name of custom code, with its file in a directory under the name that such files have there."""
    source, name = _split(where)
    if name and data_of(where) is not None:  # the code of a policy
        name = kept_code(name, Path(name).name, folder, write)
    elif not source.endswith(".py") and data_of(where) is None:
        return where
    if Path(source).parent == folder:
        return f"{source}:{name}" if name else source
    content = read_bytes(Path(source), MOST_ARRAYS)
    own = (folder / called).with_suffix(Path(source).suffix)
    if own.exists() and read_bytes(own, MOST_ARRAYS) != content:
        own = own.with_stem(f"{own.stem}-{hashlib.sha256(content).hexdigest()[:8]}")
    if not own.exists():
        write(own.name, content)
    return f"{own}:{name}" if name else str(own)


def _split(where: str) -> tuple[str, str]:
    """File or module, and the name in it, or for a file that is data the code that it needs."""
    if (data := data_of(where)) is not None:
        return data
    source = source_of(where)
    return source.place, source.name
