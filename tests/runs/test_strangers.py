"""Files that strangers made: what only reads runs none of their code, and what is wrong with them is one sentence."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import call
from experiment_fake import ABOUT
from search_fake import SPEED as SEARCH
from search_fake import FakeSimulator as FakeSearched
from sweep_fake import SPEC as SWEEP
from sweep_fake import FakeSimulator
from tune_fake import SPEC as TUNE

from nermo_mjx import trust
from nermo_mjx.cli.kinds import KINDS
from nermo_mjx.control import protocol
from nermo_mjx.control.schedule import Switch
from nermo_mjx.experiments import log_report
from nermo_mjx.experiments.cases import CaseRuns
from nermo_mjx.experiments.report import table_of
from nermo_mjx.experiments.run import EXPERIMENTS, Directory
from nermo_mjx.files import FileError, read_bytes
from nermo_mjx.hardware.channels import read_channels
from nermo_mjx.learn.policy import load_policy
from nermo_mjx.learn.spec import Training
from nermo_mjx.live import driving
from nermo_mjx.live.driving import Driving, replayed
from nermo_mjx.optimize import Search, Tuning, run_search
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.scene import resolve_scene
from nermo_mjx.rollout import Setup, own_metrics
from nermo_mjx.runs.directory import codes_of, digest, read_record
from nermo_mjx.runs.files import content_of, parquet_bytes, parquet_table, stored_json
from nermo_mjx.runs.rows import opened_part
from nermo_mjx.runs.status import last_command
from nermo_mjx.specs import reading
from nermo_mjx.specs.reading import SpecError, read_file, read_mapping
from nermo_mjx.sweep import DirectoryError, Sweep, merge_sweeps, read_table, run_sweep
from nermo_mjx.sweep.comparing import two_tables
from nermo_mjx.sweep.structures import read_row_table
from nermo_mjx.sweep.table import RECORD, Results, SweepRecord, meta, sweep_status
from nermo_mjx.view.explore import runs_of
from nermo_mjx.view.recorded import robot_of

CANARY = """
import pathlib
pathlib.Path({log!r}).write_text("run")
import jax.numpy as jnp
from nermo_mjx import Controller, metric

@metric(unit="rad/s", better="low", reduce="rms")
def yaw_shake(sensors):
    "Turning about its own axis."
    return sensors.gyro[2]

stiff = Controller(spine=lambda params, phase, turn_rate, feet, stance: 0.0 * phase)
"""
ROOT = Path(__file__).parents[2]
POLICY = ROOT / "tests" / "data" / "former_policy.npz"
RECORDED = ROOT / "docs" / "howto" / "terrain" / "walks" / "ramp" / "stiff.npz"
#: The file that says what a directory is for, by kind.
SPECS: dict[str, tuple[str, dict[str, Any]]] = {
    "sweep": ("sweep.yaml", SWEEP),
    "search": ("search.yaml", SEARCH),
    "tuning": ("tuning.yaml", TUNE),
    "training": ("training.yaml", {"worlds": 64, "steps": 10_000}),
}


@pytest.fixture
def canary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that is there when the stranger's code was run; it is also in the way of a careless import."""
    log = tmp_path / "run by mistake"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    protocol._imported.cache_clear()
    (tmp_path / "own.py").write_text(CANARY.format(log=str(log)))
    return log


@pytest.mark.parametrize("own", ["metrics", "controller", "module", "deep"])
@pytest.mark.parametrize("kind", KINDS)
def test_no_command_that_reads_runs_the_code_of_a_directory(kind: str, own: str, tmp_path: Path, canary: Path) -> None:
    out, code = tmp_path / "theirs", (tmp_path / "own.py").read_text()
    named = {
        "metrics": {"metrics": "metrics.py"},
        "controller": {"controller": "controller.py:stiff"},
        "module": {"metrics": "own"},
        "deep": {"controller": "own.under:stiff"},
    }[own]
    (out / "results").mkdir(parents=True)
    for name in ("metrics.py", "controller.py", "own.py", "sitecustomize.py"):
        (out / name).write_text(code)
    (out / "run.json").write_text(json.dumps({"kind": kind}))
    if kind in SPECS:
        name, spec = SPECS[kind]
        (out / name).write_text(json.dumps(spec | named))
    for words in (
        ("status", out),
        ("status", out, "--json"),
        ("plot", out, "--format", "png"),
        ("compare", out, out),
        ("compare", out, "--by", "gait"),
        ("sensitivity", out),
        ("view", out, "--no-open", "--out", out / "page.html"),
        ("merge", out, out, "--out", tmp_path / "both"),
    ):
        result = call(*words)
        assert result.exception is None or isinstance(result.exception, SystemExit), (words, result.exception)
        assert not canary.exists(), f"{words[0]} ran it"
        assert result.exit_code == 0 or result.stderr.count("\n") == 1, result.stderr


class Measuring(FakeSimulator):
    """With what the stranger's metric gives."""

    def run(self, values: Any, run: Any, **how: Any) -> Any:
        result = super().run(values, run, **how)
        result.metrics |= {"yaw_shake": result.metrics["speed"] * 2}
        return result


