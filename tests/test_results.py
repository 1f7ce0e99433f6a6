# Tests of docs/results.py
"""The list of what the docs show has everything, pages have its numbers, and what is stale is told."""

from __future__ import annotations

import importlib.util
import re
import sys
import warnings
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.runs.files import replace_file

ROOT = Path(__file__).parents[1]
_spec = importlib.util.spec_from_file_location("docs_results", ROOT / "docs" / "results.py")
results = sys.modules["docs_results"] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(results)

LISTED = results.results()
#: Files of the docs that runs make, by where they stand.
MADE = (
    "docs/images/**/*.*",
    "docs/answers/*.csv",
    "docs/answers/*.json",
    "docs/benchmarks/*.jsonl",
    "notebooks/*.ipynb",
)


def test_each_result_of_the_docs_is_listed_once():
    files = {path.relative_to(ROOT).as_posix() for pattern in MADE for path in ROOT.glob(pattern)}
    outputs = [
        path.relative_to(ROOT).as_posix()
        for entry in LISTED.values()
        for pattern in entry.outputs
        for path in ROOT.glob(pattern)
    ]
    assert files - set(outputs) == {"docs/answers/stamps.json"}
    assert len(outputs) == len(set(outputs))
    stamped = results.stamps()
    assert stamped.keys() <= LISTED.keys()
    for name, result in LISTED.items():
        assert all((ROOT / "docs" / page).exists() for page in result.pages), name
        assert name in stamped or result.made, f"{name}: neither a stamp, nor when it was made"


@pytest.mark.release
def test_what_is_stale_is_told():
    """Not an error: who changes the body makes its results later. A warning stands at the end of a run of the tests."""
    changed = {name: results.stale(name, result) for name, result in LISTED.items()}
    stale = [f"{name} ({', '.join(files)})" for name, files in changed.items() if files]
    unknown = [name for name, files in changed.items() if files is None]
    for name, files in changed.items():
        assert ("stale" in results.told(name, LISTED[name])) == bool(files), name
    if stale or unknown:
        warnings.warn(
            f"results of the docs that are stale: {stale}; without a stamp: {unknown}", stacklevel=1
        )


def test_pages_have_the_numbers_that_were_made():
    values = results.numbers()
    used_names = set()
    for page in results.pages():
        text = page.read_text(encoding="utf-8")
        assert results.filled(text, values) == text, f"{page}: run docs/results.py"
        used_names |= {match[2] for match in results.MARKED.finditer(text)}
        # At the beginning of a line a comment makes it HTML, and its Markdown text.
        assert not re.search(r"^<!-- [\w./]+ -->.", text, re.MULTILINE), page
    assert len(used_names & values.keys()) > 20
    assert used_names <= values.keys()
    page, numbers = (
        "a <!-- one -->0<!-- / --> b\n<!-- two --><!-- /two -->",
        {"one": "2", "two": "| a |\n|---|"},
    )
    assert (
        results.filled(page, numbers)
        == "a <!-- one -->2<!-- / --> b\n<!-- two -->\n| a |\n|---|\n<!-- /two -->"
    )


