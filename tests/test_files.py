"""Tests of nermo_mjx.files, nermo_mjx.recording and nermo_mjx.progress: declared arrays, parts, and remaining time."""

from __future__ import annotations

import io

import numpy as np
import pytest

from nermo_mjx.files import FileError, check_arrays
from nermo_mjx.progress import ProgressBar
from nermo_mjx.recording import Recording

DECLARED = {"time": ("f", ("T",)), "qpos": ("f", ("T", "nq")), "eyes": ("iu", ("T", 2, ...))}


def arrays(**changed: np.ndarray) -> dict[str, np.ndarray]:
    return {"time": np.zeros(5), "qpos": np.zeros((5, 3)), "eyes": np.zeros((5, 2, 4, 4), int)} | changed


def test_arrays_of_a_file_have_their_declared_shapes_and_one_length() -> None:
    check_arrays(arrays(), DECLARED, "a file")
    check_arrays(arrays(eyes=np.zeros((5, 2), np.uint8)), DECLARED, "a file")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"qpos": np.zeros((4, 3))}, r"a file: 'qpos' has the shape \(4, 3\): expected \(5, nq\)\."),
        ({"qpos": np.zeros(5)}, r"'qpos' has the shape \(5,\): expected \(5, nq\)\."),
        ({"eyes": np.zeros((5, 3, 4), int)}, r"'eyes' has the shape \(5, 3, 4\): expected \(5, 2, \.\.\.\)\."),
        ({"eyes": np.zeros((5, 2))}, "'eyes' is of type float64: expected numbers"),
    ],
)
def test_arrays_that_differ_from_their_declaration_are_refused(changed: dict, sentence: str) -> None:
    with pytest.raises(FileError, match=sentence):
        check_arrays(arrays(**changed), DECLARED, "a file")


def test_a_part_of_a_recording_has_both_ends_and_at_least_one_sample() -> None:
    """Times are sums of steps, whose rounding neither adds nor removes a sample."""
    time = np.cumsum(np.full(30, 0.1))
    recording = Recording(time, *(np.arange(30.0)[:, None] for _ in range(3)), sensors={"a": np.arange(30)})
    for begin, end, first, last in ((0.3, 0.7, 2, 6), (0.0, 0.1, 0, 0), (2.9, 9.0, 28, 29), (0.31, 0.32, 3, 3)):
        part = recording.between(begin, end)
        assert part.qpos[:, 0].tolist() == list(range(first, last + 1))
        assert part.sensors["a"].tolist() == list(range(first, last + 1))
        np.testing.assert_array_equal(part.time, time[first : last + 1])


def test_the_remaining_time_of_a_resumed_job_is_that_of_the_work_of_this_session(monkeypatch) -> None:
    """Eighty of a hundred were there; ten more take 20 s, so that the last ten take 20 s."""
    clock = iter([0.0, 0.0, 20.0])
    monkeypatch.setattr("nermo_mjx.progress.time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    progress = ProgressBar("sweep", "runs", every=0.0, stream=stream)
    progress.share(0.8, 80, 100)
    progress.share(0.9, 90, 100)
    assert stream.getvalue().splitlines()[-1] == "sweep: 90%, 90 of 100 runs, 0.5 runs/s, 20 s left"
