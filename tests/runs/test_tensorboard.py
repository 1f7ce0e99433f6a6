# Tests of runs/job.py, sweep/scalars.py
"""Scalars of each chunk for TensorBoard: read with its own reader, over two sessions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fakes.sweep_fake import SPEC, FakeSimulator

from nermo_mjx import read_table, run_sweep
from nermo_mjx.runs import Interrupted


@pytest.mark.extra
def test_tensorboard_reads_each_chunk_of_both_sessions(tmp_path: Path) -> None:
    """At the number of rows so far; what an earlier session ran counts in the best and the mean of the later one."""
    pytest.importorskip("tensorboardX")
    from tensorboardX.proto.event_pb2 import Event

    with pytest.raises(Interrupted):
        run_sweep(
            SPEC,
            tmp_path,
            chunk=9,
            simulator=FakeSimulator(stop_at=2, falls_above=0.1),
            tensorboard=True,
        )
    run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator(falls_above=0.1), tensorboard=True)
    table = read_table(tmp_path)
    well = np.array(table.column("status").to_pylist()) == "ok"
    speed = table.column("speed").to_numpy()[well]
    expected_values = {
        "best/speed": speed.max(),
        "mean/speed": speed.mean(),
        "rows": 36,
        "best/roll_std": 0.1,
        "status/ok": well.sum(),
        "status/fell": (~well).sum(),
    }
    series: dict[str, dict[int, float]] = {}
    for path in sorted((tmp_path / "tensorboard").iterdir()):
        content = path.read_bytes()
        while (
            content
        ):  # a record is its length, that number's checksum, the event, and its checksum
            size = int.from_bytes(content[:8], "little")
            event, content = Event.FromString(content[12 : 12 + size]), content[16 + size :]
            for value in event.summary.value:
                series.setdefault(value.tag, {})[event.step] = value.simple_value
    assert sorted(series["rows"]) == [9, 18, 27, 36]
    for name, value in expected_values.items():
        assert series[name][36] == pytest.approx(value, rel=1e-6)
    # Of every chunk, however fast the machine: a chunk of a fake simulator takes less than a millisecond.
    assert sorted(series["steps_per_second"]) == [9, 18, 27, 36]
    assert all(value > 0 for value in series["steps_per_second"].values())
