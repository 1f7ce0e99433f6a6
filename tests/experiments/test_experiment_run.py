# Tests of experiments/run.py, experiments/store.py, experiments/report.py, experiments/cases.py
"""The experiments' directory: what is kept, what is run again, what the report says. Nothing is simulated here."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.experiment_fake import RUN, pretend

from nermo_mjx.experiments import plots, run
from nermo_mjx.experiments.cases import Settings
from nermo_mjx.experiments.published import Shot
from nermo_mjx.experiments.report import published_text, rounded
from nermo_mjx.experiments.run import EXPERIMENTS, Directory, run_experiment, run_experiments, shoot
from nermo_mjx.robot import ParameterError
from nermo_mjx.runs import Interrupted, JobFailed, OtherCode, Watch, codes_of
from nermo_mjx.runs.files import TEMPORARY_SUFFIX, WrongDirectory
from nermo_mjx.runs.workers import WorkersLost
from nermo_mjx.sweep import read_table
from nermo_mjx.view import RecordingError, VideoError

NAMES = tuple(EXPERIMENTS)
#: Counts of a run without bodies.
NOT_COVERED = {"covered": 0, "not_covered": 0}
WALK = "turning/recordings/row-000003.npz"


@pytest.fixture
def fakes(monkeypatch):
    """Every experiment replaced by one that simulates nothing, and draws next to nothing."""
    made = pretend(monkeypatch)
    monkeypatch.setattr("nermo_mjx.plotting.files.lay_out", lambda figure: None)
    monkeypatch.setattr("nermo_mjx.plotting.files._encode", lambda figure, form: figure)
    pictures_of(monkeypatch, "speed")
    return made


def pictures_of(monkeypatch, *names):
    """From now on an experiment has these pictures."""

    def figures(outcome, lines):
        yield from (
            (f"{outcome.experiment}-{name}", f"{name}, {outcome.recordings[RUN].duration}".encode())
            for name in names
        )

    monkeypatch.setattr(plots, "figures_of_experiment", figures)


def ran(out, name="turning", **options):
    return run_experiment(name, out, video=False, **options)


def part_of(result):
    """The only file of a result's table."""
    (part,) = result.table.glob("*.parquet")
    return part


