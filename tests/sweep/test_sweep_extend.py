# Tests of sweep/directory.py, sweep/store.py, sweep/merging.py
"""Sweeps that are extended, reuse rows of other directories, and are merged: always the table of a single run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command import call, json_of
from fakes.sweep_fake import FakeSimulator, contents, part_of

from nermo_mjx.runs import Interrupted, OtherCode, Watch, code
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.sweep import (
    DirectoryError,
    SpecError,
    Sweep,
    merge_sweeps,
    read_table,
    run_sweep,
    sample,
)
from nermo_mjx.sweep.replay import find_row
from nermo_mjx.sweep.store import keys_of_rows

FREQUENCY, FRICTION = [0.5, 0.7, 0.9], {"contact.friction": [1.0, 1.2]}
MASS = {"mass.front": {"uniform": [0.15, 0.17]}}
SMALL = {"plots": False, "vary": {"frequency": FREQUENCY, **FRICTION}, "randomize": MASS}
UNIFORM = {"frequency": {"uniform": [0.5, 1.0]}, "stride": {"uniform": [0.5, 1.0]}}


def changed(**fields):
    """The small sweep with other fields; those of `randomize` are added."""
    return SMALL | fields | {"randomize": SMALL["randomize"] | fields.get("randomize", {})}


#: A sweep, what it becomes, and how many of the larger one's rows the smaller one has.
EXTENSIONS = {
    "more repeats": (SMALL, changed(randomize={"repeats": 4}), 6),
    "even more repeats": (changed(randomize={"repeats": 3}), changed(randomize={"repeats": 5}), 18),
    "a finer grid": (
        changed(vary={"frequency": {"linspace": [0.4, 1.2, 5]}}),
        changed(vary={"frequency": {"linspace": [0.4, 1.2, 9]}}),
        5,
    ),
    "another value": (SMALL, changed(vary={"frequency": [0.5, 0.6, 0.7, 0.9, 1.1], **FRICTION}), 6),
    "another parameter": (
        changed(vary=FRICTION, set={"frequency": 0.7}, randomize={}),
        changed(vary={"frequency": FREQUENCY, **FRICTION}),
        0,  # its draws are others
    ),
    "another structure": (
        changed(gait="lateral_walk", randomize={"repeats": 2}),
        changed(vary={"gait": ["trot", "lateral_walk"], **SMALL["vary"]}, randomize={"repeats": 2}),
        12,
    ),
    "a parameter of one structure": (
        SMALL,
        changed(
            vary={
                "spine": ["none", "stride_extension"],
                **SMALL["vary"],
                "spine.amplitude": [0.1, 0.2],
            }
        ),
        6,
    ),
    "another model": (
        changed(tail="rigid"),
        changed(vary={"tail": ["articulated", "rigid"], **SMALL["vary"]}),
        6,
    ),
    "Sobol points": (
        changed(vary=UNIFORM, sample={"sobol": 5}),
        changed(vary=UNIFORM, sample={"sobol": 23}),
        5,
    ),
    "structures of a sample": (
        changed(vary=UNIFORM, sample={"sobol": 5}, gait="walking_trot"),
        changed(vary=UNIFORM | {"gait": ["trot", "walking_trot"]}, sample={"sobol": 5}),
        5,
    ),
    "rows": (
        {
            "plots": False,
            "rows": [
                {"gait": "trot", "frequency": 0.5},
                {"gait": "lateral_walk", "frequency": 0.7},
            ],
        },
        {
            "plots": False,
            "rows": [
                {"gait": "lateral_walk", "frequency": 0.7},
                {"gait": "lateral_walk", "frequency": 0.9},
            ],
        },
        1,
    ),
    "a row of a grid": (
        SMALL,
        {
            "plots": False,
            "rows": [{"frequency": 0.7, "contact.friction": 1.0}],
            "randomize": SMALL["randomize"],
        },
        1,
    ),
}


class Counting(FakeSimulator):
    """Counts the different rows that it simulates, padding apart."""

    def __init__(self, **options):
        super().__init__(**options)
        self.rows = 0

    def run(self, values, run, **options):
        self.rows += len(np.unique(np.column_stack(list(values.values())), axis=0))
        return super().run(values, run, **options)


def extended(small, large, out, chunk=4):
    """The larger sweep in the directory of the smaller one, and how many rows were simulated for it."""
    run_sweep(small, out, chunk=chunk, simulator=FakeSimulator())
    simulator = Counting()
    return run_sweep(large, out, simulator=simulator, extend=True), simulator.rows


@pytest.mark.parametrize(("small", "large", "shared"), EXTENSIONS.values(), ids=EXTENSIONS)
def test_an_extended_directory_is_that_of_one_go(tmp_path, small, large, shared):
    """Every column of every row, seeds and draws among them; only what was not there is simulated."""
    result, simulated = extended(small, large, tmp_path / "extended")
    whole = run_sweep(large, tmp_path / "whole", chunk=7, simulator=FakeSimulator())
    assert result.table.schema.equals(whole.table.schema, check_metadata=True)
    assert result.table.to_pydict() == whole.table.to_pydict()
    assert simulated == whole.table.num_rows - shared
    assert result.complete


@pytest.mark.parametrize("move", range(1, 11))
def test_an_extension_that_is_killed_at_any_moment_loses_nothing(tmp_path, monkeypatch, move):
    """Killed before its n-th change of the directory, and resumed: each row is still simulated once."""
    small, large, shared = EXTENSIONS["another value"]
    run_sweep(small, tmp_path, chunk=2, simulator=FakeSimulator())
    before = {path.read_bytes() for path in tmp_path.glob("results/*")}

    class Killed(BaseException):
        pass

    left = [move]

    def mortal(function):
        def moved(*arguments, **options):
            left[0] -= 1
            if left[0] == 0:
                raise Killed
            return function(*arguments, **options)

        return moved

    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "write", mortal(RunDirectory.write))
        patch.setattr(Path, "rename", mortal(Path.rename))
        with pytest.raises(Killed):
            run_sweep(large, tmp_path, simulator=FakeSimulator(), extend=True)
    assert before <= {path.read_bytes() for path in tmp_path.rglob("*.parquet")}
    row_count = read_table(tmp_path).num_rows if any(tmp_path.glob("results/*")) else 0
    again = Counting()
    assert run_sweep(large, tmp_path, simulator=again, extend=True).complete
    table = read_table(tmp_path)
    assert table.equals(run_sweep(large, tmp_path / "whole", simulator=FakeSimulator()).table)
    assert again.rows <= table.num_rows - shared
    assert row_count == 0 or again.rows <= table.num_rows - min(row_count, shared)


def test_between_its_steps_the_former_sweep_can_be_gone_on_with_instead(tmp_path, monkeypatch):
    """Its rows are in the folder by then; nothing is simulated again."""
    run_sweep(SMALL, tmp_path, chunk=2, simulator=FakeSimulator())
    table = read_table(tmp_path)
    monkeypatch.setattr("nermo_mjx.sweep.directory._with_files", lambda *arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_sweep(
            changed(randomize={"repeats": 2}), tmp_path, simulator=FakeSimulator(), extend=True
        )
    monkeypatch.undo()
    assert not any(tmp_path.glob("results/*"))
    simulator = FakeSimulator()
    assert run_sweep(SMALL, tmp_path, simulator=simulator).table.equals(table)
    assert simulator.batches == []


def test_an_interrupted_extension_goes_on_without_being_named_again(tmp_path):
    """As any sweep: the same command, or that with DIR/sweep.yaml."""
    small, large, _ = EXTENSIONS["another value"]
    run_sweep(small, tmp_path, chunk=2, simulator=FakeSimulator())
    with pytest.raises(Interrupted):
        run_sweep(large, tmp_path, simulator=FakeSimulator(stop_at=1), extend=True)
    run_sweep(tmp_path / "sweep.yaml", tmp_path, simulator=FakeSimulator())
    assert read_table(tmp_path).equals(
        run_sweep(large, tmp_path / "whole", simulator=FakeSimulator()).table
    )


def test_a_directory_is_extended_twice_and_keeps_what_left_the_table(tmp_path):
    """Rows that the second sweep does not have are in their folder, and come back with the third."""
    sweeps = [
        changed(vary={"frequency": values, **FRICTION})
        for values in ([0.5, 0.6], [0.6, 0.7], [0.5, 0.6, 0.7])
    ]
    simulators = [Counting() for _ in sweeps]
    for sweep, simulator in zip(sweeps, simulators, strict=True):
        result = run_sweep(sweep, tmp_path, chunk=3, simulator=simulator, extend=True)
    assert [simulator.rows for simulator in simulators] == [4, 2, 0]
    assert len(list(tmp_path.glob("former/sweep-*.yaml"))) == 2
    assert result.summary["steps"] == pytest.approx(600)
    assert find_row(tmp_path, 5).stored["frequency"] == 0.7


REFUSED = {
    "fixed": (
        changed(set={"stride": 0.8}),
        "set.stride is absent there and 0.8 here: what is not varied stays",
    ),
    "seed": (changed(seed=3), "seed is 0 there and 3 here"),
    "length": (changed(run={"cycles": 3}), "run.cycles is 8 there and 3 here"),
    "draws": (
        changed(randomize={"mass.front": {"uniform": [0.1, 0.17]}}),
        "randomize.mass.front.uniform is",
    ),
}


@pytest.mark.parametrize(("spec", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_extension_is_refused(tmp_path, spec, sentence):
    """In one sentence, with nothing changed; and without --extend it is not offered."""
    run_sweep(SMALL, tmp_path, simulator=FakeSimulator())
    before = contents(tmp_path)
    with pytest.raises(DirectoryError, match="cannot be extended to this one") as refused:
        run_sweep(spec, tmp_path, simulator=FakeSimulator(), extend=True)
    assert sentence in str(refused.value)
    with pytest.raises(DirectoryError, match="the results of another sweep") as plain:
        run_sweep(spec, tmp_path, simulator=FakeSimulator())
    assert "--extend" not in str(plain.value)
    assert before == contents(tmp_path)


def test_a_latin_hypercube_has_no_further_points(tmp_path):
    """Its points depend on how many there are; repeats can be added."""
    smaller, larger = (changed(vary=UNIFORM, sample={"latin_hypercube": count}) for count in (4, 8))
    run_sweep(smaller, tmp_path, simulator=FakeSimulator())
    with pytest.raises(
        DirectoryError, match="a Latin hypercube of 4 points is not part of one of 8"
    ):
        run_sweep(larger, tmp_path, simulator=FakeSimulator(), extend=True)
    extended = smaller | {"randomize": smaller["randomize"] | {"repeats": 2}}
    assert run_sweep(extended, tmp_path, simulator=FakeSimulator(), extend=True).rows == 8


def test_without_being_told_another_sweep_is_refused_and_extend_is_named(tmp_path):
    run_sweep(SMALL, tmp_path, simulator=FakeSimulator())
    with pytest.raises(
        DirectoryError, match=r"randomize.repeats is 1 there and 2 here; .* with --extend\.$"
    ):
        run_sweep(changed(randomize={"repeats": 2}), tmp_path, simulator=FakeSimulator())


def test_other_code_extends_only_when_it_is_told_to(tmp_path, monkeypatch):
    """Then the column tells the rows apart."""
    small, large, shared = EXTENSIONS["more repeats"]
    run_sweep(small, tmp_path, chunk=4, simulator=FakeSimulator())
    monkeypatch.setattr(code, "__version__", "9.9.9")
    with pytest.raises(OtherCode, match=r"not 9\.9\.9"):
        run_sweep(large, tmp_path, simulator=FakeSimulator(), extend=True)
    result = run_sweep(
        large, tmp_path, simulator=FakeSimulator(), extend=True, accept_new_code=True
    )
    made = result.table.column("code").to_pylist()
    assert sorted(made.count(each) for each in set(made)) == [shared, result.rows - shared]


def test_rows_are_taken_from_another_directory(tmp_path):
    """`use`: it is only read, also where it is an extended one; a damaged chunk of it is told and not used."""
    source = tmp_path / "source"
    run_sweep(SMALL, source, chunk=2, simulator=FakeSimulator())
    damaged = part_of(source, 1)
    damaged.write_bytes(b"nothing")
    before = contents(source)
    messages, simulator = [], Counting()
    large = changed(vary={"frequency": [0.5, 0.7, 0.9, 1.1], **FRICTION})
    result = run_sweep(
        large,
        tmp_path / "out",
        chunk=8,
        use=[source],
        simulator=simulator,
        watch=Watch(warn=messages.append),
    )
    assert simulator.rows == 8 - 4
    assert messages == [f"{damaged} is damaged; its runs are not used."]
    assert result.table.equals(
        run_sweep(large, tmp_path / "whole", simulator=FakeSimulator()).table
    )
    assert before == contents(source)
    with pytest.raises(
        DirectoryError, match=r"rows of .*source cannot be used: run.cycles is 8 there and 5 here"
    ):
        run_sweep(
            SMALL | {"run": {"cycles": 5}},
            tmp_path / "other",
            use=[source],
            simulator=FakeSimulator(),
        )
    with pytest.raises(DirectoryError, match="no such directory"):
        run_sweep(SMALL, tmp_path / "other", use=[tmp_path / "nowhere"], simulator=FakeSimulator())
    assert not (tmp_path / "other").exists()


def test_directories_merge_into_one(tmp_path):
    """The union of their rows, each once, as in a single sweep of these rows; nothing is simulated."""
    sources = [tmp_path / name for name in ("a", "b")]
    plain = {"plots": False, "gait": "lateral_walk", "vary": {"frequency": [0.5, 0.7], **FRICTION}}
    run_sweep(plain, sources[0], simulator=FakeSimulator())
    spec = {"plots": False, "vary": {"gait": ["trot", "lateral_walk"], "frequency": [0.7, 0.9]}}
    run_sweep(spec | {"set": {"contact.friction": 1.2}}, sources[1], simulator=FakeSimulator())
    before = contents(*sources)
    result = merge_sweeps(sources, tmp_path / "both")
    assert result.complete
    assert result.chunks_run == 0
    label_names = ["gait", "frequency", "contact.friction"]
    rows = list(zip(*(result.table.column(name).to_pylist() for name in label_names), strict=True))
    expected = {("lateral_walk", f, x) for f in (0.5, 0.7) for x in (1.0, 1.2)}
    expected |= {(g, f, 1.2) for g in ("trot", "lateral_walk") for f in (0.7, 0.9)}
    assert sorted(rows) == sorted(expected)
    assert before == contents(*sources)
    assert find_row(tmp_path / "both", 6).values["frequency"] == rows[6][1]
    simulator = FakeSimulator()
    assert (
        run_sweep(
            tmp_path / "both" / "sweep.yaml", tmp_path / "both", simulator=simulator
        ).chunks_run
        == 0
    )


def test_draws_of_a_row_are_the_same_whatever_else_is_varied(tmp_path):
    """So that merged directories and a single run agree: a row's draws depend only on its own values."""
    turned = changed(vary={"contact.friction": [1.2, 1.0], "frequency": [0.9, 0.5, 0.7]})
    small_sample, large_sample = sample(Sweep.from_dict(SMALL)), sample(Sweep.from_dict(turned))
    for rows in (small_sample, large_sample):
        assert len(np.unique(rows.seed)) == 6
    assert sorted(small_sample.seed) == sorted(large_sample.seed)
    sweep = Sweep.from_dict(SMALL)
    assert sorted(keys_of_rows(sweep, small_sample)) == sorted(keys_of_rows(sweep, large_sample))


