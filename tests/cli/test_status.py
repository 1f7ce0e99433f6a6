# Tests of cli/directories.py, cli/kinds.py, runs/status.py
"""`nermo-mjx status`: each kind of directory says what it holds, of this release and the former; nothing changes."""

from __future__ import annotations

import functools
import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import call
from fakes.experiment_fake import Fake, pretend
from fakes.sweep_fake import SPEC, FakeSimulator, contents, part_of
from fakes.tune_fake import SPEC as TUNE_SPEC
from fakes.tune_fake import FakeProblem

from nermo_mjx.experiments import plots
from nermo_mjx.experiments.run import run_experiments
from nermo_mjx.identify.report import RESULT
from nermo_mjx.identify.run import _stored
from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.runs import Interrupted, RunDirectory, codes_of, session, stamp
from nermo_mjx.runs.code import local_time
from nermo_mjx.runs.rows import Runs
from nermo_mjx.sweep import run_sweep

status = functools.partial(call, "status")
KEYS = {"kind", "rows", "rows_done", "code", "engine", "complete"}


def said(out: Path) -> dict[str, Any]:
    """What `--json` gives; neither it nor the text for people changes anything."""
    before = contents(out)
    result, text = status(out, "--json"), status(out)
    assert (result.exit_code, text.exit_code) == (0, 0), result.stderr + text.stderr
    assert before == contents(out)
    content: dict[str, Any] = json.loads(result.stdout)
    assert set(content) == KEYS
    return content


def known(content: dict[str, Any]) -> tuple[Any, ...]:
    """What does not depend on the machine."""
    return tuple(content[key] for key in ("kind", "rows", "rows_done", "complete"))


def test_a_sweep_says_how_far_it_is_and_how_to_go_on(tmp_path: Path) -> None:
    out = tmp_path / "a sweep"
    run_sweep(SPEC, out, chunk=8, simulator=FakeSimulator())
    assert known(said(out)) == ("sweep", 36, 36, True)
    assert re.search(r"a sweep, 36 runs, complete\n", status(out).stdout)
    part_of(out, 1).unlink()
    rows_done = said(out)["rows_done"]
    assert 0 < rows_done < 36
    text = status(out).stdout
    assert f"{out}: a sweep, {rows_done} of 36 runs, not complete" in text
    assert f"resume   nermo-mjx sweep '{out}/sweep.yaml' --out '{out}'\n" in text
    damaged = part_of(out, 2)
    damaged.write_text("half")
    assert said(out)["rows_done"] < rows_done
    assert f"results/{damaged.name} is damaged" in status(out).stdout


def test_a_directory_that_is_being_written_is_read(tmp_path: Path) -> None:
    with RunDirectory(tmp_path, "sweep") as directory:
        code = stamp("a model", "c")
        directory.take_code(code, holds_rows=False)
        directory.note_session(
            {"started": "2026-01-01T00:00:00", "command": "nermo-mjx sweep a.yaml --out elsewhere"}
        )
        content = said(tmp_path)
        assert known(content) == ("sweep", None, 0, False)
        assert content["code"] == [code.id]
        text = status(tmp_path).stdout
        assert (
            f"code     {code.id}: nermo-mjx {code.package}, sources {code.sources}, model a model, engine c"
            in text
        )
        assert "2026-01-01 00:00" in text
        assert "nermo-mjx sweep a.yaml --out elsewhere" in text


def test_the_last_three_sessions_are_shown(tmp_path: Path) -> None:
    """Where run.json has no codes, the chunks know the engine."""
    run_sweep(SPEC, tmp_path, chunk=8, simulator=FakeSimulator())
    sessions = [
        {
            "started": "2026-01-01T00:00:00+0000",
            "command": "nermo-mjx sweep a",
            "versions": {"jax": "0.1"},
            "machine": {"host": "far", "cores": 4},
        }
    ]
    (tmp_path / "run.json").write_text(json.dumps({"kind": "sweep", "sessions": sessions * 5}))
    content = said(tmp_path)
    assert known(content) == ("sweep", 36, 36, True)
    assert content["code"] == []
    assert content["engine"]
    text = status(tmp_path).stdout
    assert "code     not known" in text
    assert "session  and 2 earlier" in text
    assert len(re.findall(r"2026-01-01 \d\d:\d\d \S+, jax 0.1, on far, 4 cores", text)) == 3


