# Tests of plotting/files.py, cli/directories.py
"""`nermo-mjx plot`: the figures of directories redrawn from their tables alone."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command import call
from fakes.sweep_fake import SPEC, FakeSimulator, part_of
from fakes.tune_fake import SPEC as TUNE_SPEC
from fakes.tune_fake import FakeProblem, FakeWalker
from test_experiment_plots import walked

from nermo_mjx.cli.kinds import KINDS, RECORDING, Kind
from nermo_mjx.experiments.plots import figures_of_experiment
from nermo_mjx.experiments.published import published_lines
from nermo_mjx.experiments.run import EXPERIMENTS, run_experiments
from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.code import session
from nermo_mjx.runs.directory import hold
from nermo_mjx.sweep import run_sweep

plot = functools.partial(call, "plot")


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sweep")
    run_sweep(SPEC | {"plots": True}, out, chunk=8, simulator=FakeSimulator())
    return out


@pytest.fixture
def sweep(swept: Path, tmp_path: Path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(swept, tmp_path / "sweep"))


def content(folder: Path) -> dict[str, bytes]:
    """The files of a folder but its lock."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != ".lock"}


@pytest.mark.parametrize("kind", [*KINDS.values(), RECORDING], ids=lambda kind: kind.name)
def test_each_kind_names_a_function_for_its_figures_and_one_for_its_status(kind: Kind) -> None:
    keywords = inspect.signature(kind.load(kind.figures)).parameters
    assert tuple(keywords)[1:] == kind.options
    assert kind is RECORDING or callable(kind.load(kind.status))


@pytest.mark.release
def test_two_commands_do_not_draw_into_one_folder(sweep: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with hold(tmp_path / "there"):
        result = plot(sweep, "--out", tmp_path / "there", "--format", "png")
        assert result.exit_code == 1
        assert f"another process works in {tmp_path / 'there'}; wait for it" in result.stderr
        assert not content(tmp_path / "there")
    assert plot(sweep, "--out", tmp_path / "there", "--format", "png").exit_code == 0


@pytest.mark.release
def test_a_sweep_that_is_being_written_is_drawn(sweep: Path) -> None:
    with RunDirectory(sweep, "sweep"):
        assert plot(sweep, "--format", "png").exit_code == 0


@pytest.mark.release
def test_a_sweeps_figures_are_remade_to_the_last_byte(sweep: Path, swept: Path) -> None:
    shutil.rmtree(sweep / "plots")
    result = plot(sweep)
    assert result.exit_code == 0, result.stderr
    assert content(sweep / "plots") == content(swept / "plots")
    assert len(result.stdout.splitlines()) == len(content(swept / "plots"))
    assert "speed-over-frequency-and-spine.phase.svg" in content(sweep / "plots")


@pytest.mark.release
def test_json_lists_the_files_and_nothing_else(sweep: Path, tmp_path: Path) -> None:
    report = json.loads(plot(sweep, "--out", tmp_path / "new", "--format", "png", "--json").stdout)
    assert report["kind"] == "sweep"
    assert {Path(file).name for file in report["files"]} == set(content(tmp_path / "new"))
    assert {Path(file).suffix for file in report["files"]} == {".png"}


@pytest.mark.release
def test_an_unfinished_sweep_is_drawn_as_far_as_it_is(sweep: Path) -> None:
    chunk = part_of(sweep, 1)
    remaining = 36 - pq.read_metadata(chunk).num_rows
    chunk.unlink()
    result = plot(sweep)
    assert result.exit_code == 0
    assert f"{remaining} of 36 runs are in {sweep}; the figures show these." in result.stderr
    svgs = [path.read_text() for path in (sweep / "plots").glob("*.svg")]
    assert all(f"{remaining} of 36 runs so far" in svg for svg in svgs)


@pytest.mark.release
def test_columns_of_choice(sweep: Path, tmp_path: Path) -> None:
    result = plot(
        sweep,
        "--x",
        "frequency",
        "--y",
        "spine.phase",
        "--color",
        "roll_std",
        "--out",
        tmp_path / "a",
    )
    assert sorted(content(tmp_path / "a")) == [
        f"roll_std-over-frequency-and-spine.phase.{form}" for form in ("png", "svg")
    ]
    assert result.exit_code == 0
    plot(sweep, "--color", "roll_std", "--out", tmp_path / "b")
    assert "roll_std-over-frequency-and-spine.phase.png" in content(tmp_path / "b")
    assert all(name.startswith("roll_std") for name in content(tmp_path / "b"))


@pytest.mark.release
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--x", "frequncy"], "x is 'frequncy', no column of the table; did you mean 'frequency'?"),
        (["--y", "speed"], "y is given without x"),
        (["--color", "frequency"], "color is 'frequency', a parameter: name x and y, too."),
        (["--color", "rol"], "color is 'rol', no column of the table"),
        (["--format", "pdf"], "'png', 'svg'"),
    ],
)
def test_wrong_columns_are_refused_in_a_sentence(
    sweep: Path, options: list[str], sentence: str
) -> None:
    result = plot(sweep, *options)
    assert result.exit_code == 2
    assert sentence in result.stderr


