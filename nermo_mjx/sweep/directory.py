"""A sweep's directory: what it is for, and how two sweeps differ.

DIR/sweep.yaml                    the resolved sweep
DIR/sweep.json                    what is to be known of it without running code that it names
DIR/controller.py, DIR/metrics.py copies of the files of another controller, and of metrics, if the sweep names them
DIR/run.json                      which codes made the rows; each session's versions, machine and command
DIR/results/, series/, former/    the rows, their time series, and those of the sweep before it was extended, see
                                  `nermo_mjx.runs.rows`; with them, in former/, what was made of these
DIR/results.aside/                parts that were damaged when they were made again
DIR/recordings/row-000123.npz     rows that are kept (`replay.py`)
DIR/summary.json, DIR/plots/      made from the table when it is complete
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from nermo_mjx.files import MAX_JSON_BYTES, read_bytes
from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import DirectoryError, clear_errors, content_of, create_file, to_json
from nermo_mjx.runs.rows import FORMER, retire
from nermo_mjx.specs.controllers import code_identity, with_code_copied
from nermo_mjx.specs.reading import SpecError, differing
from nermo_mjx.specs.walk import unread
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.structures import STRUCTURES
from nermo_mjx.sweep.table import RECORDINGS, SWEEP_RECORD_FILE, SweepRecord
from nermo_mjx.trust import shortened

# ---
# Whether the sweep of a directory can be extended to another one, and how two sweeps differ.


#: Fields that determine the rows; all others are fixed.
_ROWS: Final = ("vary", "rows", "sample", "randomize.repeats")
#: Number of fields that a message names when two sweeps differ.
_NAMED: Final = 3


def fixed_differences(former: Sweep, current: Sweep) -> str:
    """How two sweeps differ apart from their rows, as `seed is 0 there and 5 here`; empty if they do not.

    What one of them fixes may be varied by the other.
    """
    free = {*former.labelled, *current.labelled}
    free |= {f"set.{name}" for name in (*former.varied, *current.varied)}
    free |= {f"randomize.{name}" for name in START_SPREAD}  # come with repeats
    if "physics" in free:
        free.add("timestep")
    apart = _apart(former, current)
    for name in list(apart):
        varied = name.split(".")[0] in free & set(STRUCTURES)
        if varied or name in free or any(f"{name}.".startswith(f"{field}.") for field in _ROWS):
            del apart[name]
    return _sentence(apart)


def sweep_differences(former: Sweep, current: Sweep) -> str:
    """How two sweeps differ: the first fields, each with both values: `seed is 0 there and 5 here`."""
    # The same values, but another row 0.
    return _sentence(_apart(former, current)) or (
        "the parameters under vary or randomize stand in another order"
    )


def refusal(former: Sweep, current: Sweep) -> str:
    """Why a directory's sweep cannot be extended to another one, in words; empty if it can."""
    if fixed := fixed_differences(former, current):
        return f"{fixed}: what is not varied stays as it is"
    if former.sampler == current.sampler == "latin_hypercube" and former.samples != current.samples:
        return (
            f"a Latin hypercube of {former.samples} points is not part of one of {current.samples}: use a Sobol sample, "
            "which can be extended, or repeats"
        )
    return ""


def _apart(former: Sweep, current: Sweep) -> dict[str, tuple[Any, Any]]:
    """The fields in which they differ; what stands in an empty section has a name of its own."""
    differences = differing(former.decisive(), current.decisive())
    return {name: values for name, values in differences.items() if {} not in values}


def _sentence(apart: Mapping[str, tuple[Any, Any]]) -> str:
    some = [
        f"{name} is {_text(a)} there and {_text(b)} here"
        for name, (a, b) in list(apart.items())[:_NAMED]
    ]
    return "; ".join(some) + (
        f"; and {len(apart) - _NAMED} more fields" if len(apart) > _NAMED else ""
    )


def _text(value: Any) -> str:
    return shortened(f"{value:g}" if isinstance(value, float) else str(value))


# ---
# What a directory is for: its sweep, which is written first, and extended where that is asked for.


#: What is made of the results, and belongs to them.
_DERIVED_TABLES: Final = (
    "comparison.parquet",
    "sensitivity.parquet",
    "optimum.parquet",
    "optimum.csv",
    "optimum.tex",
)
_MADE: Final = ("summary.json", *_DERIVED_TABLES, "plots", RECORDINGS)


