# Tests of runs/directory.py, runs/code.py, runs/files.py
"""Run directories: one writer, one kind, one code; nothing is lost, mixed or deleted."""

import dataclasses
import json
import warnings

import pytest

from nermo_mjx.runs import DirectoryError, OtherCode, RunDirectory, codes_of, files, kind_of, stamp
from nermo_mjx.runs.files import TEMPORARY_SUFFIX, WrongDirectory

HERE = stamp("a model", "c")


def test_a_stamp_is_the_same_for_the_same_code_and_says_what_differs():
    assert stamp("a model", "c") == HERE
    changed_code = dataclasses.replace(HERE, engine="mjx", package="9.9.9")
    assert changed_code.id != HERE.id
    assert changed_code.unlike(HERE) == f"nermo-mjx 9.9.9, not {HERE.package}, engine mjx, not c"
    assert not HERE.unlike(HERE)


def test_one_process_writes_at_a_time(tmp_path):
    with (
        RunDirectory(tmp_path, "sweep"),
        pytest.raises(DirectoryError, match="another process works in"),
    ):
        RunDirectory(tmp_path, "sweep").__enter__()
    with RunDirectory(tmp_path, "sweep"):
        pass


def test_shards_write_together_but_not_one_twice(tmp_path):
    with RunDirectory(tmp_path, "sweep", (0, 2)), RunDirectory(tmp_path, "sweep", (1, 2)):
        for shard in ((1, 2), None):
            with pytest.raises(DirectoryError, match="another process works in"):
                RunDirectory(tmp_path, "sweep", shard).__enter__()


def test_a_directory_of_another_kind_is_refused_and_left_alone(tmp_path):
    with RunDirectory(tmp_path, "sweep") as directory:
        directory.note_session({"started": "now"})
    with pytest.raises(WrongDirectory, match="holds a sweep, and not an identification"):
        RunDirectory(tmp_path, "identification").__enter__()
    assert kind_of(tmp_path) == "sweep"


def test_rows_of_other_code_are_refused_until_they_are_accepted(tmp_path):
    changed_code = dataclasses.replace(HERE, package="9.9.9")
    with RunDirectory(tmp_path, "sweep") as directory:
        directory.take_code(HERE, holds_rows=False)
        directory.take_code(HERE, holds_rows=True)
        with pytest.raises(
            OtherCode, match=f"nermo-mjx {HERE.package}, not 9.9.9;.*--accept-new-code"
        ):
            directory.take_code(changed_code, holds_rows=True)
        assert list(codes_of(tmp_path)) == [HERE.id]
        directory.take_code(changed_code, holds_rows=True, accept=True)
        directory.take_code(HERE, holds_rows=True)
    assert codes_of(tmp_path) == {HERE.id: HERE, changed_code.id: changed_code}


def test_who_goes_on_under_another_python_or_numpy_is_told(tmp_path):
    """Not of what the stamp of the code decides, and not where nothing is known of the former session."""
    first = {"versions": {"python": "3.11.7", "numpy": "2.4.6", "jax": "0.10.2"}}
    session_of_old_versions = {
        "versions": {"python": "3.12.1", "numpy": "2.3.0", "jax": "0.9.0", "scipy": "1.17.1"}
    }
    with RunDirectory(tmp_path, "sweep") as directory, warnings.catch_warnings():
        warnings.simplefilter("error")
        for session in ({}, first, first, {"versions": {"jax": "0.9.0"}}, {"versions": {}}, first):
            directory.note_session(session)
        with pytest.raises(
            UserWarning, match=r"with python 3\.12\.1, not 3\.11\.7, numpy 2\.3\.0, not 2\.4\.6: "
        ):
            directory.note_session(session_of_old_versions)
        directory.note_session(session_of_old_versions)


def test_a_directory_without_rows_is_begun_anew_by_who_holds_it_alone(tmp_path):
    changed_code = dataclasses.replace(HERE, engine="mjx")
    with RunDirectory(tmp_path, "sweep") as directory:
        directory.take_code(HERE, holds_rows=False)
        directory.take_code(changed_code, holds_rows=False)
    assert codes_of(tmp_path) == {changed_code.id: changed_code}
    with (
        RunDirectory(tmp_path, "sweep", (0, 2)) as directory,
        pytest.raises(OtherCode, match="engine mjx, not c"),
    ):
        directory.take_code(HERE, holds_rows=False)


def test_rows_of_unknown_code_are_refused_until_they_are_accepted(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps({"sessions": [{"started": "then"}]}))
    with RunDirectory(tmp_path, "sweep") as directory:
        with pytest.raises(OtherCode, match="does not say which code made it"):
            directory.take_code(HERE, holds_rows=True)
        directory.take_code(HERE, holds_rows=True, accept=True)
        directory.note_session({"started": "now"})
    assert [
        session["started"]
        for session in json.loads((tmp_path / "run.json").read_text())["sessions"]
    ] == ["then", "now"]


def test_what_is_moved_aside_is_kept_under_a_new_name(tmp_path):
    with RunDirectory(tmp_path, "tuning") as directory:
        for count, content in enumerate((b"first", b"second"), 1):
            directory.write("history.parquet", content)
            aside = directory.move_aside("history.parquet")
            assert aside == tmp_path / f"history.parquet.aside-{count}"
            assert aside.read_bytes() == content
        assert directory.move_aside("history.parquet") is None
        directory.write("history.parquet", b"first")
        assert directory.move_aside("history.parquet") == tmp_path / "history.parquet.aside-1", (
            "it is kept already"
        )
    assert len(list(tmp_path.glob("*.aside-*"))) == 2
    assert not (tmp_path / "history.parquet").exists()


def test_what_is_moved_aside_leaves_a_folder_that_others_read_whole(tmp_path):
    with RunDirectory(tmp_path, "sweep") as directory:
        for count in (1, 2):
            directory.write("results/chunk.parquet", b"rows" * count)
            assert (
                directory.move_aside("results/chunk.parquet", "out")
                == tmp_path / "out" / f"chunk.parquet.aside-{count}"
            )
    assert list((tmp_path / "results").iterdir()) == []


def test_only_files_of_our_own_naming_are_swept_up(tmp_path):
    (tmp_path / f".table.parquet.17{TEMPORARY_SUFFIX}").write_text("half")
    (tmp_path / ".notes.tmp").write_text("a user's")
    with RunDirectory(tmp_path, "sweep"):
        pass
    assert [path.name for path in tmp_path.glob(".*") if not path.name.startswith(".lock")] == [
        ".notes.tmp"
    ]


def test_a_file_appears_whole_and_its_name_is_synced(tmp_path, monkeypatch):
    synced = []
    for module in ("nermo_mjx.files", "nermo_mjx.runs.files"):
        monkeypatch.setattr(f"{module}.sync_folder", synced.append)
    files.replace_file(tmp_path / "a", b"one")
    files.create_file(tmp_path / "a", b"two")
    files.create_file(tmp_path / "b", b"three")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "a": b"one",
        "b": b"three",
    }
    assert set(synced) == {tmp_path}


def test_a_damaged_record_is_never_overwritten(tmp_path):
    (tmp_path / "run.json").write_text("{half")
    with pytest.raises(DirectoryError, match=r"run\.json: not valid JSON"):
        RunDirectory(tmp_path, "sweep").__enter__()
    assert (tmp_path / "run.json").read_text() == "{half"
