"""A checksum over all bytes of a Parquet file, kept in the file itself.

Parquet's own checksums cover pages, not the footer, and are only read with the pages. The seal stands between the last
page and the footer: a reader finds pages by their places in the footer, and the footer from the file's end, so that
every reader passes over it.
"""

from __future__ import annotations

import hashlib

_SIZE = 16
#: Length of the footer (4 bytes) and the letters PAR1.
_TAIL = 8


def seal(content: bytes) -> bytes:
    """The Parquet file with its checksum in it."""
    start = _footer(content)
    return content[:start] + _digest(content[:start], content[start:]) + content[start:]


def is_intact(content: bytes) -> bool:
    """Whether a sealed file is as it was written, to the last bit; false for one without a seal."""
    start = _footer(content)
    pages = start - _SIZE
    return pages > 0 and _digest(content[:pages], content[start:]) == content[pages:start]


def _footer(content: bytes) -> int:
    """Where the footer begins; below 0 where there is none."""
    return len(content) - _TAIL - int.from_bytes(content[-_TAIL:-4], "little")


def _digest(*parts: bytes) -> bytes:
    digest = hashlib.blake2b(digest_size=_SIZE)
    for part in parts:
        digest.update(part)
    return digest.digest()