@pytest.fixture(params=["metrics", "controller"])
def directories(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, Path, Path]:
    """What is own, two directories that were moved here, and the file that their code writes when it is run."""
    log, made = tmp_path / "log", tmp_path / "made"
    own = {request.param: {"metrics": "own.py", "controller": "own.py:stiff"}[request.param]}
    made.mkdir()
    (made / "own.py").write_text(CANARY.format(log=str(log)))
    vary = {"frequency": {"linspace": [0.5, 1.0, 80]}, "stride": [0.5, 0.7]}
    for name, gait in (("a", "trot"), ("b", "lateral_walk")):
        spec = own | {"gait": gait, "plots": False, "vary": vary, "compare": {"by": "stride"}}
        (made / f"{name}.yaml").write_text(json.dumps(spec))
        run_sweep(made / f"{name}.yaml", made / name, simulator=Measuring())
    run_sweep(made / "a.yaml", made / "half", chunk=40, shard=(0, 2), simulator=Measuring())
    for name in ("a", "b", "half"):
        shutil.move(made / name, tmp_path / name)
    assert log.read_text().startswith("run")
    log.unlink()
    protocol._imported.cache_clear()
    return request.param, tmp_path / "a", tmp_path / "b", log


@pytest.mark.draws
def test_no_code_of_a_directory_is_run(directories: tuple[str, Path, Path, Path]) -> None:
    """Yet units, sides, meanings, the section `compare`, and how many runs there will be are known."""
    own, a, b, log = directories
    half = a.with_name("half")
    for words in (
        ("status", a),
        ("plot", a, "--format", "png"),
        ("plot", half, "--format", "png"),
        ("compare", a, "--by", "stride"),
    ):
        result = call(*words)
        assert result.exit_code == 0, result.stderr
    assert "sample is grid, whose variants are not drawn" in call("sensitivity", a).stderr
    assert "80 of 160 runs, not complete" in call("status", half).stdout
    assert "gait: trot and lateral_walk" in call("compare", a, b).stdout
    assert (a / "plots" / "differences.png").exists()
    merged = call("merge", a, half, "--out", a.with_name("both"))
    if own == "controller":
        assert merged.exit_code == 1
        assert "field 'controller' is " in merged.stderr
        assert "it is code, which a command that only reads does not run" in merged.stderr
        assert merged.stderr.count("\n") == 1
    else:
        assert merged.exit_code == 0, merged.stderr
        table = read_table(a.with_name("both"))
        assert table.num_rows == 160
        assert meta(table.schema.field("yaw_shake")) == meta(read_table(a).schema.field("yaw_shake"))
    assert not log.exists(), "it was run"
    if own == "metrics":  # the merged directory has the code, which `sweep` then runs: nothing is simulated again
        both, simulator = a.with_name("both"), Measuring()
        assert run_sweep(both / "sweep.yaml", both, simulator=simulator).complete
        assert simulator.batches == []
        assert log.exists()


def test_a_file_that_is_not_that_of_the_table_is_not_run_either(directories: tuple[str, Path, Path, Path]) -> None:
    own, a, b, log = directories
    (a / f"{own}.py").write_text((a / f"{own}.py").read_text() + "\n")
    with pytest.raises(DirectoryError, match=r"it is code, which a command that only reads does not run\."):
        merge_sweeps([a, b], a.with_name("both"))
    assert call("status", a).exit_code == 0
    assert not log.exists()
    with trust.only_reading(), pytest.raises(protocol.ParameterError, match="does not run"):
        own_metrics.load_metrics(str(a / "metrics.py") if own == "metrics" else "json:loads")


RECORD_OF_THREE = {"rows": 3, "fields": {"set": {}}, "labelled": [], "parameters": {}, "comparison": None}
WRONG = ({"rows": "3"}, {"fields": {}}, {"parameters": 1})


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "null", '{"rows": 3}', "[" * 5000, *(json.dumps(RECORD_OF_THREE | each) for each in WRONG)]
)
def test_a_damaged_record_is_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(DirectoryError, match=r"sweep.json is damaged: run nermo-mjx sweep .* again"):
        SweepRecord.of_directory(tmp_path)


# ---
# Mutants of every kind of file under the loader of its kind.


ODD_BYTES = (b"[" * 300, b'{"a":', b"\x00", b"\xff\xfe", b"1e999", b"null", b"\x1b[2J", b"-", b"\n")


def mutated_bytes(content: bytes, draw: random.Random) -> bytes:
    """Some bytes changed, left out, repeated or put in, or the end cut off."""
    changed = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8))):
        at, length = draw.randrange(len(changed) + 1), draw.choice((1, 1, 4, 64))
        act = draw.randrange(5)
        if act == 0:
            changed[at : at + length] = draw.randbytes(len(changed[at : at + length]))
        elif act == 1:
            del changed[at : at + length]
        elif act == 2:
            changed[at:at] = changed[at : at + length] * draw.choice((1, 3))
        elif act == 3:
            changed[at:at] = draw.choice(ODD_BYTES)
        elif draw.random() < 0.2:
            del changed[at:]
    return bytes(changed)


ODD_NUMBERS = (None, True, 0, -1, 10**30, 1e300, -0.5, float("nan"))
ODD = (*ODD_NUMBERS, "", "a", "\x1b[2J", "1", [], [[]], {}, {"a": None}, ["a", 1])


def mutated_values(value: Any, draw: random.Random) -> Any:
    """Plain values of which one is another, missing, or more."""
    if isinstance(value, (dict, list)) and value and draw.random() < 0.8:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        copied, key = value.copy(), draw.choice(keys)
        act = draw.random()
        if act < 0.1:
            del copied[key]
        elif act < 0.2 and isinstance(copied, dict):
            copied[draw.choice(("controller", "metrics", "a", ""))] = draw.choice(ODD)
        else:
            copied[key] = mutated_values(copied[key], draw)
        return copied
    return draw.choice(ODD)


def mutated_json(content: bytes, draw: random.Random) -> bytes:
    return json.dumps(mutated_values(json.loads(content), draw)).encode()


