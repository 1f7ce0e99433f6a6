# Tests of docs/howto/terrain/search_gait.py
"""The search for gaits on rough ground of docs/spine_on_terrain.md, and the gaits that it found."""

from __future__ import annotations

import dataclasses
import importlib.util
import operator
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.learn.spec import Training

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "howto" / "terrain"


@pytest.fixture(scope="module")
def howto():
    spec = importlib.util.spec_from_file_location("search_gait", FOLDER / "search_gait.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


@pytest.mark.release
def test_the_search_of_the_how_to_finds_a_gait_within_its_bounds_and_the_legs_reach(howto, capsys):
    """A generation of four gaits on one plank height; it says how often they pass."""
    ground = howto.Ground("stiff", (howto.Place("planks", (0.004,)),))
    gait = howto.search("stiff", ground, seed=0, generations=1, population=4)
    begin = howto.gaits().loc["stiff", "begin"].dropna()
    assert set(gait) == set(begin.index)
    assert gait["frequency"] == howto.FREQUENCY
    assert all(low <= gait[name] <= high for name, (low, high) in howto.GAIT.items())
    assert {name for name in gait if gait[name] != begin[name]} == {"frequency", *howto.GAIT}
    assert "planks" in capsys.readouterr().out
    assert ground.inside(gait)
    assert not ground.inside(gait | {"stance.rear_z": -0.072, "stride": 1.2})


@pytest.mark.release
def test_the_search_counts_a_way_beside_the_path(howto):
    """Ten times as far in a corridor of a tenth of the width."""
    test_place = howto.Place("planks", (0.004,))
    ground = howto.Ground("stiff", (test_place,))
    gait = howto.gaits().loc["stiff", "begin"].dropna().to_dict()
    run = Run(duration=1.0, warmup=0.5)
    wide, narrow = (
        ground.walk(variant, [gait], np.random.default_rng(0), run).aside.item()
        for variant in (
            test_place,
            dataclasses.replace(test_place, corridor=0.1 * test_place.corridor),
        )
    )
    assert wide > 0.0
    assert narrow == pytest.approx(10.0 * wide)


@pytest.mark.release
def test_the_gaits_of_the_page_differ_in_the_spine_alone(howto):
    """One frequency, the same bodies around the default one as in the training file, the same walks of each seed."""
    gaits = howto.gaits()
    gaits = gaits[gaits.index.get_level_values("seed").str.isdigit()]
    assert len(gaits) == 15
    assert set(gaits.frequency) == {howto.FREQUENCY}
    assert not gaits.loc[["stiff", "passive"], list(howto.BENDING)].notna().any(axis=None)
    training = Training.from_file(ROOT / "sweeps" / "train_terrains.yaml")
    for scene in training.scenes:
        assert {name: tuple(scene.task.randomize[name]) for name in howto.BODIES} == howto.BODIES
    default = Simulator(Setup(physics="fast"), engine="c").parameters({}).model
    for name, (low, high) in howto.BODIES.items():
        assert low < operator.attrgetter(name)(default) < high
    walks = pd.read_csv(FOLDER / "seeds.csv", dtype={"seed": str})
    walks = walks[walks.seed.str.isdigit()]
    assert {*walks.groupby(["spine", "seed"]).groups} == {*gaits.index}
    assert all(
        sorted(walks_of_seed.scene) == sorted(test_place.scene for test_place in howto.PLACES)
        for _, walks_of_seed in walks.groupby(["spine", "seed"])
    )


@pytest.mark.long
@pytest.mark.release
def test_a_gait_of_the_page_climbs_the_spiral_stair(howto):
    """On steps of 10 mm, on drawn bodies that the table does not have: the free spine passes 96 to 100 % there."""
    spiral = next(test_place for test_place in howto.PLACES if test_place.scene == "spiral_stairs")
    ground = howto.Ground("free", (spiral,))
    walks = howto.measured(ground, howto.gaits().loc["free", "0"].dropna().to_dict(), seed=100)
    assert walks.successes.item() >= 43  # of 48
