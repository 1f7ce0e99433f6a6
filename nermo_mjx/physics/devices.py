"""Sharding of a batch of worlds over the local devices.

Each device runs its own worlds and never waits for another one: the program is sharded with `jax.shard_map`. With JAX's
automatic partitioning all devices would synchronise in each iteration of the solver's loop.
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

#: Environment variable with the default number of devices.
VARIABLE: Final = "NERMO_MJX_DEVICES"
#: World axis of an argument or a result: the first axis, the second, or none.
FIRST: Final = PartitionSpec("worlds")
SECOND: Final = PartitionSpec(None, "worlds")
NOWHERE: Final = PartitionSpec()


@dataclasses.dataclass(frozen=True)
class Devices:
    """Devices over which the worlds of a batch are sharded.

    Attributes:
        mesh: of one axis, `worlds`; None for a single device.
    """

    mesh: Mesh | None = None

    @property
    def count(self) -> int:
        """Number of devices."""
        return 1 if self.mesh is None else int(self.mesh.size)

    def padded(self, worlds: int) -> int:
        """`worlds`, rounded up to a multiple of the number of devices."""
        return -(-worlds // self.count) * self.count

    def put(self, tree: Any) -> Any:
        """Arrays (n, ...) sharded over the devices, (padded(n), ...); the last world is repeated as padding."""
        if self.mesh is None:
            return jax.device_put(tree)
        return jax.device_put(jax.tree.map(self._filled, tree), NamedSharding(self.mesh, FIRST))

    def take(self, tree: Any, worlds: int) -> Any:
        """Arrays from `put` or a sharded function without the padding, on the host."""
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
        # Without JAX's check of varying values, which loops in other libraries fail.
        return jax.shard_map(function, mesh=self.mesh, in_specs=arguments, out_specs=results, check_vma=False)

    def _filled(self, leaf: Any) -> np.ndarray:
        more = self.padded(len(leaf)) - len(leaf)
        return np.pad(leaf, [(0, more)] + [(0, 0)] * (np.ndim(leaf) - 1), mode="edge")


def choose_devices(wanted: int | None = None) -> Devices:
    """The local devices that this process uses.

    Args:
        wanted: number of devices; None for `$NERMO_MJX_DEVICES`, or else all.

    Raises:
        ParameterError: there are fewer devices.
    """
    start_jax()
    local = jax.local_devices()
    count = _wanted(wanted, len(local))
    # Where batches must stay small to keep programs from hanging, they run in parts on one device.
    if count == 1 or batch_limit() is not None:
        return Devices()
    return Devices(Mesh(np.array(local[:count]), ("worlds",)))


def batch_limit() -> int | None:
    """Maximum number of worlds in one program on this backend; see `runtime.cpu_batch_limit`."""
    return cpu_batch_limit() if jax.default_backend() == "cpu" else None


def _wanted(wanted: int | None, available: int) -> int:
    name, value = "devices", str(wanted)
    if wanted is None:
        name, value = VARIABLE, os.environ.get(VARIABLE) or str(available)
    if not value.isdecimal() or not 1 <= int(value) <= available:
        raise ParameterError(f"{name} is {value}: allowed is 1 to {available}, as many as JAX finds here.")
    return int(value)