def report_of(out):
    def no_constant(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads((out / "report.json").read_text(), parse_constant=no_constant)


def snapshot(out):
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


# --- what is written


@pytest.mark.release
def test_the_directory_holds_what_other_programs_rely_on(fakes, tmp_path):
    """Files, columns with unit, meaning and role; what comes back is what was measured."""
    given = fakes["turning"].run(Settings(("exact",), repeats=2, progress=lambda share: None))
    result = ran(tmp_path, engine="c", profiles=("exact",), repeats=2)
    walk = "turning/recordings/row-000002.npz"
    assert not result.kept
    assert sorted(str(path.relative_to(tmp_path)) for path in snapshot(tmp_path)) == sorted(
        [
            ".lock",
            ".lock-run",
            "plots/turning-speed.png",
            "plots/turning-speed.svg",
            "report.json",
            "report.md",
            "run.json",
            "turning/.lock",
            "turning/.lock-run",
            "turning/experiment.json",
            "turning/report.json",
            "turning/run.json",
            part_of(result).relative_to(tmp_path).as_posix(),
            walk,
        ]
    )
    assert (result.table, *result.recordings) == (
        tmp_path / "turning" / "results",
        tmp_path / walk,
    )
    assert [path.suffix for path in result.plots] == [".png", ".svg"]
    table = pq.read_table(part_of(result))
    about = {field.name: field.metadata for field in table.schema}
    assert (table.num_rows, about["speed"][b"unit"]) == (4, b"m/s")
    assert all(metadata[b"description"] for metadata in about.values())
    assert {name: metadata[b"role"].decode() for name, metadata in about.items()} == {
        "row": "index",
        "variant": "index",
        "seed": "index",
        "profile": "varied",
        "gait": "varied",
        "frequency": "varied",
        "repeat": "index",
        "speed": "metric",
        "theory_speed": "metric",
        "followed": "metric",
        "status": "status",
        "code": "code",
        "key": "key",
    }
    for name, values in given.columns.items():
        np.testing.assert_array_equal(result.outcome.columns[name], values)
        assert result.outcome.columns[name].dtype == values.dtype
    assert result.outcome.about == given.about
    np.testing.assert_array_equal(result.outcome.recordings[RUN].time, given.recordings[RUN].time)


def test_a_line_has_the_promised_keys_and_what_is_not_a_number_is_null(fakes, tmp_path):
    ran(tmp_path)
    report = report_of(tmp_path)
    keys = {
        "experiment",
        "figure",
        "kind",
        "rule",
        "published",
        "author",
        "settings",
        "author_holds",
        "as_published",
        "exact",
        "as_built",
        "judged_in",
        "ratio",
        "low",
        "high",
        "covered",
        "ensemble",
        "holds",
        "unit",
        "section",
        "sentence",
        "reason",
    }
    assert [set(line) for line in report["lines"]] == [keys] * 5
    speed, ratio, trend, word, interval = report["lines"]
    assert [
        speed[name] for name in ("experiment", "published", "author", "author_holds", "judged_in")
    ] == [
        "turning",
        80.0,
        84.9,
        True,
        "as_published",
    ]
    assert [speed[name] for name in ("exact", "as_published", "as_built")] == pytest.approx(
        [81.0, 71.0, 61.0]
    )
    assert [line["holds"] for line in (speed, ratio, trend, word, interval)] == [
        True,
        False,
        True,
        False,
        None,
    ]
    assert (trend["ratio"], interval["exact"], interval["published"]) == (None, None, [0.25, 0.30])
    assert {(line["ensemble"], line["low"], line["covered"]) for line in report["lines"]} == {
        (None, None, None)
    }
    kinds = {
        "predicted": {"lines": 2, "hold": 1, "do_not_hold": 1, "not_measured": 0},
        "chosen": {"lines": 1, "hold": 1, "do_not_hold": 0, "not_measured": 0},
        "fitted": {"lines": 1, "hold": 0, "do_not_hold": 1, "not_measured": 0},
        "theory": {"lines": 1, "hold": 0, "do_not_hold": 0, "not_measured": 1},
    }
    kinds = {kind: counted | NOT_COVERED for kind, counted in kinds.items()}
    all_of_them = {
        "lines": 5,
        "hold": 2,
        "do_not_hold": 2,
        "not_measured": 1,
        "by_kind": kinds,
        **NOT_COVERED,
    }
    assert report["summary"] == {**all_of_them, "by_experiment": {"turning": all_of_them}}
    assert {"versions", "machine", "command", "wall_seconds", "started"} <= set(report)


def test_the_report_reads_well(fakes, tmp_path):
    run_experiments(
        ["straight-line", "maze"], tmp_path, values={"contact.friction": 0.8}, video=False
    )
    text = (tmp_path / "report.md").read_text()
    for part in (
        "**2 of 4 predicted figures hold.** In all, 4 of 8 figures hold. Only predicted lines",
        "| speed at 0.8 Hz [mm/s] | predicted | 80 | 84.9 | 71.0 | 81.0 | 61.0 | – | – | yes | 6.2 |",
        "| ratio of speeds | fitted | 1.2 | – | 1.60 | 1.60 | 1.60 | – | – | **no** | 6.2: faster",
        "| interval | theory | 0.25 to 0.30 | – | – | – | – | – | – | – |  |",
        "| faster \\| at 0.8 Hz | chosen | yes | – | yes | yes | yes | – | – | yes |  |",  # a bar ends no cell
        "- **no**, ratio of speeds: no reason is known.",
        "- **no**, word: the feet are round.",
        "| predicted | not used in any decision about the twin | 4 | 2 | 2 | 0 |",
        "| [The maze](#the-maze) | 1 of 2 | – | 1 of 1 | 0 of 1 | 0 of 0 | 5 | 2 | 2 | 1 |",
        "![The maze: speed](plots/maze-speed.png)",
        "| trot | 0.8 | 81.0 ± 1.0 | 96.0 | 1 of 3 |",  # mean and spread, the theory beside it, how many did
        "contact.friction=0.8",
    ):
        assert part in text
    # Every table is whole, and every link leads somewhere.
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({line.replace("\\|", "").count("|") for line in block.splitlines()}) == 1
    for link in re.findall(r"\]\(([^)#][^)]*)\)", text):
        assert (tmp_path / link).exists()


def test_numbers_have_sensible_digits():
    assert [
        rounded(x)
        for x in (0.0, 83.14159, 0.1740, 1234.5, -0.04999, 2.0, float("nan"), 8.097e-4, -6e-6)
    ] == [
        "0",
        "83.1",
        "0.174",
        "1,234",
        "-0.0500",
        "2.00",
        "–",
        "0.000810",
        "0",
    ]
    assert [
        published_text(x) for x in (96.0, 0.9, [1.15, 1.3], [1.4, 1.2, 1.3], True, "pass", 11, None)
    ] == [
        "96",
        "0.9",
        "1.15 to 1.30",
        "1.2 to 1.4",
        "yes",
        "pass",
        "11",
        "–",
    ]
    assert published_text(2.0, at_most=True) == "at most 2"


# --- what is kept


def test_what_is_done_is_not_run_again_and_other_experiments_keep_it(fakes, tmp_path):
    said = []
    ran(tmp_path)
    before = snapshot(tmp_path / "turning" / "results")
    result = ran(tmp_path, watch=Watch(warn=said.append))
    assert (result.kept, len(result.lines), len(fakes["turning"].asked)) == (True, 5, 1)
    assert snapshot(tmp_path / "turning" / "results") == before
    assert re.match(r"turning: kept as run on .*--again", said[0])
    ran(tmp_path, "straight-line")
    report = report_of(tmp_path)
    assert [line["experiment"] for line in report["lines"]] == ["straight-line"] * 5 + [
        "turning"
    ] * 5
    assert list(report["experiments"]) == ["straight-line", "turning"]
    assert report["summary"]["by_experiment"]["turning"]["hold"] == 2
    assert report["differences"] == []


def test_an_experiment_with_other_settings_keeps_its_own_and_the_report_says_so(fakes, tmp_path):
    run_experiment("straight-line", tmp_path, quick=True, seed=3)
    ran(tmp_path)
    report = report_of(tmp_path)
    assert report["experiments"]["straight-line"]["settings"]["seed"] == 3
    assert report["experiments"]["turning"]["settings"]["repeats"] == 3
    (sentence,) = report["differences"]
    assert sentence.startswith(
        "turning was run otherwise than straight-line: repeats: 3 instead of 1; seed: 0 instead"
    )
    text = (tmp_path / "report.md").read_text()
    assert f"> **Run in different ways.** {sentence}" in text
    assert "> **A quick run** of The straight-line:" in text


def test_the_same_experiment_with_other_settings_is_refused_before_anything_runs(fakes, tmp_path):
    ran(tmp_path, seed=3, engine="c")
    before = snapshot(tmp_path)
    with pytest.raises(
        ParameterError, match=r"holds turning .*\(seed: 3 instead of 0\): choose another .*--again"
    ):
        run_experiments(NAMES, tmp_path, video=False)
    assert not fakes["straight-line"].asked
    assert snapshot(tmp_path) == before
    replaced = [path.read_bytes() for path in sorted(tmp_path.glob("*/results/part-*.parquet"))]
    assert not ran(tmp_path, again=True).kept
    assert report_of(tmp_path)["experiments"]["turning"]["settings"]["seed"] == 0
    aside = sorted(tmp_path.glob("*/results/part-*.replaced"))
    assert replaced
    assert [path.read_bytes() for path in aside] == replaced, "an interruption loses no result"


def test_a_damaged_table_is_kept_aside_and_it_or_a_lost_recording_is_run_again(fakes, tmp_path):
    result = ran(tmp_path)
    part = part_of(result)
    part.write_text("half a table")
    assert not ran(tmp_path).kept
    (aside,) = (tmp_path / "turning" / "results.aside").iterdir()
    assert (aside.name, aside.read_text()) == (f"{part.name}.aside-1", "half a table")
    (tmp_path / WALK).unlink()
    assert not ran(tmp_path).kept


def test_a_failure_half_way_keeps_what_is_done(fakes, tmp_path):
    fakes["balance"].error = RecordingError("the feet came off.")
    with pytest.raises(
        JobFailed, match=r"^balance failed: the feet came off\. What was done before is kept in"
    ):
        run_experiments(NAMES, tmp_path, video=False)
    assert list(report_of(tmp_path)["experiments"]) == ["straight-line", "turning"]
    assert not fakes["maze"].asked
    fakes["balance"].error = ValueError("index 3 is out of bounds")  # a bug keeps its traceback
    with pytest.raises(ValueError, match="index 3 is out of bounds"):
        run_experiments(NAMES, tmp_path, video=False)
    fakes["balance"].error = KeyboardInterrupt()
    with pytest.raises(
        Interrupted, match=r"stopped; what is finished is kept in .*run the same command again"
    ):
        run_experiments(NAMES, tmp_path, video=False)
    fakes["balance"].error = None
    result = run_experiments(NAMES, tmp_path, video=False)
    assert [each.kept for each in result.results] == [True, True] + [False] * (len(NAMES) - 2)
    assert list(report_of(tmp_path)["experiments"]) == list(NAMES)


def test_results_are_kept_if_the_plots_fail(fakes, tmp_path, monkeypatch):
    monkeypatch.setattr(plots, "figures_of_experiment", lambda outcome, lines: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ran(tmp_path)
    assert len(report_of(tmp_path)["lines"]) == 5


# --- whose files


def test_only_the_programs_own_files_are_replaced_or_removed(fakes, tmp_path, monkeypatch):
    """What is not drawn any more goes, what was half written too; a user's files stay, or are moved out of the way."""
    said = []
    pictures_of(monkeypatch, "speed", "old")
    ran(tmp_path)
    pictures_of(monkeypatch, "speed")
    mine = [
        tmp_path / name
        for name in ("plots/turning-mine.png", "turning/recordings/mine.npz", "videos/a.mp4")
    ]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("a user's")
    for folder in ("", "turning/results", "plots", "turning/recordings", "videos"):
        (
            tmp_path / folder / f".turning.17{TEMPORARY_SUFFIX}{'.mp4' * (folder == 'videos')}"
        ).write_text("half")
    picture, walk = tmp_path / "plots" / "turning-speed.png", tmp_path / WALK
    picture.write_text("painted over")
    walk.write_text("another walk")
    ran(tmp_path, again=True, watch=Watch(warn=said.append))
    assert [path.read_text() for path in mine] == ["a user's"] * 3
    assert not [*tmp_path.rglob(f"*{TEMPORARY_SUFFIX}*"), *tmp_path.rglob("*old*")]
    assert said == [
        "turning: Files in the way were not as this program wrote them: moved aside in "
        f"{tmp_path}, to {WALK}.aside-1 and 1 more."
    ]
    assert picture.with_name("turning-speed.png.aside-1").read_text() == "painted over"
    assert picture.read_text().startswith("speed")
    assert walk.with_name(f"{walk.name}.aside-1").read_text() == "another walk"
    report = (tmp_path / "report.md").read_text()
    (tmp_path / "report.md").write_text("my remarks")
    ran(tmp_path, watch=Watch(warn=said.append))
    assert f"moved aside in {tmp_path}, to report.md.aside-1." in said[-1]
    assert (tmp_path / "report.md.aside-1").read_text() == "my remarks"
    assert (tmp_path / "report.md").read_text() == report


def test_a_killed_run_leaves_nothing_aside(fakes, tmp_path, monkeypatch):
    """Killed before each change of its directory in turn, after which nothing is written any more."""

    class Killed(BaseException):
        pass

    def shoot(outcome, shot, path, progress):
        path.parent.mkdir(exist_ok=True)
        (path.parent / "half").write_text(f"a video of {outcome.experiment}")
        os.replace(path.parent / "half", path)
        return 1.0

    monkeypatch.setattr(run, "shoot", shoot)
    for before in itertools.count(1):
        out, changes, replace = tmp_path / str(before), itertools.count(1), os.replace

        def replacing(source, target, changes=changes, before=before, replace=replace):
            if next(changes) >= before:
                raise Killed
            replace(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", replacing)
            try:
                run_experiment("turning", out)
                break
            except Killed:
                pass
        assert len(run_experiment("turning", out).videos) == 1
        assert [path.name for path in out.rglob("*") if "aside" in path.name] == [], before
    assert before > 10


def test_a_directory_may_be_named_from_here_and_moved(fakes, tmp_path, monkeypatch):
    """Its files know their own as well as in a directory that is named from the root."""
    monkeypatch.chdir(tmp_path)
    ran("here")
    Path("here").rename("there")
    Path("there/plots/turning-speed.png").write_text("painted over")
    assert ran("there").kept
    assert [path.as_posix() for path in Path("there").rglob("*aside*")] == [
        "there/plots/turning-speed.png.aside-1"
    ]
    assert not ran("there", again=True).kept
    assert len(list(Path("there").rglob("*aside*"))) == 1


# --- which code


def code_of(out, name):
    """What the column `code` of a table says."""
    return set(read_table(out / name).column("code").to_pylist())


def test_other_code_is_refused_until_it_is_accepted_and_the_report_tells_the_rows_apart(
    fakes, tmp_path, monkeypatch
):
    said = []
    ran(tmp_path)
    before = snapshot(tmp_path)
    monkeypatch.setattr("nermo_mjx.runs.code.__version__", "9.9.9")
    with pytest.raises(
        OtherCode, match=r"made by other code: nermo-mjx .*, not 9\.9\.9; .*--accept-new-code"
    ):
        run_experiments(NAMES, tmp_path, video=False)
    assert snapshot(tmp_path) == before
    assert not fakes["straight-line"].asked
    options = {"video": False, "accept_new_code": True, "watch": Watch(warn=said.append)}
    result = run_experiments(["turning", "maze"], tmp_path, **options)
    assert [each.kept for each in result.results] == [True, False]
    assert re.match(
        r"turning: kept as run on .* by other code \(nermo-mjx .*, not 9\.9\.9\); --again", said[0]
    )
    former, new = codes_of(tmp_path)
    assert (code_of(tmp_path, "turning"), code_of(tmp_path, "maze")) == ({former}, {new})
    (sentence,) = report_of(tmp_path)["differences"]
    assert f"code: {new} instead of {former}" in sentence
    assert not ran(tmp_path, again=True).kept
    assert code_of(tmp_path, "turning") == {new}
    assert report_of(tmp_path)["experiments"]["turning"]["code"] == new
    assert new in (tmp_path / "report.md").read_text()


def test_a_directory_that_lost_its_history_is_refused_until_it_is_accepted(
    fakes, tmp_path, monkeypatch
):
    """No kind, no codes, no note of the files written: what is not drawn alike is moved aside then."""
    ran(tmp_path)
    for text, aside in (
        ("speed, 0.48", []),
        ("other", ["turning-speed.png.aside-1", "turning-speed.svg.aside-1"]),
    ):
        (tmp_path / "run.json").unlink()
        monkeypatch.setattr(
            plots, "figures_of_experiment", lambda *_, text=text: [("turning-speed", text.encode())]
        )
        with pytest.raises(OtherCode, match="does not say which code made it"):
            ran(tmp_path)
        assert ran(tmp_path, accept_new_code=True).kept
        assert sorted(path.name for path in tmp_path.rglob("*aside*")) == aside


def test_a_directory_keeps_the_engine_it_was_begun_with(fakes, tmp_path):
    ran(tmp_path, engine="mjx")
    ran(tmp_path, "maze")
    assert fakes["maze"].asked[0].engine == "mjx"
    with pytest.raises(OtherCode, match=r"was made by other code: engine mjx, not c;"):
        ran(tmp_path, engine="c")
    ran(tmp_path, "maze", again=True)
    assert fakes["maze"].asked[1].engine != "mjx", "what is run again is run as on a new directory"


# --- settings


def test_settings_reach_the_experiment(fakes, tmp_path):
    heard = []
    ran(
        tmp_path,
        "maze",
        engine="c",
        profiles=["as_published"],
        repeats=2,
        seed=5,
        values={"contact.friction": 0.8},
        watch=Watch(lambda done: heard.append((done.what, done.fraction))),
    )
    (asked,) = fakes["maze"].asked
    assert asked.but(progress=None) == Settings(
        ("as_published",), 2, 5, False, {"contact.friction": 0.8}, engine="c"
    )
    assert ("maze", 0.5) in heard
    assert {(line["exact"], line["as_built"]) for line in report_of(tmp_path)["lines"]} == {
        (None, None)
    }


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"name": "turnin"}, "experiment is 'turnin': did you mean 'turning'?"),
        ({"repeats": 0}, "repeats is 0: allowed is a whole number of at least 1."),
        ({"bodies": True}, "bodies is True: allowed is"),
        ({"bodies": 10**6}, "bodies is 1000000: allowed is 1 to"),
        ({"seed": -1}, "seed is -1: allowed is"),
        ({"profiles": ()}, "allowed is a list of exact, as_published, as_built."),
        ({"profiles": "exact"}, "profiles is 'exact': allowed is a list of"),
        ({"profiles": ["exakt"]}, "profile is 'exakt': did you mean 'exact'?"),
        ({"engine": "gpu"}, "engine is 'gpu': allowed is one of auto, c, mjx, warp."),
        ({"values": {"contact.fricton": 1.0}}, "did you mean 'contact.friction'?"),
        ({"values": {"contact.friction": 50.0}}, "contact.friction is 50: allowed is [0.05, 5]."),
        ({"values": {"contact.friction": [1.0, 2.0]}}, "allowed is one number for all cases."),
        ({"values": {"frequency": 0.5}}, "frequency cannot be set for turning"),
        ({"out": "file"}, "file is a file: a directory is needed."),
        ({"out": "file/out"}, "cannot write in "),
        (
            {"out": "sweep"},
            "sweep holds a sweep, and not published experiments: choose another directory.",
        ),
    ],
)
def test_wrong_settings_are_refused_before_anything_runs(fakes, tmp_path, options, sentence):
    (tmp_path / "file").write_text("")
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "run.json").write_text('{"kind": "sweep"}')
    options = {"name": "turning", "out": "out"} | options
    with pytest.raises((ParameterError, WrongDirectory), match=re.escape(sentence)):
        ran(tmp_path / options.pop("out"), **options)
    assert not fakes["turning"].asked
    assert not list(tmp_path.glob("out/results/*"))