def claim(directory: RunDirectory, sweep: Sweep, *, extend: bool = False) -> Sweep:
    """Make a directory this sweep's, or refuse.

    Args:
        directory: the directory.
        sweep: what it is to be for.
        extend: whether a sweep there that differs only in its rows may become this one.

    Returns:
        The sweep, with the directory's copies of code and its size of batches.

    Raises:
        DirectoryError: the directory holds another sweep, or cannot be written.
    """
    out, path, folder = directory.out, directory.out / "sweep.yaml", directory.out.resolve()
    with clear_errors(out):
        if not path.exists():
            if any(out.glob("results/*.parquet")):
                raise DirectoryError(
                    f"{out} holds results of an unknown sweep (it has no sweep.yaml); choose another directory."
                )
            sweep = _with_files(directory, sweep)
            create_file(path, sweep.to_yaml(folder).encode())
        # Even if it was just written: another shard may have been faster, and have chosen another size.
        try:
            is_same = read_bytes(path, MAX_JSON_BYTES) == sweep.to_yaml(folder).encode()
            former_sweep = sweep if is_same else Sweep.from_directory(out)
        except SpecError as error:
            raise DirectoryError(
                f"{out} holds a sweep that cannot be read ({error}); choose another directory."
            ) from None
        sweep = dataclasses.replace(sweep, chunk=former_sweep.chunk or sweep.chunk)
        if former_sweep.digest() != sweep.digest():
            sweep = _extended(directory, former_sweep, sweep, extend=extend)
        elif directory.shard is None and (former_sweep.compare, former_sweep.optimum) != (
            sweep.compare,
            sweep.optimum,
        ):
            repeated = dataclasses.replace(
                former_sweep, compare=sweep.compare, optimum=sweep.optimum
            )  # no row depends on them
            directory.write(path.name, repeated.to_yaml(folder).encode())
        record = _record_of(sweep)
        if directory.shard is not None:
            create_file(out / SWEEP_RECORD_FILE, record)
        elif content_of(out / SWEEP_RECORD_FILE) != record:
            directory.write(SWEEP_RECORD_FILE, record)
    return sweep


def _extended(directory: RunDirectory, former_sweep: Sweep, sweep: Sweep, *, extend: bool) -> Sweep:
    """Turn the sweep of a directory into another one, or refuse; what was made of the former rows moves aside."""
    out, path = directory.out, directory.out / "sweep.yaml"
    why = refusal(former_sweep, sweep)
    if extend and why:
        raise DirectoryError(
            f"{out} holds a sweep that cannot be extended to this one: {why}; choose another directory."
        )
    if not extend:
        also = "" if why else ", or add these rows to it with --extend"
        raise DirectoryError(
            f"{out} holds the results of another sweep: {sweep_differences(former_sweep, sweep)}; choose another "
            f"directory, or resume with {path}{also}."
        )
    # Killed at any moment, the results are in one of two folders, and both sweeps find them there.
    (out / FORMER).mkdir(exist_ok=True)
    directory.write(
        f"{FORMER}/sweep-{former_sweep.digest()}.yaml", read_bytes(path, MAX_JSON_BYTES)
    )
    retire(directory, sweep.digest())
    for name in _MADE:
        directory.move_aside(name, FORMER)
    sweep = _with_files(directory, sweep)
    directory.write(path.name, sweep.to_yaml(out.resolve()).encode())
    return sweep


def _record_of(sweep: Sweep) -> bytes:
    """The content of sweep.json."""
    values = dict[str, set[float]]()
    for walk in sweep.structures:
        fixed_values = walk.setup.defaults() | walk.constants
        for name in sweep.parameters:
            values.setdefault(name, set()).update(
                [fixed_values[name]] if unread(walk.setup, name) is None else []
            )
    comparison: Any = None if sweep.compare is None else sweep.compare.written()
    record = SweepRecord(
        rows=sweep.variants * sweep.repeats,
        fields=sweep.walk_fields() | code_identity(sweep.setup),
        labelled=sweep.labelled,
        parameters={
            name: distinct_values.pop() if len(distinct_values) == 1 else None
            for name, distinct_values in values.items()
        },
        comparison=comparison,
        optimum=None if sweep.optimum is None else sweep.optimum.written(),
        variants=sweep.variants,
        repeats=sweep.repeats,
    )
    return to_json(dataclasses.asdict(record))


def _with_files(directory: RunDirectory, sweep: Sweep) -> Sweep:
    """The sweep with the files that it names copied into the directory."""
    if sweep.rows is not None:
        directory.write(*sweep.kept_rows())
    return dataclasses.replace(
        sweep, setup=with_code_copied(sweep.setup, directory.out.resolve(), directory.write)
    )


def sweep_in(source: Path) -> Sweep:
    """The sweep of a directory that rows are taken from.

    Raises:
        DirectoryError: it is none of a sweep, or its sweep cannot be read.
    """
    if not (source / "sweep.yaml").exists():
        problem = "not the directory of a sweep" if source.is_dir() else "no such directory"
        raise DirectoryError(f"{source}: {problem}; allowed is one with a file sweep.yaml.")
    try:
        return Sweep.from_directory(source)
    except SpecError as error:
        raise DirectoryError(f"{source} holds a sweep that cannot be read ({error}).") from None


def check_source_sweeps(sources: Sequence[Path], sweep: Sweep) -> None:
    """Refuse directories whose sweeps differ from another one in more than their rows.

    Raises:
        DirectoryError: one does, or it is none of a sweep.
    """
    for source in sources:
        if apart := fixed_differences(sweep_in(source), sweep):
            raise DirectoryError(f"rows of {source} cannot be used: {apart}.")
