"""A sweep of real walks on a Ray cluster of three nodes, one of which is killed, and another added, repeatedly.

ray_disturbed.py OUT [--rows N] [--cycles C] [--chunk N] [--every SECONDS] [--kill-driver]: the table of one process and
that of a cluster on this machine's loopback interface, in folders of OUT; what is there already is not computed again.
With `--kill-driver` the process that writes is killed by SIGKILL after a third of the rows, and started again. Prints
what happened as JSON, `same` and `in_flight` among it, and ends with 1 if the tables differ or a chunk was computed
again that was not in flight on a node, or for a driver, that was lost.

Only loopback is needed. To check this:
unshare -n sh -c 'ip link set lo up && python tests/fakes/ray_disturbed.py OUT'.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

from nermo_mjx.runs import ray_workers

WALK = {"physics": "fast", "spine": "stride_extension"}


class Walks:
    """Real walks in MuJoCo C; tells which batch it begins and ends, and on which node."""

    engine = "c"

    def __init__(self, log):
        self.log, self._simulator = str(log), None

    def __getstate__(self):
        return self.__dict__ | {"_simulator": None}

    def run(self, values, run, **options):
        import ray

        from nermo_mjx.rollout import Setup, Simulator

        self._simulator = self._simulator or Simulator(Setup(**WALK), self.engine)
        description = (
            ray.get_runtime_context().get_node_id(),
            os.getpid(),
            float(values["spine.phase"][0]),
        )
        told(self.log, "begun", *description)
        result = self._simulator.run(values, run, **options)
        told(self.log, "ended", *description)
        return result


def drive(options, out):
    """The process that hands out chunks and writes the table, on a cluster that is there, or alone."""
    from nermo_mjx.sweep import run_sweep

    vary = {"spine.phase": {"uniform": [-3.1, 3.1]}, "spine.amplitude": {"uniform": [0.0, 0.4]}}
    sweep = WALK | {"run": {"cycles": options.cycles}, "set": {"frequency": 2.0}, "plots": False}
    sweep |= {"vary": vary, "sample": {"sobol": options.rows}}
    if options.drive == "alone":
        return run_sweep(sweep, out, engine="c", chunk=options.chunk)
    with ray_workers.RayWorkers(
        options.drive, lambda sentence: print(sentence, file=sys.stderr, flush=True)
    ) as workers:
        return run_sweep(
            sweep,
            out,
            engine="c",
            chunk=options.chunk,
            workers=workers,
            simulator=Walks(f"{out}.log"),
        )


def started(options, address):
    """A driver process."""
    flags = [f"--{name}={getattr(options, name)}" for name in ("rows", "chunk", "cycles")]
    kill = ["--kill-driver"] * options.kill_driver
    return subprocess.Popen(
        [sys.executable, __file__, options.out, *flags, *kill, "--drive", address]
    )


def told(log, *words):
    """A line in the log."""
    with open(log, "a") as file:
        file.write(json.dumps(words) + "\n")


def disturbed(options, out, log):
    """The sweep while nodes go and come, and the driver once if that is asked for."""
    os.environ.update(ray_workers.QUIET | ray_workers.LOOPBACK)  # before Ray is imported
    from ray.cluster_utils import Cluster

    cluster, others = (
        Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}),
        [],
    )
    told(log, "driver")
    driver, last_look, draw = started(options, cluster.address), time.monotonic(), random.Random(0)
    kill_driver = options.kill_driver
    try:
        while driver.poll() is None:
            while len(others) < 2:
                try:
                    others.append(cluster.add_node(num_cpus=1))
                except (
                    Exception
                ) as error:  # a busy machine takes more than the 30 s that Ray gives a node
                    print(f"a node did not start: {error}", file=sys.stderr)
            time.sleep(0.2)
            chunks = len(list(out.glob("results/*.parquet")))
            if kill_driver and chunks * options.chunk * 3 > options.rows:
                kill_driver = False
                driver.kill()
                driver.wait()
                told(log, "driver")
                driver = started(options, cluster.address)
            if chunks and time.monotonic() - last_look > options.every:
                last_look = time.monotonic()
                node = others.pop(draw.randrange(len(others)))
                told(log, "killed", node.node_id)
                cluster.remove_node(node, allow_graceful=False)
        if driver.returncode:
            raise SystemExit(f"the driver ended with {driver.returncode}")
    finally:
        driver.terminate()
        driver.wait()
        cluster.shutdown()


def account(log):
    """Contents of the log: chunks, how many were restarted, and how many restarts no loss explains.

    A beginning that was not its chunk's last is explained if its node was killed, or its driver, and it was the last
    one of its process, or the last but one, whose result was on its way.
    """
    killed, drivers, ended_count, by_chunk, by_process = set(), 0, 0, {}, {}
    for event, *entries in map(json.loads, log.read_text().splitlines()):
        drivers, ended_count = drivers + (event == "driver"), ended_count + (event == "ended")
        if event == "killed":
            killed.add(entries[0])
        if event == "begun":
            node, process, chunk = entries
            by_chunk.setdefault(chunk, []).append((drivers, node, process))
            by_process.setdefault((drivers, node, process), []).append(chunk)
    repeated = [
        (chunk, process_id) for chunk, several in by_chunk.items() for process_id in several[:-1]
    ]
    unexplained = [
        chunk
        for chunk, process_id in repeated
        if not (process_id[1] in killed or process_id[0] < drivers)
        or chunk not in by_process[process_id][-2:]
    ]
    return {
        "nodes_killed": len(killed),
        "drivers_lost": drivers - 1,
        "chunks": len(by_chunk),
        "ended": ended_count,
        "in_flight": len(repeated),
        "unexplained": len(unexplained),
        "processes": len(by_process),
    }


def same(first, second):
    """Whether two tables are the same bit for bit, NaN included."""
    pairs = [(first.column(name), second.column(name)) for name in first.column_names]
    return first.schema == second.schema and all(
        a.equals(b) or a.to_numpy().tobytes() == b.to_numpy().tobytes() for a, b in pairs
    )


def main():
    """See above."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--chunk", type=int, default=250)
    parser.add_argument("--cycles", type=float, default=1.0)
    parser.add_argument("--every", type=float, default=20.0)
    parser.add_argument("--kill-driver", action="store_true")
    parser.add_argument("--drive", help=argparse.SUPPRESS)
    options = parser.parse_args()
    reference, out = (
        options.out / "one",
        options.out / ("driver" if options.kill_driver else "nodes"),
    )
    if options.drive:
        drive(options, reference if options.drive == "alone" else out)
        return 0
    from nermo_mjx.sweep import read_table

    log, began = Path(f"{out}.log"), time.monotonic()
    exit_code = started(options, "alone").wait()
    between = time.monotonic()
    disturbed(options, out, log)
    report = {
        "same": not exit_code and same(read_table(reference), read_table(out)),
        "rows": options.rows,
        **account(log),
        "one_process_s": round(between - began, 1),
        "cluster_s": round(time.monotonic() - between, 1),
    }
    print(json.dumps(report))
    return 0 if report["same"] and not report["unexplained"] else 1


if __name__ == "__main__":
    sys.exit(main())
