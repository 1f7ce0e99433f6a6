"""The job that identifies a robot from its logs into a directory, and its resumption.

DIR/results/             results of searches, one row in each part, found by their keys; see `nermo_mjx.runs.rows`
DIR/identification.json  the result; `nermo_mjx.identify.report` describes the other files
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.hardware.log import Log
from nermo_mjx.identify.body import load_body
from nermo_mjx.identify.estimation import Cache
from nermo_mjx.identify.identification import FREE_KINDS, Identification, identify_log
from nermo_mjx.identify.report import RESULT, write_identification
from nermo_mjx.identify.twin import PREDICTED_QUANTITIES
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot.quantity import require
from nermo_mjx.robot.robot import fingerprint
from nermo_mjx.runs import code
from nermo_mjx.runs.directory import RunDirectory, digest, engine_of
from nermo_mjx.runs.job import SILENT, Progress, Watch, resumable
from nermo_mjx.runs.rows import Runs, keys_of, part_files
from nermo_mjx.runs.status import Status, last_command
from nermo_mjx.specs.described import digest_of

#: Subpackages that affect the results, in addition to `code.ROOMS`.
CODE_SUBPACKAGES: Final = ("hardware", "identify")


@dataclasses.dataclass(frozen=True)
class IdentificationResult:
    """The outcome of an identification.

    Attributes:
        out: Its directory.
        identification: The result.
        content: Content of identification.json.
    """

    out: Path
    identification: Identification
    content: dict[str, Any]


@shows_progress("identify")
# Many parameters because each is an option of the job, most by keyword only.
def run_identification(
    logs: Sequence[Log],
    out: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] = "nermo_lite",
    free: Sequence[str] = FREE_KINDS,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    judges: Sequence[Log] = (),
    seed: int = 0,
    watch: Watch = SILENT,
    progress: bool = True,
) -> IdentificationResult:
    """Identify a robot from its logs into a directory, or resume the identification in it.

    The results of the searches are stored, so that a killed process loses only the search in progress.

    Args:
        logs: Logs to fit, see `read_log`.
        out: The directory, see `nermo_mjx.identify.run`.
        model: MJCF file, or `nermo_lite` or `nermo_41`.
        free: Kinds of parameters that are estimated.
        ranges: Name or kind of a parameter -> (low, high), inside which it is searched.
        judges: Logs that validate the result; by default the last quarter of each log does.
        seed: Seed of the starting points and samples.
        watch: Functions that receive the progress and messages.
        progress: Whether a terminal shows the progress if there is no watch.

    Raises:
        ParameterError: The logs and the model do not fit together, no parameter is free, or cma is not installed.
        DirectoryError, Interrupted: See "Errors of jobs" in docs/reference/python.md.
    """
    require("identify", "cma", "cma")
    unread = [
        channel.name
        for log in logs[:1]
        for channel in log.channels
        if channel.quantity not in (*PREDICTED_QUANTITIES, "command")
    ]
    if unread:
        watch.warn(f"not compared, since they are not predicted: {', '.join(unread)}.")
    body = load_body(model, [*logs, *judges], free)
    stamp = code.stamp(fingerprint(body.model), "c", CODE_SUBPACKAGES)
    channels = [
        (channel.quantity, channel.of, channel.unit, _digest(channel.times, channel.values))
        for log in (*logs, *judges)
        for channel in log.channels
    ]
    parameters = [repr(parameter) for parameter in body.parameters.values()]
    job = digest_of(stamp.id, parameters, ranges, len(logs), seed, channels)
    with RunDirectory(out, "identification from a log") as directory, resumable(directory.out):
        directory.note_session(code.session())
        runs = Runs(directory.out, job, warn=watch.warn, directory=directory)
        runs.take_codes([stamp], accept=True)
        identification = identify_log(
            logs, model, free, ranges, judges, seed,
            lambda share: watch.progress(Progress(share)), _stored(runs),
        )  # fmt: skip
        content = write_identification(identification, directory.out, last_command(directory.out))
        return IdentificationResult(directory.out, identification, content)


def _digest(*arrays: np.ndarray) -> str:
    return digest(b"".join(array.tobytes() for array in arrays))


def _stored(runs: Runs) -> Cache:
    """A cache in the rows of a directory; the key of a row is its number and the digest of its inputs."""
    numbers = itertools.count()

    def stored(compute: Callable[[], np.ndarray], inputs: np.ndarray) -> np.ndarray:
        number = np.array([next(numbers)])
        keys = keys_of(f"{runs.group} {_digest(inputs)}", {"row": number}, 1)
        if (places := runs.find(keys))[0] >= 0:
            return np.array(json.loads(runs.take(places)["result"][0].as_py()))
        result = compute()
        runs.add(keys, pa.table({"row": number, "result": [json.dumps(result.tolist())]}))
        return result

    return stored


def identification_status(out: Path) -> Status:
    """The progress of the identification in a directory."""
    done, complete = len(part_files(out)), (out / RESULT).exists()
    total, engine = done if complete else None, engine_of(out) or "c"
    return Status("steps", done, total, complete, last_command(out), engine)
