# Tests of optimize/tuning_run.py
"""Running a tuning: convergence, bounds, worlds that fall, the files, and going on after every kind of stop."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.sweep_fake import FakeSimulator
from fakes.tune_fake import BEST, SPEC, FakeProblem, FakeWalker, Three

from nermo_mjx.optimize import Tuning, read_history, run_tuning
from nermo_mjx.optimize.tuner import Tuner, initial_state
from nermo_mjx.optimize.tuning_directory import load_tuning
from nermo_mjx.runs import JobFailed
from nermo_mjx.runs.job import SILENT, Interrupted, Watch
from nermo_mjx.runs.workers import TaskFailed, WorkersLost
from nermo_mjx.sweep import DirectoryError, Sweep, run_sweep

#: Tunings by each method: what changes in `SPEC`.
METHODS = {
    "local_gradient": {},
    "wide_differences": {"method": "wide_differences"},
}


def tune(out, change=None, watch=SILENT, accept_new_code=False, **of_problem):
    """Run `SPEC` with changes on the fake problem; the result and the problem."""
    tuning = Tuning.from_dict(SPEC | (change or {}))
    problem = FakeProblem(tuning, **of_problem)
    return run_tuning(
        tuning, out, problem=problem, watch=watch, accept_new_code=accept_new_code
    ), problem


def lasting(table):
    """The history without the one column that differs between runs."""
    return table.drop_columns(["wall_seconds"])


def same(first, second):
    """Bitwise the same state and history."""
    leaves = zip(jax.tree.leaves(first.state), jax.tree.leaves(second.state), strict=True)
    assert all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in leaves)
    assert first.history["code"].equals(second.history["code"])
    a, b = (
        lasting(result.history).drop_columns(["code"]).to_pandas() for result in (first, second)
    )
    assert a.to_numpy(float).tobytes() == b.to_numpy(float).tobytes()
    return True


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The tuning run without a stop."""
    return tune(tmp_path_factory.mktemp("tuning"))[0]


def test_it_finds_the_best_point():
    """From the slow side of the circle it comes to the optimum of the closed form.

    With roll's share in the objective it lies at the amplitude where 10 (x - 0.25) + 0.4 x = 0.
    """
    rate = {"cosine": {"init_value": 0.3, "decay_steps": 80}}
    change = {"starts": 1, "optimizer": {"name": "adam", "learning_rate": rate}}
    tuning = Tuning.from_dict(SPEC | change)
    problem = FakeProblem(tuning)
    tuner, state = Tuner(tuning, problem), initial_state(tuning)
    for _ in range(80):
        state, iterate = tuner.step(state)
    amplitude, phase = iterate.points[0]
    assert abs(amplitude - 2.5 / 10.4) < 0.4 * 0.005
    assert abs(phase - BEST[1]) < 2 * np.pi * 0.005
    assert float(state.best_value[0]) <= iterate.value[0]
    assert problem.compiled == 1
    assert problem.batches == [(1, True)] * 80


def test_tunings_of_one_optimizer_share_their_programs(compilations):
    """The second one, within other bounds, compiles its problem only."""
    for high in (0.4, 0.3):
        compilations.clear()
        tuning = Tuning.from_dict(
            SPEC
            | {"tune": SPEC["tune"] | {"spine.amplitude": {"bounds": [0.0, high], "start": 0.05}}}
        )
        _, iterate = Tuner(tuning, FakeProblem(tuning)).step(initial_state(tuning))
        np.testing.assert_allclose(iterate.points[0], [0.05, 2.5], rtol=1e-5)
    assert any("program" in name for name in compilations)
    assert not [name for name in compilations if "_point_parameters" in name or "_advance" in name]


def test_the_first_iteration_is_the_given_start(reference):
    """The first row is the start of the file; exact gradients are those of the problem, in the parameters' units."""
    row = lasting(reference.history).slice(0, 1).to_pylist()[0]
    assert row["spine.amplitude"] == pytest.approx(0.05, rel=1e-5)
    assert row["spine.phase"] == pytest.approx(2.5, rel=1e-5)
    # -speed / 0.1 gives 10 (x - 0.25); 0.1 roll_std / 0.05 gives 0.4 x.
    assert row["gradient.spine.amplitude"] == pytest.approx(
        10 * (0.05 - 0.25) + 0.4 * 0.05, rel=1e-4
    )
    assert row["gradient.spine.phase"] == pytest.approx(0.2 * np.sin(2.5 - BEST[1]), rel=1e-4)


