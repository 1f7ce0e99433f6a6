"""One sweep on several hosts: who they are, that they share the work, and what becomes of it when one is lost."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from sweep_fake import SPEC, FakeSimulator

from nermo_mjx.cli import main
from nermo_mjx.sweep import Hosts, HostsError, SpecError, SweepError, join, read_table, run_sweep
from nermo_mjx.sweep.hosts import Launch, launched, own_device
from nermo_mjx.sweep.presence import Presence

WALKS = {
    "vary": {"frequency": {"linspace": [0.7, 1.2, 7]}},
    "run": {"cycles": 2, "warmup_cycles": 1},
    "chunk": 2,
    "plots": False,
}
SLURM = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_PROCID": "2", "SLURM_LOCALID": "0"}


# --- who they are


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, None),
        (SLURM | {"SLURM_STEP_NUM_TASKS": "4"}, Launch(None, 4, 2)),
        (SLURM, None),  # a batch script, or a shell within an allocation of four tasks
        (SLURM | {"SLURM_STEP_NUM_TASKS": "1", "SLURM_PROCID": "0"}, None),  # an interactive shell
        ({"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "0"}, Launch(None, 2, 0)),
        ({"JAX_COORDINATOR_ADDRESS": "a:1"}, None),
        (
            {"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "3", "JAX_PROCESS_ID": "0"},
            Launch("a:1", 3, 0),
        ),
        (
            {"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "3", "JOB_COMPLETION_INDEX": "2"},
            Launch("a:1", 3, 2),
        ),
        ({"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "1", "JAX_PROCESS_ID": "0"}, None),
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1"}, None),  # any pod
    ],
)
def test_only_a_launcher_of_several_processes_makes_a_sweep_distributed(environment, expected):
    """What srun, mpirun, an indexed job or the user says; a shell of one task within a job says nothing."""
    assert launched(environment) == expected


def test_a_job_of_kubernetes_is_left_to_jax_where_it_can_ask_the_cluster(monkeypatch):
    """With the package `kubernetes`, an indexed job needs no further options."""
    environment = {"KUBERNETES_SERVICE_HOST": "10.0.0.1", "JOB_COMPLETION_INDEX": "1"}
    for found, expected in ((None, None), (object(), Launch())):
        monkeypatch.setattr("importlib.util.find_spec", lambda name, found=found: found)
        assert launched(environment) == expected


@pytest.mark.parametrize(
    ("environment", "device"),
    [
        ({}, None),
        ({"SLURM_STEP_TASKS_PER_NODE": "1(x3)", "SLURM_LOCALID": "0"}, None),
        ({"SLURM_STEP_TASKS_PER_NODE": "4(x2)", "SLURM_LOCALID": "3"}, "3"),
        ({"SLURM_STEP_TASKS_PER_NODE": "2,1", "SLURM_LOCALID": "1", "CUDA_VISIBLE_DEVICES": "0,1"}, "1"),
        ({"SLURM_STEP_TASKS_PER_NODE": "4(x2)", "SLURM_LOCALID": "3", "CUDA_VISIBLE_DEVICES": "0"}, None),
        ({"OMPI_COMM_WORLD_LOCAL_SIZE": "2", "OMPI_COMM_WORLD_LOCAL_RANK": "1"}, "1"),
    ],
)
def test_one_process_a_host_has_all_its_devices_several_have_one_each(environment, device):
    """Unless the launcher already gave each process its own."""
    assert own_device(environment) == device


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"coordinator": "a:1"}, "--processes and --process-id must be given, too"),
        ({"coordinator": "a", "processes": 2, "process_id": 0}, "expected ADDRESS:PORT"),
        ({"coordinator": "a:1", "processes": 2, "process_id": 2}, "allowed is 0 to 1"),
    ],
)
def test_half_of_the_options_is_wrong_use(given, message):
    """All three of them, and an index that exists."""
    with pytest.raises(SpecError, match=message):
        join(**given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--coordinator", "a:1"], "--processes and --process-id must be given, too"),
        (["--processes", "2", "--shard", "0/2"], "exclude each other"),
    ],
)
def test_wrong_options_of_the_command_end_with_2(tmp_path, options, message):
    """One sentence, and no directory."""
    (tmp_path / "sweep.yaml").write_text(json.dumps(WALKS))
    command = ["sweep", str(tmp_path / "sweep.yaml"), "--out", str(tmp_path / "out"), *options]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not (tmp_path / "out").exists()


def test_nobody_is_waited_for_on_a_host_alone(monkeypatch):
    """Without options and without a launcher nothing is started."""
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("a process was started"))
    for name in (*SLURM, "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE", "JAX_COORDINATOR_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    assert join() is None


def test_who_does_not_come_is_not_needed_where_the_share_is_known(monkeypatch):
    """The others begin, and say so; where only the cluster knows the share, it is an error."""
    said = []
    address = f"127.0.0.1:{free_port()}"
    assert join(address, 2, 1, notify=said.append, timeout=2) == Hosts(1, 2)
    assert said[0] == "process 1 of 2 waits for the others, 2 s at most."
    assert re.match(r"not all 2 processes have come within 2 s \(.+\): process 1 begins its part", said[1])
    monkeypatch.setattr("nermo_mjx.sweep.hosts.launched", lambda _: Launch(address))
    with pytest.raises(HostsError, match="have not found each other"):
        join(timeout=2)


# --- how they share the work


def free_port():
    """A port of the loopback interface that nobody has."""
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return made.getsockname()[1]


def start(out, index, patience, address):
    """A process of two that run the fake sweep."""
    script = Path(__file__).with_name("sweep_fake.py")
    environment = os.environ | {"PYTHONPATH": str(script.parents[1])}
    command = [sys.executable, script, out, address, "2", str(index), str(patience)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The table of one undisturbed process."""
    return run_sweep(SPEC, tmp_path_factory.mktemp("one"), simulator=FakeSimulator()).table


