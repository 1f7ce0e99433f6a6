"""Commands that only read a directory of a sweep run none of the code in it, which may be a stranger's."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command import call
from sweep_fake import FakeSimulator

from nermo_mjx.control import loading
from nermo_mjx.rollout import own_metrics
from nermo_mjx.sweep import DirectoryError, merge_sweeps, read_table, run_sweep
from nermo_mjx.sweep.results import RECORD, SweepRecord
from nermo_mjx.sweep.table import meta

CANARY = """
open({log!r}, "a").write("run ")
import jax.numpy as jnp
from nermo_mjx import Controller, metric

@metric(unit="rad/s", better="low", reduce="rms")
def yaw_shake(sensors):
    "Turning about its own axis."
    return sensors.gyro[2]

stiff = Controller(spine=lambda params, phase, turn_rate, feet, stance: 0.0 * phase)
"""
SPECS: dict[str, dict[str, Any]] = {
    "metrics": {"metrics": "own.py"},
    "controller": {"controller": "own.py:stiff"},
}


class Measuring(FakeSimulator):
    def run(self, values: Any, run: Any, **how: Any) -> Any:
        result = super().run(values, run, **how)
        result.metrics |= {"yaw_shake": result.metrics["speed"] * 2}
        return result


@pytest.fixture(params=SPECS)
def directories(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, Path, Path]:
    """What is own, two directories that were moved here, and the file that their code writes when it is run."""
    log, made = tmp_path / "log", tmp_path / "made"
    made.mkdir()
    (made / "own.py").write_text(CANARY.format(log=str(log)))
    vary = {"frequency": {"linspace": [0.5, 1.0, 80]}, "stride": [0.5, 0.7]}
    for name, gait in (("a", "trt"), ("b", "lat")):
        spec = SPECS[request.param] | {"gait": gait, "plots": False, "vary": vary, "compare": {"by": "stride"}}
        (made / f"{name}.yaml").write_text(json.dumps(spec))
        run_sweep(made / f"{name}.yaml", made / name, simulator=Measuring())
    run_sweep(made / "a.yaml", made / "half", chunk=40, shard=(0, 2), simulator=Measuring())
    for name in ("a", "b", "half"):
        shutil.move(made / name, tmp_path / name)
    assert log.read_text().startswith("run")
    log.unlink()
    loading._imported.cache_clear()
    return request.param, tmp_path / "a", tmp_path / "b", log


def test_no_code_of_a_directory_is_run(directories: tuple[str, Path, Path, Path]) -> None:
    """Yet units, sides, meanings, the section `compare`, and how many runs there will be are known."""
    own, a, b, log = directories
    half = a.with_name("half")
    for words in (
        ("status", a),
        ("status", half),
        ("plot", a, "--format", "png"),
        ("plot", half, "--format", "png"),
        ("compare", a, b),
        ("compare", a, "--by", "stride"),
    ):
        result = call(*words)
        assert result.exit_code == 0, result.stderr
    assert "sample is grid, whose variants are not drawn" in call("sensitivity", a).stderr
    assert "80 of 160 runs, not complete" in call("status", half).stdout
    assert "gait: trt and lat" in call("compare", a, b).stdout
    assert (a / "plots" / "differences.png").exists()
    merged = call("merge", a, half, "--out", a.with_name("both"))
    if own == "controller":
        assert merged.exit_code == 1
        assert "field 'controller' is " in merged.stderr
        assert "it is code, which a command that only reads does not run" in merged.stderr
        assert merged.stderr.count("\n") == 1
    else:
        assert merged.exit_code == 0, merged.stderr
        table = read_table(a.with_name("both"))
        assert table.num_rows == 160
        assert meta(table.schema.field("yaw_shake")) == meta(read_table(a).schema.field("yaw_shake"))
    assert not log.exists(), "it was run"


def test_what_is_merged_is_gone_on_with(directories: tuple[str, Path, Path, Path]) -> None:
    """The merged directory has the code, which `sweep` then runs: nothing is simulated again."""
    own, a, _, log = directories
    if own == "controller":
        with pytest.raises(DirectoryError, match="which a command that only reads does not run"):
            merge_sweeps([a, a.with_name("half")], a.with_name("both"))
        return
    merge_sweeps([a.with_name("half"), a], out := a.with_name("both"))
    assert not log.exists()
    simulator = Measuring()
    assert run_sweep(out / "sweep.yaml", out, simulator=simulator).complete
    assert simulator.batches == []
    assert log.exists()


def test_a_file_that_is_not_that_of_the_table_is_not_run_either(directories: tuple[str, Path, Path, Path]) -> None:
    own, a, b, log = directories
    (a / f"{own}.py").write_text((a / f"{own}.py").read_text() + "\n")
    with pytest.raises(DirectoryError, match=r"it is code, which a command that only reads does not run\."):
        merge_sweeps([a, b], a.with_name("both"))
    assert call("status", a).exit_code == 0
    assert not log.exists()
    with own_metrics.without_code({}), pytest.raises(loading.ParameterError, match="does not run"):
        own_metrics.load_metrics(str(b / "metrics.py") if own == "metrics" else "json:loads")


RECORDED = {"rows": 3, "fields": {"set": {}}, "labelled": [], "parameters": {}, "comparison": None, "metrics": {}}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        "null",
        '{"rows": 3}',
        "[" * 5000,
        *(json.dumps(RECORDED | {name: wrong}) for name, wrong in (("rows", "3"), ("fields", {}), ("parameters", 1))),
        json.dumps(RECORDED | {"metrics": {"a": [1]}}),
        json.dumps(RECORDED | {"metrics": {"a": [{"name": "b"}]}}),
    ],
)
def test_a_damaged_record_is_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(DirectoryError, match=r"sweep.json is damaged: run nermo-mjx sweep .* again"):
        SweepRecord.of_directory(tmp_path)
