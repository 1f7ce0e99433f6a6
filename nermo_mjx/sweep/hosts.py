"""One sweep on several hosts: who this process is among those that run the same command.

A cluster (SLURM, Open MPI, an indexed job of Kubernetes) says so in the environment, a user by options or by
JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID. The processes meet once, by `jax.distributed`; then each
runs its share of the chunks alone, with its own devices, and sees in the directory how far the others are.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import jax

from nermo_mjx.sweep.reading import SpecError

#: Seconds within which all processes must have come.
MEETING = 300
_RENDEZVOUS = Path(__file__).with_name("rendezvous.py")


class HostsError(RuntimeError):
    """The processes of several hosts have not found each other; the message says what to do."""


@dataclasses.dataclass(frozen=True)
class Hosts:
    """This process among all that run the sweep: index from 0 to count - 1."""

    index: int
    count: int


@dataclasses.dataclass(frozen=True)
class Launch:
    """What is known about the processes before they meet; None is for JAX to find out.

    Attributes:
        coordinator: address:port at which process 0 is met.
        processes: their number.
        process_id: which one this is.
    """

    coordinator: str | None = None
    processes: int | None = None
    process_id: int | None = None


def join(
    coordinator: str | None = None,
    processes: int | None = None,
    process_id: int | None = None,
    *,
    notify: Callable[[str], None] | None = None,
    timeout: int = MEETING,
) -> Hosts | None:
    """Meet the other processes of this command; None if it runs on one host alone.

    Args:
        coordinator, processes, process_id: see `Launch`; all of them, or none where the environment says it.
        notify: called with a sentence when it waits, and when not all have come.
        timeout: seconds to wait for them.

    Raises:
        SpecError: the arguments do not make sense.
        HostsError: not all have come, and without them it is not known which share is this process's.
    """
    given = Launch(coordinator, processes, process_id)
    launch = _checked(given) if given != Launch() else launched(os.environ)
    if jax.distributed.is_initialized():
        return Hosts(jax.process_index(), jax.process_count())
    if launch is None:
        return None
    device = own_device(os.environ)
    if device is not None:
        jax.config.update("jax_cuda_visible_devices", device)
    if notify:
        which = f"process {launch.process_id} of {launch.processes}" if launch.processes else "this process"
        notify(f"{which} waits for the others, {timeout} s at most.")
    met = _meet(launch, timeout)
    if isinstance(met, Hosts):
        return met
    if launch.processes is None or launch.process_id is None:
        raise HostsError(f"the processes of this job have not found each other ({met}); or give each one its part of "
                         "the work by --shard I/N.")  # fmt: skip
    if notify:
        notify(f"not all {launch.processes} processes have come within {timeout} s ({met}): "
               f"process {launch.process_id} begins its part without them.")  # fmt: skip
    return Hosts(launch.process_id, launch.processes)


def launched(environment: Mapping[str, str]) -> Launch | None:
    """Whether something has started several processes of this command, and what it says about them.

    A shell within a job is not enough, nor is a job or a step of one task.
    """
    address = environment.get("JAX_COORDINATOR_ADDRESS")
    count = _number(environment, "JAX_NUM_PROCESSES")
    rank = _number(environment, "JAX_PROCESS_ID", "JOB_COMPLETION_INDEX")
    if address and count is not None and rank is not None:
        return Launch(address, count, rank) if count > 1 else None
    for tasks, task in (("SLURM_STEP_NUM_TASKS", "SLURM_PROCID"), ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK")):
        count, rank = _number(environment, tasks), _number(environment, task)
        if rank is not None and count is not None and count > 1:
            return Launch(address, count, rank)
    indexed = "KUBERNETES_SERVICE_HOST" in environment and "JOB_COMPLETION_INDEX" in environment
    if indexed and importlib.util.find_spec("kubernetes") is not None:  # by which JAX asks the cluster
        return Launch(address)
    return None


def own_device(environment: Mapping[str, str]) -> str | None:
    """The GPU of this process where several of them share a host and its GPUs; None if it may use all that it sees."""
    seen = environment.get("CUDA_VISIBLE_DEVICES", "")
    tasks = [int(each) for each in re.findall(r"(\d+)(?:\(x\d+\))?", environment.get("SLURM_STEP_TASKS_PER_NODE", ""))]
    local = environment.get("SLURM_LOCALID")
    if not tasks:
        tasks = [int(environment.get("OMPI_COMM_WORLD_LOCAL_SIZE", "1"))]
        local = environment.get("OMPI_COMM_WORLD_LOCAL_RANK")
    each_has_its_own = bool(seen) and "," not in seen
    return local if max(tasks) > 1 and not each_has_its_own else None


def _number(environment: Mapping[str, str], *names: str) -> int | None:
    """The first of some variables that holds a whole number."""
    return next((int(environment[name]) for name in names if environment.get(name, "").isdecimal()), None)


def _checked(given: Launch) -> Launch:
    options = {"--coordinator": given.coordinator, "--processes": given.processes, "--process-id": given.process_id}
    missing = [name for name, value in options.items() if value is None]
    if missing:
        raise SpecError(f"{' and '.join(missing)} must be given, too: all of {', '.join(options)}, or none.")
    assert given.coordinator is not None
    assert given.processes is not None
    assert given.process_id is not None
    if not re.fullmatch(r".+:\d+", given.coordinator):
        raise SpecError(f"--coordinator is {given.coordinator!r}: expected ADDRESS:PORT of process 0.")
    if not 0 <= given.process_id < given.processes:
        raise SpecError(f"--process-id is {given.process_id}: allowed is 0 to {given.processes - 1}.")
    return given


def _meet(launch: Launch, timeout: int) -> Hosts | str:
    """Where this process stands among those that came; else what went wrong."""
    known = ("" if each is None else str(each) for each in dataclasses.astuple(launch))
    # -P: the modules beside the file are not to be found under their bare names.
    command = [sys.executable, "-P", str(_RENDEZVOUS), *known, str(timeout)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=timeout + 60)
    except subprocess.TimeoutExpired:
        return "no answer"
    found = re.search(r"^(\d+) (\d+)$", done.stdout, re.MULTILINE)
    return Hosts(int(found[1]), int(found[2])) if found else _reason(done.stderr)


def _reason(log: str) -> str:
    """The line of the child's log that says what went wrong."""
    lines = [line for line in log.splitlines() if re.search(r"Error|DEADLINE|UNAVAILABLE|ALREADY_EXISTS", line)]
    return lines[-1].strip()[:200] if lines else "no answer"
