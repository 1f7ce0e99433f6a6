"""Reading of untrusted files, with limits and declared shapes, without running code from them.

Every loader of the package opens its file here. It raises a `FileError` for a file that is wrong in any way, does not wait
for pipes, and checks sizes before it allocates memory. `nermo_mjx.trust` decides which text of a file is shown, and
whether Python code that a file names may run.
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

#: Maximum size of a file of arrays or a table, and of all its arrays; and of a JSON file, whose values need up to 30
#: times its size [bytes].
MAX_ARRAY_BYTES: Final = 1 << 28
MAX_JSON_BYTES: Final = 1 << 24
#: Maximum size of any file, which the recording of the longest walk has [bytes].
MAX_FILE_BYTES: Final = 1 << 32
#: Suffix of a file that is being written.
TEMPORARY_SUFFIX: Final = ".nermo-tmp"
#: Maximum number of arrays in a file.
_MAX_ARRAYS: Final = 1000


class UnfitFile(FileError, OSError):
    """A file that cannot be read safely: a pipe, a device, or a file that is too large."""

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
    # The check uses the opened file, because the name may refer to another file in the meantime.
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise UnfitFile(path, "not a regular file")
    return file


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes.

    Raises:
        UnfitFile: The file is larger, or not regular.
        OSError: The file cannot be read.
    """
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        content = (
            file.read(limit + 1) if size <= limit else b""
        )  # some files, for example in /proc, are larger than their size in the file system
    if max(size, len(content)) > limit:
        raise UnfitFile(
            path, f"it has {_megabytes(max(size, len(content)))}: allowed are {_megabytes(limit)}"
        )
    return content


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file by new content, atomically and durably; its folder is created if missing.

    Raises:
        OSError: The file cannot be written; a former file is unchanged.
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
    """Make renames in a folder durable, so that a power cut cannot undo them."""
    # Some systems cannot open folders, and some file systems cannot sync them; renames are not made durable there.
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
        content: JSON text.
        shape: Declared type, in a form that pydantic accepts.
        called: Name of the source of the text, for messages.

    Raises:
        FileError: The text is not JSON, too long, nested too deep, or has another shape.
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
    """The arrays of an NPZ file by name; the sizes in its headers are checked before it is unpacked.

    Raises:
        FileError: The file is of another kind, damaged, contains Python objects, or needs more than `MAX_ARRAY_BYTES`
            bytes and more than ten times its own size.
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
        arrays: Arrays by name.
        declared: Kinds of numbers (as in `numpy.dtype.kind`) and shape of each array by name. In a shape, a string names a
            length that is equal in all shapes with this name, and `...` at the end allows additional dimensions.
        called: Name of the source of the arrays, for messages.

    Raises:
        FileError: An array is missing, or has another type or shape.
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
