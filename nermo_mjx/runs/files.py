"""Files of a directory: written atomically, with one-sentence errors; JSON for programs, Markdown for readers."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from nermo_mjx.files import (
    MAX_ARRAY_BYTES,
    MAX_JSON_BYTES,
    TEMPORARY_SUFFIX,
    json_of,
    opened,
    read_bytes,
    replace_file,
    sync_folder,
)
from nermo_mjx.trust import FileError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


class DirectoryError(FileError, RuntimeError):
    """A directory of results that cannot be used; the message is one sentence that says what to do."""


class WrongDirectory(DirectoryError):
    """A directory that cannot be used as requested; choosing another one helps, trying again does not."""


def make_writable(folder: Path) -> None:
    """Create a folder, and check that files can be written into it.

    Raises:
        WrongDirectory: it is a file, or cannot be written.
    """
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise WrongDirectory(
            f"{str(folder)!a} is not UTF-8, as files and tables name it: take another name."
        ) from None
    if folder.exists() and not folder.is_dir():
        raise WrongDirectory(f"{folder} is a file: a directory is needed.")
    probe = folder / f".probe-{secrets.token_hex(8)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise WrongDirectory(f"cannot write in {folder}: {error.strerror or error}.") from None


def create_file(path: Path, content: bytes) -> None:
    """Write a file unless it exists: of several processes, the first one's content is kept.

    Raises:
        OSError: it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.new-{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")
    replace_file(temporary, content)
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:  # a file system without links; the last one's content is kept
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def parquet_bytes(table: pa.Table) -> bytes:
    """The table as a Parquet file whose pages carry checksums."""
    import pyarrow as pa  # here and below: not all users of this module write tables
    import pyarrow.parquet as pq

    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, write_page_checksum=True)
    return bytes(sink.getvalue().to_pybytes())


def content_of(path: Path, limit: int = MAX_ARRAY_BYTES) -> bytes | None:
    """The content of a file of at most `most` bytes; None if it does not exist.

    Raises:
        DirectoryError: it cannot be read now. It may be intact, so it must not be recreated.
    """
    try:
        return read_bytes(path, limit)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DirectoryError(
            f"{path} cannot be read: {error.strerror or error}; nothing was changed."
        ) from error


def parquet_table(source: Path | bytes, ours: bool = True) -> pa.Table | None:
    """The table of a Parquet file, or of its content, every page checked; None if it is absent or damaged.

    Args:
        ours: whether this package wrote it; else its columns may be of any type.
    """
    import pyarrow as pa

    try:
        with parquet_file(
            pa.BufferReader(source) if isinstance(source, bytes) else source, ours
        ) as file:
            return file.read()
    except (OSError, pa.ArrowException, ValueError):
        return None


#: Bytes of a table's numbers that are made in any case, and per byte of its file beyond: constants take next to none.
_MAX_TABLE_CELLS: Final = 1 << 28
_MOST_SPREAD: Final = 100