def test_the_tables_of_the_map_follow_from_its_file():
    """The tables and the ranges on the README's first screen follow from the means that are listed next to them."""
    spec = importlib.util.spec_from_file_location(
        "spine_map", ROOT / "docs" / "answers" / "spine_map.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    table = pd.read_csv(module.TABLE)
    numbers = results.numbers()
    for profile in module.PROFILES:
        assert numbers[f"spine.table.{profile}"] == module.page_table(table, profile)
    for name, text in module.spans(table).items():
        assert numbers[name] == text


@pytest.mark.release
def test_a_plain_loop_gives_a_cell_of_the_map():
    """Trot at 0.8 Hz: MuJoCo's own step with the recorded commands gives speed and both costs, and the map's gain."""
    table = pd.read_csv(ROOT / "docs" / "answers" / "spine_map.csv")
    cell = table[
        (table["profile"] == "exact")
        & (table["gait"] == "trot")
        & (table["frequency"] == 0.8)
        & (table["stride"] == 1.0)
    ].iloc[0]
    point = {name: float(cell[name]) for name in ("spine.amplitude", "spine.phase")}
    speeds = {}
    for spine, values in (("none", {}), ("stride_extension", point)):
        setup = Setup(spine=spine, pilot="straight", steering="leg")
        result = Simulator(setup, engine="c").run(
            {"frequency": 0.8, **values}, Run(cycles=6, warmup_cycles=2), record=True
        )
        model = result.setup.load().physical
        data = mujoco.MjData(model)
        qpos, ctrl = (np.asarray(getattr(result.trace, name))[0] for name in ("qpos", "ctrl"))
        qvel = np.asarray(result.trace.qvel)[0]
        data.qpos[:], data.qvel[:] = qpos[0], qvel[0]
        begin, end, mechanical, electrical, places = 2 / 0.8, 6 / 0.8, 0.0, 0.0, []
        torque_limit, stall, idle, voltage = 0.157, 0.8, 0.008, 6.0
        time = float(result.trace.time[0])
        for command in ctrl[1:]:
            data.ctrl[:] = command
            for _ in range(round(0.01 / model.opt.timestep)):
                mujoco.mj_step(model, data)
                time += model.opt.timestep
                if begin + 1e-9 < time <= end + 1e-9:
                    places.append(data.site("imu").xpos.copy())
                    power = data.actuator_force * data.actuator_velocity
                    mechanical += np.maximum(power, 0.0).sum() * model.opt.timestep
                    heat = voltage * (stall - idle) / torque_limit**2 * data.actuator_force**2
                    electrical += (
                        voltage * idle + np.maximum(heat + power, 0.0)
                    ).sum() * model.opt.timestep
        way = np.linalg.norm(places[-1][:2] - places[0][:2])
        weight = 9.81 * model.body_mass.sum()
        own = {
            "speed": way / (end - begin),
            "cost_of_transport": mechanical / (weight * way),
            "electrical_cost_of_transport": electrical / (weight * way),
        }
        assert {name: float(result.metrics[name][0]) for name in own} == pytest.approx(
            own, rel=5e-3
        )
        speeds[spine] = own["speed"]
    assert speeds["stride_extension"] / speeds["none"] - 1.0 == pytest.approx(
        cell["gain"], abs=0.01
    )


def test_the_counts_of_published_values_leave_none_out():
    """By rule, the counts contain as many predicted values as published.yaml lists."""
    yaml = YAML(typ="safe").load(
        (ROOT / "nermo_mjx" / "experiments" / "published.yaml").read_text(encoding="utf-8")
    )
    listed = Counter(
        value["rule"]
        for group in yaml["figures"].values()
        for value in group
        if value["kind"] == "predicted"
    )
    rules = {
        "outcomes": ["outcome"],
        "numbers": ["number"],
        "effects": ["effect", "gain"],
        "ranges": ["range", "at_most"],
    }
    counts = {name: results.numbers()[f"published.{name}"].split(" of ") for name in rules}
    assert {name: int(total) for name, (_, total) in counts.items()} == {
        name: sum(listed[rule] for rule in names) for name, names in rules.items()
    }
    hold, total = results.numbers()["published.hold"].split(" of the ")
    assert sum(int(held_out_value) for held_out_value, _ in counts.values()) == int(hold)
    assert sum(int(listed_values) for _, listed_values in counts.values()) == int(total)


@pytest.mark.release
def test_a_digest_follows_what_changes_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    source = tmp_path / "nermo_mjx" / "control" / "a.py"
    source.parent.mkdir(parents=True)

    def after(text: str) -> str:
        replace_file(source, text.encode())
        results.digest_of_sources.cache_clear()
        return results.digest_of_sources("control/*.py")

    with monkeypatch.context() as patch:
        patch.setattr(results, "ROOT", tmp_path)
        first = after('def f(x):\n    """Twice."""\n    return 2 * x\n')
        assert after('# why\ndef f(x):\n    """Two times."""\n\n    return 2 * x\n') == first
        assert after('def f(x):\n    """Twice."""\n    return 3 * x\n') != first
    results.digest_of_sources.cache_clear()
    assert all(
        results.digests(result) for result in LISTED.values()
    )  # files of pictures are no text
    name = next(
        name
        for name, result in LISTED.items()
        if name in results.stamps() and result.robot == "nermo_lite"
    )
    former_digests = results.digests(LISTED[name])
    defaults = Setup.defaults
    monkeypatch.setattr(Setup, "defaults", lambda setup: defaults(setup) | {"damping.knee": 0.0253})
    results.body.cache_clear()
    now = results.digests(LISTED[name])
    results.body.cache_clear()
    assert {part for part in now if now[part] != former_digests[part]} == {"body"}
    monkeypatch.undo()
    stamp = {
        "date": "2026-01-01",
        "version": "0",
        "digests": former_digests | {"metrics": "of another day"},
    }
    monkeypatch.setattr(results, "stamps", lambda: {name: stamp})
    assert results.stale(name, LISTED[name]) == ["metrics"]
    assert results.told(name, LISTED[name]).endswith("stale, since these changed: metrics")