def test_every_published_experiment_is_in_the_catalogue():
    """And takes parameters that no case decides."""
    for name, experiment in EXPERIMENTS.items():
        assert experiment.name == name
        assert experiment.figures
        assert experiment.description
        assert experiment.metrics
        assert not {"frequency", "duty", "start.x"} & experiment.settable
        assert ("stance.rear_z" in experiment.settable) == experiment.walks
    assert all("contact.friction" in EXPERIMENTS[name].settable for name in NAMES[:4])


# --- videos


def test_a_machine_that_cannot_draw_makes_no_video_and_says_so(fakes, tmp_path, monkeypatch):
    """And a quick run, of one repeat, does not try."""

    def shoot(*_):
        raise VideoError("MuJoCo cannot draw on this machine.")

    monkeypatch.setattr("nermo_mjx.experiments.run.shoot", shoot)
    said = []
    assert run_experiment("turning", tmp_path, quick=True).notes == ()
    assert (fakes["turning"].asked[0].repeats, fakes["turning"].asked[0].quick) == (1, True)
    result = run_experiment("maze", tmp_path, watch=Watch(warn=said.append))
    note = "There is no video of maze. MuJoCo cannot draw on this machine."
    assert said == [note] == list(result.notes)
    assert note in (tmp_path / "report.md").read_text()
    assert result.videos == ()


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_a_video_is_made_once_and_linked(fakes, tmp_path):
    result = run_experiment("maze", tmp_path)
    assert result.videos == (tmp_path / "videos" / "maze.mp4",)
    assert (
        f"[videos/maze.mp4](videos/maze.mp4), {RUN}, in real time."
        in (tmp_path / "report.md").read_text()
    )
    made = result.videos[0].stat().st_mtime_ns
    assert ran(tmp_path, "maze").videos == result.videos
    assert result.videos[0].stat().st_mtime_ns == made


