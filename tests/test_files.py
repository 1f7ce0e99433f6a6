# Tests of files.py
"""Files of other people: a damaged or special file ends in one message, and costs little time and memory."""

from __future__ import annotations

import io
import json
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
from fakes.experiment_fake import ABOUT
from fakes.search_fake import SPEED as SEARCH
from fakes.search_fake import FakeSimulator as FakeSearched
from fakes.strangers import CANARY, SPECIAL, Measuring, bounded, special, write_json, write_text
from fakes.sweep_fake import SPEC as SWEEP

from nermo_mjx import trust
from nermo_mjx.cli.kinds import KINDS
from nermo_mjx.control import protocol
from nermo_mjx.experiments.cases import CaseRuns
from nermo_mjx.experiments.report import table_of
from nermo_mjx.experiments.run import EXPERIMENTS
from nermo_mjx.experiments.store import RECORD, Directory
from nermo_mjx.files import FileError, read_bytes
from nermo_mjx.hardware.channels import read_channels
from nermo_mjx.identify.report import RESULT, identification_page
from nermo_mjx.identify.run import identification_status
from nermo_mjx.learn.policy import load_policy
from nermo_mjx.live import driving
from nermo_mjx.live.driving import replay_drive
from nermo_mjx.optimize import run_search
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import Setup, custom_metrics
from nermo_mjx.runs.directory import codes_of, digest, read_record
from nermo_mjx.runs.files import content_of, parquet_bytes, parquet_table, stored_json
from nermo_mjx.runs.rows import opened_part
from nermo_mjx.runs.status import last_command
from nermo_mjx.specs.reading import read_file, read_mapping
from nermo_mjx.sweep import Sweep, read_table, run_sweep
from nermo_mjx.sweep.comparing import two_tables
from nermo_mjx.sweep.structures import read_row_table
from nermo_mjx.sweep.table import Results, sweep_status
from nermo_mjx.view.explore import runs_of
from nermo_mjx.view.recorded import robot_of

ROOT = Path(__file__).parents[1]
POLICY = ROOT / "tests" / "data" / "former_policy.npz"
#: A parameter in identification.json.
ESTIMATE = {
    "unit": "1",
    "why": "a test",
    "at_bound": "",
    "determined": True,
    "interval": [0.1, 0.3],
}
ESTIMATE |= {"start": 0.1, "value": 0.2, "low": 0.0, "high": 1.0}
RECORDED = ROOT / "docs" / "howto" / "terrain" / "walks" / "ramp" / "stiff.npz"


ODD_BYTES = (b"[" * 300, b'{"a":', b"\x00", b"\xff\xfe", b"1e999", b"null", b"\x1b[2J", b"-", b"\n")


def mutated_bytes(content: bytes, draw: random.Random) -> bytes:
    """Some bytes changed, left out, repeated or put in, or the end cut off."""
    changed = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8))):
        position, length = draw.randrange(len(changed) + 1), draw.choice((1, 1, 4, 64))
        act = draw.randrange(5)
        if act == 0:
            changed[position : position + length] = draw.randbytes(
                len(changed[position : position + length])
            )
        elif act == 1:
            del changed[position : position + length]
        elif act == 2:
            changed[position:position] = changed[position : position + length] * draw.choice((1, 3))
        elif act == 3:
            changed[position:position] = draw.choice(ODD_BYTES)
        elif draw.random() < 0.2:
            del changed[position:]
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
    line_index = draw.randrange(len(lines))
    lines[line_index] = draw.choice((mutated_bytes, mutated_json, mutated_json))(
        lines[line_index], draw
    )
    return b"\n".join(lines) + b"\n"