@pytest.mark.release
def test_the_effort_counts_gradients_at_their_cost(reference):
    """5 s a world, three times that with its gradient: two starts and seven evaluations make 210 s."""
    assert reference.best["simulated_seconds"] == 7 * 2 * 5.0 * 3.0
    at_best = reference.best["simulated_seconds_to_best"]
    assert at_best == (reference.best["iteration"] + 1) * 2 * 5.0 * 3.0


@pytest.mark.release
def test_starts_are_shared_among_workers_in_shares_of_one_size(tmp_path):
    """Five starts for three workers are three shares of two, and find what one batch finds, to float precision."""
    change = {"starts": 5}
    tuning, log = Tuning.from_dict(SPEC | change), tmp_path / "log"
    alone = tune(tmp_path / "one", change)[0]
    shared = run_tuning(
        tuning, tmp_path / "three", problem=FakeProblem(tuning, log=log), workers=Three()
    )
    ours, theirs = (lasting(result.history).to_pydict() for result in (alone, shared))
    for column, values in ours.items():
        assert theirs[column] == (
            pytest.approx(values, rel=1e-4, abs=1e-5, nan_ok=True) if column != "code" else values
        )
    worlds = [int(line.split()[1]) for line in log.read_text().splitlines()]
    assert worlds == [2] * 3 * 7


@pytest.mark.parametrize(
    ("error", "raised", "sentence"),
    [
        (
            WorkersLost("no node came."),
            JobFailed,
            r"no node came\. What is finished is kept in .*same command",
        ),
        (TaskFailed(0, ZeroDivisionError("no number")), ZeroDivisionError, "no number"),
    ],
    ids=["lost", "failing"],
)
def test_what_workers_cannot_do_is_said(tmp_path, error, raised, sentence):
    class Failing(Three):
        def results(self, tasks, tell):
            raise error

    tuning = Tuning.from_dict(SPEC)
    with pytest.raises(raised, match=sentence):
        run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), workers=Failing())


# --- worlds that do not walk


@pytest.mark.release
def test_worlds_that_fall_poison_nothing(tmp_path):
    """Worlds below an amplitude of 0.1 fall: they are counted, and every number that steers stays finite."""
    change = {"starts": 4, "iterations": 12}
    change["tune"] = SPEC["tune"] | {"spine.amplitude": {"bounds": [0.0, 0.4], "start": 0.11}}
    result, _ = tune(tmp_path, change, falls=lambda points: points[:, 0] < 0.1)
    frame = result.history.to_pandas()
    assert not frame["ok"].all()
    assert (frame["ok"] == (frame["spine.amplitude"] >= 0.1)).all()
    assert frame["objective"].isna().equals(~frame["ok"])
    steering = frame[
        [f"gradient.{name}" for name in result.tuning.names] + list(result.tuning.names)
    ]
    assert (np.isfinite(steering.to_numpy()).all(axis=1) == frame["ok"]).all()
    assert all(np.isfinite(leaf).all() for leaf in (result.state.u, result.state.best_u))
    assert result.best["parameters"]["spine.amplitude"] >= 0.1


def test_a_start_does_not_depend_on_the_others(tmp_path):
    """The given start walks the same way beside a start that falls from the first step on as beside one that walks."""
    reference, _ = tune(tmp_path / "a")
    second_start = reference.history.column("spine.phase").to_pylist()[1]
    beside, _ = tune(
        tmp_path / "b", falls=lambda points: jnp.abs(points[:, 1] - second_start) < 0.02
    )
    first = [
        lasting(result.history).to_pandas().query("start == 0").drop(columns="iteration")
        for result in (reference, beside)
    ]
    assert first[0].equals(first[1])
    assert not beside.history.column("ok").to_pylist()[1]


def test_a_start_that_falls_goes_back_towards_its_best_point(tmp_path):
    """A step over the cliff is halved until the robot walks again; the optimizer waits meanwhile."""
    change = {"starts": 1, "iterations": 8, "optimizer": {"name": "sgd", "learning_rate": 3.0}}
    result, _ = tune(tmp_path, change, falls=lambda points: points[:, 0] > 0.06)
    frame = result.history.to_pandas()
    assert frame["ok"].iloc[0]
    assert not frame["ok"].iloc[1]
    u = np.log(frame["spine.amplitude"] / (0.4 - frame["spine.amplitude"]))
    assert u.iloc[2] == pytest.approx((u.iloc[0] + u.iloc[1]) / 2, rel=1e-3)
    assert frame["ok"].iloc[2:].any()
    assert (frame["gradient.spine.amplitude"].isna() == ~frame["ok"]).all()


