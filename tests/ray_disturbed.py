"""A sweep of real walks on a Ray cluster of three nodes, one of which is killed, and another added, again and again.

ray_disturbed.py OUT [--rows N] [--cycles C] [--chunk N] [--every SECONDS] [--kill-driver]: the table of one process
and that of a cluster on this machine's loopback interface, in folders of OUT; what is there already is not computed again.
With `--kill-driver` the process that writes is killed by SIGKILL after a third of the rows, and started again. Prints
what happened as JSON, `same` and `in_flight` among it, and ends with 1 if the tables differ or a chunk was computed
again that was not in flight on a node, or for a driver, that was lost.

Nothing but loopback is needed; to show it: unshare -n sh -c 'ip link set lo up && python tests/ray_disturbed.py OUT'.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
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

    def run(self, values, run, **more):
        import ray

        from nermo_mjx.rollout import Setup, Simulator

        self._simulator = self._simulator or Simulator(Setup(**WALK), self.engine)
        context = ray.get_runtime_context()
        about = [context.get_node_id(), context.get_job_id(), os.getpid(), float(values["spine.phase"][0])]
        self._tell("begun", about)
        result = self._simulator.run(values, run, **more)
        self._tell("ended", about)
        return result

    def _tell(self, what, about):
        with open(self.log, "a") as file:
            file.write(json.dumps([what, *about]) + "\n")


def drive(asked, out):
    """The process that hands out chunks and writes the table, on a cluster that is there, or alone."""
    from nermo_mjx.sweep import run_sweep

    vary = {"spine.phase": {"uniform": [-3.1, 3.1]}, "spine.amplitude": {"uniform": [0.0, 0.4]}}
    sweep = WALK | {"run": {"cycles": asked.cycles}, "set": {"frequency": 2.0}, "plots": False}
    sweep |= {"vary": vary, "sample": {"sobol": asked.rows}}
    if asked.drive == "alone":
        return run_sweep(sweep, out, engine="c", chunk=asked.chunk)
    with ray_workers.RayWorkers(asked.drive, lambda sentence: print(sentence, file=sys.stderr, flush=True)) as workers:
        return run_sweep(sweep, out, engine="c", chunk=asked.chunk, workers=workers, simulator=Walks(f"{out}.log"))


def started(asked, address):
    """A process that drives."""
    of = [f"--{name}={getattr(asked, name)}" for name in ("rows", "chunk", "cycles")]
    kill = ["--kill-driver"] * asked.kill_driver
    return subprocess.Popen([sys.executable, __file__, asked.out, *of, *kill, "--drive", address])


def disturbed(asked, out):
    """The sweep while nodes go and come; the nodes killed, by their ids, and how often the driver was."""
    os.environ.update(ray_workers.QUIET | ray_workers.LOOPBACK)  # before Ray is imported
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    others, killed, drivers, draw = [cluster.add_node(num_cpus=1) for _ in range(2)], [], 1, random.Random(0)
    driver, looked = started(asked, cluster.address), time.monotonic()
    try:
        while driver.poll() is None:
            time.sleep(0.2)
            chunks = len(list(out.glob("results/*.parquet")))
            if asked.kill_driver and drivers == 1 and chunks * asked.chunk * 3 > asked.rows:
                driver.kill()
                driver.wait()
                driver, drivers = started(asked, cluster.address), 2
            if chunks and time.monotonic() - looked > asked.every:
                looked = time.monotonic()
                node = others.pop(draw.randrange(len(others)))
                killed.append(node.node_id)
                cluster.remove_node(node, allow_graceful=False)
                others.append(cluster.add_node(num_cpus=1))
        if driver.returncode:
            raise SystemExit(f"the driver ended with {driver.returncode}")
    finally:
        driver.send_signal(signal.SIGTERM)
        driver.wait()
        cluster.shutdown()
    return killed, drivers


def account(log, killed):
    """What the log tells: chunks, how many were begun again, and whose beginning no loss explains.

    A beginning is explained if it was not the chunk's last and its node was killed, or its driver, and it was the last
    one of its process, or the last but one, whose result was on its way.
    """
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    begun = [line[1:] for line in lines if line[0] == "begun"]
    last_job, by_chunk, by_process = begun[-1][1], {}, {}
    for node, job, process, chunk in begun:
        by_chunk.setdefault(chunk, []).append((node, job, process))
        by_process.setdefault((node, process), []).append(chunk)
    again = [(chunk, *each) for chunk, several in by_chunk.items() for each in several[:-1]]
    unexplained = [
        each for each in again
        if not (each[1] in killed or each[2] != last_job) or each[0] not in by_process[each[1], each[3]][-2:]
    ]  # fmt: skip
    ended = sum(line[0] == "ended" for line in lines)
    return {"chunks": len(by_chunk), "begun": len(begun), "ended": ended, "in_flight": len(again),
            "unexplained": len(unexplained), "processes": len(by_process)}  # fmt: skip


def same(one, other):
    """Whether two tables are the same bit for bit, NaN included."""
    pairs = [(one.column(name), other.column(name)) for name in one.column_names]
    return one.schema == other.schema and all(
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
    asked = parser.parse_args()
    one, out = asked.out / "one", asked.out / ("driver" if asked.kill_driver else "nodes")
    if asked.drive:
        drive(asked, one if asked.drive == "alone" else out)
        return 0
    from nermo_mjx.sweep import read_table

    began = time.monotonic()
    alone = started(asked, "alone").wait()
    between = time.monotonic()
    killed, drivers = disturbed(asked, out)
    found = {
        "same": not alone and same(read_table(one), read_table(out)), "rows": asked.rows, "nodes_killed": len(killed),
        "drivers_killed": drivers - 1, **account(Path(f"{out}.log"), killed),
        "one_process_s": round(between - began, 1), "cluster_s": round(time.monotonic() - between, 1),
    }  # fmt: skip
    print(json.dumps(found))
    return 0 if found["same"] and not found["unexplained"] else 1


if __name__ == "__main__":
    sys.exit(main())
