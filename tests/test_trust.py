# Tests of trust.py
"""Commands that only read files of other people run no code of these files."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import call
from fakes.search_fake import SPEED as SEARCH
from fakes.strangers import CANARY, Measuring
from fakes.sweep_fake import SPEC as SWEEP
from fakes.tune_fake import SPEC as TUNE

from nermo_mjx import trust
from nermo_mjx.cli.kinds import KINDS
from nermo_mjx.control import protocol
from nermo_mjx.learn.policy import load_policy
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import custom_metrics
from nermo_mjx.sweep import DirectoryError, merge_sweeps, read_table, run_sweep
from nermo_mjx.sweep.table import meta

#: The file that says what a directory is for, by kind.
ROOT = Path(__file__).parents[1]
POLICY = ROOT / "tests" / "data" / "former_policy.npz"
RECORDED = ROOT / "docs" / "howto" / "terrain" / "walks" / "ramp" / "stiff.npz"
#: The file that says what a directory is for, by kind.
SPECS: dict[str, tuple[str, dict[str, Any]]] = {
    "sweep": ("sweep.yaml", SWEEP),
    "search": ("search.yaml", SEARCH),
    "tuning": ("tuning.yaml", TUNE),
    "training": ("training.yaml", {"worlds": 64, "steps": 10_000}),
}


@pytest.mark.parametrize("source", ["metrics", "controller", "module", "deep"])
@pytest.mark.parametrize("kind", KINDS)
def test_no_command_that_reads_runs_the_code_of_a_directory(
    kind: str, source: str, tmp_path: Path, canary: Path
) -> None:
    out, code = tmp_path / "theirs", (tmp_path / "own.py").read_text()
    code_fields = {
        "metrics": {"metrics": "metrics.py"},
        "controller": {"controller": "controller.py:stiff"},
        "module": {"metrics": "own"},
        "deep": {"controller": "own.under:stiff"},
    }[source]
    (out / "results").mkdir(parents=True)
    for name in ("metrics.py", "controller.py", "own.py", "sitecustomize.py"):
        (out / name).write_text(code)
    (out / "run.json").write_text(json.dumps({"kind": kind}))
    if kind in SPECS:
        name, spec = SPECS[kind]
        (out / name).write_text(json.dumps(spec | code_fields))
    for words in (
        ("status", out),
        ("status", out, "--json"),
        ("plot", out, "--format", "png"),
        ("compare", out, out),
        ("compare", out, "--by", "gait"),
        ("sensitivity", out),
        ("view", out, "--no-open", "--out", out / "page.html"),
        ("merge", out, out, "--out", tmp_path / "both"),
    ):
        result = call(*words)
        assert result.exception is None or isinstance(result.exception, SystemExit), (
            words,
            result.exception,
        )
        assert not canary.exists(), f"{words[0]} ran it"
        assert result.exit_code == 0 or result.stderr.count("\n") == 1, result.stderr


@pytest.fixture(params=["metrics", "controller"])
def directories(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, Path, Path]:
    """What is own, two directories that were moved here, and the file that their code writes when it is run."""
    log, folder = tmp_path / "log", tmp_path / "made"
    code = {request.param: {"metrics": "own.py", "controller": "own.py:stiff"}[request.param]}
    folder.mkdir()
    (folder / "own.py").write_text(CANARY.format(log=str(log)))
    vary = {"frequency": {"linspace": [0.5, 1.0, 80]}, "stride": [0.5, 0.7]}
    for name, gait in (("a", "trot"), ("b", "lateral_walk")):
        spec = code | {"gait": gait, "plots": False, "vary": vary, "compare": {"by": "stride"}}
        (folder / f"{name}.yaml").write_text(json.dumps(spec))
        run_sweep(folder / f"{name}.yaml", folder / name, simulator=Measuring())
    run_sweep(folder / "a.yaml", folder / "half", chunk=40, shard=(0, 2), simulator=Measuring())
    for name in ("a", "b", "half"):
        shutil.move(folder / name, tmp_path / name)
    assert log.read_text().startswith("run")
    log.unlink()
    protocol._imported.cache_clear()
    return request.param, tmp_path / "a", tmp_path / "b", log


@pytest.mark.release
def test_no_code_of_a_directory_is_run(directories: tuple[str, Path, Path, Path]) -> None:
    """Yet units, sides, meanings, the section `compare`, and how many runs there will be are known."""
    code, a, b, log = directories
    half = a.with_name("half")
    for words in (
        ("status", a),
        ("plot", a, "--format", "png"),
        ("plot", half, "--format", "png"),
        ("compare", a, "--by", "stride"),
    ):
        result = call(*words)
        assert result.exit_code == 0, result.stderr
    assert "sample is grid, whose variants are not drawn" in call("sensitivity", a).stderr
    assert "80 of 160 runs, not complete" in call("status", half).stdout
    assert "gait: trot and lateral_walk" in call("compare", a, b).stdout
    assert (a / "plots" / "differences.png").exists()
    merged = call("merge", a, half, "--out", a.with_name("both"))
    if code == "controller":
        assert merged.exit_code == 1
        assert "field 'controller' is " in merged.stderr
        assert "it is code, which a command that only reads does not run" in merged.stderr
        assert merged.stderr.count("\n") == 1
    else:
        assert merged.exit_code == 0, merged.stderr
        table = read_table(a.with_name("both"))
        assert table.num_rows == 160
        assert meta(table.schema.field("yaw_shake")) == meta(
            read_table(a).schema.field("yaw_shake")
        )
    assert not log.exists(), "it was run"
    if (
        code == "metrics"
    ):  # the merged directory has the code, which `sweep` then runs: nothing is simulated again
        union, simulator = a.with_name("both"), Measuring()
        assert run_sweep(union / "sweep.yaml", union, simulator=simulator).complete
        assert simulator.batches == []
        assert log.exists()


def test_a_file_that_is_not_that_of_the_table_is_not_run_either(
    directories: tuple[str, Path, Path, Path],
) -> None:
    code, a, b, log = directories
    (a / f"{code}.py").write_text((a / f"{code}.py").read_text() + "\n")
    with pytest.raises(
        DirectoryError, match=r"it is code, which a command that only reads does not run\."
    ):
        merge_sweeps([a, b], a.with_name("both"))
    assert call("status", a).exit_code == 0
    assert not log.exists()
    with trust.only_reading(), pytest.raises(protocol.ParameterError, match="does not run"):
        custom_metrics.load_metrics(str(a / "metrics.py") if code == "metrics" else "json:loads")


@pytest.mark.parametrize(
    "code_fields", [{"controller": "own.py:stiff"}, {"metrics": "own.py"}, {"scene": "own.xml"}]
)
def test_a_policy_names_no_code(code_fields: dict[str, str], tmp_path: Path, canary: Path) -> None:
    with np.load(POLICY) as file:
        arrays = {name: file[name] for name in file.files}
    for level in ("base", "top"):
        metadata = json.loads(arrays["about"].tobytes())
        (metadata if level == "top" else metadata["base"]).update(code_fields)
        np.savez(
            tmp_path / "a.npz",
            **arrays | {"about": np.frombuffer(json.dumps(metadata).encode(), np.uint8)},
        )
        with pytest.raises(ParameterError, match="holds no policy of `nermo-mjx train`: "):
            load_policy(tmp_path / "a.npz")
    assert not canary.exists()


@pytest.mark.release
def test_a_recording_names_no_code(tmp_path: Path, canary: Path) -> None:
    recording = Recording.load(RECORDED)
    setup = dict(recording.metadata["setup"] or {}) | {
        "controller": "own.py:stiff",
        "metrics": ["own.py"],
    }
    theirs = dataclasses.replace(
        recording.between(1.0, 1.1), metadata={**recording.metadata, "setup": setup}
    )
    path = theirs.save(tmp_path / "walk.npz")
    for words in (
        ("view", path, "--no-open", "--out", tmp_path / "page.html"),
        ("play", path, "--xml", tmp_path / "walk.xml"),
        ("plot", path, "--out", tmp_path / "plots", "--format", "png"),
    ):
        result = call(*words)
        assert result.exit_code == 0, result.stderr
    assert not canary.exists()


def test_whose_code_is_run_is_said_before(tmp_path: Path, canary: Path) -> None:
    messages: list[tuple[str, bool]] = []
    token = trust.MESSAGE_HANDLER.set(lambda sentence: messages.append((sentence, canary.exists())))
    try:
        custom_metrics.load_metrics("own.py")
        custom_metrics.load_metrics("own.py")
    finally:
        trust.MESSAGE_HANDLER.reset(token)
    assert messages == [(f"the Python code of {tmp_path / 'own.py'} is run.", False)]
    assert canary.exists()
