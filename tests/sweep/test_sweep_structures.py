# Tests of sweep/structures.py
"""Sweeps over named choices: gait, spine, pilot, scene... Each combination is a setup, and all are in one table."""

from __future__ import annotations

import itertools
import json
import pickle
from typing import ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import call, json_of
from fakes.sweep_fake import FakeSimulator, part_of

from nermo_mjx.plotting.shown import spoken
from nermo_mjx.runs import codes_of
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep import Results, SpecError, Sweep, read_table, run_sweep, sample, simulating
from nermo_mjx.sweep.comparing import compare
from nermo_mjx.sweep.plots import sweep_figures
from nermo_mjx.sweep.replay import find_row
from nermo_mjx.sweep.table import columns_of, meta

GAITS, SPINES = ["trot", "walking_trot", "lateral_walk"], ["none", "stride_extension"]
ARC = {"arc": {"radius": 0.5, "direction": "left"}}
SCENE = """<mujoco model="step"><worldbody><geom name="floor" type="plane" size="5 5 1"/>
<geom type="box" size="0.1 0.1 0.005" pos="0 -1 0"/></worldbody></mujoco>"""
SPEC = {
    "plots": False,
    "vary": {
        "gait": GAITS,
        "spine": SPINES,
        "frequency": [0.5, 0.8],
        "spine.amplitude": [0.1, 0.2],
    },
    "randomize": {"repeats": 2, "contact.friction": {"uniform": [1.0, 1.6]}},
}


def columns(table, *names):
    return list(zip(*(table.column(name).to_pylist() for name in names), strict=True))


class Asked(FakeSimulator):
    """Simulators of all structures; `made` has the setup and the values of each batch."""

    made: ClassVar[list] = []

    def __init__(self, setup, engine):
        super().__init__(engine=engine)
        self.setup = setup

    def with_setup(self, setup):
        return Asked(setup, self.engine)

    def run(self, values, run, **options):
        Asked.made.append((self.setup, run, values))
        return super().run(values, run, **options)


@pytest.fixture
def asked(monkeypatch):
    monkeypatch.setattr(Asked, "made", [])
    monkeypatch.setattr(simulating, "Simulator", Asked)
    return Asked.made


def test_each_combination_is_a_row_and_what_a_structure_lacks_is_not_varied_in_it(tmp_path):
    """Three gaits, two spines, two frequencies; the amplitude only with the spine: 3 x 2 x (1 + 2) variants, twice."""
    table = run_sweep(SPEC, tmp_path, simulator=FakeSimulator()).table
    expected = []
    for gait, spine in itertools.product(GAITS, SPINES):
        amplitudes = [None] if spine == "none" else [0.1, 0.2]
        expected += [
            (gait, spine, f, a)
            for f, a in itertools.product([0.5, 0.8], amplitudes)
            for _ in range(2)
        ]
    assert columns(table, "gait", "spine", "frequency", "spine.amplitude") == expected
    assert columns_of(table, "varied") == ["gait", "spine", "frequency", "spine.amplitude"]
    assert meta(table.schema.field("gait"))["scale"] == "structure"
    assert str(table.schema.field("spine.amplitude").type) == "double"


def test_runs_of_two_structures_have_the_same_draws(tmp_path):
    """So that they can be compared one by one: same friction, same start; other values have others."""
    spec = {"vary": {"gait": GAITS, "frequency": [0.5, 0.8]}, "randomize": SPEC["randomize"]}
    rows = sample(Sweep.from_dict(spec))
    for name in ("contact.friction", "start.x"):
        values_by_structure = rows.values[name].reshape(3, 4)
        np.testing.assert_array_equal(values_by_structure[0], values_by_structure[1])
        np.testing.assert_array_equal(values_by_structure[0], values_by_structure[2])
    assert len(np.unique(rows.values["contact.friction"])) == 4


def test_a_sample_has_the_same_points_in_each_structure():
    """They pair, also where a structure reads only some of the parameters."""
    vary = {
        "spine": SPINES,
        "frequency": {"uniform": [0.5, 1.0]},
        "spine.amplitude": {"uniform": [0.1, 0.3]},
    }
    rows = sample(
        Sweep.from_dict({"vary": vary, "sample": {"sobol": 16}, "randomize": SPEC["randomize"]})
    )
    without, extended = rows.take(rows.structure == 0), rows.take(rows.structure == 1)
    assert len(without) == len(extended) == 32
    np.testing.assert_array_equal(without.values["frequency"], extended.values["frequency"])
    np.testing.assert_array_equal(without.seed, extended.seed)
    assert np.isnan(without.values["spine.amplitude"]).all()
    assert len(np.unique(extended.values["spine.amplitude"])) == 16


