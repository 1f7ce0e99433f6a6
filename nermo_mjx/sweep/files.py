"""Files of a result directory: written whole or not at all; what cannot be written is said in a sentence."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.robot.quantity import ParameterError


class StoreError(RuntimeError):
    """A result directory that cannot be used; the message is one sentence that says what to do."""


def make_writable(folder: Path) -> None:
    """Make a folder, and see that files can be written into it.

    Raises:
        ParameterError: it is a file, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise ParameterError(f"{folder} is a file: a directory is needed.")
    probe = folder / f".probe-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ParameterError(f"cannot write in {folder}: {error.strerror or error}.") from None


def replace_file(path: Path, content: bytes, suffix: str = ".tmp") -> None:
    """Replace a file by new content, atomically and durably; its folder is made if it is missing.

    Args:
        suffix: of the temporary file beside it, which is gone in the end.

    Raises:
        OSError: it cannot be written; what was there is still there.
    """
    path.parent.mkdir(exist_ok=True)
    temporary = path.parent / f".{path.name}{suffix}"
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def create_file(path: Path, content: bytes, suffix: str = ".tmp") -> None:
    """Write a file unless it exists: of several processes that try, the first one's content stays.

    Raises:
        OSError: it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.new{suffix}")
    replace_file(temporary, content, suffix)
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:  # a file system without links; there the last one's content stays
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def parquet_bytes(table: pa.Table) -> bytes:
    """The table as a Parquet file whose pages carry checksums."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, write_page_checksum=True)
    return bytes(sink.getvalue().to_pybytes())


@contextlib.contextmanager
def clear_errors(out: Path) -> Iterator[None]:
    """Turn an `OSError` into a `StoreError` that names the directory."""
    try:
        yield
    except OSError as error:
        kept = " What is finished is kept: run the same command again when there is room."
        room = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        reason = error.strerror or str(error)
        raise StoreError(f"cannot write in {out}: {reason}.{kept if room else ''}") from error