def mutated_lines(content: bytes, draw: random.Random) -> bytes:
    lines = content.splitlines()
    at = draw.randrange(len(lines))
    lines[at] = draw.choice((mutated_bytes, mutated_json, mutated_json))(lines[at], draw)
    return b"\n".join(lines) + b"\n"


def mutated_arrays(content: bytes, draw: random.Random) -> bytes:
    """An NPZ file of which an array, its header, or its JSON is another one."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    name = draw.choice([*arrays])
    given = arrays[name]
    if name in ("header", "about") and draw.random() < 0.9:
        text = mutated_json(given.tobytes() if name == "about" else str(given).encode(), draw)
        arrays[name] = np.frombuffer(text, np.uint8) if name == "about" else np.array(text.decode())
    else:
        odd: list[Callable[[], Any]] = [
            lambda: given[:0],
            lambda: given.ravel(),
            lambda: given[None],
            lambda: given.astype("U4"),
            lambda: given.astype(complex) if given.dtype.kind in "fiu" else given,
            lambda: np.array([]),
            lambda: np.full_like(given, np.nan) if given.dtype.kind == "f" else given,
            lambda: -given[::-1],
            lambda: given[:-1],
            lambda: np.zeros(3, "datetime64[s]"),
            lambda: np.zeros(2, [("a", "f8")]),
        ]
        try:
            arrays[name] = draw.choice(odd)()
        except (TypeError, IndexError, ValueError):
            del arrays[name]
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    if draw.random() < 0.3:  # a header that promises more
        size = draw.choice((b"7000000000000", b"-5", b"1" * 30, b"0"))
        changed, old = io.BytesIO(), zipfile.ZipFile(io.BytesIO(stream.getvalue()))
        with zipfile.ZipFile(changed, "w") as new:
            for member in old.namelist():
                text = old.read(member)
                at = text.find(b"'shape': (")
                promised = text[: at + 10] + size + text[at + 10 + len(size) :] if member == f"{name}.npy" else text
                new.writestr(member, promised)
        return changed.getvalue()
    return stream.getvalue()


def mutated_table(content: bytes, draw: random.Random) -> bytes:
    """A table of which a column, its name, its type or what is said of it is another."""
    table = parquet_table(content)
    assert table is not None
    at = draw.randrange(table.num_columns)
    field, column = table.schema.field(at), table.column(at)
    act = draw.randrange(7)
    if act == 0:
        table = table.remove_column(at)
    elif act == 1:
        table = table.set_column(at, draw.choice(("row", "", "\x1b[2J", "speed", "a" * 9000)), column)
    elif act == 2:
        other = draw.choice(([None], ["text"], [[1.0]], [True], [{"a": 1}], [float("nan")], [10**15]))
        like = pa.field(field.name, pa.array(other).type, metadata=field.metadata)
        table = table.set_column(at, like, pa.array(other * table.num_rows))
    elif act == 3:
        about = {
            key: draw.choice((b"", b"\xff", b"[1]", b"nan", b"\x1b[2J")) for key in field.metadata or {b"role": b""}
        }
        table = table.set_column(at, field.with_metadata(about), column)
    elif act == 4:
        about = dict(table.schema.metadata or {b"a": b""})
        about[draw.choice([*about])] = draw.choice((b"", b"\xff", b"[1]", b"{", b"null", b"9" * 400, b'{"a": {}}'))
        table = table.replace_schema_metadata(about)
    elif act == 5:
        some = [None if draw.random() < 0.5 else value for value in column.to_pylist()]
        table = table.set_column(at, field, pa.array(some, field.type))
    else:
        table = table.slice(0, draw.choice((0, 1)))
    stream = io.BytesIO()
    pq.write_table(table, stream)
    return stream.getvalue()


CHANNELS = {"rate": 50, "front_left_hip": {"channel": 0, "direction": 1, "zero": 90, "low": 20, "high": 160}}
ROWS = "frequency,spine.amplitude\n0.5,0.1\n0.8,0.2\n"


@pytest.fixture(scope="module")
def kinds_of_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, list[Any], Callable[[], Any]]]:
    """By kind: an intact file, how it is changed, and its loader."""
    top = tmp_path_factory.mktemp("kinds")
    (top / "own.py").write_text(CANARY.format(log=str(top / "log")))
    measured = {"metrics": "own.py", "plots": False}
    run_sweep(_file(top / "a.yaml", SWEEP | measured), sweep := top / "sweep", chunk=18, simulator=Measuring())
    run_search(_file(top / "b.yaml", SEARCH), search := top / "search", simulator=FakeSearched())
    (identified := top / "identified").mkdir()
    columns = {
        name: np.array(["exact", "as_built"] if name in ("profile", "gait", "status") else [0.5, 0.8]) for name in ABOUT
    }
    experiments = Directory(top / "experiments")
    (experiments.out / "results").mkdir(parents=True)
    about = {"started": "2026-01-01", "engine": "c", "recordings": {}, "code": "0"}
    name = "free_gait" if "free_gait" in EXPERIMENTS else next(iter(EXPERIMENTS))
    table = table_of(CaseRuns(name, columns, ABOUT, {}), {"about": json.dumps(about)}, "0")
    pq.write_table(table, experiments.path(name))
    pq.write_table(pa.table({"frequency": [0.5, 0.8]}), top / "rows.parquet")
    part = next((sweep / "results").glob("*.parquet"))
    text, table_like = [mutated_bytes, mutated_json, mutated_json], [mutated_bytes, mutated_table, mutated_table]
    arrays = [mutated_bytes, mutated_arrays, mutated_arrays]

    def kind(name: str, folder: Path) -> Callable[[], Any]:
        return lambda: KINDS[name].load(KINDS[name].status)(folder)

    def rows(path: Path) -> Callable[[], Any]:
        return lambda: read_row_table(read_mapping({}), str(path))

    def whole(path: Path) -> Callable[[], Any]:
        return lambda: robot_of(Recording.load(path))

    about = {"setup": Setup().fields(), "driven": {"values": {"frequency": 0.8}}}
    piece = {
        "commands": [[0, {"at": 0.0, "blend": 1.0, "gait": "lateral_walk", "set": {"stride": 0.9}}]],
        "pushes": [{"tick": 1, "ticks": 3, "body": 1, "force": [1, 0, 0]}],
        "samples": [[[0.0], [0.0], [0.0], [None]]],
        "ticks": 3,
    }

    def journal() -> Any:
        about, _ = driving._told(top / "drive.jsonl")
        return driving._setup(about, None)

    found: dict[str, tuple[Path, list[Any], Callable[[], Any]]] = {
        "journal": (
            _text(top / "drive.jsonl", f"{json.dumps(about)}\n{json.dumps(piece)}\n"),
            [mutated_lines],
            journal,
        ),
        "recording": (Path(shutil.copyfile(RECORDED, top / "walk.npz")), arrays, whole(top / "walk.npz")),
        "policy": (Path(shutil.copyfile(POLICY, top / "policy.npz")), arrays, lambda: load_policy(top / "policy.npz")),
        "run.json": (sweep / "run.json", text, lambda: (read_record(sweep), codes_of(sweep), last_command(sweep))),
        "sweep.json": (sweep / "sweep.json", text, lambda: two_tables(sweep, search)),
        "metrics.json": (sweep / "metrics.json", text, lambda: own_metrics.load_metrics(str(sweep / "metrics.py"))),
        "best.json": (search / "best.json", text, kind("search", search)),
        "steps.json": (
            _file(identified / log_report.STEPS, {"decides": "a", "arrays": [[[0.1, None], [0.2, 0.3]]]}),
            text,
            lambda: (
                log_report.identification_status(identified),
                log_report.kept_in(identified, "a")(lambda: np.ones(1)),
            ),
        ),
        "experiment": (experiments.path(name), table_like, kind("experiments", experiments.out)),
        "part": (part, table_like, lambda: (read_table(sweep), Results([part]), sweep_status(sweep), runs_of(sweep))),
        "rows.csv": (_text(top / "rows.csv", ROWS), [mutated_bytes], rows(top / "rows.csv")),
        "rows.parquet": (top / "rows.parquet", table_like, rows(top / "rows.parquet")),
        "sweep.yaml": (_file(top / "s.yaml", SWEEP), text, lambda: Sweep.from_file(top / "s.yaml")),
        "channels.yaml": (_file(top / "c.yaml", CHANNELS), text, lambda: read_channels(top / "c.yaml")),
        "spec as text": (
            _text(top / "t.yaml", Sweep.from_dict(SWEEP).to_yaml()),
            [mutated_bytes],
            lambda: read_file(top / "t.yaml"),
        ),
    }
    return found


def _file(path: Path, data: Any) -> Path:
    return _text(path, json.dumps(data))


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("share", [0, *(pytest.param(share, marks=pytest.mark.release) for share in range(1, 4))])
def test_mutants_of_all_kinds_of_files_end_in_a_sentence(kinds_of_files: Any, share: int) -> None:
    """2,000 in all."""
    assert hunted(kinds_of_files, 500, seed=share) == []


@pytest.mark.long
def test_many_mutants_end_in_a_sentence(kinds_of_files: Any) -> None:
    assert hunted(kinds_of_files, 20_000, seed=40) == []


def peak_memory() -> float:
    """Of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def hunted(kinds_of_files: Any, mutants: int, seed: int) -> list[str]:
    """What is wrong with how mutants were read: kind, number, and an error that is none of the package's, or the
    processor time or memory that it took."""
    draw, wrong, hunted_from = random.Random(seed), list[str](), peak_memory()
    for number in range(mutants):
        name = draw.choice([*kinds_of_files])
        path, changes, load = kinds_of_files[name]
        intact = path.read_bytes()
        path.write_bytes(draw.choice(changes)(intact, draw))
        began = time.process_time()
        try:
            with trust.only_reading():
                load()
        except (FileError, ParameterError) as error:
            if "\n" in str(error) or not str(error).endswith((".", "?")):
                wrong.append(f"{number} {name}: {error}")
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            wrong.append(f"{number} {name}: {error!r} in {place.filename}:{place.lineno}")
        finally:
            path.write_bytes(intact)
        if (took := time.process_time() - began) > 5.0:
            wrong.append(f"{number} {name}: {took:.1f} s")
        peak = peak_memory()
        if peak > hunted_from + 1.0:
            wrong.append(f"{number} {name}: {peak:.1f} GB")
            break
    return wrong


