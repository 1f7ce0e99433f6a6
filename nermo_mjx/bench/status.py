"""What a directory of benchmarks holds."""

from __future__ import annotations

import shlex
from pathlib import Path

from nermo_mjx.bench.history import RESULTS, History, read
from nermo_mjx.runs.status import Status


def status(out: Path) -> Status:
    """The measurements that results.jsonl has; the commits that were measured are their code."""
    history = read(out) if (out / RESULTS).exists() else History({}, (), 0, ())
    measured = [each for machine in history.machines.values() for each in machine]
    engines = dict.fromkeys(each.good["engine"] for each in measured if each.good and "engine" in each.good)
    notes = [f"{machine}: {len(each)} kinds of measurement." for machine, each in history.machines.items()]
    failures = [failure for each in measured if (failure := each.failure())]
    go_on = f"nermo-mjx bench --into {shlex.quote(str(out))}"
    return Status("measurements", history.lines, history.lines, history.lines > 0, go_on, ", ".join(engines) or None,
                  code=history.commits, notes=(*notes, *history.remarks, *failures))  # fmt: skip