def test_a_structure_that_reads_nothing_of_a_sample_is_one_variant():
    vary = {"spine": SPINES, "spine.amplitude": {"uniform": [0.1, 0.3]}}
    assert Sweep.from_dict({"vary": vary, "sample": {"sobol": 16}}).counts == (1, 16)


def test_chunks_have_one_structure_and_each_gets_its_own_setup_run_and_values(tmp_path, asked):
    """Pilots with options of their own: radius where there is one, and a run that ends at its distance."""
    pilots = ["straight", ARC, {"straight": {"distance": 0.5}}]
    spec = {
        "plots": False,
        "vary": {"pilot": pilots, "tail": ["rigid", "articulated"], "frequency": [0.5, 0.6, 0.7]},
    }
    table = run_sweep(spec, tmp_path, chunk=2, engine="c").table
    for path in tmp_path.glob("results/*"):
        assert len(set(columns(pq.read_table(path), "pilot", "tail"))) == 1
    labels = {"straight", "{arc: {direction: 1.0, radius: 0.5}}", "{straight: {distance: 0.5}}"}
    assert set(table.column("pilot").to_pylist()) == labels
    assert len(asked) == 12
    for setup, _, values in asked:
        assert ("pilot.radius" in values) == (setup.pilot == "arc")
        assert values.get("pilot.radius", [0.5])[0] == 0.5
    assert {(setup.pilot, run.distance) for setup, run, _ in asked} == {
        ("straight", None),
        ("arc", None),
        ("straight", 0.5),
    }
    assert {setup.tail for setup, _, _ in asked} == {"rigid", "articulated"}


def test_the_simulator_of_all_structures_travels_and_reuses_programs(asked):
    """To a worker it goes cold, after it was warm here; gaits share one, and each batch has its structure's setup."""
    sweep = Sweep.from_dict({"vary": {"gait": ["trot", "lateral_walk"], "spine": SPINES}})
    here = simulating.SweepSimulator(sweep.structures, "c", notify=print)
    here.warm()
    copied = pickle.loads(pickle.dumps(here))
    assert copied._kept == {}
    for structure in (0, 1, 2, 3, 0):
        copied((structure, {"frequency": np.full(2, 0.7)}))
    assert [(setup.gait, setup.spine) for setup, _, _ in asked] == [
        *itertools.product(["trot", "lateral_walk"], SPINES),
        ("trot", "none"),
    ]
    assert len(copied._kept) == 2
    assert {here.stamp(k).id for k in range(4)} == {copied.stamp().id}


def test_each_model_has_its_own_code_and_they_are_no_other_code(tmp_path, asked):
    """Rows of two tails: two names in the column `code` that differ in the model alone; going on is not refused."""
    spec = {"plots": False, "vary": {"tail": ["rigid", "articulated"], "frequency": [0.5, 0.6]}}
    table = run_sweep(spec, tmp_path, chunk=1, engine="c").table
    assert len(set(columns(table, "tail", "code"))) == 2
    rigid, articulated = codes_of(tmp_path).values()
    assert rigid.unlike(articulated) == f"model {rigid.model}, not {articulated.model}"
    part_of(tmp_path, 3).unlink()
    assert run_sweep(spec, tmp_path, engine="c").table.equals(table)


def test_a_time_step_is_that_of_each_physics_unless_it_is_given():
    vary = {"physics": ["reference", "fast"]}
    steps = [structure.setup.timestep for structure in Sweep.from_dict({"vary": vary}).structures]
    assert steps == pytest.approx([0.002, 0.01 / 3])
    explicit = Sweep.from_text(Sweep.from_dict({"vary": vary, "timestep": 0.0025}).to_yaml())
    assert [structure.setup.timestep for structure in explicit.structures] == [0.0025, 0.0025]


def test_a_scene_of_ones_own_is_told_by_its_name_and_content(tmp_path):
    """In the table; a file beside the sweep's is found, and the directory needs neither."""
    (tmp_path / "step.xml").write_text(SCENE)
    (tmp_path / "sweep.yaml").write_text(
        "vary: {scene: [flat, step.xml]}\nset: {frequency: 0.8}\nplots: false\n"
    )
    run_sweep(tmp_path / "sweep.yaml", tmp_path / "out", simulator=FakeSimulator())
    (tmp_path / "step.xml").unlink()
    flat, custom = read_table(tmp_path / "out").column("scene").to_pylist()
    assert flat == "flat"
    assert custom.startswith("step ")
    assert find_row(tmp_path / "out", 1).walk.labels == {"scene": custom}


