"""The experiments' directory: what is kept, what is run again, what the report says. Nothing is simulated here."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from experiment_fake import RUN, Fake

from nermo_mjx.experiments import plots
from nermo_mjx.experiments.cases import Settings
from nermo_mjx.experiments.report import number, published_text
from nermo_mjx.experiments.run import (
    EXPERIMENTS,
    Directory,
    Shot,
    run_experiment,
    run_experiments,
    shoot,
)
from nermo_mjx.robot import ParameterError
from nermo_mjx.runs import DirectoryError, Interrupted, JobFailed, OtherCode, RunDirectory, Watch, codes_of
from nermo_mjx.runs.files import TEMPORARY, WrongDirectory
from nermo_mjx.view import RecordingError, VideoError

NAMES = tuple(EXPERIMENTS)
#: Counts of a run without bodies.
NOT_COVERED = {"covered": 0, "not_covered": 0}


@pytest.fixture
def fakes(monkeypatch):
    """Every experiment replaced by one that simulates nothing, and draws next to nothing."""
    made = {name: Fake(name) for name in NAMES}
    for name, fake in made.items():
        monkeypatch.setitem(EXPERIMENTS, name, fake.experiment())

    monkeypatch.setattr(plots, "figures_of", lambda outcome, lines: [(f"{outcome.experiment}-speed", b"a picture")])
    monkeypatch.setattr("nermo_mjx.plotting.files.lay_out", lambda figure: None)
    monkeypatch.setattr("nermo_mjx.plotting.files._encode", lambda figure, form: figure)
    return made


def report_of(out):
    def no_constant(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads((out / "report.json").read_text(), parse_constant=no_constant)


def snapshot(out):
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


# --- what is written


def test_the_directory_holds_what_other_programs_rely_on(fakes, tmp_path):
    """results/*.parquet, report.json, report.md, plots/ and recordings/ are there, and nothing half-written."""
    result = run_experiment("turning", tmp_path / "out", engine="c", video=False)
    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == [
        ".lock", ".lock-run", "plots", "recordings", "report.json", "report.md", "results", "run.json",
    ]  # fmt: skip
    assert result.table == out / "results" / "turning.parquet"
    assert [path.name for path in result.recordings] == ["turning-trt-0.8-hz-with-spine.npz"]
    assert [path.name for path in result.plots] == ["turning-speed.png", "turning-speed.svg"]
    assert not [path for folder in out.iterdir() if folder.is_dir() for path in folder.glob(".*")]
    assert not result.kept


def test_a_line_has_the_promised_keys_and_what_is_not_a_number_is_null(fakes, tmp_path):
    run_experiment("turning", tmp_path, video=False)
    report = report_of(tmp_path)
    keys = {"experiment", "figure", "kind", "rule", "published", "author", "settings", "author_holds", "as_published",
            "exact", "as_built", "judged_in", "ratio", "low", "high", "covered", "ensemble", "holds", "unit", "section",
            "sentence", "reason"}  # fmt: skip
    assert [set(line) for line in report["lines"]] == [keys] * 5
    speed, ratio, trend, word, interval = report["lines"]
    assert (speed["experiment"], speed["published"], speed["exact"], speed["as_published"]) == (
        "turning", 80.0, pytest.approx(81.0), pytest.approx(71.0),
    )  # fmt: skip
    assert [line["holds"] for line in (speed, ratio, trend, word, interval)] == [True, False, True, False, None]
    assert (trend["ratio"], interval["exact"], interval["published"]) == (None, None, [0.25, 0.30])
    assert [line["kind"] for line in report["lines"]] == ["predicted", "fitted", "chosen", "predicted", "theory"]
    assert speed["as_built"] == pytest.approx(61.0)
    assert (speed["author"], speed["author_holds"], speed["judged_in"]) == (84.9, True, "as_published")
    assert [line["rule"] for line in report["lines"]] == ["number", "effect", "outcome", "outcome", "range"]
    assert {(line["ensemble"], line["low"], line["covered"]) for line in report["lines"]} == {(None, None, None)}
    kinds = {
        "predicted": {"lines": 2, "hold": 1, "do_not_hold": 1, "not_measured": 0},
        "chosen": {"lines": 1, "hold": 1, "do_not_hold": 0, "not_measured": 0},
        "fitted": {"lines": 1, "hold": 0, "do_not_hold": 1, "not_measured": 0},
        "theory": {"lines": 1, "hold": 0, "do_not_hold": 0, "not_measured": 1},
    }
    kinds = {kind: counted | NOT_COVERED for kind, counted in kinds.items()}
    all_of_them = {"lines": 5, "hold": 2, "do_not_hold": 2, "not_measured": 1, "by_kind": kinds, **NOT_COVERED}
    assert report["summary"] == {**all_of_them, "by_experiment": {"turning": all_of_them}}
    assert {"versions", "machine", "command", "wall_seconds", "started"} <= set(report)


def test_every_world_is_a_row_and_every_column_says_its_unit_meaning_and_role(fakes, tmp_path):
    run_experiment("maze", tmp_path, repeats=2, video=False)
    table = pq.read_table(tmp_path / "results" / "maze.parquet")
    assert table.num_rows == 12, "three profiles, two frequencies, two repeats"
    about = {field.name: field.metadata for field in table.schema}
    assert about["speed"][b"unit"] == b"m/s"
    assert {name: metadata[b"role"].decode() for name, metadata in about.items()} == {
        "profile": "case", "gait": "case", "frequency": "case", "repeat": "index", "speed": "metric",
        "theory_speed": "metric", "followed": "metric", "status": "status", "code": "code",
    }  # fmt: skip
    assert all(metadata[b"description"] for metadata in about.values())


def test_what_is_stored_is_what_was_measured(fakes, tmp_path):
    """Truth values, texts and what is not a number come back as they were."""
    given = fakes["maze"].run(Settings(("exact",), repeats=3, progress=lambda share: None))
    result = run_experiment("maze", tmp_path, profiles=("exact",), video=False)
    for name, values in given.columns.items():
        np.testing.assert_array_equal(result.outcome.columns[name], values)
        assert result.outcome.columns[name].dtype == values.dtype
    assert result.outcome.about == given.about
    assert list(result.outcome.recordings) == ["trt, 0.8 Hz, with spine"]
    np.testing.assert_array_equal(
        result.outcome.recordings["trt, 0.8 Hz, with spine"].time,
        given.recordings["trt, 0.8 Hz, with spine"].time,
    )


def test_the_report_reads_well(fakes, tmp_path):
    run_experiments(["straight-line", "maze"], tmp_path, values={"contact.friction": 0.8}, video=False)
    text = (tmp_path / "report.md").read_text()
    assert "**2 of 4 predicted figures hold.** In all, 4 of 8 figures hold. Only predicted lines" in text
    assert "| speed at 0.8 Hz [mm/s] | predicted | 80 | 84.9 | 71.0 | 81.0 | 61.0 | – | – | yes | 6.2 |" in text
    assert "| ratio of speeds | fitted | 1.2 | – | 1.60 | 1.60 | 1.60 | – | – | **no** | 6.2: faster" in text
    assert "| interval | theory | 0.25 to 0.30 | – | – | – | – | – | – | – |  |" in text
    assert "| faster \\| at 0.8 Hz | chosen | yes | – | yes | yes | yes | – | – | yes |  |" in text, (
        "a bar ends no cell"
    )
    assert "- **no**, ratio of speeds: no reason is known." in text
    assert "- **no**, word: the feet are round." in text
    assert "| predicted | not used in any decision about the twin | 4 | 2 | 2 | 0 |" in text
    assert "| [The maze](#the-maze) | 1 of 2 | 1 of 1 | 0 of 1 | 0 of 0 | 5 | 2 | 2 | 1 |" in text
    assert "![The maze: speed](plots/maze-speed.png)" in text
    assert "| trt | 0.8 | 81.0 ± 1.0 | 96.0 | 1 of 3 |" in text, "mean and spread, the theory beside it, how many did"
    assert "contact.friction=0.8" in text
    # Every table is whole, and every link leads somewhere.
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({line.replace("\\|", "").count("|") for line in block.splitlines()}) == 1
    for link in re.findall(r"\]\(([^)#][^)]*)\)", text):
        assert (tmp_path / link).exists()


def test_numbers_have_sensible_digits():
    assert [number(x) for x in (0.0, 83.14159, 0.1740, 1234.5, -0.04999, 2.0, float("nan"), 8.097e-4, -6e-6)] == [
        "0", "83.1", "0.174", "1,234", "-0.0500", "2.00", "–", "0.000810", "0",
    ]  # fmt: skip
    assert [published_text(x) for x in (96.0, 0.9, [1.15, 1.3], [1.4, 1.2, 1.3], True, "pass", 11, None)] == [
        "96", "0.9", "1.15 to 1.30", "1.2 to 1.4", "yes", "pass", "11", "–",
    ]  # fmt: skip
    assert published_text(2.0, at_most=True) == "at most 2"


# --- what is kept


def test_what_is_done_is_not_run_again(fakes, tmp_path):
    said = []
    run_experiment("turning", tmp_path, video=False)
    before = (tmp_path / "results" / "turning.parquet").read_bytes()
    result = run_experiment("turning", tmp_path, video=False, watch=Watch(warn=said.append))
    assert len(fakes["turning"].asked) == 1
    assert result.kept
    assert (tmp_path / "results" / "turning.parquet").read_bytes() == before
    assert re.match(r"turning: kept as run on .*--again", said[0])
    assert len(result.lines) == 5


def test_another_experiment_keeps_the_lines_of_the_former(fakes, tmp_path):
    run_experiment("turning", tmp_path, video=False)
    run_experiment("straight-line", tmp_path, video=False)
    report = report_of(tmp_path)
    assert [line["experiment"] for line in report["lines"]] == ["straight-line"] * 5 + ["turning"] * 5
    assert list(report["experiments"]) == ["straight-line", "turning"]
    assert report["summary"]["by_experiment"]["turning"]["hold"] == 2
    assert report["differences"] == []


def test_an_experiment_with_other_settings_keeps_its_own_and_the_report_says_so(fakes, tmp_path):
    run_experiment("straight-line", tmp_path, quick=True, seed=3)
    run_experiment("turning", tmp_path, video=False)
    report = report_of(tmp_path)
    assert report["experiments"]["straight-line"]["settings"]["seed"] == 3
    assert report["experiments"]["turning"]["settings"]["repeats"] == 3
    (sentence,) = report["differences"]
    assert sentence.startswith("turning was run otherwise than straight-line: repeats: 3 instead of 1; seed: 0 instead")
    text = (tmp_path / "report.md").read_text()
    assert f"> **Run in different ways.** {sentence}" in text
    assert "> **A quick run** of The straight-line:" in text


def test_the_same_experiment_with_other_settings_is_refused_before_anything_runs(fakes, tmp_path):
    run_experiment("turning", tmp_path, seed=3, engine="c", video=False)
    before = snapshot(tmp_path)
    with pytest.raises(ParameterError, match=r"holds turning .*\(seed: 3 instead of 0\): choose another .*--again"):
        run_experiments(NAMES, tmp_path, video=False)
    with pytest.raises(OtherCode, match=r"was made by other code: engine c, not mjx;"):
        run_experiment("turning", tmp_path, seed=3, engine="mjx", video=False)
    assert not fakes["straight-line"].asked
    assert snapshot(tmp_path) == before
    result = run_experiment("turning", tmp_path, video=False, again=True)
    assert not result.kept
    assert report_of(tmp_path)["experiments"]["turning"]["settings"]["seed"] == 0


def test_a_damaged_table_or_a_lost_recording_is_run_again(fakes, tmp_path):
    for file in ("results/turning.parquet", "recordings/turning-trt-0.8-hz-with-spine.npz"):
        result = run_experiment("turning", tmp_path, video=False)
        if file.startswith("results"):
            result.table.write_bytes(result.table.read_bytes()[:100])
        else:
            (tmp_path / file).unlink()
        assert not run_experiment("turning", tmp_path, video=False).kept


def test_a_failure_half_way_keeps_what_is_done(fakes, tmp_path):
    fakes["balance"].error = RecordingError("the feet came off.")
    with pytest.raises(JobFailed, match=r"^balance failed: the feet came off\. What was done before is kept in"):
        run_experiments(NAMES, tmp_path, video=False)
    assert list(report_of(tmp_path)["experiments"]) == ["straight-line", "turning"]
    assert not fakes["maze"].asked
    fakes["balance"].error = None
    result = run_experiments(NAMES, tmp_path, video=False)
    assert [each.kept for each in result.results] == [True, True] + [False] * (len(NAMES) - 2)
    assert list(report_of(tmp_path)["experiments"]) == list(NAMES)


def test_a_bug_keeps_its_traceback(fakes, tmp_path):
    fakes["turning"].error = ValueError("index 3 is out of bounds")
    with pytest.raises(ValueError, match="index 3 is out of bounds"):
        run_experiment("turning", tmp_path, video=False)


def test_ctrl_c_says_how_to_go_on(fakes, tmp_path):
    fakes["turning"].error = KeyboardInterrupt()
    with pytest.raises(Interrupted, match=r"stopped; what is finished is kept in .*run the same command again"):
        run_experiments(NAMES, tmp_path, video=False)
    assert list(report_of(tmp_path)["experiments"]) == ["straight-line"]


def test_results_are_kept_if_the_plots_fail(fakes, tmp_path, monkeypatch):
    def fail(*_):
        raise ValueError("no such colour")

    monkeypatch.setattr(plots, "figures_of", fail)
    with pytest.raises(ValueError, match="no such colour"):
        run_experiment("turning", tmp_path, video=False)
    assert len(report_of(tmp_path)["lines"]) == 5


# --- whose files


def pictures_of(monkeypatch, *names):
    """From now on an experiment has these pictures."""

    def figures(outcome, lines):
        for name in names:
            yield f"{outcome.experiment}-{name}", f"{name} of {outcome.recordings[RUN].duration}".encode()

    monkeypatch.setattr(plots, "figures_of", figures)


def test_what_a_fresh_run_does_not_make_any_more_is_removed(fakes, tmp_path, monkeypatch):
    pictures_of(monkeypatch, "speed", "old")
    run_experiment("turning", tmp_path, video=False)
    pictures_of(monkeypatch, "speed")
    run_experiment("turning", tmp_path, video=False, again=True)
    assert [path.name for path in sorted((tmp_path / "plots").iterdir())] == ["turning-speed.png", "turning-speed.svg"]


def test_what_a_killed_process_left_half_written_is_removed(fakes, tmp_path):
    run_experiment("turning", tmp_path, video=False)
    for folder in ("results", "plots"):
        (tmp_path / folder / f".turning.17{TEMPORARY}").write_text("half")
    run_experiment("turning", tmp_path, video=False)
    assert not list(tmp_path.rglob(f"*{TEMPORARY}"))


def test_a_users_files_outlive_a_run_again(fakes, tmp_path):
    """Whatever they are called; the program removes what it wrote, and nothing else."""
    run_experiment("turning", tmp_path, video=False)
    mine = [
        tmp_path / name
        for name in ("plots/turning-mine.png", "recordings/turning-mine.npz", "plots/turning-speed.pdf", "videos/a.mp4")
    ]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("a user's")
    run_experiment("turning", tmp_path, video=False, again=True)
    assert [path.read_text() for path in mine] == ["a user's"] * 4
    assert not list(tmp_path.rglob("*aside*"))


def test_a_users_file_in_the_way_is_moved_aside_with_a_sentence(fakes, tmp_path):
    said = []
    run_experiment("turning", tmp_path, video=False)
    (tmp_path / "plots" / "turning-speed.png").write_text("painted over")
    (tmp_path / "recordings" / "turning-trt-0.8-hz-with-spine.npz").write_text("another walk")
    run_experiment("turning", tmp_path, video=False, again=True, watch=Watch(warn=said.append))
    assert said == [
        "turning: Files in the way were not as this program wrote them: moved aside in "
        f"{tmp_path}, to recordings/turning-trt-0.8-hz-with-spine.npz.aside-1 and 1 more."
    ]
    assert (tmp_path / "plots" / "turning-speed.png.aside-1").read_text() == "painted over"
    assert (tmp_path / "plots" / "turning-speed.png").read_text() == "a picture"
    aside = tmp_path / "recordings" / "turning-trt-0.8-hz-with-spine.npz.aside-1"
    assert aside.read_text() == "another walk"


def test_a_report_that_a_user_has_written_on_is_moved_aside_with_a_sentence(fakes, tmp_path):
    said = []
    run_experiment("turning", tmp_path, video=False)
    report = (tmp_path / "report.md").read_text()
    run_experiment("turning", tmp_path, video=False, watch=Watch(warn=said.append))
    assert not any("moved aside" in sentence for sentence in said)
    (tmp_path / "report.md").write_text("my remarks")
    run_experiment("turning", tmp_path, video=False, watch=Watch(warn=said.append))
    assert f"moved aside in {tmp_path}, to report.md.aside-1." in said[-1]
    assert (tmp_path / "report.md.aside-1").read_text() == "my remarks"
    assert (tmp_path / "report.md").read_text() == report


def test_a_directory_may_be_named_from_here_and_moved(fakes, tmp_path, monkeypatch):
    """Its files know their own as well as in a directory that is named from the root."""
    monkeypatch.chdir(tmp_path)
    run_experiment("turning", "here", video=False)
    Path("here").rename("there")
    Path("there/plots/turning-speed.png").write_text("painted over")
    assert run_experiment("turning", "there", video=False).kept
    assert [path.as_posix() for path in Path("there").rglob("*aside*")] == ["there/plots/turning-speed.png.aside-1"]
    assert not run_experiment("turning", "there", video=False, again=True).kept
    assert len(list(Path("there").rglob("*aside*"))) == 1


def test_a_damaged_table_is_kept_aside(fakes, tmp_path):
    result = run_experiment("turning", tmp_path, video=False)
    result.table.write_text("half a table")
    run_experiment("turning", tmp_path, video=False)
    assert result.table.with_name("turning.parquet.aside-1").read_text() == "half a table"


def test_files_of_an_earlier_release_are_moved_aside_if_they_are_not_drawn_alike(fakes, tmp_path, monkeypatch):
    """It did not note what it wrote."""
    run_experiment("turning", tmp_path, video=False)
    forget_code(tmp_path)
    run_experiment("turning", tmp_path, video=False, accept_new_code=True)
    assert not list(tmp_path.rglob("*aside*"))
    forget_code(tmp_path)
    pictures_of(monkeypatch, "speed")
    run_experiment("turning", tmp_path, video=False, accept_new_code=True)
    aside = sorted(path.name for path in tmp_path.rglob("*aside*"))
    assert aside == ["turning-speed.png.aside-1", "turning-speed.svg.aside-1"]


# --- which code


def forget_code(out):
    """Make a directory look like one that lost its history: no kind, no codes, no note of the files written."""
    (out / "run.json").unlink()
    for path in (out / "results").glob("*.json"):
        entry = json.loads(path.read_text())
        path.write_text(json.dumps({key: value for key, value in entry.items() if key not in ("files", "code")}))


def as_version(monkeypatch, version):
    """From now on the package has another version."""
    monkeypatch.setattr("nermo_mjx.runs.code.__version__", version)


def code_of(out, name):
    """What the column `code` of a table says."""
    return set(pq.read_table(out / "results" / f"{name}.parquet").column("code").to_pylist())


def test_every_row_names_the_code_that_made_it(fakes, tmp_path):
    run_experiment("turning", tmp_path, engine="c", video=False)
    ((name, code),) = codes_of(tmp_path).items()
    assert code_of(tmp_path, "turning") == {name}
    assert code.engine == "c"
    assert report_of(tmp_path)["experiments"]["turning"]["code"] == name
    assert name in (tmp_path / "report.md").read_text()


def test_what_other_code_made_is_refused_before_anything_runs(fakes, tmp_path, monkeypatch):
    run_experiment("turning", tmp_path, video=False)
    before = snapshot(tmp_path)
    as_version(monkeypatch, "9.9.9")
    with pytest.raises(OtherCode, match=r"made by other code: nermo-mjx .*, not 9\.9\.9; .*--accept-new-code"):
        run_experiments(NAMES, tmp_path, video=False)
    assert snapshot(tmp_path) == before
    assert not fakes["straight-line"].asked


def test_accepted_code_goes_on_and_the_report_tells_the_rows_apart(fakes, tmp_path, monkeypatch):
    said = []
    run_experiment("turning", tmp_path, video=False)
    as_version(monkeypatch, "9.9.9")
    options = {"video": False, "accept_new_code": True, "watch": Watch(warn=said.append)}
    result = run_experiments(["turning", "maze"], tmp_path, **options)
    assert [each.kept for each in result.results] == [True, False]
    assert re.match(r"turning: kept as run on .* by other code \(nermo-mjx .*, not 9\.9\.9\); --again", said[0])
    former, new = codes_of(tmp_path)
    assert (code_of(tmp_path, "turning"), code_of(tmp_path, "maze")) == ({former}, {new})
    (sentence,) = report_of(tmp_path)["differences"]
    assert f"code: {new} instead of {former}" in sentence


def test_other_code_runs_again_when_it_is_asked_to(fakes, tmp_path, monkeypatch):
    run_experiment("turning", tmp_path, video=False)
    as_version(monkeypatch, "9.9.9")
    assert not run_experiment("turning", tmp_path, video=False, again=True).kept
    assert code_of(tmp_path, "turning") == {list(codes_of(tmp_path))[1]}


def test_a_directory_that_lost_its_history_is_refused_until_it_is_accepted(fakes, tmp_path):
    run_experiment("turning", tmp_path, video=False)
    forget_code(tmp_path)
    with pytest.raises(OtherCode, match="does not say which code made it"):
        run_experiment("turning", tmp_path, video=False)
    assert run_experiment("turning", tmp_path, video=False, accept_new_code=True).kept


def test_a_directory_keeps_the_engine_it_was_begun_with(fakes, tmp_path):
    run_experiment("turning", tmp_path, engine="mjx", video=False)
    run_experiment("maze", tmp_path, video=False)
    assert fakes["maze"].asked[0].engine == "mjx"
    run_experiment("maze", tmp_path, video=False, again=True)
    assert fakes["maze"].asked[1].engine != "mjx", "what is run again is run as on a new directory"


def test_one_process_runs_experiments_in_a_directory(fakes, tmp_path):
    with RunDirectory(tmp_path, "experiments"), pytest.raises(DirectoryError, match="another process works in"):
        run_experiment("turning", tmp_path, video=False)
    assert not fakes["turning"].asked


# --- settings


def test_settings_reach_the_experiment(fakes, tmp_path):
    heard = []
    run_experiment(
        "maze", tmp_path, engine="c", profiles=["as_published"], repeats=2, seed=5, values={"contact.friction": 0.8},
        video=False, watch=Watch(lambda done: heard.append((done.what, done.fraction))),
    )  # fmt: skip
    (asked,) = fakes["maze"].asked
    assert asked.but(progress=None) == Settings(("as_published",), 2, 5, False, {"contact.friction": 0.8}, engine="c")
    assert ("maze", 0.5) in heard
    report = report_of(tmp_path)
    assert {line["exact"] for line in report["lines"]} == {None}
    assert {line["as_built"] for line in report["lines"]} == {None}


def test_a_quick_run_is_one_repeat_and_no_video(fakes, tmp_path, monkeypatch):
    def none(*_):
        raise AssertionError("no video")

    monkeypatch.setattr("nermo_mjx.experiments.run.shoot", none)
    run_experiment("maze", tmp_path, quick=True)
    assert fakes["maze"].asked[0].repeats == 1
    assert fakes["maze"].asked[0].quick


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"name": "turnin"}, "experiment is 'turnin': did you mean 'turning'?"),
        ({"repeats": 0}, "repeats is 0: allowed is a whole number of at least 1."),
        ({"bodies": 0}, "bodies is 0: allowed is a whole number of at least 1."),
        ({"bodies": True}, "bodies is True: allowed is"),
        ({"bodies": 10**6}, "bodies is 1000000: allowed is"),
        ({"seed": -1}, "seed is -1: allowed is"),
        ({"profiles": ()}, "allowed is a list of exact, as_published, as_built."),
        ({"profiles": ["exakt"]}, "profile is 'exakt': did you mean 'exact'?"),
        ({"engine": "gpu"}, "engine is 'gpu': allowed is one of auto, c, mjx, warp."),
        ({"values": {"contact.fricton": 1.0}}, "did you mean 'contact.friction'?"),
        ({"values": {"contact.friction": 50.0}}, "contact.friction is 50: allowed is [0.05, 5]."),
        ({"out": "file"}, "file is a file: a directory is needed."),
        ({"out": "file/out"}, "cannot write in "),
        ({"out": "/sys/kernel/nermo"}, "cannot write in /sys/kernel/nermo: "),
        ({"out": "sweep"}, "sweep holds a sweep, and not published experiments: choose another directory."),
    ],
)
def test_wrong_settings_are_refused_before_anything_runs(fakes, tmp_path, options, sentence):
    (tmp_path / "file").write_text("")
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "run.json").write_text('{"kind": "sweep"}')
    options = {"name": "turning", "out": "out", "video": False} | options
    with pytest.raises((ParameterError, WrongDirectory), match=re.escape(sentence)):
        run_experiment(options.pop("name"), tmp_path / options.pop("out"), **options)
    assert not fakes["turning"].asked
    assert not list(tmp_path.glob("out/results/*"))


# --- videos


def test_a_machine_that_cannot_draw_makes_no_video_and_says_so(fakes, tmp_path, monkeypatch):
    def shoot(*_):
        raise VideoError("MuJoCo cannot draw on this machine.")

    monkeypatch.setattr("nermo_mjx.experiments.run.shoot", shoot)
    said = []
    result = run_experiment("maze", tmp_path, watch=Watch(warn=said.append))
    note = "There is no video of maze. MuJoCo cannot draw on this machine."
    assert said == [note] == list(result.notes)
    assert note in (tmp_path / "report.md").read_text()
    assert result.videos == ()


@pytest.mark.usefixtures("drawing")
def test_a_video_is_made_once_and_linked(fakes, tmp_path, monkeypatch):
    result = run_experiment("maze", tmp_path)
    assert result.videos == (tmp_path / "videos" / "maze.mp4",)
    assert (
        "[videos/maze.mp4](videos/maze.mp4), trt, 0.8 Hz, with spine, in real time."
        in (tmp_path / "report.md").read_text()
    )
    made = result.videos[0].stat().st_mtime_ns
    assert run_experiment("maze", tmp_path, video=False).videos == result.videos
    assert result.videos[0].stat().st_mtime_ns == made


def test_a_long_run_is_shown_faster_up_to_its_end(fakes, tmp_path, monkeypatch):
    """A run of 100 s that has ended after 70 fits into a video of 8 s."""
    shown = {}
    monkeypatch.setattr(
        "nermo_mjx.experiments.run.render",
        lambda recording, model, path, **how: shown.update(how, duration=recording.duration),
    )
    run_experiment("maze", tmp_path, video=False)
    stored = Directory(tmp_path).load("maze")
    assert stored is not None
    outcome = stored.outcome
    outcome.columns["speed"][:] = 70.0
    (name,) = outcome.recordings
    recording = outcome.recordings[name]
    object.__setattr__(recording, "time", np.linspace(0.0, 100.0, len(recording.time)))
    assert shoot(outcome, Shot("with spine", speed=8.0, until="speed"), Path("a.mp4")) == 9.0
    assert shown["speed"] == 9.0
    assert shown["duration"] == pytest.approx(71.0, abs=3.0)


# --- the catalogue


def test_every_published_experiment_is_in_the_catalogue():
    for name, experiment in EXPERIMENTS.items():
        assert experiment.name == name
        assert experiment.figures
        assert experiment.description
        assert experiment.metrics


def test_what_the_cases_decide_cannot_be_set(fakes, tmp_path):
    """Before anything runs; an option that did nothing would be worse than none."""
    with pytest.raises(ParameterError, match="frequency cannot be set for maze"):
        run_experiment("maze", tmp_path, values={"frequency": 0.5}, video=False)
    assert not list(tmp_path.rglob("*.parquet"))


def test_the_published_experiments_take_parameters_that_no_case_decides():
    for name in ("straight-line", "turning", "maze"):
        settable = EXPERIMENTS[name].settable
        assert {"contact.friction", "stance.rear_z", "mass.front"} <= settable, name
        assert not {"frequency", "duty", "start.x"} & settable, name
    assert "contact.friction" in EXPERIMENTS["balance"].settable
    assert "stance.rear_z" not in EXPERIMENTS["balance"].settable