def test_a_long_run_is_shown_faster_up_to_its_end(fakes, tmp_path, monkeypatch):
    """A run of 100 s that has ended after 70 fits into a video of 8 s."""
    shown = {}
    monkeypatch.setattr(
        "nermo_mjx.experiments.run.render",
        lambda recording, model, path, **how: shown.update(how, duration=recording.duration),
    )
    outcome = ran(tmp_path, "maze").outcome
    outcome.columns["speed"][:] = 70.0
    recording = outcome.recordings[RUN]
    object.__setattr__(recording, "time", np.linspace(0.0, 100.0, len(recording.time)))
    assert shoot(outcome, Shot("with spine", speed=8.0, until="speed"), Path("a.mp4")) == 9.0
    assert shown["speed"] == 9.0
    assert shown["duration"] == pytest.approx(71.0, abs=3.0)


# --- identified bodies, which walk as much faster than 70 mm/s as their friction says (see `experiment_fake`): 80 mm/s
# are published, so that 60 to 100 hold, as do the three starts of the default body

FRICTION = np.array([1.0, 1.2, 1.5, 0.7])
HOLD = 5 / 7


def drawn(n, seed=0, **more):
    """Bodies without the ensemble."""
    return {"contact.friction": np.roll(FRICTION, seed)[:n]} | more


