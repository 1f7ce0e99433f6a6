"""A results directory of any kind: who may write it, what it is for, and which code made its contents.

DIR/.lock       held by the process that writes alone; DIR/.lock-I-of-N by each of several that write together
DIR/run.json    kind; `codes`, which code made rows, by its short name; `sessions`, each with command, versions, machine
                (`files`: path -> digest of what the program wrote, where a user's may be in the way, see `Written`)
DIR/*.aside-N   files that did not match, renamed: nothing is deleted that a user may want back
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import filecmp
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout
from pydantic import BaseModel

from nermo_mjx.files import (
    MAX_FILE_BYTES,
    MAX_JSON_BYTES,
    FileError,
    UnfitFile,
    json_of,
    read_bytes,
)
from nermo_mjx.runs.code import CodeStamp, stored_stamp
from nermo_mjx.runs.files import (
    TEMPORARY_SUFFIX,
    DirectoryError,
    WrongDirectory,
    clear_errors,
    make_writable,
    replace_file,
    sync_folder,
)

RUN: Final = "run.json"
#: Where partial files of a killed process may be.
FOLDERS: Final = ("", "results", "series", "recordings", "plots", "videos", "checkpoints")


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

    def __init__(
        self, out: str | os.PathLike[str], kind: str, shard: tuple[int, int] | None = None
    ) -> None:
        if not isinstance(out, (str, os.PathLike)):
            raise TypeError(f"out is {out!r}: expected the path of a directory.")
        self.out, self.kind, self.shard = Path(out), kind, shard
        self._held = contextlib.ExitStack()

    def __enter__(self) -> RunDirectory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            make_writable(self.out)
            if self.shard is None:
                stack.enter_context(hold(self.out))
                for shard_lock in self.out.glob(".lock-*-of-*"):
                    with hold(self.out, shard_lock.name):
                        pass
            else:
                with hold(self.out, wait=ENTRY):
                    stack.enter_context(hold(self.out, ".lock-{}-of-{}".format(*self.shard)))
            kind = kind_of(self.out)
            if kind not in (None, self.kind):
                raise WrongDirectory(
                    f"{self.out} holds {with_article(str(kind))}, and not {with_article(self.kind)}: choose another "
                    "directory."
                )
            if self.shard is None:
                for folder in FOLDERS:
                    for leftover in (self.out / folder).glob(f".*{TEMPORARY_SUFFIX}*"):
                        leftover.unlink(missing_ok=True)
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

        A file that has been moved aside before is kept once.

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
            try:
                while (target := into / f"{source.name}.aside-{count}").exists():
                    if (
                        source.is_file()
                        and target.is_file()
                        and filecmp.cmp(source, target, shallow=False)
                    ):
                        break  # it is kept already
                    count += 1
                source.replace(target)
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

    def take_code(
        self, stamp: CodeStamp, *, holds_rows: bool, accept: bool = False, any_model: bool = False
    ) -> None:
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
        with self.record() as record:
            codes = record.setdefault("codes", {})
            if self.shard is None and not holds_rows:
                codes.clear()
            if stamp.id not in codes:
                begun = stored_stamp(next(reversed(codes.values()), None))
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

    def note_session(self, session: dict[str, Any]) -> None:
        """Add this session (`code.session`); warn if Python or a package beside it is not the former session's.

        The stamp of the code decides which rows are not mixed; Python, NumPy and others may change last digits.
        """
        with self.record() as record:
            sessions = record.setdefault("sessions", [])
            former, current = (
                (entry or {}).get("versions") or {}
                for entry in (sessions[-1] if sessions else None, session)
            )
            versions = [
                name
                for name in current
                if name in former and name not in ("nermo-mjx", "mujoco", "mujoco-mjx", "jax")
            ]
            differences = [
                f"{name} {current[name]}, not {former[name]}"
                for name in versions
                if current[name] != former[name]
            ]
            sessions.append(session)
        if differences:
            warnings.warn(
                f"{self.out} goes on with {', '.join(differences)}: points and metrics may differ in their last digits.",
                stacklevel=2,
            )

    @contextlib.contextmanager
    def record(self) -> Iterator[dict[str, Any]]:
        """The content of run.json, written back if changed; processes take turns."""
        with clear_errors(self.out), hold(self.out, ".lock-run", wait=-1.0):
            before = read_record(self.out)
            record = json.loads(json.dumps({"kind": self.kind} | before))
            yield record
            if record != before:
                replace_file(self.out / RUN, (json.dumps(record, indent=2) + "\n").encode())


def read_record(out: Path) -> dict[str, Any]:
    """The content of a directory's run.json; empty if there is none.

    Raises:
        DirectoryError: it is damaged.
    """
    try:
        record: dict[str, Any] = json_of(read_bytes(out / RUN, MAX_JSON_BYTES), _Record, out / RUN)
    except FileNotFoundError:
        return {}
    except OSError as error:
        reason = f"{out / RUN} cannot be read ({error.strerror})"
    except FileError as error:
        reason = str(error).rstrip(".")
    else:
        return record
    raise DirectoryError(f"{reason}: move it away to continue without it.")


class SessionRecord(BaseModel, extra="allow"):
    """One session in run.json, see `code.session`, as far as it is read."""

    started: str | None = None
    command: str | None = None
    versions: dict[str, str | None] = {}
    machine: dict[str, str | int | None] = {}
    experiments: list[str] = []


class _Record(BaseModel, extra="allow"):
    """What run.json says, as far as it is read."""

    kind: str | None = None
    codes: dict[str, dict[str, str]] = {}
    sessions: list[SessionRecord] = []
    files: dict[str, str] = {}


def kind_of(out: Path) -> str | None:
    """The kind of a directory; None if it is unknown or empty."""
    kind: str | None = read_record(out).get("kind")
    return kind


def codes_of(out: Path) -> dict[str, CodeStamp]:
    """The codes that made a directory's contents, by their short names, in order."""
    codes = {
        name: stored_stamp(fields) for name, fields in read_record(out).get("codes", {}).items()
    }
    return {name: stamp for name, stamp in codes.items() if stamp is not None}


