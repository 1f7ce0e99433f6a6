# Tests of runs/directory.py, runs/rows.py, runs/job.py
"""Processes of every kind of job, killed by SIGKILL before the n-th change of their directory: when the same command
has gone on, the tables are those of a job that was left alone, bit for bit.

test_kills.py OUT: imports everything once, and forks a process for each run, before JAX starts any thread.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from nermo_mjx.files import TEMPORARY_SUFFIX

#: Changes of a directory before which its process is killed.
BEFORE = (1, 2, 3, 4, 5, 6, 8, 12, 17)
#: Columns that are never twice the same.
CLOCK = "wall_seconds"


@pytest.mark.long
def test_forty_kills_leave_the_tables_as_they_were(tmp_path: Path) -> None:
    process = subprocess.run(
        [sys.executable, __file__, str(tmp_path)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr[-3000:]
    kills = json.loads(process.stdout.splitlines()[-1])
    assert sum(kills.values()) >= 40, kills
    assert min(kills.values()) >= 3, kills


def jobs() -> dict[str, Callable[[Path], pa.Table]]:
    """By kind: runs a job into a directory, and reads its table."""
    from fakes.experiment_fake import Fake
    from fakes.search_fake import SPEED
    from fakes.search_fake import FakeSimulator as Searched
    from fakes.sweep_fake import SPEC, FakeSimulator
    from fakes.tune_fake import SPEC as TUNE
    from fakes.tune_fake import FakeProblem

    from nermo_mjx.experiments import plots
    from nermo_mjx.experiments.run import EXPERIMENTS, run_experiments
    from nermo_mjx.optimize import Tuning, read_history, run_search, run_tuning
    from nermo_mjx.sweep import merge_sweeps, read_table, run_sweep

    name = next(iter(EXPERIMENTS))
    EXPERIMENTS[name] = Fake(name).experiment()
    plots.figures_of_experiment = lambda outcome, lines: []  # type: ignore[assignment, return-value]

    def sweep(out: Path) -> pa.Table:
        run_sweep(SPEC, out, chunk=4, simulator=FakeSimulator())
        return read_table(out)

    def merge(out: Path) -> pa.Table:
        for i in range(2):
            run_sweep(
                SPEC,
                out.with_name(f"{out.name}-{i}"),
                chunk=4,
                shard=(i, 2),
                simulator=FakeSimulator(),
            )
        merge_sweeps([out.with_name(f"{out.name}-{i}") for i in range(2)], out)
        return read_table(out)

    def search(out: Path) -> pa.Table:
        run_search(SPEED, out, simulator=Searched())
        return read_table(out)

    def tuning(out: Path) -> pa.Table:
        tuning = Tuning.from_dict(TUNE | {"iterations": 4})
        run_tuning(tuning, out, problem=FakeProblem(tuning))
        return read_history(out).drop([CLOCK])

    def experiments(out: Path) -> pa.Table:
        outcome = run_experiments([name], out, engine="c", video=False).results[0].outcome
        return pa.table({key: pa.array(column.tolist()) for key, column in outcome.columns.items()})

    return {
        "sweep": sweep,
        "merge": merge,
        "search": search,
        "tuning": tuning,
        "experiments": experiments,
    }


def ended(job: Callable[[Path], pa.Table], out: Path, calls: int = 0) -> bool:
    """Run a job in a process of its own, which writes its table beside the directory; whether it was killed."""
    child = os.fork()
    if child:
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status):
            return os.WTERMSIG(status) == signal.SIGKILL
        assert os.WEXITSTATUS(status) == 0, out
        return False
    code, changes = 1, 0

    def counted(act: Callable[..., Any]) -> Callable[..., Any]:
        def acting(*arguments: Any, **keywords: Any) -> Any:
            nonlocal changes
            changes += str(arguments[0]).startswith(str(out))
            if changes == calls > 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return act(*arguments, **keywords)

        return acting

    try:
        for name in ("replace", "rename", "link"):
            setattr(os, name, counted(getattr(os, name)))
        Path.with_name(out, f"{out.name}.txt").write_text(shown(job(out)))
        code = 0
    finally:
        sys.stderr.flush()
        os._exit(code)


def shown(table: pa.Table) -> str:
    """All of a table's values, to the last bit."""
    table = table.drop([name for name in table.column_names if name == CLOCK])
    return json.dumps(
        {
            name: [repr(value) for value in table.column(name).to_pylist()]
            for name in table.column_names
        }
    )


if __name__ == "__main__":
    import faulthandler

    faulthandler.enable()
    top, kills = Path(sys.argv[1]), {}
    for kind, job in jobs().items():
        reference = top / f"{kind}-alone"
        assert not ended(job, reference)
        for calls in BEFORE:
            out = top / f"{kind}-{calls}"
            if not ended(job, out, calls):
                break
            kills[kind] = kills.get(kind, 0) + 1
            assert not ended(job, out), out
            texts = [
                directory.with_name(f"{directory.name}.txt").read_text()
                for directory in (reference, out)
            ]
            assert texts[0] == texts[1], out
            assert [
                path.name
                for path in out.rglob("*")
                if "aside" in path.name or TEMPORARY_SUFFIX in path.name
            ] == [], out
        print(kind, kills.get(kind), flush=True)
    print(json.dumps(kills))
