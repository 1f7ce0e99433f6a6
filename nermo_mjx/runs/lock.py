"""Locks on a result directory: who may write it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from nermo_mjx.runs.files import DirectoryError

try:
    import fcntl
except ImportError:  # Windows: a directory is not locked there
    fcntl = None  # type: ignore[assignment]


def hold(folder: Path, name: str = ".lock", *, shared: bool = False, wait: bool = False) -> int:
    """Lock a file of a folder; the file descriptor holds it until it is closed.

    Args:
        shared: several processes may hold it so, but none beside them alone.
        wait: until the holder releases it.

    Raises:
        DirectoryError: another process holds it.
        OSError: it cannot be opened.
    """
    held = os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if fcntl is not None:
            fcntl.flock(held, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(held)
        raise DirectoryError(f"another process works in {folder}; wait for it, or choose another directory.") from None
    except OSError as error:  # a network file system without locks
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            os.close(held)
            raise
    return held
