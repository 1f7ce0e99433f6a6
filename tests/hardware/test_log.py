# Tests of hardware/log.py
"""A robot's log: what is read, what is brought in order, and what is refused in one sentence."""

import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from nermo_mjx.hardware import read_log
from nermo_mjx.hardware.log import LogFields
from nermo_mjx.robot import ParameterError
from nermo_mjx.specs.fields import schema_of

ANGLE = {"quantity": "angle", "of": "spine", "unit": "rad"}


def told(**channels):
    return {"time": {"column": "t", "unit": "s"}, "channels": channels}


def written(folder, rows, header="t,a"):
    path = folder / "log.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_values_are_in_si_units_by_sign_and_zero(tmp_path):
    path = written(
        tmp_path, [(1000 + 10 * i, 90 + i, i, 2 * i, 512 + i) for i in range(5)], "t,a,x,y,n"
    )
    servo = {"quantity": "command", "of": "spine", "unit": "deg", "sign": -1, "zero": 90}
    track = {"quantity": "position", "columns": ["x", "y"], "unit": "mm"}
    count = {"quantity": "angle", "of": "spine", "unit": 0.005, "zero": 512}
    log = read_log(
        path,
        {
            "time": {"column": "t", "unit": "ms"},
            "channels": {"a": servo, "track": track, "n": count},
        },
    )
    spine, marker, count_channel = log.channels
    assert (spine.quantity, spine.of, spine.unit) == ("command", "spine", "rad")
    np.testing.assert_allclose(spine.times, 0.01 * np.arange(5), atol=1e-12)
    np.testing.assert_allclose(spine.values, -np.radians(np.arange(5)), atol=1e-12)
    np.testing.assert_allclose(marker.values, 1e-3 * np.outer(np.arange(5), [1, 2]), atol=1e-12)
    assert (marker.of, marker.unit) == ("torso", "m")
    np.testing.assert_allclose(count_channel.values, 0.005 * np.arange(5), atol=1e-12)
    assert log.findings == ()
    assert log.duration == pytest.approx(0.04)
    assert log.channel("position") is marker
    assert log.channel("angle", "neck") is None


def test_units_of_sliding_joints_and_motors_are_told(tmp_path):
    path = written(tmp_path, [(i, i, i) for i in range(3)], "t,a,b")
    slide, motor = ({"quantity": "command", "of": name, "unit": name} for name in ("mm", "mN m"))
    log = read_log(path, told(a=slide, b=motor))
    assert [channel.unit for channel in log.channels] == ["m", "N m"]


def test_rates_that_differ_gaps_and_late_or_doubled_stamps(tmp_path):
    """A channel has its own samples; what is brought in order is told."""
    rows = [(0.01 * i, 0.1 * i, i if i % 4 == 0 else "") for i in range(100) if not 40 <= i < 50]
    rows[20], rows[21] = rows[21], rows[20]
    rows.insert(31, (rows[30][0], 77.0, ""))
    path = written(tmp_path, rows, "t,a,b")
    log = read_log(path, told(a=ANGLE, b={**ANGLE, "of": "neck"}))
    fast, slow = log.channels
    assert len(fast.times) == 90
    assert (np.diff(fast.times) > 0).all()
    assert fast.values[30] == 77.0
    assert slow.interval == pytest.approx(0.04)
    assert len(slow.times) == 22
    assert fast.gaps.round(3).tolist() == [[0.39, 0.5]]
    text = " ".join(log.findings)
    assert "a: 1 samples came late, by up to 0.01 s" in text
    assert "a: 1 stamps are doubled" in text
    assert "a: a gap of 0.11 s at 0.390 s: 10 % of the samples are missing" in text


def test_a_second_clock(tmp_path):
    """Its offset and scale are those of the file; the scale acts from its first stamp on."""
    rows = [(1.7e9 + 0.01 * i, 0.1 * i, 60_000 + 30 * i) for i in range(100)]
    path = written(tmp_path, rows, "t,a,frame")
    clock = {"column": "frame", "unit": 0.001, "scale": 1.002, "offset": 1.7e9 + 0.25 - 60.0}
    log = read_log(path, told(a=ANGLE, b={**ANGLE, "of": "neck", "column": "a", "time": clock}))
    np.testing.assert_allclose(
        log.channels[1].times, 0.25 + 1.002 * 0.03 * np.arange(100), atol=1e-6
    )
    np.testing.assert_allclose(log.channels[0].times, 0.01 * np.arange(100), atol=1e-6)


def test_forms_of_csv_and_parquet(tmp_path):
    """Comments, blank lines, semicolons with decimal commas, and a column of texts that nobody asked for."""
    path = tmp_path / "log.csv"
    path.write_text(
        "# made by hand\n\nt; a; note\n0,0;1,5;begin\n0,1;2,5;\n# half\n0,2;;end\n0,3;4,5;\n"
    )
    log = read_log(path, told(a=ANGLE))
    np.testing.assert_allclose(log.channels[0].values, [1.5, 2.5, 4.5])
    table = tmp_path / "log.parquet"
    pq.write_table(pa.table({"t": [0.0, 0.1, 0.2, 0.3], "a": [1.5, 2.5, None, 4.5]}), table)
    parquet_log = read_log(table, told(a=ANGLE))
    np.testing.assert_array_equal(parquet_log.channels[0].times, log.channels[0].times)
    np.testing.assert_array_equal(parquet_log.channels[0].values, log.channels[0].values)


