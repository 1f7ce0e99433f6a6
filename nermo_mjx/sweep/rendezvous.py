"""A process in which one of several hosts meets the others: prints its index and their number, and ends.

`hosts.py` runs this file by itself; it is never imported. JAX ends a process in which the meeting fails, and later one
whose peer has died. In a process of its own that costs nothing: who has met computes alone, and outlives the others.
"""

from __future__ import annotations

import sys

import jax


def main(coordinator: str, processes: str, process_id: str, timeout: str) -> None:
    """Meet; an empty text stands for what JAX is to find out from the cluster by itself."""
    jax.distributed.initialize(
        coordinator or None,
        int(processes) if processes else None,
        int(process_id) if process_id else None,
        local_device_ids=[],  # all: this process uses none
        initialization_timeout=int(timeout),
    )
    print(jax.process_index(), jax.process_count(), flush=True)
    jax.distributed.shutdown()


main(*sys.argv[1:])