def test_what_does_not_go_together_is_not_merged(tmp_path):
    run_sweep(SMALL, tmp_path / "a", simulator=FakeSimulator())
    run_sweep(SMALL | {"gait": "lateral_walk"}, tmp_path / "b", simulator=FakeSimulator())
    run_sweep(changed(vary={"frequency": [0.5]}), tmp_path / "c", simulator=FakeSimulator())
    run_sweep(SMALL, tmp_path / "d", simulator=FakeSimulator(engine="other"))
    with pytest.raises(
        DirectoryError,
        match=r"a and .*b cannot be merged: gait is trot there and lateral_walk here\.$",
    ):
        merge_sweeps([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    with pytest.raises(
        DirectoryError,
        match=r"c cannot be merged: only one of them varies contact.friction, on which",
    ):
        merge_sweeps([tmp_path / "a", tmp_path / "c"], tmp_path / "out")
    for name, varied in (("e", {"frequency": [0.5]}), ("f", {"stride": [0.5, 0.6]})):
        run_sweep({"plots": False, "vary": varied}, tmp_path / name, simulator=FakeSimulator())
    with pytest.raises(
        DirectoryError, match="e cannot be merged: it neither varies nor sets stride, which"
    ):
        merge_sweeps([tmp_path / "e", tmp_path / "f"], tmp_path / "out")
    with pytest.raises(SpecError, match="two directories"):
        merge_sweeps([tmp_path / "a"], tmp_path / "out")
    with pytest.raises(OtherCode, match="engine fake, not other"):
        merge_sweeps([tmp_path / "a", tmp_path / "d"], tmp_path / "out")
    assert merge_sweeps(
        [tmp_path / "a", tmp_path / "d"], tmp_path / "out", accept_new_code=True
    ).complete


def test_the_command_merges_and_says_what_is_missing(tmp_path):
    """Sweeps of different repeats: the rest is named with the command that runs it."""
    run_sweep(changed(vary={"frequency": [0.5]}), tmp_path / "a", simulator=FakeSimulator())
    run_sweep(
        changed(vary={"frequency": [0.7]}, randomize={"repeats": 2}),
        tmp_path / "b",
        simulator=FakeSimulator(),
    )
    command = ("merge", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "c")
    result = call(*command)
    assert result.exit_code == 0, result.stderr
    assert "of 4 runs are in" in result.stdout
    assert f"--use {tmp_path / 'a'} --use {tmp_path / 'b'}" in result.stdout
    assert json_of(*command)["complete"] is False
    simulator = Counting()
    whole = run_sweep(
        tmp_path / "c" / "sweep.yaml",
        tmp_path / "c",
        simulator=simulator,
        use=[tmp_path / "a", tmp_path / "b"],
    )
    assert whole.complete
    assert simulator.rows == 1


def test_values_that_differ_in_their_last_digits_are_one_variant(tmp_path):
    """0.7 and 7 * 0.1: nothing is run again, a merged sweep has it once, with its draws, and no list has both."""
    spec = changed(vary={"frequency": [0.5, 0.7]}, randomize={"repeats": 3})
    first = run_sweep(spec, tmp_path / "first", simulator=FakeSimulator())
    computed = changed(vary={"frequency": [0.5, 7 * 0.1]}, randomize={"repeats": 3})
    assert Sweep.from_dict(computed).digest() == Sweep.from_dict(spec).digest()
    again = FakeSimulator()
    wider = changed(vary={"frequency": [0.5, 7 * 0.1, 0.9]}, randomize={"repeats": 3})
    run_sweep(wider, tmp_path / "first", extend=True, simulator=again)
    assert again.batches == [3]
    rows = changed(rows=[{"frequency": 7 * 0.1}, {"frequency": 3 * 0.1}], randomize={"repeats": 3})
    del rows["vary"]
    listed = run_sweep(rows, tmp_path / "rows", simulator=FakeSimulator())
    merged = merge_sweeps([tmp_path / "first", tmp_path / "rows"], tmp_path / "merged")
    assert merged.complete
    assert sorted(set(merged.table.column("frequency").to_pylist())) == [0.3, 0.5, 0.7, 0.9]
    assert merged.rows == 12
    for sweep_rows, digits in ((first, 3), (listed, 0)):
        assert sweep_rows.table.column("frequency")[digits].as_py() == 0.7
        assert (
            sweep_rows.table.column("seed")[digits].as_py() == first.table.column("seed")[3].as_py()
        )
    with pytest.raises(SpecError, match=r"lists 0\.7 twice"):
        Sweep.from_dict(changed(vary={"frequency": [0.7, 7 * 0.1]}))
    with pytest.raises(SpecError, match="a row is the same as that of"):
        Sweep.from_dict(rows | {"rows": [{"frequency": 0.7}, {"frequency": 7 * 0.1}]})
    third = Sweep.from_dict(changed(vary={"frequency": [1 / 3, 0.5]}))
    assert third.axes[0].listed()[0] == 1 / 3  # nothing is rounded that no short number is