#: What stands under `vary`, and what is said of it.
WRONG = {
    "unknown value": ("gait: [trot, trott]", "sweep.yaml:3: field 'gait' is 'trott'"),
    "misspelt structure": ("gate: [trot, lateral_walk]", "'gate' is not a parameter; "),
    "nearest structure": ("gate: [trot, lateral_walk]", "did you mean 'gait'?"),
    "a number": ("gait: [trot, 3]", "sweep.yaml:3: field 'gait' is the number 3: expected a name"),
    "no list": ("gait: trot", "'gait' is the text 'trot': expected the list [a, b, ...]"),
    "empty": ("gait: []", "is an empty list"),
    "empty values": ("gait: {values: []}", "is an empty list"),
    "a form": ("gait: {linspace: [1, 2, 3]}", "is a mapping of linspace: expected the list"),
    "twice": ("gait: [trot, lateral_walk, trot]", "lists trot twice"),
    "the same pilot": (
        "pilot: [{arc: {radius: 1, direction: left}}, {arc: {direction: 1, radius: 1.0}}]",
        "twice",
    ),
    "pilot's option": ("pilot: [straight, {arc: {radus: 1}}]", "did you mean 'radius'?"),
    "two sources": (
        "profile: [exact, as_published]",
        "is varied and also given as 'profile': give it one source",
    ),
    "no effect in any": (
        "spine: [none, balance]\n  spine.phase: [0, 1]",
        "has no effect: it is read only with spine: stride_extension, and spine is none or balance",
    ),
    "pilot's own number": (
        "pilot: [straight, {arc: {radius: 1}}]\n  pilot.radius: [1, 2]",
        "set by 'pilot.arc",
    ),
    "beyond the legs": (
        "gait: [trot, lateral_walk]\n  stance.swing_amplitude: [0.01, 0.04]",
        "'stance.swing_",
    ),
    "too many": (
        "\n  ".join(f"{name}: [{', '.join('abcdefghijk')}]" for name in ("gait", "spine", "tail")),
        "makes 1,331 combinations of structures; allowed are 1,000",
    ),
    "beyond one time step": (
        "physics: [reference, fast]\n  contact.time_constant: [0.005, 0.01]",
        "contact.time_constant' is 0.005: allowed is [0.00666",
    ),
}


@pytest.mark.parametrize(("vary", "sentence"), WRONG.values(), ids=WRONG)
def test_wrong_structures_are_refused_with_their_line(tmp_path, vary, sentence):
    """Before anything compiles, and with what is allowed."""
    path = tmp_path / "sweep.yaml"
    path.write_text(f"profile: exact\nvary:\n  {vary}\n  frequency: [0.5, 0.6]\n")
    with pytest.raises(SpecError) as refused:
        Sweep.from_file(path)
    assert sentence in str(refused.value)
    assert "sweep.yaml:" in str(refused.value)


def test_the_summary_names_structures(tmp_path):
    """The best one, the mean of each, and the gain over the spine that is switched off."""
    summary = json.loads(json.dumps(run_sweep(SPEC, tmp_path, simulator=FakeSimulator()).summary))
    best = summary["best"]["speed"]["parameters"]
    assert (best["spine"], best["spine.amplitude"], best["frequency"]) == (
        "stride_extension",
        0.2,
        0.8,
    )
    assert [entry["value"] for entry in summary["marginal_means"]["gait"]] == sorted(GAITS)
    assert [entry["value"] for entry in summary["marginal_means"]["spine.amplitude"]] == [0.1, 0.2]
    assert "gait" not in summary["rank_correlations"]
    gain = summary["spine_gain"][-1]["best"]
    assert gain["parameters"]["spine.amplitude"] == 0.2
    assert gain["ratio"] == pytest.approx(
        1.1, abs=0.01
    )  # 1 + 0.5 x 0.2, by the fake robot's formula
    slowest = run_sweep(
        SPEC | {"vary": {"gait": GAITS}}, tmp_path / "names", simulator=FakeSimulator()
    ).summary
    assert slowest["variants"] == 3


def test_the_authors_codes_of_gaits_are_accepted_and_shown_nowhere(tmp_path):
    """In a file, where a column is chosen, and in tables of former versions, which had them."""
    codes = dict(zip(GAITS, ("trt", "trt1", "lat"), strict=True))
    written = SPEC | {"vary": SPEC["vary"] | {"gait": [*codes.values()]}}
    run_sweep(written, tmp_path, simulator=FakeSimulator())
    table = read_table(tmp_path)
    assert {*table.column("gait").to_pylist()} == {*GAITS}
    for part in part_files(tmp_path):
        rows = pq.read_table(part)
        former = pa.array([codes[gait] for gait in rows.column("gait").to_pylist()])
        column_index = rows.column_names.index("gait")
        pq.write_table(rows.set_column(column_index, rows.schema.field(column_index), former), part)
    assert read_table(tmp_path).equals(table)
    coded, named = (
        compare(tmp_path, by="spine", where={"gait": gait}) for gait in ("lat", "lateral_walk")
    )
    assert coded.table.column("base_mean").equals(named.table.column("base_mean"))
    output = call(
        "compare",
        tmp_path,
        "--by",
        "spine",
        "--for",
        "gait",
        "--where",
        "gait=trt1",
        "--metric",
        "speed",
    ).stdout
    assert "walking_trot" in output
    assert "trt1" not in output
    assert "roll_std" not in output


