"""States on disk: Orbax checkpoints of a directory, written atomically, and checked when they are read."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from nermo_mjx.files import MAX_FILE_BYTES, read_bytes
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import DirectoryError, replace_file

#: Free space that a checkpoint requires [bytes].
ROOM: Final = 1 << 18
#: Number of checkpoints to keep; all but the latest are backups in case it is damaged.
KEPT: Final = 3
#: Parts of a checkpoint by name, each a pytree of arrays, and its metadata.
Parts = Mapping[str, Any]
About = Mapping[str, Any]


class Checkpoints:
    """The checkpoints of one directory, by number; use it in a `with` statement.

    A checkpoint contains parts, each of them a pytree of arrays, and their description (item `about`, with checksums).

    Args:
        directory: Directory of results; checkpoints are in its folder `checkpoints`, which is created if it is missing.
        item: Name of the item of the parts, such as "tuning".
    """

    def __init__(self, directory: RunDirectory, item: str) -> None:
        self.folder, self._held, self._item = directory.out / "checkpoints", directory, item

    def __enter__(self) -> Checkpoints:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, enable_async_checkpointing=False, cleanup_tmp_directories=True
        )
        with _quiet():
            self._manager = ocp.CheckpointManager(self.folder.absolute(), options=options)
        return self

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    def save(self, number: int, parts: Parts, metadata: About) -> None:
        """Store parts, with a description in plain JSON, atomically.

        Raises:
            OSError: there is no room for it.
            DirectoryError: it cannot be written for another reason.
        """
        # A full disk is detected here, in one exception, rather than by each of Orbax's threads.
        replace_file(self.folder / ".room", bytes(ROOM))
        (self.folder / ".room").unlink()
        metadata = {**metadata, "checksum": _checksum(parts)}
        metadata["seal"] = _seal(metadata)
        saved = ocp.args.StandardSave(dict(parts))
        items = ocp.args.Composite(**{self._item: saved, "about": ocp.args.JsonSave(metadata)})
        try:
            with _quiet():
                self._manager.save(number, args=items, force=True)
        except OSError:
            raise
        except Exception as error:  # a failed write can raise any exception in its thread
            logging.getLogger("absl").setLevel(
                logging.CRITICAL
            )  # other threads of Orbax fail later, and would print
            if (full := os.strerror(errno.ENOSPC)) in str(
                error
            ):  # another program took the room meanwhile
                raise OSError(errno.ENOSPC, full) from error
            raise DirectoryError(
                f"cannot write a checkpoint in {self.folder}: {' '.join(str(error).split())}."
            ) from error

    def restore(
        self, like: Callable[[About], Parts], warn: Callable[[str], None] = lambda _: None
    ) -> tuple[dict[str, Any], About] | None:
        """The latest intact checkpoint, None if there is none. Newer ones that are damaged are moved aside.

        Args:
            like: Function that returns parts of the same shapes for the description of a checkpoint; it raises a
                `DirectoryError` if the description does not fit the job.
            warn: Function that is called with a message about each damaged checkpoint, which is renamed as a backup.

        Raises:
            DirectoryError: A checkpoint cannot be read now, or does not fit the job; nothing has been changed.
        """
        damaged, result = [], None
        with _quiet():
            for number in sorted(self._manager.all_steps(), reverse=True):
                try:  # distinguish an unresponsive disk from a damaged file, which Orbax does not
                    for path in (self.folder / str(number)).rglob("*"):
                        if not path.is_dir():
                            read_bytes(path, MAX_FILE_BYTES)
                except OSError as error:
                    raise self._unreadable(number, error) from error
                result = self._read(number, like)
                if result is not None:
                    break
                damaged.append(number)
            for number in damaged:
                aside = self._held.move_aside(self.folder.relative_to(self._held.out) / str(number))
                if aside is not None:
                    warn(
                        f"checkpoint {number} in {self.folder} is damaged; it is kept as {aside.name}."
                    )
            if damaged:
                self._manager.reload()
        return result

    def _unreadable(self, number: int, error: OSError) -> DirectoryError:
        return DirectoryError(
            f"checkpoint {number} in {self.folder} cannot be read: {error.strerror or error}; "
            "nothing was changed, run the same command again."
        )

    def _read(
        self, number: int, like: Callable[[About], Parts]
    ) -> tuple[dict[str, Any], About] | None:
        """A checkpoint; None if it is damaged."""
        try:
            metadata: About = self._manager.restore(
                number, args=ocp.args.Composite(about=ocp.args.JsonRestore())
            )["about"]
            if metadata.get("seal", "") != ("" if "identity" not in metadata else _seal(metadata)):
                return None
            shapes = {  # what is a NumPy array is restored as one, all else as a JAX array
                name: jax.tree.map(
                    lambda leaf: (
                        leaf
                        if isinstance(leaf, np.ndarray)
                        else ocp.utils.to_shape_dtype_struct(leaf)
                    ),
                    part,
                )
                for name, part in like(metadata).items()
            }
            items = ocp.args.Composite(**{self._item: ocp.args.StandardRestore(shapes)})
            restored = self._manager.restore(number, args=items)[self._item]
            # As plain arrays: Orbax commits them to a device, and programs would be recompiled for those.
            parts = {
                name: jax.tree.map(_plain, restored[name], like) for name, like in shapes.items()
            }
        except (DirectoryError, MemoryError):
            raise
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise self._unreadable(number, error) from error
        except Exception:  # a damaged file can raise any exception in its reader
            return None
        return (parts, metadata) if metadata["checksum"] == _checksum(parts) else None


def _plain(restored: Any, like: Any) -> Any:
    return (
        np.asarray(restored) if isinstance(like, np.ndarray) else jnp.asarray(np.asarray(restored))
    )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress what Orbax's threads print about a damaged or failed checkpoint, which is expected and handled here."""
    logger, hook = logging.getLogger("absl"), sys.unraisablehook
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        logger.setLevel(level)
        sys.unraisablehook = hook


def _checksum(parts: Parts) -> str:
    """A hash of all values; the file format alone would not detect every flipped bit."""
    total = hashlib.sha256()
    for leaf in (leaf for part in parts.values() for leaf in jax.tree.leaves(part)):
        array = np.asarray(leaf)
        total.update(f"{array.dtype} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _seal(metadata: About) -> str:
    """A hash of a checkpoint's metadata, as read back from JSON."""
    content = json.dumps({key: metadata[key] for key in metadata if key != "seal"}, sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()
