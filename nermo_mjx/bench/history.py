"""The runs in results.jsonl: the latest good figures of each measurement, by machine, and later failures."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from nermo_mjx.bench.columns import rows, titled
from nermo_mjx.bench.registry import CASES
from nermo_mjx.runs.files import replace_file
from nermo_mjx.runs.status import Status

RESULTS: Final = "results.jsonl"
#: Heading of runs that ended before they could report their machine.
UNKNOWN: Final = "Unknown machine"
_VERSIONS: Final = ("mujoco", "jax", "python")


@dataclasses.dataclass
class Measured:
    """The results of one measurement on one machine.

    Attributes:
        good: its newest line with figures, and in `made` when it was measured and with what; None if there is none.
        failed: the latest line with an error, if that is newer.
    """

    good: dict[str, Any] | None = None
    failed: dict[str, Any] | None = None

    @property
    def case(self) -> str:
        """Name of the measurement."""
        line = self.good or self.failed
        assert line is not None
        return str(line["case"])

    def failure(self) -> str | None:
        """A sentence on the failure, its date and the date of the figures; None without a failure."""
        if self.failed is None:
            return None
        line = {key: value for key, value in self.failed.items() if key not in ("made", "day")}
        figures = f"; the figures are of {self.good['day']}" if self.good else ""
        return f"{str(titled(line)).rstrip('.')}. That was on {self.failed['made']}{figures}."


@dataclasses.dataclass(frozen=True)
class History:
    """The contents of results.jsonl.

    Attributes:
        machines: machine -> its measurements, in the order of the registry.
        remarks: a sentence about each line that is not shown.
        lines: readable measurements in the file, of any age.
        commits: measured ones, oldest first.
    """

    machines: dict[str, list[Measured]]
    remarks: tuple[str, ...]
    lines: int
    commits: tuple[str, ...]


def append(folder: Path, run: Mapping[str, Any]) -> None:
    """Append a run of `run_bench` to FOLDER/results.jsonl as one line; existing lines are unchanged."""
    path = folder / RESULTS
    before = path.read_bytes() if path.exists() else b""
    if before and not before.endswith(b"\n"):  # truncated when the process was killed
        before += b"\n"
    replace_file(path, before + json.dumps(run).encode() + b"\n")


def read(folder: Path) -> History:
    """The content of FOLDER/results.jsonl; unreadable lines become remarks.

    Raises:
        OSError: the file does not exist or cannot be read.
    """
    found: dict[str, dict[tuple[Any, ...], Measured]] = {}
    unreadable, remarks, commits, count = list[int](), list[str](), dict[str, None](), 0
    for number, text in enumerate((folder / RESULTS).read_bytes().splitlines(), 1):
        try:
            run = json.loads(text)
            machine, made, lines = _machine(run["hardware"]), _made(run), list(run["cases"])
        except (ValueError, KeyError, TypeError, AttributeError):
            unreadable.append(number)
            continue
        commits[str(run["commit"])] = None
        for line in lines:
            wrong = _wrong(line)
            if wrong:
                remarks.append(f"Line {number} of {RESULTS} has a case {wrong}; it is not shown.")
                continue
            count += 1
            known = found.setdefault(machine, {}).setdefault(_key(line), Measured())
            line = {**line, "made": made, "day": run["date"][:10]}
            if "error" in line:
                known.failed = line
            else:
                known.good, known.failed = line, None
    if unreadable:
        *most, last = map(str, unreadable)
        named = f"Lines {', '.join(most)} and {last}" if most else f"Line {last}"
        remarks.insert(0, f"{named} of {RESULTS} cannot be read, and {'are' if most else 'is'} not shown.")
    order = sorted(found, key=lambda machine: machine == UNKNOWN)
    return History({machine: _in_order(found[machine]) for machine in order}, tuple(remarks), count, tuple(commits))


def is_known(folder: Path, case: str, options: Mapping[str, Any]) -> bool:
    """Whether results.jsonl has good figures of a measurement on any machine."""
    if not (folder / RESULTS).exists():
        return False
    wanted = _key({"case": case, **options})
    measured = [each for machine in read(folder).machines.values() for each in machine]
    return any(each.good is not None and _key(each.good) == wanted for each in measured)


def status(out: Path) -> Status:
    """Status of a directory of benchmarks: the content of results.jsonl; its code is the measured commits."""
    history = read(out) if (out / RESULTS).exists() else History({}, (), 0, ())
    measured = [each for machine in history.machines.values() for each in machine]
    engines = dict.fromkeys(each.good["engine"] for each in measured if each.good and "engine" in each.good)
    notes = [f"{machine}: {len(each)} kinds of measurement." for machine, each in history.machines.items()]
    failures = [failure for each in measured if (failure := each.failure())]
    go_on = f"nermo-mjx bench --into {shlex.quote(str(out))}"
    return Status("measurements", history.lines, history.lines, history.lines > 0, go_on, ", ".join(engines) or None,
                  code=history.commits, notes=(*notes, *history.remarks, *failures))  # fmt: skip


def _machine(about: Mapping[str, Any] | None) -> str:
    return f"{about['device']}; {about['cores']} x {about['cpu']}" if about else UNKNOWN


def _made(run: Mapping[str, Any]) -> str:
    versions = [f"{name} {run['hardware'][name]}" for name in _VERSIONS] if run["hardware"] else []
    return ", ".join([run["date"][:10], f"commit {run['commit']}", *versions])


def _wrong(line: Any) -> str:
    """Why a measurement cannot be shown; empty if it can."""
    name = line.get("case") if isinstance(line, dict) else None
    if name not in CASES:
        return f"{name!r} that this version does not know"
    try:
        list(rows(line))
        titled(line)
    except (KeyError, TypeError, ValueError):
        return f"{name!r} that cannot be read"
    return ""


def _key(line: Mapping[str, Any]) -> tuple[Any, ...]:
    """The key of a measurement; in lines older than an option, the value that it implicitly had."""
    options = CASES[line["case"]].options
    return (line["case"], *(line.get(name, option.unsaid) for name, option in options.items()))


def _in_order(found: Mapping[tuple[Any, ...], Measured]) -> list[Measured]:
    order = list(CASES)
    return [found[key] for key in sorted(found, key=lambda key: (order.index(key[0]), *map(_sortable, key[1:])))]


def _sortable(value: Any) -> tuple[int, Any]:
    return (0, value) if isinstance(value, (int, float)) else (1, str(value))
