# Tests of optimize/tuning_directory.py, optimize/tuning_history.py, optimize/directory.py
"""A tuning's directory: which code made it, that it can be moved, and that damage costs no more than an iteration."""

import dataclasses
import errno
import resource
import shutil
import signal
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
from fakes.tune_fake import SPEC, FakeProblem
from test_tune_run import lasting, same, tune

from nermo_mjx.optimize import Tuning, read_history, run_tuning, tuning_run
from nermo_mjx.optimize.tuner import initial_state
from nermo_mjx.optimize.tuning_directory import TuningDirectory, load_tuning
from nermo_mjx.optimize.tuning_figures import tuning_figures
from nermo_mjx.optimize.tuning_history import TuningHistory, history_columns
from nermo_mjx.robot import load_robot
from nermo_mjx.runs import DirectoryError, Interrupted, OtherCode, Watch, codes_of
from nermo_mjx.runs.checkpoints import KEPT
from nermo_mjx.runs.files import WrongDirectory

FEW = {"starts": 1, "iterations": 1}
#: A tuning that compares with a recording.
COMPARED = SPEC | FEW | {"objective": [{"minimize": "trajectory_error"}]}


@pytest.fixture
def other_code(monkeypatch):
    """From here on, another version runs."""

    def upgrade(package="9.9.9"):
        real = tuning_run.stamp
        monkeypatch.setattr(
            tuning_run,
            "stamp",
            lambda *arguments: dataclasses.replace(real(*arguments), package=package),
        )

    return upgrade


def test_other_code_is_refused_until_it_is_accepted(tmp_path, other_code):
    """The sentence names the difference; accepted, the rows are told apart, in every later session, too."""
    tune(tmp_path, FEW)
    ((first, made_by),) = codes_of(tmp_path).items()
    assert (made_by.engine, made_by.model) == ("c", load_robot().fingerprint)
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
    messages = []
    run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), watch=Watch(warn=messages.append))
    assert (tmp_path / "tuning.yaml.aside-1").read_text() == text
    assert (tmp_path / "best.json.aside-1").read_text() == "mine, too"
    assert sorted(messages) == [
        f"{tmp_path / 'best.json'} is of another history; it is kept as best.json.aside-1.",
        f"{spec} is of another history; it is kept as tuning.yaml.aside-1.",
    ]
    run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), watch=Watch(warn=messages.append))
    assert len(messages) == 2


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
    by_name = {
        name: Tuning.from_dict(COMPARED | {"recording": str(tmp_path / name)}) for name in "abc"
    }
    assert (
        run_tuning(by_name["a"], tmp_path / "out", problem=FakeProblem(by_name["a"])).iterations_run
        == 2
    )
    assert (
        run_tuning(by_name["b"], tmp_path / "out", problem=FakeProblem(by_name["b"])).iterations_run
        == 0
    )
    with pytest.raises(
        WrongDirectory, match="of another tuning, with another recording; choose another directory"
    ):
        run_tuning(by_name["c"], tmp_path / "out", problem=FakeProblem(by_name["c"]))
    assert (tmp_path / "out" / "recording.npz").read_bytes() == b"one"


TUNING = {
    "tune": {"duty": {"bounds": [0.4, 0.7]}, "stride": {"bounds": [0.5, 1.0]}},
    "objective": [{"maximize": "speed"}],
    "starts": 3,
}
FRICTION = Tuning.from_dict(TUNING).parameters["contact.friction"].default


@pytest.fixture
def done(tmp_path):
    """A finished tuning."""
    return tune(tmp_path / "out")[0]


def steps(out):
    return sorted(
        int(path.name) for path in (out / "checkpoints").iterdir() if path.name.isdecimal()
    )


