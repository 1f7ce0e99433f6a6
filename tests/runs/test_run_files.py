# Tests of runs/files.py
"""Files of run directories: limits of Parquet tables, and names of directories."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import call
from fakes.strangers import bounded

from nermo_mjx.runs.files import parquet_table
from nermo_mjx.specs.reading import SpecError, read_mapping
from nermo_mjx.sweep import DirectoryError
from nermo_mjx.sweep.structures import read_row_table
from nermo_mjx.sweep.table import Results


def heavy(form: str) -> bytes:
    """Parquet of 0.1 MB or less whose texts unpack to 2 GB."""
    texts = pa.array(["x" * 100_000]).take(pa.array(np.zeros(20_000, np.int8)))
    if form == "large":
        texts = texts.cast(pa.large_string())
    rows = pa.array(np.arange(len(texts)), pa.int64())
    stream = io.BytesIO()
    pq.write_table(
        pa.table({"row": rows, "status": texts}),
        stream,
        compression="zstd",
        use_dictionary=form != "plain",
        data_page_size=1 << 20,
    )
    return stream.getvalue()


@pytest.mark.release
@pytest.mark.parametrize("form", ["dictionary", "large", "plain"])
def test_texts_count_by_what_they_unpack_to(form: str, tmp_path: Path) -> None:
    content = heavy(form)
    assert len(content) < 2e6
    (tmp_path / "rows.parquet").write_bytes(content)
    with bounded():
        assert parquet_table(content) is None
        with pytest.raises(SpecError, match="cannot be read as Parquet"):
            read_row_table(read_mapping({}), str(tmp_path / "rows.parquet"))
        with pytest.raises(
            DirectoryError, match=r"texts unpack to more than|is of type large_string"
        ):
            Results([tmp_path / "rows.parquet"])


def test_a_name_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    from nermo_mjx.runs.files import make_writable

    name = b"gr\xf6\xdfe".decode(errors="surrogateescape")
    for words in (["sweep", "s.yaml", "--out", name], ["status", name]):
        result = call(*words)
        assert result.exit_code == 2
        assert r"'gr\udcf6\udcdfe' is not UTF-8: rename" in result.stderr
    with pytest.raises(RuntimeError, match="is not UTF-8"):
        make_writable(tmp_path / name)
    assert not list(tmp_path.iterdir())
