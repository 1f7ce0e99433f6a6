# Tests of runs/ray_workers.py, runs/workers.py
"""A sweep on a Ray cluster: the table of one process, whoever computed it, and however many were lost meanwhile."""

from __future__ import annotations

import collections
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from fakes.ray_fake import STARTS
from fakes.sweep_fake import SPEC, FakeSimulator
from fakes.tune_fake import SPEC as TUNING
from fakes.tune_fake import FakeProblem

from nermo_mjx.cli import main
from nermo_mjx.experiments.run import run_experiments
from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.runs.ray_workers import RayWorkers
from nermo_mjx.runs.workers import LocalWorkers, WorkersLost
from nermo_mjx.sweep import read_table, run_sweep
from nermo_mjx.version import __version__

pytestmark = pytest.mark.release

FAKE = Path(__file__).parents[1] / "fakes" / "ray_fake.py"
WALKS = {
    "vary": {"frequency": {"linspace": [0.7, 1.2, 7]}},
    "run": {"cycles": 2, "warmup_cycles": 1},
    "plots": False,
}


@pytest.fixture(scope="module", autouse=True)
def ray():
    """Skips where Ray is not installed."""
    return pytest.importorskip("ray", reason="Ray is not installed: pip install 'nermo-mjx[ray]'")


def started(*arguments):
    """A process of `ray_fake.py`."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        [sys.executable, FAKE, *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def told(process):
    """The final output of a process of `ray_fake.py`."""
    out, log = process.communicate(timeout=300)
    assert process.returncode == 0, log[-3000:]
    return json.loads(out.splitlines()[-1])


def computed(log):
    """How often each chunk was begun, and by how many processes in all."""
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    return collections.Counter(tuple(first) for _, *first in lines), {line[0] for line in lines}


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """Three jobs on one cluster whose nodes come and go: where they are, and how they ended."""
    out = tmp_path_factory.mktemp("nodes")
    (out / "sweep.yaml").write_text(json.dumps(WALKS | {"chunk": 3}))
    return out, told(started("nodes", out))


def test_a_cluster_that_loses_and_gains_nodes_makes_the_undisturbed_table(tmp_path, nodes):
    """Three nodes, one killed, one added: bit for bit, and only what the lost one was at is computed again."""
    undisturbed, (out, reports) = run_sweep(SPEC, tmp_path, simulator=FakeSimulator()).table, nodes
    assert (reports["sweep"]["complete"], reports["sweep"]["chunks_run"]) == (True, 36)
    assert read_table(out / "sweep").equals(undisturbed)
    (sentence,) = reports["sweep"]["said"]
    assert re.fullmatch(
        r"a worker on \S+ \(\S+\) is lost \(\w+\); what it computed is computed again\.", sentence
    )
    times, processes = computed(out / "sweep.log")
    assert len(times) == 36
    assert sum(times.values()) <= 37, "the one chunk in flight"
    assert len(processes) >= 3


@pytest.mark.parametrize(
    "number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_driver_that_is_killed_goes_on_from_what_it_wrote(tmp_path, number):
    """The process that writes is gone: no worker of it is left, and at most what was not written yet is lost."""
    undisturbed = run_sweep(SPEC, tmp_path / "one", simulator=FakeSimulator()).table
    process = started("driver", tmp_path / "out", tmp_path / "log")
    began = time.monotonic()
    while len(list(tmp_path.glob("out/results/*.parquet"))) < 8:
        assert process.poll() is None, process.communicate()[1][-3000:]
        assert time.monotonic() - began < 200
        time.sleep(0.05)
    process.send_signal(number)
    _, log = process.communicate(timeout=60)
    assert ("Interrupted: stopped; what is finished is kept" in log) == (
        number == signal.SIGTERM
    ), log[-3000:]
    stored_chunks = len(list(tmp_path.glob("out/results/*.parquet")))
    assert (
        told(started("driver", tmp_path / "out", tmp_path / "log"))["chunks_run"]
        == 36 - stored_chunks
    )
    assert read_table(tmp_path / "out").equals(undisturbed)
    times, processes = computed(tmp_path / "log")
    assert len(times) == 36
    assert sum(times.values()) <= 36 + 3, "one computed, one on its way, one being written"
    assert len(processes) == 2


def test_a_tuning_on_a_cluster_that_loses_a_node_finds_what_one_process_finds(tmp_path, nodes):
    """Five starts on three nodes are shares of two: the numbers are those of one batch but for XLA's rounding."""
    (out, reports), tuning = nodes, Tuning.from_dict(STARTS)
    reference = run_tuning(tuning, tmp_path, problem=FakeProblem(tuning))
    assert (reports["tuning"]["iterations"], len(reports["tuning"]["said"])) == (
        reference.iterations_run,
        1,
    )
    table = pq.read_table(out / "tuning" / "history.parquet").drop_columns(["wall_seconds"])
    for name in table.column_names:
        theirs, ours = (
            table_of_tuning.column(name).to_pylist()
            for table_of_tuning in (table, reference.history)
        )
        assert theirs == (
            pytest.approx(ours, rel=1e-4, abs=1e-5, nan_ok=True) if name != "code" else ours
        ), name
    processes, sizes = zip(
        *(line.split() for line in (out / "tuning.log").read_text().splitlines()), strict=True
    )
    assert set(sizes) == {"2"}, "one shape, so that each worker compiles once"
    assert len(sizes) <= 3 * reference.iterations_run + 1, "the share in flight"
    assert len(set(processes)) == 3