def engine_of(out: Path) -> str | None:
    """The engine of the latest code in a directory; None if unknown."""
    codes = codes_of(out)
    return next(reversed(codes.values())).engine if codes else None


#: Kinds of directories whose names are no nouns for a sentence.
_KIND_PHRASES: Final = {
    "experiments": "published experiments",
    "experiment": "the rows of an experiment",
    "sensitivity": "a sensitivity analysis",
}


def with_article(kind: str) -> str:
    """A kind of directory in a sentence."""
    return _KIND_PHRASES.get(kind) or f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


# ---
# Locks: who may write a directory.


#: How long one of several processes waits while another one of them enters the directory [s].
ENTRY: Final = 2.0


@contextlib.contextmanager
def hold(folder: Path, name: str = ".lock", wait: float = 0.0) -> Iterator[None]:
    """Locks a file of a folder inside of it, or until the process ends.

    Args:
        folder: The folder.
        name: Name of the file, which is created if it does not exist.
        wait: How long to wait for the process that holds the lock [s]; -1 without a limit.

    Raises:
        DirectoryError: Another process holds the lock.
        OSError: The file cannot be opened.
    """
    lock = FileLock(folder / name, wait, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise DirectoryError(
            f"another process works in {folder}; wait for it, or choose another directory."
        ) from None
    except (NotImplementedError, OSError) as error:  # a network file system without locks
        if getattr(error, "errno", errno.ENOSYS) not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise
    try:
        yield
    finally:
        lock.release()


# ---
# Which files of a directory the program wrote itself: it replaces and removes only these.


class Written:
    """Writes files of a directory; files in the way that are not the program's own are moved aside.

    Use it in a `with` statement: what was written is noted in run.json, as `files`, path -> digest.

    Args:
        held: the directory.

    Attributes:
        known: path in the directory -> digest of what the program wrote there.
        aside: new paths of the files that were moved aside.
    """

    def __init__(self, directory: RunDirectory) -> None:
        self.held = directory
        self.known: dict[str, str] = dict(read_record(directory.out).get("files", {}))
        self.aside: list[str] = []

    def __enter__(self) -> Written:
        return self

    def __exit__(self, *_: object) -> None:
        self.note()

    def note(self) -> None:
        """Record now what was written, so that the files are recognized even if the process is killed later."""
        with self.held.record() as record:
            record["files"] = dict(self.known)

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file, by its path with the directory's; atomically.

        Raises:
            DirectoryError: it cannot be written.
        """
        self._make_way(path, digest(content))
        self.held.write(self.name(path), content)
        self.known[self.name(path)] = digest(content)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, by their paths in the directory, if they are unmodified; the others are kept."""
        for name in names:
            path, digest = self.held.out / name, self.known.pop(name, None)
            if digest is not None and self._digest_of(path) == digest:
                with clear_errors(self.held.out):
                    path.unlink()

    def clear(self, path: Path) -> None:
        """Make way for a file of this name: the program's own file is removed, any other one moved aside.

        Raises:
            DirectoryError: it cannot be.
        """
        self.remove([self.name(path)])
        self._make_way(path)

    def sentence(self) -> str:
        """What was moved aside; empty if nothing was."""
        if not self.aside:
            return ""
        subject, remainder = "A file in the way was not as this program wrote it", ""
        if len(self.aside) > 1:
            subject, remainder = (
                "Files in the way were not as this program wrote them",
                f" and {len(self.aside) - 1} more",
            )
        return f"{subject}: moved aside in {self.held.out}, to {self.aside[0]}{remainder}."

    def name(self, path: Path) -> str:
        """The path of a file from the directory, for links as well."""
        return path.relative_to(self.held.out).as_posix()

    def _make_way(self, path: Path, *also: str) -> None:
        """Move a file aside that is neither as the program wrote it nor of one of these digests."""
        if self._digest_of(path) not in (None, self.known.get(self.name(path)), *also):
            moved = self.held.move_aside(self.name(path))
            self.aside += [] if moved is None else [self.name(moved)]

    def _digest_of(self, path: Path) -> str | None:
        """Digest of a file; None if it does not exist, a marker for a folder."""
        with clear_errors(self.held.out):
            if path.is_dir():
                return "a folder"
            try:
                return digest(read_bytes(path, MAX_FILE_BYTES)) if path.exists() else None
            except UnfitFile:
                return "not the program's own"


def digest(content: bytes) -> str:
    """A short hash of a file's content."""
    return hashlib.blake2b(content, digest_size=8).hexdigest()
