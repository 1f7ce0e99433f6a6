"""Workers on a Ray cluster: a warm computer on each node or GPU takes the next task when free; lost ones are replaced.

A computer is an actor. Where there are GPUs and the engine can use them, each has one, and its share of the node's
cores; else one has a whole node, as MuJoCo C and XLA divide a batch among all cores of their process. Nodes may join
and leave at any time; a task whose worker is lost goes to another one. Only this process writes.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import logging
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.workers import Computer, TaskFailed, Tell, WorkersLost

#: Environment that Ray reads on import: no usage reports.
QUIET: Final = {"RAY_USAGE_STATS_ENABLED": "0"}
#: A cluster that is started here listens on 127.0.0.1 alone. The switch is made for Windows and macOS; on Linux Ray
#: replaces a given address of 127.0.0.1 by the machine's. Its workers have the command's nice value rather than 15
#: more, which would starve them on a busy machine.
LOOPBACK: Final = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_worker_niceness": "0"}
#: Seconds between two polls of the nodes, and without any node before giving up.
LOOK, PATIENCE = 1.0, 300.0
#: How often a task's worker may be lost, and how often a node's workers may fail to start.
MAX_WORKER_ATTEMPTS: Final = 3
#: Threads that JAX needs on a CPU, see `nermo_mjx.runtime.SAFE_THREADS`.
_THREADS: Final = 8


class _Actor:
    """A computer on a node."""

    def __init__(self, cores: int) -> None:
        # JAX reads both when it starts. It would take 75 % of a GPU's memory at once, and as many threads as there are
        # cores, of which this one has a share.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        os.environ.setdefault("PJRT_NPROC", str(max(cores, _THREADS)))

    def begin(self, computer: Computer, expected: CodeStamp) -> str:
        """Make the computer ready; how its code differs from the expected one, empty if it does not."""
        stamp = computer.stamp()
        if stamp == expected:
            computer.warm()
            self._computer = computer
        return stamp.unlike(expected)

    def compute(self, task: Any) -> Any:
        return self._computer(task)


@dataclasses.dataclass
class _Worker:
    """An actor, the node it is on, and the task that it computes, if it is not being made ready."""

    actor: Any
    node: str
    key: int | None = None
    task: Any = None


class RayWorkers:
    """Actors of a Ray cluster; use it in a `with` statement, in the main process of a run.

    Args:
        address: of the cluster, "ADDRESS:PORT" or "auto"; by default that in `$RAY_ADDRESS`, or else one of this
            machine alone is started, and ended with the `with` statement.
        say: called with a message if a node is not used, or a worker is lost.
        patience: seconds to wait for a node while there is none.

    Raises:
        WorkersLost: on entry: there is no such cluster.
    """

    def __init__(
        self,
        address: str | None = None,
        say: Callable[[str], None] | None = None,
        patience: float = PATIENCE,
    ) -> None:
        self.address = address or os.environ.get("RAY_ADDRESS") or None
        self._say, self._patience = say or (lambda sentence: None), patience
        self._computer: Computer | None = None
        self._stamp: CodeStamp | None = None
        self._workers: list[_Worker] = []
        self._busy: dict[Any, _Worker] = {}
        #: By the nodes' ids: names for sentences, failures to start a worker there, and why a node is not used.
        self._names: dict[str, str] = {}
        self._failures: collections.Counter[str] = collections.Counter()
        self._refused: dict[str, str] = {}
        self._looked = self._seen = -math.inf

    def __enter__(self) -> RayWorkers:
        if self.address not in (
            None,
            "auto",
            "local",
        ):  # fail at once if nothing listens: Ray would retry for minutes
            host, _, port = str(self.address).rpartition(":")
            message = f"no Ray cluster at {self.address}"
            if not host or "/" in host or not port.isdecimal():
                raise WorkersLost(
                    f"{message}: expected ADDRESS:PORT of its head, such as 10.0.0.1:6379."
                )
            try:
                socket.create_connection((host.strip("[]"), int(port)), timeout=10.0).close()
            except (OSError, OverflowError) as error:
                raise WorkersLost(
                    f"{message}: {getattr(error, 'strerror', None) or error}."
                ) from None
        os.environ.update(QUIET if self.address else QUIET | LOOPBACK)
        import ray
        import ray.util.scheduling_strategies

        self._ray = ray
        if not self.address and ray._private.ray_constants.ENABLE_RAY_CLUSTER:
            raise WorkersLost(
                "Ray was imported before this job without RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER=0, so that the"
                " cluster of this machine would listen to other machines: set this environment variable"
                " before `import ray`."
            )
        # Ray lets SIGTERM end the process at once; a writer must finish what is half done first.
        main = threading.current_thread() is threading.main_thread()
        former_handler = signal.getsignal(signal.SIGTERM) if main else None
        options: dict[str, Any] = {"include_dashboard": False} if self.address is None else {}
        try:
            for last in (False, True):
                try:
                    ray.init(
                        self.address or "local",
                        log_to_driver=False,
                        logging_level=logging.ERROR,
                        **options,
                    )
                    break
                except Exception as error:
                    # Ray allows 30 s for its own start, which a busy machine may need.
                    if (
                        last
                        or self.address is not None
                        or "timed out during startup" not in str(error)
                    ):
                        raise
                    self._say("Ray has not started within its 30 s, and is started once more.")
        except Exception as error:  # Ray raises plain ones, too
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
            raise WorkersLost(
                f"no Ray cluster at {self.address or 'this machine'}: {reason}."
            ) from error
        finally:
            if main:
                signal.signal(signal.SIGTERM, former_handler)
        return self

    def __exit__(self, *_: object) -> None:
        self._end_all()
        self._ray.shutdown()

    @property
    def parts(self) -> int:
        """See `nermo_mjx.runs.workers.Workers`."""
        resources = [node["Resources"] for node in self._nodes()]
        return max(
            1, sum(int(node.get("GPU", 0)) or int(node.get("CPU", 0) >= 1) for node in resources)
        )

    def begin(self, computer: Computer) -> CodeStamp:
        """See `Workers`; the code of this process is the one that all must have."""
        if computer is not self._computer:
            self._computer, self._stamp = computer, computer.stamp()
            self._end_all()
        assert self._stamp is not None
        return self._stamp

    # Long because the states of tasks and nodes change in one loop.
    def results(self, tasks: Iterable[tuple[int, Any]], tell: Tell) -> Iterator[tuple[int, Any]]:
        """See `Workers`; the progress of a task remains unknown until it is done."""
        coming, repeated, lost_counts = (
            iter(tasks),
            collections.deque[tuple[int, Any]](),
            collections.Counter[int](),
        )
        self._seen = time.monotonic()
        try:
            while True:
                self._staff()
                busy = set(map(id, self._busy.values()))
                for worker in [
                    candidate for candidate in self._workers if id(candidate) not in busy
                ]:
                    next_task = repeated.popleft() if repeated else next(coming, None)
                    if next_task is not None:
                        worker.key, worker.task = next_task
                        self._busy[worker.actor.compute.remote(worker.task)] = worker
                if not repeated and not self._computing():
                    # Either everything is done, or there is no worker yet for the remaining tasks.
                    next_task = next(coming, None)
                    if next_task is None:
                        return
                    repeated.append(next_task)
                if self._workers:
                    self._seen = time.monotonic()
                no_workers = bool(self._refused) and all(
                    node["NodeID"] in self._refused for node in self._nodes()
                )
                if not self._workers and (
                    no_workers or time.monotonic() - self._seen > self._patience
                ):
                    raise WorkersLost(
                        " ".join(self._refused.values())
                        or f"no node came within {self._patience:.0f} s."
                    )
                if not self._busy:
                    time.sleep(LOOK)
                    continue
                for reference in self._ray.wait(list(self._busy), timeout=LOOK)[0]:
                    worker = self._busy.pop(reference)
                    key, task, worker.key, worker.task = worker.key, worker.task, None, None
                    if key is None:
                        self._begun(worker, reference)
                        continue
                    try:
                        result = self._ray.get(reference)
                    except self._ray.exceptions.RayTaskError as error:
                        raise TaskFailed(key, _cause(error)) from _cause(error)
                    except self._ray.exceptions.RayError as error:
                        node_name, kind = self._names[worker.node], type(error).__name__
                        self._say(
                            f"a worker on {node_name} is lost ({kind}); what it computed is computed again."
                        )
                        self._drop(worker)
                        repeated.append((key, task))
                        lost_counts[key] += 1
                        if lost_counts[key] >= MAX_WORKER_ATTEMPTS:
                            cause = RuntimeError(
                                f"its worker was lost {MAX_WORKER_ATTEMPTS} times ({kind})"
                            )
                            raise TaskFailed(key, cause) from cause
                    else:
                        yield key, result
        finally:
            for (
                worker
            ) in self._computing():  # ended early: their current tasks are no longer needed
                self._drop(worker)

    def _computing(self) -> list[_Worker]:
        return [worker for worker in self._busy.values() if worker.key is not None]

    def _begun(self, worker: _Worker, reference: Any) -> None:
        """A worker is ready, or its node is not used."""
        try:
            difference = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            alive = any(node["NodeID"] == worker.node for node in self._nodes())
            self._failures[worker.node] += alive
            if self._failures[worker.node] >= MAX_WORKER_ATTEMPTS:
                cause = _cause(error)
                lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
                first = f"{type(cause).__name__}{f': {lines[0]}' if lines else ''}".rstrip(".")[
                    :300
                ]
                self._refuse(worker, f"no worker starts there: {first}")
            else:
                self._drop(worker)
        else:
            if difference:
                self._refuse(worker, f"it has other code: {difference}")

    def _staff(self) -> None:
        """Start workers on nodes that lack some."""
        if time.monotonic() - self._looked < LOOK:
            return
        self._looked = time.monotonic()
        assert self._stamp is not None
        for node in self._nodes():
            name, resources = node["NodeID"], node["Resources"]
            self._names[name] = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            cores, gpus = (
                int(resources.get("CPU", 0)),
                int(resources.get("GPU", 0)) if self._stamp.engine != "c" else 0,
            )
            worker_count = 0 if name in self._refused else gpus or min(cores, 1)
            for _ in range(worker_count - sum(worker.node == name for worker in self._workers)):
                strategy = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
                    name, soft=False
                )
                share = {"num_cpus": max(1, cores // worker_count), "num_gpus": 1 if gpus else 0}
                kind = self._ray.remote(_Actor).options(scheduling_strategy=strategy, **share)
                worker = _Worker(kind.remote(share["num_cpus"]), name)
                self._workers.append(worker)
                self._busy[worker.actor.begin.remote(self._computer, self._stamp)] = worker

    def _refuse(self, worker: _Worker, reason: str) -> None:
        if worker.node not in self._refused:
            self._refused[worker.node] = f"node {self._names[worker.node]} is not used: {reason}."
            self._say(self._refused[worker.node])
        self._drop(worker)

    def _drop(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        self._busy = {
            reference: busy_worker
            for reference, busy_worker in self._busy.items()
            if busy_worker is not worker
        }
        with contextlib.suppress(Exception):  # it may be gone, or never have come
            self._ray.kill(worker.actor)

    def _end_all(self) -> None:
        for worker in list(self._workers):
            self._drop(worker)
        for record in (self._failures, self._refused):
            record.clear()
        self._looked = -math.inf

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]


def _cause(error: BaseException) -> BaseException:
    """The exception raised by a task, instead of Ray's wrapper."""
    return getattr(error, "cause", None) or error