def test_nothing_that_walks_is_an_error_at_once(tmp_path):
    """All worlds fall at all starts: no iteration could change that. Another tuning may take the directory."""
    with pytest.raises(JobFailed, match="no world of iteration 0 walked"):
        tune(tmp_path, falls=lambda points: jnp.ones(len(points), bool))
    assert not (tmp_path / "best.json").exists()
    assert tune(tmp_path, {"seed": 9})[0].best["complete"]


def test_a_problem_that_says_ok_to_nan_is_not_believed():
    """A world with a number that is not finite does not count, whatever its flag says."""
    tuning = Tuning.from_dict(SPEC)
    problem = FakeProblem(tuning)
    real = problem.evaluate

    def careless(points, gradient):
        evaluation = real(points, gradient)
        return type(evaluation)(
            evaluation.value.at[0].set(jnp.nan),
            evaluation.gradient.at[1, 0].set(jnp.inf),
            evaluation.metrics,
            evaluation.ok,
        )

    problem.evaluate = careless
    state, iterate = Tuner(tuning, problem).step(initial_state(tuning))
    assert not iterate.ok.any()
    assert np.isfinite(state.u).all()
    assert np.isinf(state.best_value).all(), "no point is the best"
    assert state.best_iteration.tolist() == [-1, -1]


# --- going on


@pytest.mark.filterwarnings("ignore:method. differences is a former name:FutureWarning")
@pytest.mark.parametrize("given", ["differences", "wide_differences"])
def test_a_directory_with_the_former_name_of_a_method_goes_on(tmp_path, given):
    """Its file has the former name, as its checkpoints do, under either name in the file of the user."""
    whole, _ = tune(tmp_path / "whole", METHODS["wide_differences"])
    with pytest.raises(Interrupted):
        tune(tmp_path / "out", METHODS["wide_differences"], stop_at=3)
    stored = tmp_path / "out" / "tuning.yaml"
    stored.write_text(stored.read_text().replace("  wide_differences:", "  differences:"))
    texts = {
        path.read_text() for path in (tmp_path / "out" / "checkpoints" / "2").rglob("metadata")
    }
    (identity_text,) = (text for text in texts if "identity" in text)
    assert json.loads(identity_text)["identity"]["fields"]["method"] == {
        "differences": {"scheme": "central", "step": 0.02}
    }
    rest, _ = tune(tmp_path / "out", {"method": given})
    assert rest.iterations_run == whole.iterations_run - 3
    assert same(rest, whole)
    assert not [*(tmp_path / "out").glob("*aside*")]


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "stops"),
    [("local_gradient", (0, 3, 6)), ("wide_differences", (4,))],
)
def test_an_interrupted_tuning_goes_on_bit_for_bit(tmp_path, name, stops):
    """Stopped in any iteration, or within one, the same call resumes and ends with the same state and history."""
    spec = METHODS[name]
    whole, problem = tune(tmp_path / "whole", spec)
    for stop in stops:
        out = tmp_path / str(stop)
        with pytest.raises(Interrupted, match=r"run the same command again, or: nermo-mjx tune"):
            tune(out, spec, stop_at=stop)
        if stop:
            assert read_history(out).num_rows == whole.tuning.starts * stop
            assert json.loads((out / "best.json").read_text())["complete"] is False
        rest, again = tune(out, spec)
        assert rest.iterations_run == whole.iterations_run - stop
        assert len(again.batches) == rest.iterations_run
        assert again.compiled == problem.compiled == 1
        assert same(rest, whole)
        assert rest.best == whole.best
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_finished_tuning_is_not_run_again(tmp_path, reference):
    """The same call evaluates nothing and gives the same; files that were lost are made again."""
    tune(tmp_path)
    for name in ("best.json", "tuned.yaml", "history.parquet"):
        (tmp_path / name).unlink()
    result, problem = tune(tmp_path)
    assert problem.batches == []
    assert same(result, reference)
    assert json.loads((tmp_path / "best.json").read_text()) == result.best
    assert len(json.loads((tmp_path / "run.json").read_text())["sessions"]) == 1