@pytest.fixture
def bodies(fakes, monkeypatch):
    """The fakes, with an ensemble of four bodies."""
    monkeypatch.setattr(run, "draw", drawn)
    return fakes


def line_of(result, name="speed at 0.8 Hz"):
    return next(line for line in result.lines if line.figure == name)


def stored(out, name="maze"):
    """The columns of the bodies in a directory; None without any."""
    found = Directory(out).load(name, bodies=True)
    return None if found is None else found.outcome.columns


class Workers:
    """Simulate the last part first; lost after so many."""

    def __init__(self, lost_after=None):
        self.lost_after = lost_after

    def begin(self, computer):
        self.computer = computer

    def results(self, tasks, tell):
        tasks = list(tasks)
        for key, task in reversed(tasks) if self.lost_after is None else tasks[: self.lost_after]:
            yield key, self.computer(task)
        if self.lost_after is not None:
            raise WorkersLost("no node came within 300 s.")


def test_a_line_has_the_interval_of_its_bodies_and_starts_and_says_whether_it_covers(
    bodies, tmp_path
):
    result = ran(tmp_path, bodies=4, seed=4)
    speed = line_of(result)
    assert (speed.low, speed.high) == pytest.approx((49.0, 105.0))
    assert (speed.covered, speed.ensemble) == (True, pytest.approx(HOLD))
    assert line_of(result, "faster | at 0.8 Hz").ensemble == 1.0
    ratio = line_of(result, "ratio of speeds")
    assert (ratio.ensemble, ratio.low, ratio.covered) == (0.0, 1.6, False)
    assert line_of(result, "interval").ensemble is None
    text = (tmp_path / "report.md").read_text()
    assert "| 80 | 84.9 | 71.0 | 81.0 | 61.0 | 49.0 to 105 | yes | yes | 6.2 |" in text
    assert "4 identified bodies, a start each" in text
    assert (
        "**1 of 2 predicted figures hold; 1 of 1 published values lie in the 90 % interval.**"
        in text
    )
    report = report_of(tmp_path)
    assert (report["experiments"]["turning"]["bodies"], report["summary"]["covered"]) == (4, 1)


