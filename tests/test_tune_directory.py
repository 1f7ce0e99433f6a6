"""A tuning's directory: which code made each row, that it can be moved, and that nothing is lost in it."""

import dataclasses
import shutil

import pytest
from test_tune_run import lasting, tune
from tune_fake import SPEC, FakeProblem

from nermo_mjx.optimize import Tuning, load_tuning, read_history, run, run_tuning
from nermo_mjx.optimize.figures import tuning_figures
from nermo_mjx.robot import load_robot
from nermo_mjx.runs import Interrupted, OtherCode, Watch, codes_of
from nermo_mjx.runs.files import WrongDirectory

pytestmark = pytest.mark.compiles

FEW = {"starts": 1, "iterations": 1}
#: A tuning that compares with a recording.
COMPARED = SPEC | FEW | {"objective": [{"minimize": "trajectory_error"}]}


@pytest.fixture
def other_code(monkeypatch):
    """From here on, another version runs."""

    def upgrade(package="9.9.9"):
        real = run.stamp
        monkeypatch.setattr(run, "stamp", lambda *known: dataclasses.replace(real(*known), package=package))

    return upgrade


def test_other_code_is_refused_until_it_is_accepted(tmp_path, other_code):
    """The sentence names the difference; accepted, the rows are told apart, in every later session, too."""
    tune(tmp_path, FEW)
    ((first, made_by),) = codes_of(tmp_path).items()
    assert (made_by.engine, made_by.model) == ("mjx", load_robot().fingerprint)
    other_code()
    with pytest.raises(OtherCode, match=r"nermo-mjx .*, not 9\.9\.9; .*--accept-new-code"):
        tune(tmp_path, FEW | {"iterations": 3})
    assert (read_history(tmp_path).num_rows, load_tuning(tmp_path).iterations) == (2, 1)
    with pytest.raises(Interrupted):
        tune(tmp_path, FEW | {"iterations": 3}, accept_new_code=True, stop_at=1)
    result, _ = tune(tmp_path, FEW | {"iterations": 3})
    second = list(codes_of(tmp_path))[1]
    assert result.history["code"].to_pylist() == [first, first, second, second]


def test_a_finished_tuning_is_drawn_again_by_any_code(tmp_path, other_code):
    """Nothing is added to its rows, so nothing is refused, and the code is not noted."""
    done, _ = tune(tmp_path, FEW)
    other_code()
    again, problem = tune(tmp_path, FEW)
    assert problem.batches == []
    assert again.history.equals(done.history)
    assert len(codes_of(tmp_path)) == 1


def test_a_directory_without_an_iteration_is_any_codes(tmp_path, other_code):
    """What was stopped before its first row is begun by a new version without being asked."""
    with pytest.raises(Interrupted):
        tune(tmp_path, FEW, stop_at=0)
    other_code()
    result, _ = tune(tmp_path, FEW)
    assert set(result.history["code"].to_pylist()) == set(codes_of(tmp_path))
    assert len(codes_of(tmp_path)) == 1


def test_a_users_own_file_is_kept_aside(tmp_path):
    """A tuning file with comments in the directory itself, and results of something else."""
    spec = tmp_path / "tuning.yaml"
    text = "# mine\n" + Tuning.from_dict(SPEC | FEW).to_yaml()
    spec.write_text(text)
    (tmp_path / "best.json").write_text("mine, too")
    tuning = dataclasses.replace(Tuning.from_file(spec), iterations=2)
    said = []
    run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), watch=Watch(warn=said.append))
    assert (tmp_path / "tuning.yaml.aside-1").read_text() == text
    assert (tmp_path / "best.json.aside-1").read_text() == "mine, too"
    assert sorted(said) == [
        f"{tmp_path / 'best.json'} is of another history; it is kept as best.json.aside-1.",
        f"{spec} is of another history; it is kept as tuning.yaml.aside-1.",
    ]
    run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), watch=Watch(warn=said.append))
    assert len(said) == 2


def test_a_history_that_goes_further_than_the_checkpoints_is_kept_aside(tmp_path):
    """The newest checkpoint is gone: what had been computed after the one before stays readable."""
    done, _ = tune(tmp_path, FEW | {"iterations": 3})
    shutil.rmtree(tmp_path / "checkpoints" / "4")
    result, problem = tune(tmp_path, FEW | {"iterations": 3})
    assert len(problem.batches) == 1
    assert lasting(result.history).equals(lasting(done.history))
    (tmp_path / "history.parquet").unlink()
    (tmp_path / "history.parquet.aside-1").rename(tmp_path / "history.parquet")
    assert read_history(tmp_path).equals(done.history)


def test_a_directory_that_compares_with_a_recording_can_be_moved(tmp_path):
    """Moved, and with the original recording gone, it can be drawn and resumed."""
    (tmp_path / "walk.npz").write_bytes(b"a walk")
    tuning = Tuning.from_dict(COMPARED | {"recording": str(tmp_path / "walk.npz")})
    run_tuning(tuning, tmp_path / "here", problem=FakeProblem(tuning))
    assert "recording: recording.npz\n" in (tmp_path / "here" / "tuning.yaml").read_text()
    (tmp_path / "here").rename(tmp_path / "there")
    (tmp_path / "walk.npz").unlink()
    moved = Tuning.from_file(tmp_path / "there" / "tuning.yaml")
    assert moved.recording == (tmp_path / "there" / "recording.npz").resolve()
    assert len(list(tuning_figures(tmp_path / "there"))) == 4
    longer = dataclasses.replace(moved, iterations=2)
    assert run_tuning(longer, tmp_path / "there", problem=FakeProblem(longer)).iterations_run == 1
    assert load_tuning(tmp_path / "there") == longer


def test_another_recording_is_another_tuning(tmp_path):
    """It counts by its content, not by its place; the copy in the directory is not replaced."""
    for name, content in (("a", b"one"), ("b", b"one"), ("c", b"two")):
        (tmp_path / name).write_bytes(content)
    by_name = {name: Tuning.from_dict(COMPARED | {"recording": str(tmp_path / name)}) for name in "abc"}
    assert run_tuning(by_name["a"], tmp_path / "out", problem=FakeProblem(by_name["a"])).iterations_run == 2
    assert run_tuning(by_name["b"], tmp_path / "out", problem=FakeProblem(by_name["b"])).iterations_run == 0
    with pytest.raises(WrongDirectory, match="of another tuning, with another recording; choose another directory"):
        run_tuning(by_name["c"], tmp_path / "out", problem=FakeProblem(by_name["c"]))
    assert (tmp_path / "out" / "recording.npz").read_bytes() == b"one"
