"""A results directory of any kind: who may write it, what it is for, and which code made its contents.

DIR/.lock       held by the writing process
DIR/run.json    kind; `codes`, which code made rows, by its short name; `sessions`, each with command, versions, machine
                (`files`: path -> digest of what the program wrote, where a user's may be in the way, see `written`)
DIR/*.aside-N   files that did not match, renamed: nothing is deleted that a user may want back
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from nermo_mjx.runs.code import CodeStamp, known
from nermo_mjx.runs.files import (
    TEMPORARY,
    DirectoryError,
    WrongDirectory,
    clear_errors,
    make_writable,
    replace_file,
    sync_folder,
)
from nermo_mjx.runs.lock import hold

RUN: Final = "run.json"


class OtherCode(WrongDirectory):
    """A directory that other code made; the message names the difference."""


class RunDirectory:
    """A directory held by this process; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        kind: what it is for, such as "sweep".
        shard: (i, n) if n processes write it together, of which this is one.

    Raises:
        DirectoryError: on entry: it holds another kind, is in use, or cannot be written.
    """

    def __init__(self, out: str | os.PathLike[str], kind: str, shard: tuple[int, int] | None = None) -> None:
        self.out, self.kind, self.shard = Path(out), kind, shard
        self._held = contextlib.ExitStack()

    def __enter__(self) -> RunDirectory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            make_writable(self.out)
            stack.callback(os.close, hold(self.out, shared=self.shard is not None))
            if self.shard is not None:
                stack.callback(os.close, hold(self.out, f".lock-{self.shard[0]}-of-{self.shard[1]}"))
            found = kind_of(self.out)
            if found not in (None, self.kind):
                raise WrongDirectory(
                    f"{self.out} holds {_with_article(str(found))}, and not {_with_article(self.kind)}: choose another "
                    "directory."
                )
            if self.shard is None:
                remove_leftovers(self.out)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def write(self, path: str | Path, content: bytes) -> None:
        """Replace a file of the directory, atomically and durably.

        Args:
            path: of the file, from the directory if it is relative.

        Raises:
            DirectoryError: it cannot be written; what was there is still there.
        """
        with clear_errors(self.out):
            replace_file(self.out / path, content)

    def move_aside(self, path: str | Path, folder: str | None = None) -> Path | None:
        """Rename a file or folder of the directory to mark it as unused; returns its new path, None if it is absent.

        Args:
            folder: of the directory, for what readers of the folder it is in would take for one of theirs.

        Raises:
            DirectoryError: it cannot be renamed.
        """
        source = self.out / path
        if not source.exists():
            return None
        into = source.parent if folder is None else self.out / folder
        with clear_errors(self.out):
            into.mkdir(exist_ok=True)
            count = 1
            while (target := into / f"{source.name}.aside-{count}").exists():
                count += 1
            try:
                source.rename(target)
            except FileNotFoundError:  # another process was faster
                return None
            sync_folder(into)
            sync_folder(source.parent)
        return target

    def set_aside(self, what: str, names: Iterable[str], warn: Callable[[str], None]) -> None:
        """Move existing files aside, with a message about each."""
        for name in names:
            if (aside := self.move_aside(name)) is not None:
                warn(f"{self.out / name} is {what}; it is kept as {aside.name}.")

    def take_code(self, stamp: CodeStamp, *, holds_rows: bool, accept: bool = False, any_model: bool = False) -> None:
        """Record that this code is about to add rows, or refuse: the rows of one directory are made by one code.

        Of several processes that begin together, the first one's code counts. A sole holder of a directory
        without rows starts it afresh.

        Args:
            stamp: of the code that runs here.
            holds_rows: whether the directory holds rows already.
            accept: add the code to those that the directory knows, whatever they are.
            any_model: whether the directory holds rows of several models, so that another one is no other code.

        Raises:
            OtherCode: what is there was made by other code, and `accept` is not given.
        """
        with self._record() as record:
            codes = record.setdefault("codes", {})
            if self.shard is None and not holds_rows:
                codes.clear()
            if stamp.id not in codes:
                begun = known(next(reversed(codes.values()), None))
                if begun is not None and any_model:
                    begun = dataclasses.replace(begun, model=stamp.model)
                if begun is not None and begun != stamp and not accept:
                    raise OtherCode(
                        f"{self.out} was made by other code: {begun.unlike(stamp)}; use that, choose another "
                        "directory, or resume with --accept-new-code, and distinguish the rows by their column code."
                    )
                if begun is None and holds_rows and not accept:
                    raise OtherCode(
                        f"{self.out} does not say which code made it: choose another directory, or "
                        "resume with --accept-new-code, and distinguish the rows by their column code."
                    )
                codes[stamp.id] = stamp.fields()

    def note_files(self, files: Mapping[str, str]) -> None:
        """Record which files the program wrote (`written.Written`)."""
        with self._record() as record:
            record["files"] = dict(files)

    def note_session(self, session: dict[str, Any]) -> None:
        """Add this session (`provenance.session`)."""
        with self._record() as record:
            record.setdefault("sessions", []).append(session)

    @contextlib.contextmanager
    def _record(self) -> Iterator[dict[str, Any]]:
        """The content of run.json, written back if changed; processes take turns."""
        with clear_errors(self.out):
            held = hold(self.out, ".lock-run", wait=True)
            try:
                before = read_record(self.out)
                record = json.loads(json.dumps({"kind": self.kind} | before))
                yield record
                if record != before:
                    replace_file(self.out / RUN, (json.dumps(record, indent=2) + "\n").encode())
            finally:
                os.close(held)


def read_record(out: Path) -> dict[str, Any]:
    """The content of a directory's run.json; empty if there is none.

    Raises:
        DirectoryError: it is damaged.
    """
    try:
        record = json.loads((out / RUN).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DirectoryError(f"{out / RUN} cannot be read ({error}): move it away to continue without it.") from None
    return record if isinstance(record, dict) else {}


def kind_of(out: Path) -> str | None:
    """The kind of a directory; None if it is unknown or empty."""
    kind = read_record(out).get("kind")
    return kind if isinstance(kind, str) else None


def codes_of(out: Path) -> dict[str, CodeStamp]:
    """The codes that made a directory's contents, by their short names, in order."""
    found = {name: known(fields) for name, fields in read_record(out).get("codes", {}).items()}
    return {name: stamp for name, stamp in found.items() if stamp is not None}


def engine_of(out: Path) -> str | None:
    """The engine of the latest code in a directory; None if unknown."""
    codes = codes_of(out)
    return next(reversed(codes.values())).engine if codes else None


def remove_leftovers(folder: Path) -> None:
    """Remove partial files of a killed process from a folder; only `replace_file` uses such names."""
    for leftover in folder.glob(f".*{TEMPORARY}"):
        leftover.unlink(missing_ok=True)


def _with_article(kind: str) -> str:
    one = {"experiments": "published experiments", "benchmarks": "benchmarks"}
    return one.get(kind, f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}")