def test_bodies_walk_once_where_they_are_judged_without_what_is_set_for_all(
    bodies, tmp_path, monkeypatch
):
    """Simulation is judged as published, the hardware as built."""
    chosen = EXPERIMENTS["maze"]
    figures = (
        chosen.figures[0],
        dataclasses.replace(chosen.figures[0], figure="hardware", profile="as_built"),
    )
    monkeypatch.setitem(EXPERIMENTS, "maze", dataclasses.replace(chosen, own_figures=figures))
    monkeypatch.setattr(run, "draw", lambda n, seed: drawn(n, **{"servo.kp": np.full(4, 5.0)}))
    result = ran(tmp_path, "maze", bodies=4, values={"servo.kp": 9.0})
    own, *several = bodies["maze"].asked
    assert own.bodies is None
    for asked, profile in zip(several, ("as_published", "as_built"), strict=True):
        assert (asked.profiles, asked.repeats, asked.values) == ((profile,), 1, {"servo.kp": 9.0})
        assert set(asked.bodies) == {"contact.friction"}
        assert asked.bodies["contact.friction"].tolist() == FRICTION.tolist()
    assert sorted(set(stored(tmp_path)["body"].tolist())) == [1, 2, 3, 4]
    assert "body" not in result.outcome.columns
    assert list(result.outcome.recordings) == [RUN]
    assert (result.lines[0].high, result.lines[1].high) == pytest.approx((105.0, 90.0))