def test_a_name_of_any_length_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    pq.write_table(pa.table({"spine.amplitude" * 20_000: [0.1]}), path)
    began = time.process_time()
    with pytest.raises(FileError, match="is not a parameter") as refused:
        read_row_table(read_mapping({}), str(path))
    assert time.process_time() - began < 5.0
    assert len(str(refused.value)) < 1000


# ---
# What is asked for is weighed before anything is made of it.


def scene(inside: str) -> str:
    floor = '<worldbody><geom name="floor" type="plane" size="1 1 1"/></worldbody>'
    return f"<mujoco model='theirs'>{inside}{floor}</mujoco>"


def nested(count: int, depth: int) -> str:
    return f'<replicate count="{count}">' * depth + '<geom size="1"/>' + "</replicate>" * depth


HUGE = {
    "texture": scene('<asset><texture name="a" type="2d" builtin="flat" width="30000" height="30000"/></asset>'),
    "cube": scene('<asset><texture name="a" type="cube" builtin="flat" width="9000" height="54000"/></asset>'),
    "hfield": scene('<asset><hfield name="a" nrow="20000" ncol="20000" size="1 1 1 1"/></asset>'),
    "user numbers": scene('<size nuser_geom="200000000"/>'),
    "keyframes": scene('<size nkey="2000000000"/>'),
    "numeric": scene('<custom><numeric name="a" size="2000000000"/></custom>'),
    "replicate": scene(f"<worldbody>{nested(100, 3)}</worldbody>"),
    "deep replicate": scene(f"<worldbody>{nested(10, 30)}</worldbody>"),
    "composite": scene('<worldbody><composite type="cable" count="999 1 1"/></worldbody>'),
}