def test_the_command_makes_the_table_of_one_process_on_ray(tmp_path, nodes, simulator):
    """Real walks in MuJoCo C, bit for bit, whoever simulated them."""
    walked, (out, reports) = (
        run_sweep(WALKS, tmp_path, chunk=2, simulator=simulator("c")).table,
        nodes,
    )
    assert reports["command"]["chunks_run"] == 3, reports["command"]
    table = read_table(out / "command")
    for name in walked.column_names:
        np.testing.assert_array_equal(
            table.column(name), walked.column(name), strict=True, err_msg=name
        )


@pytest.mark.long
def test_experiments_on_a_cluster_are_those_of_one_process(tmp_path, monkeypatch):
    """Real walks in MuJoCo C, bit for bit: tables of experiments and bodies."""
    monkeypatch.setattr(
        "nermo_mjx.experiments.run.BATCH_BODIES", 1
    )  # as there; the seed follows a batch's first body
    report = told(started("real", tmp_path))
    names = ["balance", "body"]
    assert report["names"] == names
    assert {"balance", "body", "balance, 3 bodies", "body, 3 bodies"} <= set(report["done"])
    run_experiments(names, tmp_path / "one", engine="c", quick=True, bodies=3)
    for name in (*names, *(f"{name}-bodies" for name in names)):
        theirs, ours = (
            pq.read_table(tmp_path / out / "results" / f"{name}.parquet")
            for out in ("experiments", "one")
        )
        assert theirs.column_names == ours.column_names
        for column in ours.column_names:
            np.testing.assert_array_equal(
                theirs[column], ours[column], strict=True, err_msg=f"{name} {column}"
            )


def test_tasks_and_nodes_that_fail_are_named(tmp_path):
    """What fails in a task, kills its worker again and again, has other code, or cannot run, is one sentence each."""
    output = told(started("tasks"))
    outcomes = output["ended"]
    assert outcomes["None"] == {str(k): 2 * k for k in range(6)}
    assert outcomes["3"] == "3: ZeroDivisionError('not 3')"
    assert re.fullmatch(
        r"3: RuntimeError\('its worker was lost 3 times \(\w+\)'\)", outcomes["dies"]
    )
    node = r"node \S+ \(127\.0\.0\.1\) is not used: "
    assert re.fullmatch(
        rf"{node}it has other code: nermo-mjx 9\.9\.9, not {re.escape(__version__)}\.",
        outcomes["code"],
    )
    assert re.fullmatch(
        rf"{node}no worker starts there: RuntimeError: no engine here\.", outcomes["cold"]
    )
    assert {outcomes["code"], outcomes["cold"]} < set(output["said"])
    loopback = {"127.0.0.1", "::ffff:127.0.0.1", "::1"}
    assert output["addresses"]
    assert set(output["addresses"]) <= loopback, "who is elsewhere cannot run code here"


@pytest.mark.long
def test_real_walks_are_the_same_while_nodes_and_the_driver_are_killed(tmp_path):
    """A small run of `ray_disturbed.py`; 100,000 walks are run by hand."""
    command = [
        sys.executable,
        FAKE.with_name("ray_disturbed.py"),
        tmp_path,
        "--rows",
        "1000",
        "--chunk",
        "25",
        "--cycles",
        "0.25",
        "--every",
        "10",
        "--kill-driver",
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.run(
        [*map(str, command)], env=environment, capture_output=True, text=True, timeout=580
    )
    assert process.returncode == 0, process.stdout + process.stderr[-3000:]
    report = json.loads(process.stdout.splitlines()[-1])
    assert (report["same"], report["unexplained"], report["chunks"], report["drivers_lost"]) == (
        True,
        0,
        40,
        1,
    )
    assert report["nodes_killed"] >= 1


@pytest.mark.parametrize("command", ["sweep", "tune", "experiment"])
def test_an_address_without_ray_is_wrong_use(tmp_path, command):
    """One sentence, and no directory."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(json.dumps(TUNING if command == "tune" else WALKS))
    subject = {"experiment": ["body"]}.get(command, [str(spec)])
    result = CliRunner().invoke(
        main, [command, *subject, "--out", str(tmp_path / "out"), "--ray-address", "auto"]
    )
    assert result.exit_code == 2
    assert "--ray-address is given without --workers ray" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("nonsense", "expected ADDRESS:PORT"),
        ("ray://a:1", "expected ADDRESS:PORT"),
        ("127.0.0.1:1", "refused"),
    ],
)
def test_a_cluster_that_is_not_there_is_one_sentence_at_once(address, why):
    """Ray itself would try to connect for minutes."""
    began = time.monotonic()
    with (
        pytest.raises(WorkersLost, match=rf"no Ray cluster at {address}: .*{why}"),
        RayWorkers(address),
    ):
        pass
    assert time.monotonic() - began < 5


def test_this_process_asks_for_a_task_when_it_is_free():
    """The local side of the seam: one at a time, in order, and its progress by the task's key."""
    items, results_and_times = [], []

    class Computer:
        def __call__(self, task, progress):
            progress(0.5)
            return 2 * task

        warm = stamp = lambda self: None

    workers = LocalWorkers()
    workers.begin(Computer())
    results = workers.results(
        ((items.append(k), (k, 10 * k))[1] for k in range(3)),
        lambda *arguments: results_and_times.append(arguments),
    )
    assert next(results) == (0, 0)
    assert (items, results_and_times) == ([0], [(0, 0.5)])
    assert list(results) == [(1, 20), (2, 40)]


def test_a_process_that_would_open_the_cluster_to_other_machines_is_refused():
    """Ray reads the switch when it is imported, and the package does not change Ray."""
    code = "import ray; from nermo_mjx.runs.ray_workers import RayWorkers; RayWorkers().__enter__()"
    environment = {
        name: value
        for name, value in os.environ.items()
        if name != "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
    }
    process = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert process.returncode == 1
    assert "set this environment variable before `import ray`" in process.stderr
