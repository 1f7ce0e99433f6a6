"""Experiment trackers for long runs: TensorBoard and MLflow, each an extra."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from nermo_mjx.runs.files import WrongDirectory, clear_errors, replace_file


class NoTracker(WrongDirectory):
    """An unknown tracker, or one whose package is not installed; the message says what to do."""


class Tracker(Protocol):
    """Receives values by name, at increasing steps; `close` is told whether the work was completed."""

    def log(self, step: int, numbers: Mapping[str, float]) -> None: ...

    def close(self, *, whole: bool) -> None: ...


class _Needs(NamedTuple):
    """The module of a tracker, and the package that has it."""

    module: str
    package: str


#: Trackers by the name of their extra.
TRACKERS: Final = {
    "tensorboard": _Needs("tensorboardX", "tensorboardX"),
    "mlflow": _Needs("mlflow", "mlflow-skinny"),
}
_RUN: Final = "mlflow.json"


class TensorBoard:
    """Scalars in DIR/tensorboard, which `tensorboard --logdir DIR` shows; a resumed session adds a file."""

    def __init__(self, out: Path, part: str) -> None:
        from tensorboardX import SummaryWriter

        # Files are named by the second: of two sessions within one, the later would overwrite the earlier.
        self._writer = SummaryWriter(str(out / "tensorboard" / part), filename_suffix=f".{time.time_ns()}")

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        for name, value in numbers.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def close(self, *, whole: bool) -> None:
        self._writer.close()


class MLflow:
    """A run of the experiment `nermo_mjx`, where MLFLOW_TRACKING_URI says, else in DIR/mlruns.

    DIR/mlflow.json names it, so that a resumed session adds to it.
    """

    def __init__(self, out: Path, part: str) -> None:
        from mlflow.entities import Metric
        from mlflow.tracking import MlflowClient

        # MLflow prefers a database, which needs its larger package.
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
        self._metric = Metric
        where = os.environ.get("MLFLOW_TRACKING_URI") or (out / "mlruns").absolute().as_uri()
        self._client = MlflowClient(tracking_uri=where)
        noted = out / (f"mlflow-{part}.json" if part else _RUN)
        self._run = self._known(noted, where) or self._new(noted, where, f"{out.absolute().name} {part}".strip())

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        now = int(time.time() * 1000)
        self._client.log_batch(self._run, [self._metric(name, value, now, step) for name, value in numbers.items()])

    def close(self, *, whole: bool) -> None:
        self._client.set_terminated(self._run, "FINISHED" if whole else "KILLED")

    def _known(self, noted: Path, where: str) -> str | None:
        """The run of an earlier session, if it is still there."""
        with contextlib.suppress(Exception):
            about = json.loads(noted.read_text())
            if about["uri"] == where:
                self._client.update_run(about["run"], status="RUNNING")
                return str(about["run"])
        return None

    def _new(self, noted: Path, where: str, name: str) -> str:
        found = self._client.get_experiment_by_name("nermo_mjx")
        experiment = found.experiment_id if found is not None else self._client.create_experiment("nermo_mjx")
        run: str = self._client.create_run(experiment, run_name=name).info.run_id
        with clear_errors(noted.parent):
            replace_file(noted, (json.dumps({"uri": where, "run": run}, indent=2) + "\n").encode())
        return run


def check_trackers(names: Sequence[str]) -> None:
    """Refuse trackers whose package is not installed.

    Raises:
        NoTracker: with the sentence that says which one to install.
    """
    for name in names:
        if name not in TRACKERS:
            raise NoTracker(f"log is {name!r}: allowed are {', '.join(TRACKERS)}.")
        if importlib.util.find_spec(TRACKERS[name].module) is None:
            package = TRACKERS[name].package
            raise NoTracker(f"log is {name}, which needs {package}: install nermo-mjx with its extra {name}, or "
                            f"{package} itself, by pip.")  # fmt: skip


@contextlib.contextmanager
def tracked(names: Sequence[str], out: Path, part: str = "") -> Iterator[list[Tracker]]:
    """Open trackers of a directory.

    Args:
        names: of `TRACKERS`.
        out: the directory.
        part: of several processes that write the directory, which one this is.
    """
    kinds: dict[str, Callable[[Path, str], Tracker]] = {"tensorboard": TensorBoard, "mlflow": MLflow}
    with contextlib.ExitStack() as stack:
        opened: list[Tracker] = []
        for name in names:
            tracker = kinds[name](out, part)
            stack.push(functools.partial(_close, tracker))
            opened.append(tracker)
        yield opened


def _close(tracker: Tracker, kind: type[BaseException] | None, *_: object) -> None:
    tracker.close(whole=kind is None)


def finite(numbers: Mapping[str, float]) -> dict[str, float]:
    """The finite values: the others cannot be plotted."""
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