@pytest.mark.parametrize("name", HUGE)
def test_a_scene_that_asks_for_more_than_fits_is_refused(name: str, tmp_path: Path) -> None:
    """As text, and as a file that another one includes."""
    with pytest.raises(ParameterError, match=r"asks for [\d,]+ (bytes|elements): allowed are|only the robot may move"):
        resolve_scene(HUGE[name])
    _text(
        tmp_path / "inner.xml",
        HUGE[name].replace("<mujoco model='theirs'>", "<mujocoinclude>").replace("</mujoco>", "</mujocoinclude>"),
    )
    outer = _text(tmp_path / "outer.xml", '<mujoco><include file="inner.xml"/></mujoco>')
    with pytest.raises(ParameterError, match=r"allowed are|only the robot may move"):
        resolve_scene(str(outer))


def test_a_picture_with_many_pixels_is_refused(tmp_path: Path) -> None:
    size = (50_000).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + size + size + bytes(9))
    given = scene('<asset><texture name="a" type="2d" file="a.png"/></asset>')
    with pytest.raises(ParameterError, match=r"a\.png takes 10,000,000,000 bytes: allowed are 134,217,728"):
        resolve_scene(str(_text(tmp_path / "a.xml", given)))


@pytest.mark.parametrize(
    ("read", "spec", "said"),
    [
        (Sweep.from_dict, {"vary": {"frequency": [0.8]}, "run": {"cycles": 1e300}}, "field 'run.cycles' is 1e+300"),
        (Sweep.from_dict, {"vary": {"frequency": [0.8]}, "run": {"duration": 1e12}}, "field 'run.duration'"),
        (Search.from_dict, SEARCH | {"batch": 100_000}, "field 'batch' is 100,000: 100,000 worlds at once take 5.0 GB"),
        (Search.from_dict, SEARCH | {"batch": 700, "randomize": {"repeats": 100}}, "70,000 worlds at once take 3.5 GB"),
        (Tuning.from_dict, TUNE | {"starts": 100_000}, "500,000 worlds at once take 25.0 GB"),
        (
            Tuning.from_dict,
            TUNE | {"starts": 30_000},
            "each with 5 walks: 150,000 worlds at once take 7",
        ),
        (Training.from_dict, {"worlds": 500_000, "steps": 1_000_000}, "500,000 worlds at once take 25.0 GB"),
        *(
            (read, spec | {"pilot": {"waypoints": {"points": [[0.0, 0.0], [0.0, -0.5], [far, -1.0]]}}}, said)
            for read, spec in (
                (Sweep.from_dict, {"vary": {"frequency": [0.8]}}),
                (Search.from_dict, SEARCH),
                (Tuning.from_dict, TUNE),
                (Training.from_dict, {}),
            )
            for far, said in ((1e308, "field 'pilot.waypoints.points' is refused: Way point 2 is (1e+308, -1): "),)
        ),
    ],
)
def test_a_batch_that_does_not_fit_and_a_run_without_end_are_refused(read: Any, spec: Any, said: str) -> None:
    with pytest.raises(SpecError, match=re.escape(said)):
        read(spec)


def test_the_ticks_of_a_sweep_have_a_limit(tmp_path: Path) -> None:
    spec = {
        "vary": {"frequency": {"linspace": [1e-3, 2e-3, 100]}},
        "run": {"cycles": 100},
        "randomize": {"repeats": 1000},
        "plots": False,
    }
    with pytest.raises(SpecError, match=r"simulates .* s in 100,000 runs: allowed are 1e\+09 s"):
        run_sweep(spec, tmp_path, chunk=1000, simulator=FakeSimulator())
    with pytest.raises(SpecError, match=r"chunk is 100,000: 100,000 worlds at once take 5\.0 GB"):
        run_sweep(spec | {"run": {"duration": 1.0}}, tmp_path, chunk=100_000, simulator=FakeSimulator())


def test_yaml_has_a_limit_of_values_and_of_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(text: str, reason: str) -> None:
        with pytest.raises(SpecError, match=reason):
            read_file(_text(tmp_path / "a.yaml", text))

    refused("# " + "x" * (1 << 23), "it has 8 MB: allowed are 8 MB")
    refused("vary: [" + "1," * 60_000 + "1]", "holds more than 50,000 values")
    monkeypatch.setattr(reading, "_MOST_VALUES", 100)
    refused("a: {" + "".join(f"b{i}: 1, " for i in range(60)) + "}", "holds more than 100 values")