@contextlib.contextmanager
def parquet_file(
    source: Path | pa.BufferReader, ours: bool = True, **options: Any
) -> Iterator[pq.ParquetFile]:
    """A Parquet file whose pages are checked as they are read, opened; `ours` as for `parquet_table`.

    Raises:
        OSError, pyarrow.ArrowException, ValueError: it is absent or damaged, promises more than it can hold, or has
            other columns than numbers, truth values and texts.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with opened(source) if isinstance(source, Path) else source as stream:
        size, options = stream.seek(0, os.SEEK_END), {"page_checksum_verification": True, **options}
        file, cell_limit = (
            pq.ParquetFile(stream, **options),
            max(_MAX_TABLE_CELLS, _MOST_SPREAD * size),
        )
        metadata, schema = file.metadata, file.schema_arrow
        cells = 8 * metadata.num_rows * metadata.num_columns
        if metadata.num_rows < 0 or cells > cell_limit:
            raise ValueError(
                f"it promises {metadata.num_rows:,} rows of {metadata.num_columns:,} columns in {size:,} bytes"
            )
        texts = list[str]()
        for field in schema:
            kind = (
                field.type.value_type
                if pa.types.is_dictionary(field.type) and not ours
                else field.type
            )
            of_text = (
                pa.types.is_string,
                pa.types.is_large_string,
                pa.types.is_binary,
                pa.types.is_large_binary,
            )
            if any(is_text(kind) for is_text in of_text[: 1 if ours else None]):
                texts.append(field.name)
            elif not (pa.types.is_primitive(kind) or pa.types.is_null(kind)):
                if ours:
                    raise ValueError(f"its column {field.name!r} is of type {field.type}")
                cells += 0 if pa.types.is_decimal(kind) else _at_most(metadata, field.name)
            if ours and schema.names.count(field.name) > 1:
                raise ValueError(f"its column {field.name!r} is there twice")
        for schema_field in (schema, *schema):
            for key, value in (schema_field.metadata or {}).items():
                (key + value).decode()
        if cells > cell_limit:
            raise ValueError(f"its lists may unpack to more than {cell_limit:,} bytes")
        if texts:
            encoded = pq.ParquetFile(stream, read_dictionary=texts, **options)
            for batch in encoded.iter_batches(1 << 16, columns=texts, use_threads=False):
                cells += sum(_length(column) for column in batch.columns)
                if cells > cell_limit:
                    raise ValueError(f"its texts unpack to more than {cell_limit:,} bytes")
        yield file


def _at_most(metadata: pq.FileMetaData, name: str) -> int:
    """Bytes that a column of lists or the like has at most: no value is longer than all that is stored of it."""
    groups = [metadata.row_group(group) for group in range(metadata.num_row_groups)]
    chunks = [group.column(i) for group in groups for i in range(group.num_columns)]
    column_chunks = [chunk for chunk in chunks if chunk.path_in_schema.partition(".")[0] == name]
    return sum(max(chunk.num_values * chunk.total_uncompressed_size, 0) for chunk in column_chunks)


def _length(texts: pa.Array) -> int:
    """Bytes of all texts, whose different ones are there once each."""
    import pyarrow.compute as pc

    lengths = pc.binary_length(getattr(texts, "dictionary", texts))
    return (
        pc.sum(lengths.take(texts.indices) if hasattr(texts, "indices") else lengths).as_py() or 0
    )


def stored_json(path: Path, shape: Any = dict[str, Any]) -> Any:
    """What a JSON file of a directory says; None if it is absent or damaged, or has not its declared shape."""
    try:
        return json_of(read_bytes(path, MAX_JSON_BYTES), shape, path)
    except (OSError, FileError):
        return None


def stored_table(path: Path, what: str) -> pa.Table:
    """The table of a directory's file.

    Raises:
        DirectoryError: there is none, it is damaged, or cannot be read now; the message names the directory and `what`.
    """
    if (table := parquet_table(content_of(path) or b"")) is None:
        raise DirectoryError(f"{path.parent} holds no {what}.")
    return table


@contextlib.contextmanager
def clear_errors(out: Path) -> Iterator[None]:
    """Turn an `OSError` into a `DirectoryError` that names the directory."""
    try:
        yield
    except OSError as error:
        advice = " What is finished is kept: run the same command again when there is room."
        room = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        reason = error.strerror or str(error)
        raise DirectoryError(f"cannot write in {out}: {reason}.{advice if room else ''}") from error


# ---
# Texts of a run.

#: Content of an empty cell.
EMPTY_CELL: Final = "–"


def plain_json(value: Any) -> Any:
    """The value as plain JSON: arrays as lists, non-finite numbers as null."""
    if isinstance(value, Mapping):
        return {str(key): plain_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_json(item) for item in value]
    if hasattr(value, "tolist"):  # numpy and JAX
        return plain_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def to_json(content: Mapping[str, Any]) -> bytes:
    """A JSON file's content; see `plain`."""
    return (json.dumps(plain_json(content), indent=2, allow_nan=False) + "\n").encode()


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], sides: str = "") -> str:
    """A Markdown table; `sides` has one letter per column, l or r, by default all l."""
    rules = ["--:" if side == "r" else "---" for side in sides or "l" * len(headings)]
    texts = [headings, rules, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in texts) + "\n"


def listed(entries: Mapping[str, Any] | None) -> str:
    """Names with their values, as in "numpy 2.3, jax 0.8"."""
    return ", ".join(f"{name} {value}" for name, value in (entries or {}).items())
