"""Controllers in spec files: which one a file names, and the copy of it that a directory keeps."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from nermo_mjx.control.loading import controller_digest
from nermo_mjx.robot.quantity import ParameterError, quantities
from nermo_mjx.rollout import Setup
from nermo_mjx.rollout.setup import with_controller
from nermo_mjx.specs.reading import Document, describe
from nermo_mjx.specs.values import NAMES

#: The copy of a controller's file in a directory.
KEPT: Final = "controller.py"


def named_controller(doc: Document) -> str | None:
    """What stands under `controller`; the path of a file counts from the folder of the document's."""
    given = doc.data.get("controller")
    if given is None:
        return None
    if not isinstance(given, str):
        doc.fail(("controller",), f"is {describe(given)}: expected FILE.py:NAME or MODULE:NAME.")
    source, colon, name = given.rpartition(":")
    if not source.endswith(".py"):
        return given
    path = (Path(doc.source).parent / source if doc.lines else Path(source)).expanduser().resolve()
    return f"{path}{colon}{name}"


@contextlib.contextmanager
def parameters_of(doc: Document) -> Iterator[None]:
    """While it is read, a document may name the parameters of its controller, and no others."""
    where = named_controller(doc)
    if where is None:
        yield
        return
    try:
        world = with_controller(None, where).world({})
    except ParameterError as error:
        doc.fail(("controller",), str(error).removeprefix("controller "))
    token = NAMES.set(dict(quantities(world)))
    try:
        yield
    finally:
        NAMES.reset(token)


def controller_identity(setup: Setup) -> dict[str, str]:
    """What of a setup's controller decides the results: its name and its file's content; nothing for the published."""
    if setup.controller is None:
        return {}
    where = written_controller(setup)
    return {"controller": f"{where.rpartition(':')[2]} {controller_digest(where)}"}


def written_controller(setup: Setup, folder: Path | None = None) -> str:
    """A setup's controller as it stands in a file of a folder.

    Raises:
        ParameterError: it was given as an object, which no file can name.
    """
    if not isinstance(setup.controller, str):
        kind = type(setup.controller).__name__
        raise ParameterError(f"controller is a {kind}: name it as FILE.py:NAME or MODULE:NAME, as a file can.")
    source, colon, name = setup.controller.rpartition(":")
    return f"{Path(source).name}{colon}{name}" if Path(source).parent == folder else setup.controller


def keep_controller(setup: Setup, folder: Path, write: Callable[[str, bytes], Any]) -> Setup:
    """The setup with the file of its controller in a directory, so that it can be moved.

    Args:
        setup: with any controller.
        folder: the directory, resolved.
        write: puts content under a name there.
    """
    if not isinstance(setup.controller, str) or not setup.controller.rpartition(":")[0].endswith(".py"):
        return setup
    source, colon, name = setup.controller.rpartition(":")
    if Path(source).parent == folder:
        return setup
    content = Path(source).read_bytes()
    own = folder / KEPT
    if own.exists() and own.read_bytes() != content:
        own = folder / f"controller-{hashlib.sha256(content).hexdigest()[:8]}.py"
    if not own.exists():
        write(own.name, content)
    return dataclasses.replace(setup, controller=f"{own}{colon}{name}")