@contextlib.contextmanager
def bounded(seconds: int = 60, more: int = 1 << 30) -> Iterator[None]:
    """Inside of it, waiting ends in an alarm, and memory beyond what is taken now in a MemoryError."""

    def late(*_: Any) -> None:
        raise AssertionError("it waits")

    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before, memory = signal.signal(signal.SIGALRM, late), resource.getrlimit(resource.RLIMIT_AS)
    signal.alarm(seconds)
    resource.setrlimit(resource.RLIMIT_AS, (taken + more, memory[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, memory)
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def special(path: Path, kind: str) -> Path:
    """A pipe that nobody writes into, or a link to a device that never ends, in the place of a file."""
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    return path


SPECIAL = pytest.mark.parametrize("kind", ["pipe", "device"])


@SPECIAL
@pytest.mark.parametrize(
    "load",
    [
        lambda path: read_record(path.parent),
        Recording.load,
        load_policy,
        read_file,
        content_of,
        parquet_table,
        lambda path: read_row_table(read_mapping({}), str(path.with_suffix(".parquet"))),
        stored_json,
        replayed,
        lambda path: protocol.Source.named("metrics has", str(path.with_suffix(".py")), "a file").content(),
        lambda path: opened_part(path).__enter__(),
    ],
)
def test_a_file_that_is_none_is_refused(load: Any, kind: str, tmp_path: Path) -> None:
    for name in ("run.json", "run.parquet", "run.py"):
        special(tmp_path / name, kind)
    said = "not a regular file"
    with bounded():
        try:
            said = load(tmp_path / "run.json") or said  # None as of a damaged file
        except (FileError, ParameterError) as error:
            said = str(error)
    assert "not a regular file" in said or "there is no such file" in said


@SPECIAL
@pytest.mark.parametrize("name", ["run.json", "sweep.yaml", "sweep.json", "metrics.json", "results/part", "plots"])
def test_a_special_file_in_a_directory_ends_in_a_sentence(kinds_of_files: Any, kind: str, name: str, tmp_path: Path):
    """As of a sweep's directory that someone sends; a figure's place is no file of ours, either."""
    out = tmp_path / "theirs"
    shutil.copytree(kinds_of_files["part"][0].parents[1], out)
    part = next((out / "results").glob("*.parquet"))
    (out / "plots").mkdir(exist_ok=True)
    special({"results/part": part, "plots": out / "plots" / "speed.png"}.get(name, out / name), kind)
    for words in (("status", out), ("compare", out, "--by", "frequency"), ("plot", out, "--format", "png")):
        with bounded():
            result = call(*words)
        assert result.exit_code in (0, 1, 2)
        assert result.exit_code == 0 or result.stderr.count("\n") == 1, result.stderr


@SPECIAL
@pytest.mark.parametrize(
    "inside",
    [
        '<include file="{0}"/>',
        '<asset><model name="m" file="{0}"/></asset>',
        '<asset><mesh name="m" file="{0}" content_type="model/stl"/></asset>',
        '<asset><texture name="t" type="2d" file="{0}" content_type="image/png"/></asset>',
        '<asset><hfield name="h" size="1 1 1 1" file="{0}" content_type="image/png"/></asset>',
        '<asset><model name="m" file="{1}/nested.xml"/></asset>',
    ],
)
def test_a_special_file_in_a_scene_is_refused(inside: str, kind: str, tmp_path: Path) -> None:
    """As a file and as text, as in a recording; and one that a model beside it names from its own folder."""
    (tmp_path / "under").mkdir()
    file = special(tmp_path / "under" / "a", kind)
    _text(tmp_path / "a", scene(""))  # of that name there is another one, which is right
    _text(tmp_path / "under" / "nested.xml", scene('<asset><model name="n" file="a"/></asset>'))
    text = scene(inside.format(file, tmp_path / "under"))
    for given in (text, str(_text(tmp_path / "a.xml", text))):
        with bounded(), pytest.raises(ParameterError, match=r"cannot be read \(not a regular file\)"):
            resolve_scene(given)


@pytest.mark.parametrize("size", [0, 1 << 25])
def test_what_has_more_than_it_says_is_refused(size: int, tmp_path: Path) -> None:
    """Files of /proc say that they have nothing; one that is mostly a hole takes no room."""
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.truncate(size)
    with pytest.raises(FileError, match="allowed are"):
        read_bytes(Path("/proc/self/maps") if size == 0 else path, 100)


#: Calls that open a file.
OPENS = re.compile(
    r"(?<![\w.])(?<!def )open\(|\bos\.open\(|\.open\(\"|\.read_(bytes|text)\(|pq\.(read_\w+|ParquetFile)\(|loadtxt\("
    r"|np\.(load|fromfile)\(|ElementTree\.parse\(|(MjSpec\.from_file|from_xml_path)\(|json\.load\(|Image\.open\("
)
#: Lines that do so outside of `nermo_mjx.files`: they write, or read what belongs to the package or to the system.
NOT_READ_FOR_A_PERSON = {
    "cli/choices.py": 1,
    "experiments/cases.py": 1,
    "experiments/published.py": 1,
    "live/driving.py": 1,  # a journal is written
    "robot/parts.py": 2,
    "robot/scene.py": 1,  # MuJoCo, after all files of the scene were read here
    "runs/code.py": 2,
    "runs/directory.py": 1,  # a lock
    "runs/files.py": 2,  # Parquet, of what was opened here
    "runtime.py": 1,
    "view/page.py": 1,
}


def test_nothing_else_opens_what_is_read() -> None:
    package = Path(protocol.__file__).parents[1]
    found = {
        path.relative_to(package).as_posix(): len([1 for line in path.read_text().splitlines() if OPENS.search(line)])
        for path in package.rglob("*.py")
        if "vendor" not in path.parts
    }
    assert {name: count for name, count in found.items() if count} == NOT_READ_FOR_A_PERSON | {"files.py": 5}


def heavy(form: str) -> bytes:
    """Parquet of 0.1 MB or less whose texts unpack to 2 GB."""
    texts = pa.array(["x" * 100_000]).take(pa.array(np.zeros(20_000, np.int8)))
    if form == "large":
        texts = texts.cast(pa.large_string())
    rows = pa.array(np.arange(len(texts)), pa.int64())
    stream = io.BytesIO()
    pq.write_table(
        pa.table({"row": rows, "status": texts}),
        stream,
        compression="zstd",
        use_dictionary=form != "plain",
        data_page_size=1 << 20,
    )
    return stream.getvalue()


@pytest.mark.parametrize("form", ["dictionary", "large", "plain"])
def test_texts_count_by_what_they_unpack_to(form: str, tmp_path: Path) -> None:
    content = heavy(form)
    assert len(content) < 2e6
    (tmp_path / "rows.parquet").write_bytes(content)
    with bounded():
        assert parquet_table(content) is None
        with pytest.raises(SpecError, match="cannot be read as Parquet"):
            read_row_table(read_mapping({}), str(tmp_path / "rows.parquet"))
        with pytest.raises(DirectoryError, match=r"texts unpack to more than|is of type large_string"):
            Results([tmp_path / "rows.parquet"])


@pytest.mark.parametrize("name", ["row", "variant", "status", "code", "frequency", "speed", "fell"])
def test_a_null_in_a_typed_column_is_a_sentence_or_a_gap(kinds_of_files: Any, name: str, tmp_path: Path) -> None:
    """In a part that is sealed: its name has its digest."""
    out = tmp_path / "theirs"
    shutil.copytree(kinds_of_files["part"][0].parents[1], out)
    part = next((out / "results").glob("*.parquet"))
    table = parquet_table(part)
    assert table is not None
    at, field = table.column_names.index(name), table.schema.field(name)
    table = table.set_column(at, field, pa.array([None, *table.column(at).to_pylist()[1:]], field.type))
    content = parquet_bytes(table)
    part.unlink()
    part.with_name(f"{part.stem.rpartition('-')[0]}-{digest(content)}.parquet").write_bytes(content)
    for words in (
        ("status", out),
        ("compare", out, "--by", "frequency"),
        ("sensitivity", out),
        ("plot", out, "--format", "png"),
        ("view", out, "--no-open", "--out", tmp_path / "page.html"),
    ):
        result = call(*words)
        assert result.exit_code == 0 or result.stderr.count("\n") == 1, result.stderr


# ---
# Whose code, and whose characters.


@pytest.mark.parametrize("named", [{"controller": "own.py:stiff"}, {"metrics": "own.py"}, {"scene": "own.xml"}])
def test_a_policy_names_no_code(named: dict[str, str], tmp_path: Path, canary: Path) -> None:
    with np.load(POLICY) as file:
        arrays = {name: file[name] for name in file.files}
    for place in ("base", "top"):
        about = json.loads(arrays["about"].tobytes())
        (about if place == "top" else about["base"]).update(named)
        np.savez(tmp_path / "a.npz", **arrays | {"about": np.frombuffer(json.dumps(about).encode(), np.uint8)})
        with pytest.raises(ParameterError, match="holds no policy of `nermo-mjx train`: "):
            load_policy(tmp_path / "a.npz")
    assert not canary.exists()


@pytest.mark.draws
def test_a_recording_names_no_code(tmp_path: Path, canary: Path) -> None:
    recording = Recording.load(RECORDED)
    setup = dict(recording.metadata["setup"] or {}) | {"controller": "own.py:stiff", "metrics": ["own.py"]}
    theirs = dataclasses.replace(recording.between(1.0, 1.1), metadata={**recording.metadata, "setup": setup})
    path = theirs.save(tmp_path / "walk.npz")
    for words in (
        ("view", path, "--no-open", "--out", tmp_path / "page.html"),
        ("play", path, "--xml", tmp_path / "walk.xml"),
        ("plot", path, "--out", tmp_path / "plots", "--format", "png"),
    ):
        result = call(*words)
        assert result.exit_code == 0, result.stderr
    assert not canary.exists()


@pytest.fixture(scope="module")
def driven() -> Recording:
    """A drive with a command and a push."""
    driving = Driving(Setup(pilot="open_loop"))
    driving.command(Switch(0.0, values={"stride": 0.9}))
    driving.push(1, (0.5, 0.0, 0.0), 0.1)
    for _ in range(5):
        driving.tick()
    return driving.recording()


def told(recording: Recording, driven: Any = None, **setup: Any) -> Recording:
    """The same with another setup, or another course."""
    about = dict(recording.metadata)
    about["setup"] = {**about["setup"], **setup}
    about["driven"] = {**about["driven"], **(driven or {})}
    return dataclasses.replace(recording, metadata=about)


@pytest.mark.compiles
@pytest.mark.parametrize("named", ["own.py:stiff", "{0}/own.py:stiff", "own:stiff", "own.under:stiff"])
@pytest.mark.parametrize("form", ["npz", "jsonl"])
def test_replay_runs_no_code_that_a_drive_names(named: str, form: str, driven: Any, tmp_path: Path, canary: Path):
    """Not even where its setup is refused afterwards; nor do its metrics run, or another file of the same name."""
    theirs = told(driven, controller=named.format(tmp_path), pilot="straight", metrics=["own.py"])
    path = tmp_path / f"drive.{form}"
    if form == "npz":
        theirs.save(path)
    else:
        path.write_text(json.dumps(theirs.metadata) + "\n" + json.dumps({"ticks": 5}) + "\n")
    for words in (("replay", path), ("replay", path, "--sweep", tmp_path / "a.yaml")):
        result = call(*words)
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1), result.stderr
        assert "code that a file names, which is not run: give your own copy of it, --controller" in result.stderr
    if form == "npz":
        call("servos", "--recording", path, "--out", tmp_path / "a.csv")
    assert not canary.exists()


@pytest.mark.compiles
def test_a_drive_by_a_controller_of_ones_own_is_made_again_with_it(tmp_path: Path, canary: Path) -> None:
    driving = Driving(Setup(controller="own.py:stiff"))
    for _ in range(3):
        driving.tick()
    path = driving.recording().save(tmp_path / "drive.npz")
    canary.unlink()
    protocol._imported.cache_clear()
    assert call("replay", path).exit_code == 2
    assert not canary.exists()
    result = call("replay", path, "--controller", "own.py:stiff")
    assert "All 3 samples equal" in result.stdout, result.stderr
    (tmp_path / "own.py").write_text((tmp_path / "own.py").read_text() + "\n")
    assert "another one than that of the drive" in call("replay", path, "--controller", "own.py:stiff").stderr


MALFORMED: dict[str, dict[str, Any]] = {
    "unknown key": {"wings": 2},
    "waypoints 3": {"waypoints": 3},
    "waypoints [1, 2]": {"waypoints": [1, 2]},
    "gait": {"gait": ["trot"]},
    "scene": {"scene": 3},
    "spine": {"spine": 1},
    "tail": {"tail": ["rigid"]},
    "timestep": {"timestep": "fast"},
    "command": {"driven": {"commands": [[float("inf"), {"at": 0.0, "set": {"stride": 0.9}}]]}},
    "a tick below 0": {"driven": {"commands": [[-1, {"at": 0.0, "set": {"stride": 0.9}}]]}},
    "no pair": {"driven": {"commands": [3]}},
    "frequency": {"driven": {"commands": [[0, {"at": 0.0, "set": {"frequency": 1e-20}}]]}},
    "frequency at the start": {"driven": {"values": {"frequency": 1e-300}}},
    "unknown start": {"driven": {"values": {"froquency": 1.0}}},
    "start NaN": {"driven": {"values": {"frequency": float("nan")}}},
    "push without a body": {"driven": {"pushes": [{"tick": 0, "ticks": 3, "force": [1, 0, 0]}]}},
    "push of nobody": {"driven": {"pushes": [{"tick": 0, "ticks": 3, "body": 10**30, "force": [1, 0, 0]}]}},
    "push NaN": {"driven": {"pushes": [{"tick": 0, "ticks": 3, "body": 1, "force": [float("nan"), 0, 0]}]}},
    "push too long": {"driven": {"pushes": [{"tick": 0, "ticks": 10**15, "body": 1, "force": [1, 0, 0]}]}},
    "samples of another": {"driven": {"samples": [[[0.0], [0.0], [0.0], [None]]]}},
}


@pytest.mark.compiles
@pytest.mark.usefixtures("shared_simulators")
@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_drive_ends_in_a_sentence(name: str, driven: Recording, tmp_path: Path) -> None:
    path = told(driven, **MALFORMED[name]).save(tmp_path / "drive.npz")
    result = call("replay", path, "--quiet")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1), result.stderr
    assert result.stderr.startswith(f"nermo-mjx: {path}: ")