def test_kept_bodies_are_not_walked_again_and_a_report_is_remade_from_them(bodies, tmp_path):
    """They are hours of work: a damaged table of the same settings leaves them, one of other settings does not."""

    def asked_for_bodies():
        return [asked.bodies is not None for asked in bodies["maze"].asked]

    ran(tmp_path, "maze", bodies=4)
    for count in (4, None):
        result = ran(tmp_path, "maze", bodies=count)
        assert line_of(result).ensemble == pytest.approx(HOLD)
    part_of(result).write_text("damaged")
    assert line_of(ran(tmp_path, "maze")).ensemble == pytest.approx(HOLD)
    assert asked_for_bodies() == [False, True, False]
    # Other bodies are walked, and the results of the default body stay.
    assert line_of(ran(tmp_path, "maze", bodies=2)).ensemble == 1.0
    assert asked_for_bodies() == [False, True, False, True]
    part_of(result).write_text("damaged")
    assert line_of(ran(tmp_path, "maze", seed=3)).ensemble is None
    # A fresh run has none.
    ran(tmp_path, "maze", seed=3, bodies=4)
    assert line_of(ran(tmp_path, "maze", again=True)).ensemble is None
    assert stored(tmp_path) is None


def test_parts_are_stored_in_the_order_in_which_they_come(bodies, tmp_path, monkeypatch):
    """Whoever is free simulates: here the last part comes first. Tables and report are those of one process."""
    monkeypatch.setattr(run, "BATCH_BODIES", 3)
    names = ("maze", "turning")
    one = run_experiments(names, tmp_path / "one", bodies=4, video=False)
    other = run_experiments(names, tmp_path / "other", bodies=4, video=False, workers=Workers())
    assert [each.lines for each in one.results] == [each.lines for each in other.results]
    for name in names:
        ours, theirs = (stored(each.out, name) for each in (one, other))
        assert list(ours) == list(theirs)
        assert list(ours)[:2] == ["profile", "body"]
        assert np.unique(ours["body"]).tolist() == [1, 2, 3, 4]
        for column in ours:
            np.testing.assert_array_equal(ours[column], theirs[column])
    # What is run again replaces the bodies, also where they come before what they belong to.
    again = run_experiments(
        names, tmp_path / "other", bodies=4, again=True, video=False, workers=Workers()
    )
    assert {line_of(each).ensemble for each in again.results} == {HOLD}


def test_workers_that_are_lost_leave_the_experiments_that_are_done(bodies, tmp_path):
    former = ran(tmp_path, "maze", bodies=4, seed=4)
    part_of(former).write_text("damaged")
    with pytest.raises(
        JobFailed, match=r"no node came within 300 s\. What is finished is kept in .*same"
    ):
        run_experiments(("maze", "turning"), tmp_path, bodies=4, video=False, workers=Workers(1))
    assert Directory(tmp_path).load("maze") is not None
    assert stored(tmp_path) is None, "those of other settings are none of these results"


def test_the_identified_ensemble_gives_parameters_of_the_body():
    drawn_bodies = run.draw(2, 0)
    assert all(len(column) == 2 for column in drawn_bodies.values())
    for experiment in EXPERIMENTS.values():
        assert set(drawn_bodies) <= experiment.settable, experiment.name
    assert drawn_bodies["servo.kp"].min() > 5.0
