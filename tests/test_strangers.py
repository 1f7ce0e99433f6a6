"""Files that strangers made: what only reads runs none of their code, and what is wrong with them is one sentence."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import random
import re
import resource
import shutil
import time
import traceback
import zipfile
from collections.abc import Callable
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
from nermo_mjx.cli.directories import KINDS
from nermo_mjx.control import protocol
from nermo_mjx.experiments import identification
from nermo_mjx.experiments.cases import Outcome
from nermo_mjx.experiments.report import table_of
from nermo_mjx.experiments.run import EXPERIMENTS, Directory
from nermo_mjx.files import FileError
from nermo_mjx.hardware.channels import read_channels
from nermo_mjx.learn.policy import load_policy
from nermo_mjx.learn.spec import Training
from nermo_mjx.optimize import Search, Tuning, run_search
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.scene import resolve_scene
from nermo_mjx.rollout import own_metrics
from nermo_mjx.runs.directory import codes_of, read_record
from nermo_mjx.runs.files import parquet_table
from nermo_mjx.runs.status import last_command
from nermo_mjx.specs import reading
from nermo_mjx.specs.reading import SpecError, read_file, read_mapping
from nermo_mjx.sweep import DirectoryError, Sweep, merge_sweeps, read_table, run_sweep
from nermo_mjx.sweep.comparing import two_tables
from nermo_mjx.sweep.structures import read_row_table
from nermo_mjx.sweep.table import RECORD, Results, SweepRecord, meta, status
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
ROOT = Path(__file__).parents[1]
POLICY = ROOT / "docs" / "howto" / "terrain" / "stiff.npz"
RECORDED = ROOT / "docs" / "howto" / "terrain" / "walks" / "ramp" / "stiff.npz"
#: The file that says what a directory is for, by kind.
SPECS: dict[str, tuple[str, dict[str, Any]]] = {
    "sweep": ("sweep.yaml", SWEEP),
    "search": ("search.yaml", SEARCH),
    "tuning": ("tuning.yaml", TUNE),
    "landscape": ("tuning.yaml", TUNE),
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
    for name, gait in (("a", "trt"), ("b", "lat")):
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
    assert "gait: trt and lat" in call("compare", a, b).stdout
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
    act = draw.randrange(6)
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
    else:
        table = table.slice(0, draw.choice((0, 1)))
    stream = io.BytesIO()
    pq.write_table(table, stream)
    return stream.getvalue()


IDENTIFIED = {
    "settings": {"generations": 1, "population": 4, "seed": 0},
    "costs": [0.9, None, 0.5],
    "plots": [],
    "objective": {"start": 0.9, "end": 0.5},
    "engine": "c",
    "started": "2026-01-01",
    "versions": {"jax": "0"},
    "machine": {"cores": 2},
    "targets": {"a": {"residual": 0.1, "start_residual": None}},
    "ensemble": {
        "size": 2,
        "tolerance": 0.5,
        "bodies": {"servo.gain": [1.0, 2.0], "objective": [0.1, 0.2], "weight": [0.5, 0.5]},
        "parameters": {"servo.gain": {"low": 0.1, "high": 9.0, "quantiles": [1.0]}},
    },
}
CHANNELS = {"rate": 50, "front_left_hip": {"channel": 0, "direction": 1, "zero": 90, "low": 20, "high": 160}}
HARDWARE = {"device": "cpu", "cores": 2, "cpu": "some", "mujoco": "3", "jax": "0", "python": "3"}
CASE = {"case": "throughput", "engine": "c", "worlds": 64, "steps_per_second": 3.0}
MEASURED = {"date": "2026-01-01", "commit": "abc", "hardware": HARDWARE, "cases": [CASE]}
ROWS = "frequency,spine.amplitude\n0.5,0.1\n0.8,0.2\n"


@pytest.fixture(scope="module")
def kinds_of_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, list[Any], Callable[[], Any]]]:
    """By kind: an intact file, how it is changed, and its loader."""
    top = tmp_path_factory.mktemp("kinds")
    (top / "own.py").write_text(CANARY.format(log=str(top / "log")))
    measured = {"metrics": "own.py", "plots": False}
    run_sweep(_file(top / "a.yaml", SWEEP | measured), sweep := top / "sweep", chunk=18, simulator=Measuring())
    run_search(_file(top / "b.yaml", SEARCH), search := top / "search", simulator=FakeSearched())
    landscape, identified, bench = top / "landscape", top / "identified", top / "bench"
    for folder in (landscape / "batches", identified, bench):
        folder.mkdir(parents=True)
    np.savez(landscape / "batches" / "a-5-000000.npz", value=np.zeros(5))
    columns = {
        name: np.array(["exact", "as_built"] if name in ("profile", "gait", "status") else [0.5, 0.8]) for name in ABOUT
    }
    experiments = Directory(top / "experiments")
    (experiments.out / "results").mkdir(parents=True)
    about = {"started": "2026-01-01", "engine": "c", "recordings": {}, "code": "0"}
    name = "free_gait" if "free_gait" in EXPERIMENTS else next(iter(EXPERIMENTS))
    table = table_of(Outcome(name, columns, ABOUT, {}), {"about": json.dumps(about)}, "0")
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

    found: dict[str, tuple[Path, list[Any], Callable[[], Any]]] = {
        "recording": (Path(shutil.copyfile(RECORDED, top / "walk.npz")), arrays, whole(top / "walk.npz")),
        "policy": (Path(shutil.copyfile(POLICY, top / "policy.npz")), arrays, lambda: load_policy(top / "policy.npz")),
        "batch of a landscape": (landscape / "batches" / "a-5-000000.npz", arrays, kind("landscape", landscape)),
        "run.json": (sweep / "run.json", text, lambda: (read_record(sweep), codes_of(sweep), last_command(sweep))),
        "sweep.json": (sweep / "sweep.json", text, lambda: two_tables(sweep, search)),
        "metrics.json": (sweep / "metrics.json", text, lambda: own_metrics.load_metrics(str(sweep / "metrics.py"))),
        "best.json": (search / "best.json", text, kind("search", search)),
        "identification.json": (
            _file(identified / identification.RESULT, IDENTIFIED),
            text,
            lambda: (identification.status(identified), identification.drawn(identified)),
        ),
        "results.jsonl": (_file(bench / "results.jsonl", MEASURED), text, kind("benchmarks", bench)),
        "experiment": (experiments.path(name), table_like, kind("experiments", experiments.out)),
        "part": (part, table_like, lambda: (read_table(sweep), Results([part]), status(sweep), runs_of(sweep))),
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


@pytest.mark.parametrize("share", [0, *(pytest.param(share, marks=pytest.mark.slow) for share in range(1, 4))])
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


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    """A pipe that nobody writes into, and a device that never ends."""
    os.mkfifo(tmp_path / "run.json")
    with pytest.raises(FileError, match="not a regular file"):
        read_record(tmp_path)
    for load in (Recording.load, load_policy, read_file):
        with pytest.raises((FileError, ParameterError), match="not a regular file"):
            load("/dev/zero")


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