def test_whose_code_is_run_is_said_before(tmp_path: Path, canary: Path) -> None:
    said: list[tuple[str, bool]] = []
    token = trust.TELL.set(lambda sentence: said.append((sentence, canary.exists())))
    try:
        own_metrics.load_metrics("own.py")
        own_metrics.load_metrics("own.py")
    finally:
        trust.TELL.reset(token)
    assert said == [(f"the Python code of {tmp_path / 'own.py'} is run.", False)]
    assert canary.exists()


def test_control_characters_of_a_stranger_are_escaped(tmp_path: Path) -> None:
    evil = "\x1b]0;owned\x07\x1b[2J\x9b2J\u202egnp.exe\r\nfigures  rm -rf ~"
    stamp = dict.fromkeys(("package", "sources", "model", "engine", "mujoco", "mujoco_mjx", "jax"), evil)
    session = {"started": evil, "command": f"nermo-mjx {evil}", "machine": {"host": evil}, "versions": {"jax": evil}}
    record = {"kind": "sweep", "codes": {evil: stamp}, "sessions": [session]}
    for kind in KINDS:
        (tmp_path / "run.json").write_text(json.dumps(record | {"kind": kind}))
        for words in (("status",), ("status", "--json"), ("plot",), ("view", "--no-open")):
            result = call(words[0], tmp_path, *words[1:])
            for character in "\x1b\x07\x9b\u202e\r":
                assert character not in result.stdout + result.stderr, words
            assert not any(line.startswith("figures  rm") for line in result.stdout.splitlines())
            if "--json" in words:
                json.loads(result.stdout)
    (tmp_path / "run.json").write_text(json.dumps({"kind": evil}))
    assert "\\u001b[2J" in call("status", tmp_path).stderr


@pytest.mark.parametrize("error", [MemoryError, RecursionError])
def test_what_does_not_fit_ends_in_a_sentence(error: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any) -> None:
        raise error

    monkeypatch.setattr("nermo_mjx.runs.directory.read_record", failing)
    result = call("status", tmp_path)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
