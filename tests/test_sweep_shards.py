"""One sweep as the shards of a job array: one table, the last shard writes the summary, and different machines do not
mix."""

from __future__ import annotations

import json

import numpy as np
import pytest
from sweep_fake import SPEC, FakeSimulator

from nermo_mjx.runs import OtherCode
from nermo_mjx.sweep import read_table, run_sweep

WALKS = {
    "vary": {"frequency": {"linspace": [0.7, 1.2, 7]}},
    "run": {"cycles": 2, "warmup_cycles": 1},
    "chunk": 2,
    "plots": False,
}


class Beside(FakeSimulator):
    """Does something else, once, while one of its batches is simulated."""

    def __init__(self, what, at=0, **more):
        super().__init__(**more)
        self.what, self.at = what, at

    def run(self, *args, **kwargs):
        if len(self.batches) == self.at:
            self.what()
        return super().run(*args, **kwargs)


def test_three_shards_make_the_table_of_one(tmp_path, simulator):
    """Real walks in MuJoCo C, by one process and by shards 0/3 to 2/3: the same numbers, to the last bit."""
    walked = run_sweep(WALKS, tmp_path / "one", simulator=simulator("c")).table
    for part in range(3):
        result = run_sweep(WALKS, tmp_path / "three", shard=(part, 3), simulator=simulator("c"))
        assert result.complete == (part == 2)
    assert result.table.schema.equals(walked.schema, check_metadata=True)
    for name in walked.column_names:
        np.testing.assert_array_equal(result.table.column(name), walked.column(name), strict=True, err_msg=name)


def test_two_shards_begun_together_on_unlike_machines_do_not_mix_engines(tmp_path):
    """The second one begins while the first one has written nothing yet; it is refused, and adds no row."""
    refused = []

    def second():
        with pytest.raises(
            OtherCode, match=r"was made by other code: engine c, not warp;.*--accept-new-code"
        ) as caught:
            run_sweep(SPEC, tmp_path, chunk=4, shard=(1, 2), simulator=FakeSimulator(engine="warp"))
        refused.append(caught.value)

    run_sweep(SPEC, tmp_path, chunk=4, shard=(0, 2), simulator=Beside(second, engine="c"))
    assert refused
    assert len(set(read_table(tmp_path).column("code").to_pylist())) == 1
    result = run_sweep(SPEC, tmp_path, shard=(1, 2), simulator=FakeSimulator(engine="c"))
    assert result.summary["engine"] == "c"


@pytest.mark.parametrize("last", [0, 1])
def test_whichever_shard_finds_the_table_complete_sums_up(tmp_path, last):
    """The one that began first, too, where the other one ends before it."""

    def other():
        assert not run_sweep(SPEC, tmp_path, chunk=4, shard=(1 - last, 2), simulator=FakeSimulator()).summary

    result = run_sweep(SPEC, tmp_path, chunk=4, shard=(last, 2), simulator=Beside(other, at=2))
    assert result.complete
    assert json.loads((tmp_path / "summary.json").read_text())["rows"] == result.summary["rows"] == 36


def test_a_shard_that_died_before_it_summed_up_does_so_when_it_is_run_again(tmp_path, monkeypatch):
    """Nothing is simulated again; the summary is that of an undisturbed sweep, times apart."""
    whole = run_sweep(SPEC, tmp_path / "whole", chunk=4, simulator=FakeSimulator()).summary
    run_sweep(SPEC, tmp_path, chunk=4, shard=(0, 2), simulator=FakeSimulator())
    with monkeypatch.context() as patch:
        patch.setattr("nermo_mjx.sweep.run._sum_up", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run_sweep(SPEC, tmp_path, shard=(1, 2), simulator=FakeSimulator())
    assert not (tmp_path / "summary.json").exists()
    result = run_sweep(SPEC, tmp_path, shard=(0, 2), simulator=FakeSimulator())
    assert result.chunks_run == 0
    times = {"wall_seconds", "steps_per_second"}
    assert {k: v for k, v in result.summary.items() if k not in times} == {
        k: v for k, v in whole.items() if k not in times
    }