@pytest.mark.parametrize(
    "optimizer",
    [
        "adam",
        {"name": "sgd", "momentum": 0.9, "clip": 1.0},
        {"learning_rate": {"cosine": {"init_value": 1, "decay_steps": 9}}},
    ],
)
def test_a_state_comes_back_as_it_was(tmp_path, optimizer):
    """Every leaf, of any optimizer, with its type and its bits, NaN included."""
    tuning = Tuning.from_dict(TUNING | {"optimizer": optimizer})
    state = initial_state(tuning)
    rows = np.random.default_rng(0).standard_normal(
        (2, 3, len(history_columns(tuning, ("speed",))))
    )
    rows[0, 0, 0] = np.nan
    history = TuningHistory(tuning, ("speed",), rows, ((0, "one"), (1, "other")))
    state = jax.tree.map(
        lambda leaf: (leaf + 1) / 3 if leaf.dtype == np.float32 else leaf + 5, state
    )
    with TuningDirectory(tmp_path, tuning) as directory:
        directory.claim(TuningHistory(tuning))
        directory.keep(state, history)
    with TuningDirectory(tmp_path, tuning) as directory:
        restored = directory.restore()
    assert jax.tree.structure(restored[0]) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(restored[0]), jax.tree.leaves(state), strict=True):
        assert a.dtype == b.dtype
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert restored[1].rows.tobytes() == rows.tobytes()
    assert (restored[1].metrics, restored[1].codes) == (history.metrics, history.codes)


def test_the_last_few_are_kept(done):
    """One checkpoint an iteration; the newest three stay."""
    assert steps(done.out) == list(range(8 - KEPT, 8))
    with (
        ocp.StandardCheckpointer() as reader
    ):  # whoever has Orbax, and not this package, can read them
        stored = reader.restore(Path(done.out, "checkpoints", "7", "tuning").absolute())["state"]
    np.testing.assert_array_equal(stored["u"], done.state.u)


def content(folder):
    """Every file below a folder."""
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def data_files(out, step):
    return [path for path in (out / "checkpoints" / str(step)).rglob("d/*") if path.is_file()]


def cut(out, step):
    for path in data_files(out, step):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_bits(out, step):
    """One in each eighth byte; Orbax keeps some of its files twice."""
    for path in data_files(out, step):
        content = bytearray(path.read_bytes())
        content[::8] = bytes(byte ^ 16 for byte in content[::8])
        path.write_bytes(content)


def empty(out, step):
    shutil.rmtree(out / "checkpoints" / str(step))
    (out / "checkpoints" / str(step)).mkdir()


def without_about(out, step):
    shutil.rmtree(out / "checkpoints" / str(step) / "about")


def flipped_about(out, step):
    """Another precision stands there, and the text is still JSON."""
    path = out / "checkpoints" / str(step) / "about" / "metadata"
    path.write_text(path.read_text().replace('"precision": "float32"', '"precision": "float64"'))


def without_numbers(out, step):
    shutil.rmtree(out / "checkpoints" / str(step) / "tuning")


def swapped(out, step):
    """The numbers of another iteration."""
    without_numbers(out, step)
    shutil.copytree(
        out / "checkpoints" / str(step - 1) / "tuning", out / "checkpoints" / str(step) / "tuning"
    )


@pytest.mark.release(cases=("empty", "swapped"))
@pytest.mark.parametrize(
    "damage", [cut, flip_bits, empty, without_about, flipped_about, without_numbers, swapped]
)
def test_a_damaged_checkpoint_falls_back_to_the_one_before(done, damage):
    """If the newest is damaged in any way, it is moved aside, the iteration is repeated, and the result is the same."""
    damage(done.out, steps(done.out)[-1])
    before, messages = content(done.out / "checkpoints" / "7"), []
    result, problem = tune(done.out, watch=Watch(warn=messages.append))
    assert len(problem.batches) == 1
    assert same(result, done)
    assert steps(done.out) == list(range(8 - KEPT, 8))
    assert content(done.out / "checkpoints" / "7.aside-1") == before
    assert (
        f"checkpoint 7 in {done.out / 'checkpoints'} is damaged; it is kept as 7.aside-1."
        in messages
    )


def test_all_damaged_begins_again(done):
    """Nothing whole is left: the tuning starts from its beginning, and ends the same; what it had is kept aside."""
    contents = {
        name: (done.out / name).read_bytes()
        for name in ("history.parquet", "best.json", "tuned.yaml", "tuning.yaml")
    }
    for step in steps(done.out):
        cut(done.out, step)
    messages = []
    result, problem = tune(done.out, watch=Watch(warn=messages.append))
    assert len(problem.batches) == 7
    assert same(result, done)
    for step in (5, 6, 7):
        assert (done.out / "checkpoints" / f"{step}.aside-1").is_dir()
    for name, before in contents.items():
        assert (done.out / f"{name}.aside-1").read_bytes() == before
    assert len(messages) == 7