@pytest.fixture(scope="module")
def walked(tmp_path_factory, simulator):
    """Seven real walks in MuJoCo C, by one process in chunks of two."""
    return run_sweep(WALKS, tmp_path_factory.mktemp("walked"), simulator=simulator("c")).table


def assert_same_bits(table, other):
    """Two tables are equal, NaN included."""
    assert table.schema.equals(other.schema, check_metadata=True)
    for name in other.column_names:
        np.testing.assert_array_equal(table.column(name), other.column(name), strict=True, err_msg=name)


def test_two_processes_make_the_table_of_one(tmp_path, walked):
    """The same command twice: they meet on the loopback interface, share the chunks, and the first one sums up."""
    spec, out, address = tmp_path / "sweep.yaml", tmp_path / "out", f"127.0.0.1:{free_port()}"
    spec.write_text(json.dumps(WALKS))  # JSON is YAML
    command = [sys.executable, "-m", "nermo_mjx", "sweep", spec, "--out", out, "--engine", "c", "--json"]
    command += ["--coordinator", address, "--processes", "2", "--process-id"]
    processes = [subprocess.Popen([*command, str(index)], stdout=subprocess.PIPE, text=True) for index in (0, 1)]
    first, second = (json.loads(process.communicate(timeout=200)[0]) for process in processes)
    assert [process.returncode for process in processes] == [0, 0]
    assert (first["chunks_run"], second["chunks_run"]) == (2, 2)
    assert (first["complete"], second["complete"]) == (True, True)
    assert (first["summary"]["rows"], second["summary"]) == (7, {})
    assert_same_bits(read_table(out), walked)
    assert json.loads((out / "summary.json").read_text())["rows"] == 7
    assert len(json.loads((out / "run.json").read_text())["sessions"]) == 2
    assert not list(out.glob(".process-*"))


def test_three_shards_make_the_table_of_one(tmp_path, walked, simulator):
    """Shards 0/3 to 2/3, one after the other: the same numbers, to the last bit."""
    for part in range(3):
        result = run_sweep(WALKS, tmp_path, shard=(part, 3), simulator=simulator("c"))
        assert result.complete == (part == 2)
    assert_same_bits(result.table, walked)


@pytest.mark.parametrize("killed", [0, 1])
def test_a_lost_process_is_named_and_the_other_ends(tmp_path, reference, killed):
    """Killed at its first chunk, process 0 or 1 is given up after its patience; one sentence says what is missing."""
    address = f"127.0.0.1:{free_port()}"
    processes = [start(tmp_path, index, 1.5, address) for index in (0, 1)]
    waited = time.monotonic()
    while not (tmp_path / f".process-{killed}-of-2").exists():
        assert time.monotonic() - waited < 100
        time.sleep(0.01)
    processes[killed].send_signal(signal.SIGKILL)
    printed, _ = processes[1 - killed].communicate(timeout=60)
    processes[killed].communicate()
    assert processes[1 - killed].returncode == 1, printed
    (sentence,) = [line for line in printed.splitlines() if "did not come back" in line]
    expected = rf"process {killed} of 2 did not come back: chunks? [\d, ]+(and \d more )?\(\d+ runs\) of 9 are missing"
    assert re.search(expected, sentence)
    assert "run the same command again" in sentence
    simulator = FakeSimulator()
    again = run_sweep(SPEC, tmp_path, simulator=simulator)
    assert again.table.equals(reference)
    assert 1 <= len(simulator.batches) <= (5 if killed == 0 else 4), "what was finished is kept"


def test_the_first_process_shows_the_progress_of_all(tmp_path, monkeypatch):
    """Process 0 of 2 ends at 100 % of all rows, the other one's included."""
    monkeypatch.setattr("nermo_mjx.sweep.waiting.LOOK", 0.01)
    run_sweep(SPEC, tmp_path, chunk=4, shard=(1, 2), simulator=FakeSimulator())
    seen = []
    result = run_sweep(SPEC, tmp_path, hosts=Hosts(0, 2), simulator=FakeSimulator(), progress=seen.append)
    assert (seen[0].rows, seen[0].rows_done, seen[0].resumed) == (36, 16, 16)
    assert (seen[-1].rows_done, seen[-1].fraction) == (36, 1.0)
    assert result.complete


def test_a_process_that_never_comes_is_given_up(tmp_path, monkeypatch):
    """Its part is missing, and named; a later command with that part alone completes the table."""
    monkeypatch.setattr("nermo_mjx.sweep.waiting.LOOK", 0.01)
    with pytest.raises(SweepError, match=r"process 1 of 2 did not come back: chunks 1, 3, 5, 7 \(16 runs\) of 9 are"):
        run_sweep(SPEC, tmp_path, chunk=4, hosts=Hosts(0, 2), patience=0.1, simulator=FakeSimulator())
    assert run_sweep(SPEC, tmp_path, shard=(1, 2), simulator=FakeSimulator()).complete


def test_a_process_that_changes_its_sign_is_there(tmp_path):
    """Whoever gives signs is not lost, however long it takes; who stops is, after its patience."""
    watcher, other = Presence(tmp_path, Hosts(0, 2), 0.3), Presence(tmp_path, Hosts(1, 2), 0.3)
    with other:
        began = time.monotonic()
        while time.monotonic() - began < 0.8:
            assert not watcher.lost(1)
            time.sleep(0.02)
    assert not watcher.lost(1)
    time.sleep(0.4)
    assert watcher.lost(1)
