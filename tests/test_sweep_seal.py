"""The checksum within a chunk's file."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.sweep.seal import is_intact, seal

TABLE = pa.table({"row": np.arange(5), "speed": np.linspace(0.1, 0.5, 5), "status": ["ok"] * 4 + ["fell"]})


@pytest.fixture(scope="module")
def content():
    """A sealed file."""
    return seal(parquet_bytes(TABLE.replace_schema_metadata({"sweep": "abc"})))


def test_every_reader_passes_over_the_seal(content):
    """Data, metadata and statistics are read as without it."""
    assert is_intact(content)
    assert pq.read_table(io.BytesIO(content), page_checksum_verification=True).equals(TABLE)
    assert pq.read_metadata(io.BytesIO(content)).metadata[b"sweep"] == b"abc"
    pandas = pytest.importorskip("pandas")
    assert pandas.read_parquet(io.BytesIO(content))["speed"].tolist() == TABLE.column("speed").to_pylist()


def test_any_flipped_byte_is_seen(content):
    """Pages, footer, its length, the seal itself: each byte of the file counts."""
    for at in range(len(content)):
        damaged = bytearray(content)
        damaged[at] ^= 1 << (at % 8)
        assert not is_intact(bytes(damaged)), at


@pytest.mark.parametrize("cut", [0, 1, 7, 8, 100, -1, -200])
def test_a_cut_file_is_seen(content, cut):
    """However much of it is left."""
    assert not is_intact(content[:cut])


def test_a_file_without_a_seal_is_no_sealed_file():
    """Whoever wrote it."""
    assert not is_intact(parquet_bytes(TABLE))