def mutated_arrays(content: bytes, draw: random.Random) -> bytes:
    """An NPZ file of which an array, its header, or its JSON is another one."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    name = draw.choice([*arrays])
    array = arrays[name]
    if name in ("header", "about") and draw.random() < 0.9:
        text = mutated_json(array.tobytes() if name == "about" else str(array).encode(), draw)
        arrays[name] = np.frombuffer(text, np.uint8) if name == "about" else np.array(text.decode())
    else:
        odd: list[Callable[[], Any]] = [
            lambda: array[:0],
            lambda: array.ravel(),
            lambda: array[None],
            lambda: array.astype("U4"),
            lambda: array.astype(complex) if array.dtype.kind in "fiu" else array,
            lambda: np.array([]),
            lambda: np.full_like(array, np.nan) if array.dtype.kind == "f" else array,
            lambda: -array[::-1],
            lambda: array[:-1],
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
                position = text.find(b"'shape': (")
                promised = (
                    text[: position + 10] + size + text[position + 10 + len(size) :]
                    if member == f"{name}.npy"
                    else text
                )
                new.writestr(member, promised)
        return changed.getvalue()
    return stream.getvalue()


def mutated_table(content: bytes, draw: random.Random) -> bytes:
    """A table of which a column, its name, its type or what is said of it is another."""
    table = parquet_table(content)
    assert table is not None
    index = draw.randrange(table.num_columns)
    field, column = table.schema.field(index), table.column(index)
    act = draw.randrange(7)
    if act == 0:
        table = table.remove_column(index)
    elif act == 1:
        table = table.set_column(
            index, draw.choice(("row", "", "\x1b[2J", "speed", "a" * 9000)), column
        )
    elif act == 2:
        values = draw.choice(
            ([None], ["text"], [[1.0]], [True], [{"a": 1}], [float("nan")], [10**15])
        )
        like = pa.field(field.name, pa.array(values).type, metadata=field.metadata)
        table = table.set_column(index, like, pa.array(values * table.num_rows))
    elif act == 3:
        metadata = {
            key: draw.choice((b"", b"\xff", b"[1]", b"nan", b"\x1b[2J"))
            for key in field.metadata or {b"role": b""}
        }
        table = table.set_column(index, field.with_metadata(metadata), column)
    elif act == 4:
        metadata = dict(table.schema.metadata or {b"a": b""})
        metadata[draw.choice([*metadata])] = draw.choice(
            (b"", b"\xff", b"[1]", b"{", b"null", b"9" * 400, b'{"a": {}}')
        )
        table = table.replace_schema_metadata(metadata)
    elif act == 5:
        incomplete = [None if draw.random() < 0.5 else value for value in column.to_pylist()]
        table = table.set_column(index, field, pa.array(incomplete, field.type))
    else:
        table = table.slice(0, draw.choice((0, 1)))
    stream = io.BytesIO()
    pq.write_table(table, stream)
    return stream.getvalue()


#: Options of `plot` for one figure of a sweep instead of all.
ONE_FIGURE = ("--x", "frequency", "--y", "spine.phase", "--color", "speed")
CHANNELS = {
    "rate": 50,
    "front_left_hip": {"channel": 0, "direction": 1, "zero": 90, "low": 20, "high": 160},
}
ROWS = "frequency,spine.amplitude\n0.5,0.1\n0.8,0.2\n"


@pytest.fixture(scope="module")
def kinds_of_files(
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, tuple[Path, list[Any], Callable[[], Any]]]:
    """By kind: an intact file, how it is changed, and its loader."""
    top = tmp_path_factory.mktemp("kinds")
    (top / "own.py").write_text(CANARY.format(log=str(top / "log")))
    measured = {"metrics": "own.py", "plots": False}
    run_sweep(
        write_json(top / "a.yaml", SWEEP | measured),
        sweep := top / "sweep",
        chunk=18,
        simulator=Measuring(),
    )
    run_search(
        write_json(top / "b.yaml", SEARCH), search := top / "search", simulator=FakeSearched()
    )
    (identified := top / "identified").mkdir()
    columns = {
        name: np.array(
            ["exact", "as_built"] if name in ("profile", "gait", "status") else [0.5, 0.8]
        )
        for name in ABOUT
    }
    experiments = Directory(top / "experiments")
    name = "free_gait" if "free_gait" in EXPERIMENTS else next(iter(EXPERIMENTS))
    rows = experiments.folder(name)
    (rows / "results").mkdir(parents=True)
    write_json(
        rows / RECORD, {"started": "2026-01-01", "settings": {}, "rows": 2, "recordings": {}}
    )
    about = {"engine": "c", "steps": 0, "wall_seconds": 1.0}
    table = table_of(CaseRuns(name, columns, ABOUT, {}), 0, 0, 0, "0", about)
    walked = rows / "results" / f"part-0-{0:016x}.parquet"
    pq.write_table(table, walked)
    pq.write_table(pa.table({"frequency": [0.5, 0.8]}), top / "rows.parquet")
    part = next((sweep / "results").glob("*.parquet"))
    text, table_like = (
        [mutated_bytes, mutated_json, mutated_json],
        [mutated_bytes, mutated_table, mutated_table],
    )
    arrays = [mutated_bytes, mutated_arrays, mutated_arrays]

    def kind(name: str, folder: Path) -> Callable[[], Any]:
        return lambda: KINDS[name].load(KINDS[name].status)(folder)

    def rows(path: Path) -> Callable[[], Any]:
        return lambda: read_row_table(read_mapping({}), str(path))

    def whole(path: Path) -> Callable[[], Any]:
        return lambda: robot_of(Recording.load(path))

    metadata = {"setup": Setup().fields(), "driven": {"values": {"frequency": 0.8}}}
    piece = {
        "commands": [
            [0, {"at": 0.0, "blend": 1.0, "gait": "lateral_walk", "set": {"stride": 0.9}}]
        ],
        "pushes": [{"tick": 1, "ticks": 3, "body": 1, "force": [1, 0, 0]}],
        "samples": [[[0.0], [0.0], [0.0], [None]]],
        "ticks": 3,
    }

    def journal() -> Any:
        metadata, _ = driving._read_drive(top / "drive.jsonl")
        return driving._make_setup(metadata, None)

    kinds: dict[str, tuple[Path, list[Any], Callable[[], Any]]] = {
        "journal": (
            write_text(top / "drive.jsonl", f"{json.dumps(metadata)}\n{json.dumps(piece)}\n"),
            [mutated_lines],
            journal,
        ),
        "recording": (
            Path(shutil.copyfile(RECORDED, top / "walk.npz")),
            arrays,
            whole(top / "walk.npz"),
        ),
        "policy": (
            Path(shutil.copyfile(POLICY, top / "policy.npz")),
            arrays,
            lambda: load_policy(top / "policy.npz"),
        ),
        "run.json": (
            sweep / "run.json",
            text,
            lambda: (read_record(sweep), codes_of(sweep), last_command(sweep)),
        ),
        "sweep.json": (sweep / "sweep.json", text, lambda: two_tables(sweep, search)),
        "metrics.json": (
            sweep / "metrics.json",
            text,
            lambda: custom_metrics.load_metrics(str(sweep / "metrics.py")),
        ),
        "best.json": (search / "best.json", text, kind("search", search)),
        "identification.json": (
            write_json(
                identified / RESULT,
                {
                    "command": "",
                    "logs": ["a"],
                    "sentences": ["It moves."],
                    "parameters": {"kp": ESTIMATE},
                },
            ),
            text,
            lambda: (identification_status(identified), identification_page(identified)),
        ),
        "experiment": (walked, table_like, kind("experiments", experiments.out)),
        "part": (
            part,
            table_like,
            lambda: (read_table(sweep), Results([part]), sweep_status(sweep), runs_of(sweep)),
        ),
        "rows.csv": (write_text(top / "rows.csv", ROWS), [mutated_bytes], rows(top / "rows.csv")),
        "rows.parquet": (top / "rows.parquet", table_like, rows(top / "rows.parquet")),
        "sweep.yaml": (
            write_json(top / "s.yaml", SWEEP),
            text,
            lambda: Sweep.from_file(top / "s.yaml"),
        ),
        "channels.yaml": (
            write_json(top / "c.yaml", CHANNELS),
            text,
            lambda: read_channels(top / "c.yaml"),
        ),
        "spec as text": (
            write_text(top / "t.yaml", Sweep.from_dict(SWEEP).to_yaml()),
            [mutated_bytes],
            lambda: read_file(top / "t.yaml"),
        ),
    }
    return kinds


@pytest.mark.release
@pytest.mark.parametrize("share", [0, 1])
def test_mutants_of_all_kinds_of_files_end_in_a_sentence(kinds_of_files: Any, share: int) -> None:
    """1,000 in all."""
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
            frame = traceback.extract_tb(error.__traceback__)[-1]
            wrong.append(f"{number} {name}: {error!r} in {frame.filename}:{frame.lineno}")
        finally:
            path.write_bytes(intact)
        if (took := time.process_time() - began) > 5.0:
            wrong.append(f"{number} {name}: {took:.1f} s")
        peak = peak_memory()
        if peak > hunted_from + 1.0:
            wrong.append(f"{number} {name}: {peak:.1f} GB")
            break
    return wrong


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
        replay_drive,
        lambda path: protocol.Source.named(
            "metrics has", str(path.with_suffix(".py")), "a file"
        ).content(),
        lambda path: opened_part(path).__enter__(),
    ],
)
def test_a_file_that_is_none_is_refused(load: Any, kind: str, tmp_path: Path) -> None:
    for name in ("run.json", "run.parquet", "run.py"):
        special(tmp_path / name, kind)
    message = "not a regular file"
    with bounded():
        try:
            message = load(tmp_path / "run.json") or message  # None as of a damaged file
        except (FileError, ParameterError) as error:
            message = str(error)
    assert "not a regular file" in message or "there is no such file" in message


@pytest.mark.release
@SPECIAL
@pytest.mark.parametrize(
    "name", ["run.json", "sweep.yaml", "sweep.json", "metrics.json", "results/part", "plots"]
)
def test_a_special_file_in_a_directory_ends_in_a_sentence(
    kinds_of_files: Any, kind: str, name: str, tmp_path: Path
):
    """As of a sweep's directory that someone sends; a figure's place is no file of ours, either."""
    out = tmp_path / "theirs"
    shutil.copytree(kinds_of_files["part"][0].parents[1], out)
    part = next((out / "results").glob("*.parquet"))
    (out / "plots").mkdir(exist_ok=True)
    special(
        {"results/part": part, "plots": out / "plots" / "speed.png"}.get(name, out / name), kind
    )
    for words in (
        ("status", out),
        ("compare", out, "--by", "frequency"),
        ("plot", out, "--format", "png", *(() if name == "plots" else ONE_FIGURE)),
    ):
        with bounded():
            result = call(*words)
        assert result.exit_code in (0, 1, 2)
        assert result.exit_code == 0 or result.stderr.count("\n") == 1, result.stderr


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
    "live/driving.py": 1,  # a journal is written
    "robot/parts.py": 2,
    "robot/scene.py": 1,  # MuJoCo, after all files of the scene were read here
    "runs/code.py": 1,
    "runs/files.py": 2,  # Parquet, of what was opened here
    "runtime.py": 1,
    "view/page.py": 1,
}


def test_nothing_else_opens_what_is_read() -> None:
    package = Path(protocol.__file__).parents[1]
    counts_of_files = {
        path.relative_to(package).as_posix(): len(
            [1 for line in path.read_text().splitlines() if OPENS.search(line)]
        )
        for path in package.rglob("*.py")
        if "vendor" not in path.parts
    }
    assert {
        name: count for name, count in counts_of_files.items() if count
    } == NOT_READ_FOR_A_PERSON | {"files.py": 5}


@pytest.mark.release(cases=("variant", "fell", "speed", "frequency", "code"))
@pytest.mark.parametrize("name", ["row", "variant", "status", "code", "frequency", "speed", "fell"])
def test_a_null_in_a_typed_column_is_a_sentence_or_a_gap(
    kinds_of_files: Any, name: str, tmp_path: Path
) -> None:
    """In a part that is sealed: its name has its digest."""
    out = tmp_path / "theirs"
    shutil.copytree(kinds_of_files["part"][0].parents[1], out)
    part = next((out / "results").glob("*.parquet"))
    table = parquet_table(part)
    assert table is not None
    index, field = table.column_names.index(name), table.schema.field(name)
    table = table.set_column(
        index, field, pa.array([None, *table.column(index).to_pylist()[1:]], field.type)
    )
    content = parquet_bytes(table)
    part.unlink()
    part.with_name(f"{part.stem.rpartition('-')[0]}-{digest(content)}.parquet").write_bytes(content)
    for words in (
        ("status", out),
        ("compare", out, "--by", "frequency"),
        ("sensitivity", out),
        ("plot", out, "--format", "png", *(() if name == "speed" else ONE_FIGURE)),
        ("view", out, "--no-open", "--out", tmp_path / "page.html"),
    ):
        result = call(*words)
        assert result.exit_code == 0 or result.stderr.count("\n") == 1, result.stderr
