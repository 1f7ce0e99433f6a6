"""Files that a stranger may have made: read with a limit, against a declared shape, and never run.

Every loader of the package opens its file here, and raises a `FileError` for whatever is wrong with it: nothing is
waited for, and sizes are looked at before anything of that size is made. What a command shows of such a file, and whose
Python is run, is in `nermo_mjx.trust`.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import math
import os
import secrets
import stat
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from pydantic import TypeAdapter, ValidationError
from pydantic_core import from_json

from nermo_mjx.trust import FileError, one_line, shortened

#: Bytes of a file of arrays or a table, and of all its arrays; of a JSON file, whose values take up to 30 times that.
MAX_ARRAY_BYTES: Final = 1 << 28
MAX_JSON_BYTES: Final = 1 << 24
#: Bytes of any file: those of the longest walk that is recorded.
MAX_FILE_BYTES: Final = 1 << 32
#: Suffix of a file that is being written.
TEMPORARY_SUFFIX: Final = ".nermo-tmp"
#: Arrays in a file.
_MAX_ARRAYS: Final = 1000


class UnfitFile(FileError, OSError):
    """A file that is not read: a pipe, a device, or one that is too large."""

    def __init__(self, path: Path, why: str) -> None:
        OSError.__init__(self, errno.EINVAL, why, str(path))

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}."


def opened(path: Path) -> BinaryIO:
    """A regular file, open for reading.

    Raises:
        UnfitFile: it is none.
        OSError: it cannot be opened.
    """

    def ready(name: str, flags: int) -> int:  # a pipe without a writer would wait for one
        return os.open(name, flags | getattr(os, "O_NONBLOCK", 0))

    file = open(path, "rb", opener=ready)  # noqa: SIM115 - the caller closes it
    # What is judged is what was opened: a name may mean another file by now.
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise UnfitFile(path, "not a regular file")
    return file


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most `most` bytes.

    Raises:
        UnfitFile: it is larger, or no regular file.
        OSError: it cannot be read.
    """
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        content = (
            file.read(limit + 1) if size <= limit else b""
        )  # some have more than they say, as in /proc
    if max(size, len(content)) > limit:
        raise UnfitFile(
            path, f"it has {_megabytes(max(size, len(content)))}: allowed are {_megabytes(limit)}"
        )
    return content


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file by new content, atomically and durably; its folder is created if missing.

    Raises:
        OSError: it cannot be written; what was there is still there.
    """
    path.parent.mkdir(exist_ok=True)
    # Two processes may write the same file, even on two machines with equal process ids.
    temporary = path.parent / f".{path.name}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}"
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames in a folder durable: otherwise a power cut may undo them."""
    # Not every system opens folders, and not every file system syncs them; there a rename is as durable as it gets.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def json_of(content: bytes | str, shape: Any, called: object) -> Any:
    """The plain values of JSON text that has a declared shape; see `read_as`."""
    read_as(content, shape, called)
    return from_json(content)


def read_as(content: bytes | str, shape: Any, called: object) -> Any:
    """JSON text as an object of its declared type.

    Args:
        content: the text.
        shape: the type, as pydantic reads it.
        called: what holds the text, for messages.

    Raises:
        FileError: it is no JSON, too long, nested too deep, or has another shape.
    """
    if len(content) > MAX_JSON_BYTES:
        raise FileError(
            f"{called}: it has {_megabytes(len(content))}: allowed are {_megabytes(MAX_JSON_BYTES)}."
        )
    try:
        return _adapter(shape).validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
    except UnicodeError:
        raise FileError(f"{called}: not valid JSON: it is not UTF-8.") from None
    field = shortened(one_line(".".join(map(str, first["loc"]))), 200)
    value = shortened(one_line(repr(first["input"])))
    message = f"field {field!r} is {value}" if field else f"it holds {value}"
    message = "not valid JSON" if first["type"] == "json_invalid" else message
    raise FileError(f"{called}: {message}: {first['msg'].rstrip('.')}.") from None


def arrays_of(content: bytes, called: object) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file, by name; sizes are those that the file says, checked before it is unpacked.

    Raises:
        FileError: it is no such file, damaged, holds Python objects, or takes more than `MAX_ARRAY_BYTES` bytes and ten
            times its own size.
    """
    limit = max(MAX_ARRAY_BYTES, 10 * len(content))
    try:
        if content.count(b"PK\x01\x02") > _MAX_ARRAYS:
            raise FileError(f"{called}: it has more than {_MAX_ARRAYS:,} arrays.")
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            size = 0
            for member in file.infolist():
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError
                with file.open(member) as stream:
                    version = np.lib.format.read_magic(stream)
                    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else _HEADER_2
                    shape, _, dtype = header(stream)
                if dtype.hasobject:
                    raise FileError(
                        f"{called}: {member.filename!r} holds Python objects, which are not read."
                    )
                size += math.prod(shape) * dtype.itemsize
                if size > limit or any(length < 0 for length in shape):
                    raise FileError(
                        f"{called}: {member.filename!r} has the shape {shape}: allowed are {_megabytes(limit)} in all."
                    )
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays.files}
    except (FileError, MemoryError):
        raise
    except Exception:  # a damaged file can raise any exception in its reader
        raise FileError(f"{called}: not an NPZ file, or a damaged one.") from None


_HEADER_2: Final = np.lib.format.read_array_header_2_0


def check_arrays(
    arrays: Mapping[str, np.ndarray],
    declared: Mapping[str, tuple[str, tuple[Any, ...]]],
    called: object,
) -> None:
    """Compare arrays with their declaration.

    Args:
        arrays: by name.
        declared: name -> (kinds of numbers, as in `numpy.dtype.kind`; the shape). In a shape, a text names a length
            that is the same wherever the name stands, and `...` at the end allows further ones.
        called: what holds them, for messages.

    Raises:
        FileError: one is missing, or has other numbers or another shape.
    """
    sizes: dict[str, int] = {}
    for name, (kinds, shape) in declared.items():
        if name not in arrays:
            raise FileError(f"{called}: it has no {name!r}.")
        array, lengths = arrays[name], tuple(length for length in shape if length is not ...)
        if array.dtype.kind not in kinds:
            raise FileError(f"{called}: {name!r} is of type {array.dtype}: expected numbers.")
        fits = array.ndim == len(lengths) or (... in shape and array.ndim >= len(lengths))
        for have, want in zip(array.shape, lengths, strict=False):
            fits = fits and have == (
                sizes.setdefault(want, have) if isinstance(want, str) else want
            )
        if not fits:
            expected = ", ".join(
                "..." if dimension is ... else str(sizes.get(dimension, dimension))
                for dimension in shape
            )
            raise FileError(
                f"{called}: {name!r} has the shape {array.shape}: expected ({expected})."
            )


@functools.cache
def _adapter(shape: Any) -> TypeAdapter[Any]:
    return TypeAdapter(shape)


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.0f} MB"
