"""Custom controllers and metrics in spec files: what a file names, and the copies in a directory."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from nermo_mjx.control.protocol import CONTROLLER_FORM, controller_digest, data_of
from nermo_mjx.control.schedule import MAX_SWITCHES, Schedule
from nermo_mjx.files import MAX_ARRAY_BYTES, read_bytes
from nermo_mjx.robot.quantity import ParameterError, quantities
from nermo_mjx.rollout import Setup, all_metrics
from nermo_mjx.rollout.custom_metrics import (
    FORM,
    METRICS_FILE,
    kept_metrics,
    metrics_digest,
    source_of,
)
from nermo_mjx.specs.reading import Document, describe
from nermo_mjx.specs.values import FILE_METRICS, FILE_PARAMETERS

#: The copies of the files of a controller and of metrics in a directory.
CONTROLLER_COPY: Final = "controller.py"
METRICS_COPY: Final = "metrics.py"


def named_controller(doc: Document) -> str | None:
    """The field `controller`; paths are relative to the document's folder."""
    name = doc.data.get("controller")
    if name is None:
        return None
    if not isinstance(name, str):
        doc.fail(("controller",), f"is {describe(name)}: expected {CONTROLLER_FORM}.")
    return code_beside(doc, name)


def code_beside(doc: Document, reference: str) -> str:
    """Custom code that a document names, with the path of its file, which is relative to the document's folder."""
    if (data := data_of(reference)) is not None:
        path, code = data
        return f"{_beside(doc, path)}:{code_beside(doc, code)}" if code else str(_beside(doc, path))
    if reference.endswith(".py"):
        return str(_beside(doc, reference))
    source, colon, name = reference.rpartition(":")
    return f"{_beside(doc, source)}{colon}{name}" if source.endswith(".py") else reference


def named_metrics(doc: Document) -> tuple[str, ...]:
    """The field `metrics`; paths are relative to the document's folder."""
    names = doc.data.get("metrics")
    listed = [] if names is None else [names] if isinstance(names, str) else names
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        doc.fail(("metrics",), f"is {describe(names)}: expected {FORM}, or a list of such.")
    metrics = []
    for name in listed:
        try:
            source_of(name)
        except ParameterError as error:
            doc.fail(("metrics",), str(error).removeprefix("metrics "))
        metrics.append(code_beside(doc, name))
    return tuple(metrics)


def _beside(doc: Document, source: str) -> Path:
    """A file named in a document, relative to the document's folder."""
    return (Path(doc.source).parent / source if doc.lines else Path(source)).expanduser().resolve()


@contextlib.contextmanager
def known_names(doc: Document) -> Iterator[None]:
    """While it is read, a document may name the parameters of its controller, and no others, and its own metrics."""
    controller, measured = named_controller(doc), named_metrics(doc)
    schedule = doc.data.get("schedule")
    switches = range(1, min(len(schedule), MAX_SWITCHES) + 1) if isinstance(schedule, list) else ()
    if controller is None and not measured and not switches:
        yield
        return
    try:
        setup = Setup(controller=controller, metrics=measured)
    except ParameterError as error:
        field, _, message = str(error).partition(" ")
        doc.fail((field,), message)
    parameters = (
        dict(quantities(setup.world({}))) if controller is not None else FILE_PARAMETERS.get()
    )
    times = {
        f"schedule.{name}": declaration
        for name, declaration in quantities(Schedule)
        if int(name.split(".")[1]) in switches
    }
    names = FILE_PARAMETERS.set({**parameters, **times})
    metrics = FILE_METRICS.set(all_metrics(setup))
    try:
        yield
    finally:
        FILE_PARAMETERS.reset(names)
        FILE_METRICS.reset(metrics)


def code_identity(setup: Setup) -> dict[str, str]:
    """The custom code of a setup that affects results: names and content of the files of its controller and metrics."""
    identity = {}
    if setup.controller is not None:
        controller = written_controller(setup)
        name = controller.rpartition(":")[2] if data_of(controller) is None else "policy"
        identity["controller"] = f"{name} {controller_digest(controller)}"
    if setup.metrics:
        names = ", ".join(metric.name for metric in setup.own_metrics)
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
    for metric in setup.metrics:
        if not isinstance(metric, str):
            raise ParameterError(
                f"metrics has {metric.place}: name it as FILE.py:NAME or MODULE:NAME, as a file can."
            )
    return [written_code(str(metric), folder) for metric in setup.metrics]


def written_code(reference: str, folder: Path | None) -> str:
    """Custom code as written in a file of a folder."""
    source, name = _split(reference)
    if name and data_of(reference) is not None:  # the code of a policy
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
            setup, controller=kept_code(setup.controller, CONTROLLER_COPY, folder, write)
        )
    references = written_metrics(setup)
    if references:
        write(METRICS_FILE, kept_metrics(references))
    metrics = tuple(kept_code(reference, METRICS_COPY, folder, write) for reference in references)
    return dataclasses.replace(setup, metrics=metrics) if metrics else setup


def kept_code(reference: str, called: str, folder: Path, write: Callable[[str, bytes], Any]) -> str:
    """The name of custom code, with its file in a directory under the name that such files have there."""
    source, name = _split(reference)
    if name and data_of(reference) is not None:  # the code of a policy
        name = kept_code(name, Path(name).name, folder, write)
    elif not source.endswith(".py") and data_of(reference) is None:
        return reference
    if Path(source).parent == folder:
        return f"{source}:{name}" if name else source
    content = read_bytes(Path(source), MAX_ARRAY_BYTES)
    copy = (folder / called).with_suffix(Path(source).suffix)
    if copy.exists() and read_bytes(copy, MAX_ARRAY_BYTES) != content:
        copy = copy.with_stem(f"{copy.stem}-{hashlib.sha256(content).hexdigest()[:8]}")
    if not copy.exists():
        write(copy.name, content)
    return f"{copy}:{name}" if name else str(copy)


def _split(reference: str) -> tuple[str, str]:
    """File or module, and the name in it, or for a file that is data the code that it needs."""
    if (data := data_of(reference)) is not None:
        return data
    source = source_of(reference)
    return source.place, source.name