ROWS = [(0.01 * i, 0.1 * (i % 7)) for i in range(60)]
BACK = ROWS[:40] + [(t - 0.3, a) for t, a in ROWS[40:]]
GYRO = {"quantity": "gyro", "columns": ["a", "b"], "unit": "deg/s"}
WRONG = {
    "no such column": (
        ROWS,
        told(b=ANGLE),
        "'channels.b' asks for the column 'b', but .*log.csv has t, a",
    ),
    "unit": (
        ROWS,
        told(a={**ANGLE, "unit": "degs"}),
        "'channels.a.unit' is the text 'degs': allowed is rad, deg",
    ),
    "unit of another quantity": (
        ROWS,
        told(a={**ANGLE, "unit": "g"}),
        "allowed is rad, deg, m, cm, mm, or how many",
    ),
    "unit is no number": (
        ROWS,
        told(a={**ANGLE, "unit": -2}),
        "'channels.a.unit' is the number -2: allowed",
    ),
    "no unit": (ROWS, told(a={"quantity": "angle", "of": "x"}), "field 'channels.a' has no 'unit'"),
    "sign": (ROWS, told(a={**ANGLE, "sign": 2.0}), "'channels.a.sign' is 2: allowed is 1 or -1"),
    "quantity": (
        ROWS,
        told(a={**ANGLE, "quantity": "angel"}),
        "is the text 'angel': allowed are .*'angle'",
    ),
    "field": (
        ROWS,
        told(a={**ANGLE, "zeros": 1}),
        "'channels.a.zeros' is not a field of a channel; .*'zero'",
    ),
    "of": (
        ROWS,
        told(a={"quantity": "angle", "unit": "rad"}),
        "'channels.a' has no 'of': expected the name of",
    ),
    "same twice": (
        ROWS,
        told(a=ANGLE, b={**ANGLE, "column": "a"}),
        "'channels.b.of' is 'spine': its angle is channel 'a' already",
    ),
    "an axis twice": (
        ROWS,
        told(a={**GYRO, "columns": ["a", "a", "t"]}),
        "'channels.a.columns' names a column twice: expected one for each axis",
    ),
    "axes": (ROWS, told(a=GYRO), "'channels.a' has 2 columns: allowed for its quantity is 3"),
    "no channels": (ROWS, told(), "'channels' names no channel"),
    "clock": (
        ROWS,
        {"time": {"unit": "s"}, "channels": {"a": ANGLE}},
        "field 'time' has no 'column'",
    ),
    "unit of the clock": (
        ROWS,
        {"time": {"column": "t", "unit": "m"}, "channels": {"a": ANGLE}},
        "'m': allowed is s",
    ),
    "time runs backward": (
        BACK,
        told(a=ANGLE),
        r"log.csv:42: the time runs backward, from 0.39 to 0.1 s, for 20 rows",
    ),
    "time stands": (
        [(1, i) for i in range(9)],
        told(a=ANGLE),
        "the time of channel 'a' is 1 s in all rows",
    ),
    "text": (
        [*ROWS[:3], (0.5, "off"), *ROWS[3:]],
        told(a=ANGLE),
        "log.csv:5: column 'a' is the text 'off': expected",
    ),
    "infinite": (
        [*ROWS[:3], (0.5, "inf")],
        told(a=ANGLE),
        "log.csv:5: column 'a' is .*inf.*: expected a finite number",
    ),
    "cells": (
        [*ROWS[:3], (0.5,)],
        told(a=ANGLE),
        "log.csv:5: it has 1 cells, but there are 2 columns",
    ),
    "empty": ([], told(a=ANGLE), "log.csv: it is empty"),
    "one sample": (ROWS[:1], told(a=ANGLE), "has 1 samples .*: expected two at least"),
    "constant": (
        [(t, a, 3.0) for t, a in ROWS],
        told(a={**ANGLE, "quantity": "command"}, b=ANGLE),
        "'channels.b' is of column 'b', which never changes in .*log.csv: a measured angle",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(case, tmp_path):
    rows, channels, message = WRONG[case]
    path = written(tmp_path, rows, "t,a,b" if case == "constant" else "t,a")
    with pytest.raises(ParameterError, match=message) as error:
        read_log(path, channels)
    assert "\n" not in str(error.value)
    assert len(re.findall(r"[.?](?:\s|$)", str(error.value))) == 1


def test_a_servo_that_is_not_commanded_may_stand_still(tmp_path):
    path = written(tmp_path, [(0.1 * i, 2.0, 2.0) for i in range(5)], "t,a,b")
    assert len(read_log(path, told(a={**ANGLE, "quantity": "command"}, b=ANGLE)).channels) == 2


@pytest.mark.parametrize("name", ["missing.csv", "log.xlsx", "folder.csv"])
def test_files_that_are_none(name, tmp_path):
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ParameterError, match=name):
        read_log(tmp_path / name, told(a=ANGLE))


def test_file_of_channels_names_its_line(tmp_path):
    path = tmp_path / "channels.yaml"
    path.write_text(
        "time: {column: t, unit: s}\nchannels:\n  a: {quantity: angle, of: spine, unit: turns}\n"
    )
    with pytest.raises(
        ParameterError, match=r"channels\.yaml:3: field 'channels.a.unit' is the text 'turns'"
    ):
        read_log(written(tmp_path, ROWS), path)
    assert set(schema_of(LogFields)["properties"]) == {"time", "channels"}