def test_a_tuning_can_be_prolonged(tmp_path, reference):
    """Three iterations and then three more are the same six; the file says so, too."""
    short, _ = tune(tmp_path, {"iterations": 3})
    assert (short.best["iterations"], short.best["complete"]) == (3, True)
    result, _ = tune(tmp_path)
    assert result.iterations_run == 3
    assert same(result, reference)
    assert load_tuning(tmp_path).iterations == 6


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"seed": 4}, r"seed \(3 there, 4 here\)"),
        (
            {"optimizer": {"name": "sgd", "learning_rate": 0.2}},
            r"optimizer\.name \(adam there, sgd here\)",
        ),
        (
            {"objective": [{"maximize": "speed"}], "starts": 3},
            r"objective \(.*\), starts \(2 there, 3 here\)",
        ),
    ],
)
def test_a_directory_belongs_to_one_tuning(tmp_path, change, word):
    """Another seed, optimizer or objective is refused in a sentence that says what differs."""
    tune(tmp_path, {"iterations": 2})
    with pytest.raises(
        DirectoryError, match=f"holds another tuning, with another {word}.*choose another directory"
    ):
        tune(tmp_path, change)
    (tmp_path / "tuning.yaml").unlink()
    with pytest.raises(DirectoryError, match="checkpoints of an unknown tuning"):
        tune(tmp_path)


# --- files


@pytest.mark.release
def test_the_directory_holds_what_other_programs_rely_on(reference):
    """best.json, history.parquet, checkpoints/ and the rest, and nothing half-written."""
    names = sorted(path.name for path in reference.out.iterdir() if path.name[0] != ".")
    assert names == [
        "best.json",
        "checkpoints",
        "history.parquet",
        "run.json",
        "tuned.yaml",
        "tuning.yaml",
    ]
    # The point that the last step leads to is evaluated, too.
    assert reference.history.column("iteration").to_pylist() == [
        i for i in range(7) for _ in range(2)
    ]
    assert reference.best["iteration"] == 6
    assert reference.best["objective"] == min(reference.history.column("objective").to_pylist())
    best = json.loads((reference.out / "best.json").read_text())
    assert best == reference.best
    assert set(best["parameters"]) == {"spine.amplitude", "spine.phase"}
    assert set(best["metrics"]) == {"speed", "roll_std"}
    assert best["objective"] == pytest.approx(
        -best["metrics"]["speed"] / 0.1 + 2 * best["metrics"]["roll_std"], rel=1e-5
    )
    assert Tuning.from_file(reference.out / "tuning.yaml") == reference.tuning


def test_every_column_says_its_unit_meaning_and_role(reference):
    """Units of parameters, gradients and metrics stand in the Parquet file itself; pandas needs nothing else."""
    column_metadata = {
        field.name: field.metadata for field in pq.read_schema(reference.out / "history.parquet")
    }
    names = ("spine.amplitude", "spine.phase")
    gradients = [f"{kind}.{name}" for name in names for kind in ("gradient",)]
    others = ("ok", "simulated_seconds", "wall_seconds", "code")
    assert list(column_metadata) == [
        "iteration",
        "start",
        "objective",
        *names,
        *gradients,
        "speed",
        "roll_std",
        *others,
    ]
    assert column_metadata["spine.phase"][b"unit"] == b"rad"
    assert column_metadata["gradient.spine.phase"][b"unit"] == b"1/(rad)"
    assert column_metadata["speed"][b"unit"] == b"m/s"
    assert column_metadata["speed"][b"role"] == b"metric"
    assert column_metadata["simulated_seconds"][b"role"] == b"effort"
    assert all(metadata[b"description"] for metadata in column_metadata.values())
    frame = read_history(reference.out).to_pandas()
    assert frame["wall_seconds"].is_monotonic_increasing


def test_a_sweep_runs_the_tuned_gait(tmp_path, reference):
    """tuned.yaml is a sweep file: the tuned and the fixed values, run from starts a little apart."""
    sweep = Sweep.from_file(reference.out / "tuned.yaml")
    expected = {"frequency": 0.8} | reference.best["parameters"]
    assert sweep.fixed == pytest.approx(expected, rel=1e-6)
    assert (sweep.setup, sweep.run) == (reference.tuning.setup, reference.tuning.run)
    result = run_sweep(sweep, tmp_path, simulator=FakeSimulator())
    assert result.table.num_rows == 3
    assert result.complete


def test_progress_tells_how_far_and_how_good(tmp_path, reference):
    """One report before the first evaluation, one after each; a resumed tuning starts where it was."""
    with pytest.raises(Interrupted):
        tune(tmp_path, stop_at=3)
    tuning, messages = Tuning.from_dict(SPEC), []
    run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), watch=Watch(messages.append))
    assert [(report.what, report.done) for report in messages] == [
        ("", done) for done in (3, 4, 5, 6, 7)
    ]
    assert {report.total for report in messages} == {7}
    assert {report.resumed for report in messages} == {3}
    best = [report.best for report in messages[1:]]
    assert best == sorted(best, reverse=True)
    assert best[-1] == reference.best["objective"]
    assert set(messages[-1].numbers) == {"objective", "speed", "roll_std", "simulated_seconds"}
    assert messages[-1].numbers["simulated_seconds"] == reference.best["simulated_seconds"]


