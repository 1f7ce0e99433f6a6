"""The local devices that a batch of worlds is divided among.

Each device runs its own worlds and never waits for another one: the program is divided with `jax.shard_map`. Under
JAX's automatic partition the end of the solver's loop would be agreed upon by all devices in each of its iterations.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import Any, Final

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from nermo_mjx.robot import ParameterError
from nermo_mjx.runtime import cpu_batch_limit, start_jax

#: Environment variable with the number of devices, where a caller does not say.
VARIABLE: Final = "NERMO_MJX_DEVICES"
#: Where the worlds of an argument or a result are: along the first axis, along the second, or nowhere.
FIRST: Final = PartitionSpec("worlds")
SECOND: Final = PartitionSpec(None, "worlds")
NOWHERE: Final = PartitionSpec()


@dataclasses.dataclass(frozen=True)
class Devices:
    """Devices among which a batch is divided by worlds.

    Attributes:
        mesh: of one axis, `worlds`; None for one device, where nothing is divided.
    """

    mesh: Mesh | None = None

    @property
    def count(self) -> int:
        """How many there are."""
        return 1 if self.mesh is None else int(self.mesh.size)

    def padded(self, worlds: int) -> int:
        """Worlds of a batch that has as many for each device, `worlds` or a few more."""
        return -(-worlds // self.count) * self.count

    def put(self, tree: Any) -> Any:
        """Arrays (n, ...) with their worlds on the devices, (padded(n), ...); the last world fills up."""
        if self.mesh is None:
            return jax.device_put(tree)
        return jax.device_put(jax.tree.map(self._filled, tree), NamedSharding(self.mesh, FIRST))

    def take(self, tree: Any, worlds: int) -> Any:
        """The arrays of what `put` and a divided function gave, without the worlds that filled up; on the host."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda leaf: leaf[:worlds], jax.device_get(tree))

    def divide(self, function: Callable[..., Any], arguments: Any, results: Any) -> Callable[..., Any]:
        """A function of batches that runs on each device with that device's worlds.

        Args:
            function: of arrays, jittable.
            arguments, results: `FIRST`, `SECOND` or `NOWHERE` for each argument, and for each part of the result.
        """
        if self.mesh is None:
            return function
        # Without JAX's check of what differs between devices, which loops of other libraries do not pass.
        return jax.shard_map(function, mesh=self.mesh, in_specs=arguments, out_specs=results, check_vma=False)

    def _filled(self, leaf: Any) -> np.ndarray:
        more = self.padded(len(leaf)) - len(leaf)
        return np.pad(leaf, [(0, more)] + [(0, 0)] * (np.ndim(leaf) - 1), mode="edge")


def choose_devices(wanted: int | None = None) -> Devices:
    """The local devices that this process computes on.

    Args:
        wanted: how many; None for `$NERMO_MJX_DEVICES`, or all of them.

    Raises:
        ParameterError: there are not as many.
    """
    start_jax()
    local = jax.local_devices()
    count = _wanted(wanted, len(local))
    # Where batches must stay small, so that no program hangs, they run in parts on one device.
    if count == 1 or batch_limit() is not None:
        return Devices()
    return Devices(Mesh(np.array(local[:count]), ("worlds",)))


def batch_limit() -> int | None:
    """Most worlds of one program on this backend; see `runtime.cpu_batch_limit`."""
    return cpu_batch_limit() if jax.default_backend() == "cpu" else None


def _wanted(wanted: int | None, available: int) -> int:
    name, value = "devices", str(wanted)
    if wanted is None:
        name, value = VARIABLE, os.environ.get(VARIABLE) or str(available)
    if not value.isdecimal() or not 1 <= int(value) <= available:
        raise ParameterError(f"{name} is {value}: allowed is 1 to {available}, as many as JAX finds here.")
    return int(value)