def test_figures_put_structures_side_by_side(tmp_path):
    """A line and a panel for each; one without the parameter is a level line; two axes may be any columns."""
    run_sweep(SPEC, tmp_path, simulator=FakeSimulator())
    figures = dict(sweep_figures(tmp_path))
    assert list(figures) == [
        "speed-over-structures",
        "speed-over-frequency-by-structure",
        "speed-over-spine.amplitude-by-structure",
        "speed-over-frequency-and-spine.amplitude-by-structure",
        "speed-against-roll_std",
    ]
    dots = figures["speed-over-structures"].axes[0]
    assert [label.get_text() for label in dots.get_yticklabels()] == [
        f"{spoken(g)}, {spoken(s)}" for g in GAITS for s in SPINES
    ]
    over = figures["speed-over-spine.amplitude-by-structure"].axes[0]
    assert sorted(len(line.get_xdata()) for line in over.get_lines()) == [2] * 6
    level = [line for line in over.get_lines() if list(line.get_xdata()) == [0, 1]]
    well = Results(read_table(tmp_path))
    stiff = (well.column("gait") == "trot") & (well.column("spine") == "none")
    assert level[0].get_ydata()[0] == pytest.approx(1000 * well.column("speed")[stiff].mean())
    panels = figures["speed-over-frequency-and-spine.amplitude-by-structure"].axes
    assert [ax.get_title() for ax in panels if ax.get_title()] == [
        f"{spoken(gait)}, stride extension" for gait in GAITS
    ]
    ((name, figure),) = sweep_figures(tmp_path, x="gait", y="frequency")
    assert name == "speed-over-gait-and-frequency"
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == [*map(spoken, GAITS)]
    ((_, scatter),) = sweep_figures(tmp_path, x="spine", y="roll_std", color="speed")
    assert [label.get_text() for label in scatter.axes[0].get_xticklabels()] == [
        *map(spoken, SPINES)
    ]


@pytest.mark.long
@pytest.mark.release
@pytest.mark.usefixtures("shared_simulators")
def test_on_the_engine_c_an_extended_directory_is_that_of_one_go_bit_for_bit(tmp_path):
    """Real walks: another gait, another frequency and a repeat are added; one row alone replays to the last bit."""
    small = {
        "plots": False,
        "run": {"duration": 0.3},
        "vary": {"frequency": [0.7, 0.9]},
        "set": {"stride": 0.8},
        "randomize": {"repeats": 2, "contact.friction": {"uniform": [1.0, 1.6]}},
    }
    large = small | {
        "vary": {"gait": ["lateral_walk", "trot"], "frequency": [0.7, 0.8, 0.9]},
        "randomize": small["randomize"] | {"repeats": 3},
    }
    run_sweep(small, tmp_path / "extended", engine="c", chunk=3)
    before = read_table(tmp_path / "extended")
    extended = run_sweep(large, tmp_path / "extended", engine="c", extend=True)
    whole = run_sweep(large, tmp_path / "whole", engine="c", chunk=9)
    assert extended.summary["rows"] == 18
    assert extended.table.schema.equals(whole.table.schema, check_metadata=True)
    for name in whole.table.column_names:
        np.testing.assert_array_equal(
            extended.table.column(name).to_numpy(), whole.table.column(name).to_numpy()
        )
    assert set(before.column("speed").to_pylist()) < set(whole.table.column("speed").to_pylist())
    report = json_of("replay", tmp_path / "extended", "--row", "10")
    assert report["comparison"]["equal"]
    assert report["setup"]["gait"] == "trot"


def test_parameters_and_structures_are_listed():
    listed = json_of("sweep", "--list-parameters")
    assert listed["structures"]["gait"]["allowed"][:5] == [*GAITS, "bound", "gallop"]
    assert (
        "trot, walking_trot, lateral_walk, bound, gallop"
        in call("sweep", "--list-parameters").stdout
    )


def test_the_command_says_where_a_parameter_is_not_varied(tmp_path, asked):
    """One sentence on standard error, as such rows would be expected."""
    (tmp_path / "sweep.yaml").write_text(
        "plots: false\nvary: {spine: [none, stride_extension], spine.phase: [0, 1]}\n"
    )
    result = call("sweep", tmp_path / "sweep.yaml", "--out", tmp_path / "out", "--engine", "c")
    assert "spine.phase is varied in 1 of 2 structures: the others do not read it." in result.stderr
    assert read_table(tmp_path / "out").column("spine.phase").to_pylist() == [None, 0.0, 1.0]