# --- the end


@pytest.mark.release
def test_a_tuning_stops_when_nothing_more_is_gained(tmp_path):
    """Long before its iterations are done, with a sentence; the same call adds nothing, and a longer patience adds."""
    change = {"iterations": 200, "patience": 3, "optimizer": "controlled_adam", "starts": 1}
    first, _ = tune(tmp_path, change)
    done = first.best["iterations"]
    assert 5 < done < 60
    assert first.best["complete"]
    assert (
        f"stopped after {done} of 200 iterations: the last 3 gained less than 1% of the total gain"
        in first.best["stopped"]
    )
    lowest = np.minimum.accumulate(first.history.column("objective").to_numpy())
    gained = lowest[0] - lowest[-1]
    assert lowest[-4] - lowest[-1] <= 0.01 * gained < lowest[-5] - lowest[-2]
    again, _ = tune(tmp_path, change)
    assert again.iterations_run == 0
    longer, _ = tune(tmp_path, change | {"patience": 8})
    assert longer.iterations_run > 0
    assert (
        longer.history.column("objective").to_pylist()[: done + 1]
        == first.history.column("objective").to_pylist()
    )


@pytest.mark.release
def test_one_start_that_still_gains_goes_on(tmp_path):
    """A tuning of two starts ends when neither gains; one of both that always falls is not waited for."""
    change = {"iterations": 60, "patience": 3, "optimizer": "controlled_adam"}
    result, _ = tune(tmp_path / "both", change)
    value = result.history.column("objective").to_numpy().reshape(-1, 2)
    lowest = np.minimum.accumulate(value)
    gained = lowest[0].min() - lowest[-1].min()
    assert (lowest[-4] - lowest[-1] <= 0.01 * gained).all()
    assert (lowest[-5] - lowest[-2] > 0.01 * gained).any()
    lost, _ = tune(tmp_path / "lost", change, falls=lambda points: jnp.arange(len(points)) == 1)
    assert lost.best["stopped"]
    assert lost.best["start"] == 0


def test_start_and_best_are_walked_again_from_unseen_starts(tmp_path):
    """By the engine c, eight times each from the same starts; the file has both figures."""
    tuning = Tuning.from_dict(SPEC)
    walker = FakeWalker(falls=lambda values: values["start.yaw"] > 0.005)
    result = run_tuning(tuning, tmp_path, problem=FakeProblem(tuning), simulator=walker)
    verified = json.loads((tmp_path / "best.json").read_text())["verified"]
    assert verified == result.best["verified"]
    assert (verified["engine"], verified["walks"], walker.again, walker.batches) == (
        "c",
        8,
        [16],
        [],
    )
    assert verified["start"]["walks_ok"] == verified["best"]["walks_ok"] < 8
    for point, point_values in (("start", result.start), ("best", result.best)):
        assert verified[point]["metrics"]["speed"] == pytest.approx(
            point_values["metrics"]["speed"], rel=1e-5
        )
        assert verified[point]["objective"] == pytest.approx(point_values["objective"], rel=1e-5)


@pytest.mark.release
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_process_is_gone_on_with(tmp_path, reference, number):
    """Killed by a signal in its fourth evaluation, the tuning loses no more than that one."""
    out, log = tmp_path / "out", tmp_path / "log"
    script = Path(__file__).parents[1] / "fakes" / "tune_fake.py"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, script, out, log], stdout=subprocess.PIPE, text=True, env=environment
    )
    waited = time.monotonic()
    while (log.read_text().count("\n") if log.exists() else 0) < 4:
        assert process.poll() is None, "the tuning ended too early"
        assert time.monotonic() - waited < 120
        time.sleep(0.005)
    process.send_signal(number)
    printed, _ = process.communicate(timeout=60)
    if number == signal.SIGTERM:
        assert process.returncode == 3
        assert f"nermo-mjx tune {out}/tuning.yaml --out {out}" in printed
    result, _ = tune(out)
    assert result.iterations_run == 4
    assert same(result, reference)
    sessions = json.loads((out / "run.json").read_text())["sessions"]
    assert [session["begun_at"] for session in sessions] == [0, 7 - result.iterations_run]
