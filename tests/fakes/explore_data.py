"""Directories for tests of their page: a sweep in closed form, an atlas, and recordings that took no controller."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fakes.sweep_fake import SPEC, FakeSimulator
from nermo_mjx import Recording, load_robot
from nermo_mjx.sweep import run_sweep
from nermo_mjx.view import model_hash

#: Faster than this falls [m/s]: 0.1 times the frequency is the speed of a stiff spine.
FALLS_ABOVE = 0.125
#: Of a structure; the last one would end a page's script.
NAMES = ["trot", "lateral_walk", "</script>"]
MEASURES = (
    {"metric": "speed", "low": 0.0, "high": 0.1, "cells": 5},
    {"metric": "shake", "low": 0.0, "high": 2.0, "cells": 4},
)


def sweep(out: Path, recorded: tuple[int, ...] = ()) -> Path:
    """A sweep of 36 rows over frequency, spine.amplitude and spine.phase, some of which fell."""
    run_sweep(SPEC, out, chunk=16, simulator=FakeSimulator(falls_above=FALLS_ABOVE))
    for row in recorded:
        falling().save(out / "recordings" / f"row-{row:06d}.npz")
    return out


def falling(seconds: float = 0.5) -> Recording:
    """The robot dropped from a finger's breadth, its servos at rest."""
    model = load_robot().model
    data = mujoco.MjData(model)
    data.qpos[2] += 0.02
    rows = []
    for _ in range(round(seconds / 0.01)):
        mujoco.mj_step(model, data, round(0.01 / model.opt.timestep))
        rows.append((data.time, data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
    time, qpos, qvel, ctrl = (np.array(column) for column in zip(*rows, strict=True))
    return Recording(
        time, qpos, qvel, ctrl, model_hash=model_hash(model), metadata={"case": "dropped"}
    )


def posed(recording: Recording, sample: int) -> mujoco.MjData:
    """MuJoCo's data of the robot in a sample of a recording."""
    data = mujoco.MjData(load_robot().model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (
        column[sample] for column in (recording.qpos, recording.qvel, recording.ctrl)
    )
    mujoco.mj_forward(data.model, data)
    return data


def table(columns: dict[str, tuple[object, dict[str, str]]], **metadata: str) -> pa.Table:
    """A table of columns with metadata; name -> (values, metadata)."""
    arrays = {name: pa.array(values) for name, (values, _) in columns.items()}
    fields = [
        pa.field(name, arrays[name].type, metadata=field_metadata)
        for name, (_, field_metadata) in columns.items()
    ]
    return pa.table(arrays, schema=pa.schema(fields, metadata=metadata))


def atlas(out: Path) -> tuple[Path, dict[str, np.ndarray]]:
    """An atlas of three parameters' best in 5 x 4 cells, of which 11 are filled, and its columns."""
    random = np.random.default_rng(0)
    cells = np.sort(random.permutation(20)[:11])
    speed, shake = (cells // 4 + random.random(11)) * 0.02, (cells % 4 + random.random(11)) * 0.5
    values = {
        "row": np.sort(random.permutation(500)[:11]),
        "cell": cells,
        "frequency": random.uniform(0.4, 1.2, 11),
        "speed": speed,
        "shake": shake,
        "price": random.uniform(3, 9, 11),
    }
    metadata_of_columns = {
        "row": {"role": "index", "unit": "1"},
        "cell": {"role": "index", "unit": "1"},
        "frequency": {
            "role": "varied",
            "unit": "Hz",
            "description": "gait cycles a second",
            "scale": "linear",
        },
        "speed": {"role": "metric", "unit": "m/s"},
        "price": {"role": "metric", "unit": "J"},
        "shake": {
            "role": "metric",
            "unit": "rad/s",
            "better": "low",
            "description": "a custom metric",
        },
    }
    objective = {"metric": "price", "direction": "minimize"}
    columns = {name: (values[name], metadata_of_columns[name]) for name in values}
    out.mkdir(parents=True)
    atlas_table = table(columns, atlas=json.dumps({"objective": objective, "measures": MEASURES}))
    pq.write_table(atlas_table, out / "atlas.parquet")
    (out / "run.json").write_text(json.dumps({"kind": "search"}))
    (out / "search.yaml").write_text(
        "robot: nermo_lite\ngait: lateral_walk\nrun: {cycles: 8, warmup_cycles: 2}\nset: {}\n"
    )
    return out, values


def many(out: Path, rows: int) -> Path:
    """A sampled sweep of so many rows, with a structure of three names and thirty metrics."""
    random = np.random.default_rng(1)
    numbers = {
        f"metric_{i}": (random.normal(size=rows), {"role": "metric", "unit": "N"})
        for i in range(30)
    }
    columns = {
        "row": (np.arange(rows), {"role": "index", "unit": "1"}),
        "seed": (random.integers(0, 2**60, rows), {"role": "index", "unit": "1"}),
        "gait": (random.choice(NAMES, rows), {"role": "varied", "unit": "1", "scale": "structure"}),
        "frequency": (
            random.uniform(0.4, 1.2, rows),
            {"role": "varied", "unit": "Hz", "scale": "linear"},
        ),
        "spine.phase": (
            random.uniform(-np.pi, np.pi, rows),
            {"role": "varied", "unit": "rad", "scale": "linear"},
        ),
        "speed": (random.normal(0.1, 0.02, rows), {"role": "metric", "unit": "m/s"}),
        "radius": (np.exp(random.normal(0, 3, rows)), {"role": "metric", "unit": "m"}),
        **numbers,
        "status": (
            np.where(random.random(rows) < 0.05, "fell", "ok"),
            {"role": "status", "unit": "1"},
        ),
    }
    (out / "results").mkdir(parents=True)
    pq.write_table(
        table(columns, sampler="sobol"), out / "results" / "part-0-0123456789abcdef.parquet"
    )
    (out / "run.json").write_text(json.dumps({"kind": "sweep"}))
    return out