@pytest.mark.parametrize(
    ("zone", "local"),
    [
        ("Asia/Tokyo", "2026-01-01 09:30 JST"),
        ("UTC", "2026-01-01 00:30 UTC"),
        ("EST5EDT", "2025-12-31 19:30 EST"),
    ],
)
def test_times_are_those_of_this_machines_zone_and_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zone: str, local: str
) -> None:
    """Wherever a session ran; what is no time is shown as it is."""
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    sessions = [
        {"started": time_text}
        for time_text in ("2026-01-01T00:30:00+0000", "2025-12-31T16:30:00-0800", "2026-01-01")
    ]
    (tmp_path / "run.json").write_text(
        json.dumps({"kind": "sweep", "sessions": [*sessions, {"started": "then"}, {}]})
    )
    text = status(tmp_path).stdout
    assert "session  then, " in text
    assert "session  some time, " in text
    assert "session  2026-01-01 00:00 " in text
    assert [local_time(time_text["started"]) for time_text in sessions[:2]] == [local, local]
    monkeypatch.undo()
    time.tzset()


def test_a_tuning_counts_the_evaluations_of_its_starts(tmp_path: Path) -> None:
    tuning = Tuning.from_dict(TUNE_SPEC | {"starts": 2, "iterations": 3})
    run_tuning(tuning, tmp_path, problem=FakeProblem(tuning))
    assert known(said(tmp_path)) == ("tuning", 8, 8, True)
    (tmp_path / "history.parquet").unlink()
    assert known(said(tmp_path)) == ("tuning", 8, 0, False)
    assert (
        f"resume   nermo-mjx tune {tmp_path}/tuning.yaml --out {tmp_path}"
        in status(tmp_path).stdout
    )


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> dict[str, Fake]:
    """Experiments that simulate and draw nothing."""
    return pretend(monkeypatch)


def test_experiments_are_complete_when_all_that_was_asked_for_is_there(
    fakes: dict[str, Fake], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "sys.argv", ["/usr/bin/nermo-mjx", "experiment", "all", "--out", "elsewhere", "--no-video"]
    )
    fakes["maze"].error = KeyboardInterrupt()
    with pytest.raises(Interrupted):
        run_experiments(["turning", "maze"], tmp_path, engine="c", video=False)
    content = said(tmp_path)
    assert known(content) == ("experiments", None, 18, False)
    assert (content["engine"], content["code"]) == ("c", list(codes_of(tmp_path)))
    text = status(tmp_path).stdout
    assert "maze is not finished." in text
    assert f"resume   nermo-mjx experiment all --out {tmp_path} --no-video\n" in text
    fakes["maze"].error = None
    run_experiments(["turning", "maze"], tmp_path, video=False)
    assert known(said(tmp_path)) == ("experiments", 36, 36, True)
    assert f"figures  nermo-mjx plot {tmp_path}\n" in status(tmp_path).stdout


def test_an_experiment_that_was_killed_while_it_drew_is_not_complete(
    fakes: dict[str, Fake], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as drawing:
        drawing.setattr(plots, "figures_of_experiment", killed)
        with pytest.raises(Interrupted):
            run_experiments(["turning"], tmp_path, engine="c", video=False)
    assert known(said(tmp_path)) == ("experiments", None, 18, False)
    assert "turning is not finished." in status(tmp_path).stdout
    run_experiments(["turning"], tmp_path, video=False)
    assert known(said(tmp_path)) == ("experiments", 18, 18, True)
    assert len(fakes["turning"].asked) == 1


@pytest.mark.parametrize("kind", ["identification", "identification from a log"])
def test_an_identification_counts_its_steps(tmp_path: Path, kind: str) -> None:
    """The first kind is the directory of an earlier release, which identified from the published speeds."""
    with RunDirectory(tmp_path, kind) as directory:
        directory.note_session(session())
        stored = _stored(Runs(tmp_path, "0", directory=directory))
        for number in range(2):
            stored(lambda number=number: np.full(3, number), np.zeros(1))
    assert known(said(tmp_path)) == (kind, None, 2, False)
    (tmp_path / RESULT).write_text("{}")
    assert known(said(tmp_path)) == (kind, 2, 2, True)


def test_what_is_no_directory_of_results_is_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name, sentence in (
        ("missing", "there is no such file or directory."),
        ("file", "is not a results directory"),
        (".", "is not a results directory: it contains neither a sweep, "),
    ):
        result = status(tmp_path / name)
        assert result.exit_code == 2
        assert sentence in result.stderr
    (tmp_path / "run.json").write_text('{"kind": "census"}')
    assert (
        "holds a census, which this release does not open: use the release that made it"
        in status(tmp_path).stderr
    )
    (tmp_path / "run.json").write_text('{"kind": "landscape"}')
    assert "holds a landscape, which this release does not open" in status(tmp_path).stderr, (
        "of an earlier release"
    )
    (tmp_path / "run.json").write_text('{"kind": ')
    result = status(tmp_path)
    assert result.exit_code == 1
    assert "run.json: not valid JSON" in result.stderr