@pytest.mark.release
def test_what_has_no_figures_says_why(sweep: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    result = plot(tmp_path / "empty")
    assert result.exit_code == 2
    assert (
        "is not a results directory: it contains neither a sweep, a search, a tuning, a training, published "
        "experiments, the rows of an experiment, an identification, an identification from a log, a comparison nor a "
        "sensitivity analysis." in result.stderr
    )
    shutil.rmtree(sweep / "results")
    result = plot(sweep)
    assert result.exit_code == 1
    assert "holds no results of its sweep yet: run nermo-mjx sweep" in result.stderr
    for chunk in ("", "no parquet"):
        (sweep / "results").mkdir(exist_ok=True)
        (sweep / "results" / "part-0-0123456789abcdef.parquet").write_text(chunk)
        result = plot(sweep)
        assert result.exit_code == 1
        assert "cannot be read" in result.stderr
    fallen = tmp_path / "fallen"
    run_sweep(SPEC, fallen, simulator=FakeSimulator(falls_above=0.0))
    assert "no run succeeded" in plot(fallen).stderr
    single = tmp_path / "single"
    run_sweep({"vary": {"frequency": [0.5]}, "plots": False}, single, simulator=FakeSimulator())
    assert "all its parameters have one value" in plot(single).stderr
    (tmp_path / "walk.npz").write_text("nothing")
    assert "--out DIR" in plot(tmp_path / "walk.npz").stderr
    result = plot(tmp_path / "walk.npz", "--out", tmp_path / "plots")
    assert result.exit_code == 2
    assert "not a recording of nermo_mjx" in result.stderr
    assert not (tmp_path / "plots").exists()
    assert (
        "choose columns of a sweep"
        in plot(tmp_path / "walk.npz", "--x", "speed", "--out", tmp_path / "a").stderr
    )


def test_a_directory_without_figures_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RunDirectory(tmp_path, "experiments") as directory:
        directory.note_session(session())
    monkeypatch.setattr("nermo_mjx.experiments.run.images", lambda out: iter(()))
    result = plot(tmp_path)
    assert result.exit_code == 1
    assert f"nothing to draw of {tmp_path}: its tables have no figures." in result.stderr


@pytest.mark.release
@pytest.mark.parametrize("walker", [FakeWalker(), None])
def test_a_tunings_figures_are_remade_with_the_landscape_it_keeps(
    walker: FakeWalker | None, tmp_path: Path
) -> None:
    tuning = Tuning.from_dict(TUNE_SPEC | {"plots": True})
    run_tuning(tuning, tmp_path / "tuned", problem=FakeProblem(tuning), simulator=walker)
    result = plot(tmp_path / "tuned", "--out", tmp_path / "again")
    assert result.exit_code == 0, result.stderr
    figures = content(tmp_path / "tuned" / "plots")
    assert content(tmp_path / "again") == figures


@pytest.mark.long
@pytest.mark.release
def test_a_directory_of_experiments_is_drawn_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the stored tables and recordings: the pictures that the run itself would draw."""
    outcome, out = walked(repeats=1, quick=True), tmp_path / "experiments"
    name = outcome.experiment
    simulated = {"run": lambda settings: outcome, "rows": lambda settings: len(outcome)}
    experiment = dataclasses.replace(EXPERIMENTS[name], **simulated)
    monkeypatch.setitem(EXPERIMENTS, name, experiment)
    run_experiments([name], out, engine="c", video=False)
    shutil.rmtree(out / "plots")
    result = plot(out)
    assert result.exit_code == 0, result.stderr
    lines = published_lines(outcome)
    files = write_figures(figures_of_experiment(outcome, lines), tmp_path / "drawn")
    assert len(files) > 6
    assert content(out / "plots") == content(tmp_path / "drawn")
    # A picture that a user has changed is kept.
    picture = next((out / "plots").glob("*.png"))
    picture.write_text("painted over")
    result = plot(out)
    assert result.exit_code == 0
    assert "plot: A file in the way was not as this program wrote it: moved aside" in result.stderr
    assert picture.with_name(f"{picture.name}.aside-1").read_text() == "painted over"
    (part,) = (out / name / "results").iterdir()
    part.write_text("damaged")
    result = plot(out)
    assert result.exit_code == 1
    assert "holds no experiment whose table and recordings can be read" in result.stderr
