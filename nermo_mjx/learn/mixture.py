"""Several environments as one: a policy that learns in all of them at once, in one batch of worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.learn.environment import Environment, State
from nermo_mjx.learn.loop import EpisodeLoop
from nermo_mjx.learn.task import Task
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.runtime import thread_count


class Mixture:
    """Worlds of several setups side by side, in the form of one `Environment`; `State.engine` is the parts' states.

    Every part has the same observation and the same action. The critic's input differs: it is the union of the parts'
    inputs, with zeros where a part lacks them, and the index of the part.

    >>> parts = [(Setup(), Task(duration=1.0)), (Setup(pilot="arc"), Task(duration=1.0))]
    >>> [part.worlds for part in Mixture(parts, worlds=5).parts]
    [3, 2]

    Attributes:
        parts: the environments; the worlds of the first come first.
    """

    def __init__(
        self,
        parts: Sequence[tuple[Setup, Task]],
        *,
        engine: str = "c",
        worlds: int = 256,
        shares: Sequence[float] | None = None,
        staggered: bool = False,
        threads: int | None = None,
    ) -> None:
        """
        Args:
            parts: what is chosen by name, and the task, of each environment.
            engine: `c`, `mjx`, or `auto`.
            worlds: of all parts together.
            shares: in which they are divided among the parts, relative to each other; None for evenly.
            staggered: see `Environment`.
            threads: processors that `c` uses; None for `$NERMO_MJX_THREADS`, or all of them.

        Raises:
            ParameterError: fewer worlds than parts, or parts with different observations, actions or step lengths; and
                what `Environment` refuses.
        """
        check_worlds(worlds, len(parts))
        counts = divided(worlds, [1.0] * len(parts) if shares is None else shares)
        # The blocks of all parts share the processors: a single part may have too few worlds for all of them.
        processors = ThreadPoolExecutor(thread_count(threads), thread_name_prefix="nermo_mjx")
        self.parts = tuple(
            Environment(setup, engine=engine, worlds=count, task=task, staggered=staggered, threads=processors)
            for (setup, task), count in zip(parts, counts, strict=True)
        )
        check_alike({str(part.setup.scene): part.loop for part in self.parts})
        self.worlds = worlds
        self._bounds = np.cumsum(counts)[:-1]
        told = dict.fromkeys(name for part in self.parts for name in part.privileged_names)
        self.privileged_names = (*told, *(f"part.{i}" for i in range(len(self.parts))))
        self._columns = [
            np.array([self.privileged_names.index(name) for name in part.privileged_names]) for part in self.parts
        ]
        self._waiting = ThreadPoolExecutor(len(parts), thread_name_prefix="nermo_mjx_part")

    @property
    def pure(self) -> bool:
        """Whether `reset` and `step` are pure functions, which can be traced."""
        return self.parts[0].pure

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self.parts[0].observation_size

    @property
    def privileged_size(self) -> int:
        """Length of a critic's input."""
        return len(self.privileged_names)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.parts[0].action_size

    @property
    def step_seconds(self) -> float:
        """Simulated seconds of a control step."""
        return self.parts[0].step_seconds

    def reset(self, key: Any) -> State:
        """Begin an episode in every world; each part draws from a key of its own."""
        key = jax.random.key(key) if isinstance(key, int) else key
        keys = [jax.random.fold_in(key, i) for i in range(len(self.parts))]
        return self.joined([part.reset(each) for part, each in zip(self.parts, keys, strict=True)])

    def step(self, state: State, action: Any) -> State:
        """One control step of all worlds; see `Environment.step`."""
        given = zip(self.parts, state.engine, self.split(action), strict=True)
        calls = [functools.partial(part.step, each, own) for part, each, own in given]
        return self.joined([call() for call in calls] if self.pure else self.at_once(calls))

    def split(self, values: Any, axis: int = 0) -> list[Any]:
        """What belongs to each part's worlds, along an axis of all worlds."""
        return (jnp if self.pure else np).split(values, self._bounds, axis)

    def at_once(self, calls: Sequence[Callable[[], Any]]) -> list[Any]:
        """The results of a call for each part, each in a thread of its own; the largest part begins."""
        order = sorted(range(len(calls)), key=lambda i: -self.parts[i].worlds)
        started = {i: self._waiting.submit(calls[i]) for i in order}
        return [started[i].result() for i in range(len(calls))]

    def joined(self, states: Sequence[State]) -> State:
        """The state of all worlds from those of the parts."""
        numbers = jnp if self.pure else np
        fields = {name: [getattr(state, name) for state in states] for name in State._fields if name != "engine"}
        for name in ("privileged", "final_privileged"):
            fields[name] = [self.told(i, each) for i, each in enumerate(fields[name])]
        joined = {
            name: jax.tree.map(lambda *leaves: numbers.concatenate(leaves), *each) for name, each in fields.items()
        }
        return State(**joined, engine=tuple(states))

    def told(self, i: int, own: Any) -> Any:
        """The critic's input (..., p) from that of part i, in the columns of all parts."""
        which = len(self.privileged_names) - len(self.parts) + i
        shape = *own.shape[:-1], self.privileged_size
        if not self.pure:
            told = np.zeros(shape, np.float32)
            told[..., self._columns[i]], told[..., which] = own, 1.0
            return told
        return jnp.zeros(shape, jnp.float32).at[..., self._columns[i]].set(own).at[..., which].set(1.0)


def divided(worlds: int, shares: Sequence[float]) -> list[int]:
    """Worlds of each part: in these shares, but at least one; what is left over goes to the largest remainders.

    >>> divided(10, [1.0, 1.0, 2.0])
    [3, 2, 5]
    """
    exact = worlds * np.asarray(shares, float) / np.sum(shares)
    counts = np.maximum(np.floor(exact + 1e-9).astype(int), 1)
    while counts.sum() != worlds:
        missing = exact - counts
        at = int(np.argmax(missing)) if counts.sum() < worlds else int(np.argmin(np.where(counts > 1, missing, np.inf)))
        counts[at] += 1 if counts.sum() < worlds else -1
    return counts.tolist()


def check_worlds(worlds: int, parts: int) -> None:
    """Raise `ParameterError` where a part would have no world."""
    if worlds < parts:
        raise ParameterError(f"worlds is {worlds}: {parts} scenes need at least one world each.")


def check_alike(loops: Mapping[str, EpisodeLoop]) -> None:
    """Raise `ParameterError` where one policy cannot learn in all of these loops, by the names of their scenes."""
    (name, first), *others = loops.items()
    for other, loop in others:
        names = set(loop.observation_names) ^ set(first.observation_names)
        same = (loop.observer, loop.controller.kind, loop.dt * loop.task.decimation) == (
            first.observer,
            first.controller.kind,
            first.dt * first.task.decimation,
        )
        if not same:
            differs = f" ({', '.join(sorted(names))})" if names else ""
            raise ParameterError(
                f"scenes has {other!r}, where a policy observes or does something else than on {name!r}{differs}: one "
                "policy needs the same on all."
            )