def test_what_a_killed_process_left_half_written_is_removed(done):
    """Orbax writes beside and renames; a directory that was never renamed is no checkpoint."""
    half = done.out / "checkpoints" / "8.orbax-checkpoint-tmp-1"
    shutil.copytree(done.out / "checkpoints" / "7", half)
    (done.out / ".history.parquet.7.nermo-tmp").write_text("half")
    result, problem = tune(done.out)
    assert problem.batches == []
    assert same(result, done)
    assert not half.exists()
    assert not list(done.out.glob(".*.nermo-tmp"))


def test_a_full_disk_is_one_sentence(tmp_path, capfd):
    """If the system rejects more bytes, finished work is kept, nothing else is printed, and it can be resumed later."""
    handler, limits = (
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
        resource.getrlimit(resource.RLIMIT_FSIZE),
    )
    tuning, problem = Tuning.from_dict(SPEC), FakeProblem(Tuning.from_dict(SPEC))

    def fill(progress):
        if progress.done == 3:
            resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))

    try:
        with pytest.raises(
            DirectoryError, match=r"cannot write in .*: File too large\. What is finished is kept"
        ):
            run_tuning(tuning, tmp_path, problem=problem, watch=Watch(fill))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert capfd.readouterr().err == ""
    assert steps(tmp_path) == [1, 2, 3]
    assert tune(tmp_path)[0].iterations_run == 4


def test_another_precision_is_refused_and_nothing_is_lost(done):
    """A tuning in float32 cannot be resumed in float64: its numbers would differ."""
    before = steps(done.out)
    with (
        jax.enable_x64(True),
        pytest.raises(
            DirectoryError, match="was started in float32, and JAX now computes in float64"
        ),
    ):
        tune(done.out)
    assert steps(done.out) == before


def test_checkpoints_of_another_tuning_are_refused(tmp_path, done):
    """Copied in from elsewhere, they are neither taken nor lost, whatever is accepted."""
    second_out = tmp_path / "other"
    tune(second_out, {"iterations": 1, "seed": 8})
    for path in (second_out / "checkpoints").iterdir():
        shutil.rmtree(path)
    shutil.copytree(done.out / "checkpoints" / "7", second_out / "checkpoints" / "7")
    before = content(second_out)
    for accept in (False, True):
        with pytest.raises(
            WrongDirectory,
            match=r"of another tuning, with another seed \(3 there, 8 here\); choose",
        ):
            tune(second_out, {"iterations": 1, "seed": 8}, accept_new_code=accept)
    assert content(second_out) == before


def changed_default(monkeypatch, name, value):
    """A new version with another default of one parameter."""
    getter = Tuning.parameters.fget

    def parameters(self):
        declarations = getter(self)
        return declarations | {name: dataclasses.replace(declarations[name], default=value)}

    monkeypatch.setattr(Tuning, "parameters", property(parameters))


def test_a_changed_default_is_refused_by_name_and_loses_nothing(done, monkeypatch):
    """A new version with another default: checkpoints and history are kept until the user resumes them."""
    before = content(done.out)
    changed_default(monkeypatch, "contact.friction", 0.77)
    sentence = rf"with other defaults: contact\.friction \({FRICTION:g} there, 0\.77 here\); .*--accept-new-code"
    with pytest.raises(OtherCode, match=sentence):
        tune(done.out, {"iterations": 8})
    assert content(done.out) == before
    result, problem = tune(done.out, {"iterations": 8}, accept_new_code=True)
    assert len(problem.batches) == 2
    assert lasting(result.history).slice(0, 14).equals(lasting(done.history))


@pytest.mark.parametrize("broken", ["the file system", "orbax"])
def test_a_disk_that_does_not_answer_ends_it_and_changes_nothing(done, monkeypatch, broken):
    """Read again later, the checkpoint may be whole: the command ends in one sentence."""
    before = content(done.out)

    def fail(*_, **__):
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        if broken == "orbax":
            patch.setattr(ocp.CheckpointManager, "restore", fail)
        else:
            patch.setattr("nermo_mjx.runs.checkpoints.read_bytes", fail)
        with pytest.raises(
            DirectoryError,
            match=r"checkpoint 7 in .* cannot be read: Input/output error; nothing was",
        ):
            tune(done.out)
    assert content(done.out) == before
    assert tune(done.out)[1].batches == []
