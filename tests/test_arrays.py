# Tests of files.py
"""Arrays of a file, compared with their declaration."""

from __future__ import annotations

import numpy as np
import pytest

from nermo_mjx.files import FileError, check_arrays

DECLARED = {"time": ("f", ("T",)), "qpos": ("f", ("T", "nq")), "eyes": ("iu", ("T", 2, ...))}


def arrays(**changed: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "time": np.zeros(5),
        "qpos": np.zeros((5, 3)),
        "eyes": np.zeros((5, 2, 4, 4), int),
    } | changed


def test_arrays_of_a_file_have_their_declared_shapes_and_one_length() -> None:
    check_arrays(arrays(), DECLARED, "a file")
    check_arrays(arrays(eyes=np.zeros((5, 2), np.uint8)), DECLARED, "a file")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (
            {"qpos": np.zeros((4, 3))},
            r"a file: 'qpos' has the shape \(4, 3\): expected \(5, nq\)\.",
        ),
        ({"qpos": np.zeros(5)}, r"'qpos' has the shape \(5,\): expected \(5, nq\)\."),
        (
            {"eyes": np.zeros((5, 3, 4), int)},
            r"'eyes' has the shape \(5, 3, 4\): expected \(5, 2, \.\.\.\)\.",
        ),
        ({"eyes": np.zeros((5, 2))}, "'eyes' is of type float64: expected numbers"),
    ],
)
def test_arrays_that_differ_from_their_declaration_are_refused(
    changed: dict, sentence: str
) -> None:
    with pytest.raises(FileError, match=sentence):
        check_arrays(arrays(**changed), DECLARED, "a file")
