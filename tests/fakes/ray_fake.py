"""What runs on Ray, each in a process of its own, on this machine's loopback interface; prints what happened as JSON.

ray_fake.py nodes OUT: on one cluster of three nodes a sweep, OUT/sweep, of `sweep_fake`, while one node is killed and
another one comes; a tuning, OUT/tuning, of `tune_fake` from five starts, while one is killed; and the command that
sweeps OUT/sweep.yaml into OUT/command. OUT/sweep.log gets a line for each batch that is begun: the process, and the
frequency, amplitude and phase of its first row.
ray_fake.py driver OUT LOG: the same sweep on a cluster of one node, to be killed.
ray_fake.py real OUT: two experiments with three bodies, OUT/experiments, on two nodes.
ray_fake.py tasks: a cluster of one node, computers that it takes and does not take, and where it listens.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import sys

from fakes.sweep_fake import SPEC, FakeSimulator
from fakes.tune_fake import SPEC as TUNING
from fakes.tune_fake import FakeProblem
from nermo_mjx.runs import Watch, ray_workers, stamp
from nermo_mjx.runs.workers import TaskFailed, WorkersLost

#: A tuning from as many starts as three workers do not share evenly.
STARTS = TUNING | {"starts": 5}


class LoggingSimulator(FakeSimulator):
    """Reports which batch it starts; only once it runs, since it is pickled first."""

    def run(self, values, run, **options):
        first = [float(values[name][0]) for name in ("frequency", "spine.amplitude", "spine.phase")]
        with open(self.log, "a") as file:
            file.write(json.dumps([os.getpid(), *first]) + "\n")
        log, self.log = self.log, None
        try:
            return super().run(values, run, **options)
        finally:
            self.log = log


@contextlib.contextmanager
def cluster_of(others):
    """A cluster of a head and so many other nodes, and these."""
    os.environ.update(ray_workers.QUIET | ray_workers.LOOPBACK)  # before Ray is imported
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    try:
        yield cluster, [cluster.add_node(num_cpus=1) for _ in range(others)]
    finally:
        cluster.shutdown()


def nodes(out):
    """Jobs while nodes come and go."""
    from click.testing import CliRunner

    from nermo_mjx.cli import main
    from nermo_mjx.optimize import Tuning, run_tuning
    from nermo_mjx.sweep import run_sweep

    tuning, killed, reports = Tuning.from_dict(STARTS), [], {}
    with cluster_of(2) as (cluster, others):

        def swept(progress):
            """After a third of the rows one node is killed, after two thirds another one comes."""
            if progress.done >= 12 and not killed:
                killed.append(others.pop())
                cluster.remove_node(killed[0], allow_graceful=False)
            if progress.done >= 24 and len(others) == 1:
                others.append(cluster.add_node(num_cpus=1))

        def tuned(progress):
            """After three iterations one node is killed."""
            if progress.done >= 4 and len(others) == 2:
                cluster.remove_node(others.pop(), allow_graceful=False)

        messages = []
        with ray_workers.RayWorkers(cluster.address, messages.append) as workers:
            simulator = LoggingSimulator(delay=0.3, log=f"{out}/sweep.log")
            result = run_sweep(
                SPEC,
                f"{out}/sweep",
                chunk=1,
                workers=workers,
                simulator=simulator,
                watch=Watch(swept),
            )
        reports["sweep"] = {
            "complete": result.complete,
            "said": messages,
            "chunks_run": result.chunks_run,
        }
        messages = []
        with ray_workers.RayWorkers(cluster.address, messages.append) as workers:
            problem = FakeProblem(tuning, delay=0.5, log=f"{out}/tuning.log")
            result = run_tuning(
                tuning, f"{out}/tuning", problem=problem, workers=workers, watch=Watch(tuned)
            )
        reports["tuning"] = {"said": messages, "iterations": result.iterations_run}
        command = f"sweep {out}/sweep.yaml --out {out}/command --engine c --workers ray --json --ray-address"
        result = CliRunner().invoke(main, [*command.split(), cluster.address])
        reports["command"] = json.loads(result.stdout) if result.exit_code == 0 else result.stderr
    print(json.dumps(reports))


def real(out):
    """Experiments, and their bodies one by one."""
    from nermo_mjx.experiments import run

    run.BATCH_BODIES = 1
    finished, names = [], ["balance", "body"]
    with cluster_of(1) as (cluster, _), ray_workers.RayWorkers(cluster.address) as workers:
        watch = Watch(lambda now: finished.append(now.what))
        options = {"engine": "c", "quick": True, "bodies": 3, "workers": workers, "watch": watch}
        result = run.run_experiments(names, f"{out}/experiments", **options)
    result_names = [run_result.name for run_result in result.results]
    print(json.dumps({"names": result_names, "done": sorted(set(finished))}))


def driver(out, log):
    """A sweep whose driver can be killed."""
    from nermo_mjx.sweep import run_sweep

    with ray_workers.RayWorkers() as workers:
        result = run_sweep(
            SPEC, out, chunk=1, workers=workers, simulator=LoggingSimulator(delay=0.3, log=log)
        )
    print(json.dumps({"complete": result.complete, "chunks_run": result.chunks_run}))


class Doubling:
    """Doubles numbers; of other code on the cluster, cold there, or neither."""

    def __init__(self, flaw=None):
        self.flaw, self.home = flaw, os.getpid()

    def stamp(self):
        local_stamp = stamp("numbers", "c")
        return (
            dataclasses.replace(local_stamp, package="9.9.9")
            if self.flaw == "code" and os.getpid() != self.home
            else local_stamp
        )

    def warm(self):
        if self.flaw == "cold":
            raise RuntimeError("no engine here")

    def __call__(self, task, progress=None):
        if task == self.flaw:
            raise ZeroDivisionError(f"not {task}")
        if (self.flaw, task) == ("dies", 3):
            os.kill(os.getpid(), signal.SIGKILL)
        return 2 * task


def listening():
    """Addresses at which this process and its descendants listen."""
    import psutil  # Ray brings it

    addresses, this_process = set(), psutil.Process()
    for process in (this_process, *this_process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            addresses |= {
                connection.laddr.ip
                for connection in process.net_connections("tcp")
                if connection.status == psutil.CONN_LISTEN
            }
    return addresses


def tasks():
    """Results of tasks, by the flaw of their computer."""
    outcomes, messages = {}, []
    with ray_workers.RayWorkers(say=messages.append) as workers:
        for flaw in (None, 3, "dies", "code", "cold"):
            workers.begin(Doubling(flaw))
            try:
                outcomes[str(flaw)] = dict(workers.results(((k, k) for k in range(6)), print))
            except TaskFailed as error:
                outcomes[str(flaw)] = f"{error.key}: {error.__cause__!r}"
            except WorkersLost as error:
                outcomes[str(flaw)] = str(error)
        addresses = listening()
    print(json.dumps({"ended": outcomes, "said": messages, "addresses": sorted(addresses)}))


if __name__ == "__main__":
    {function.__name__: function for function in (nodes, driver, real, tasks)}[sys.argv[1]](
        *sys.argv[2:]
    )
