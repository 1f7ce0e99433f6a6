"""Analysis of a compiled GPU program from its optimized HLO: launches, loops and bytes moved.

After XLA's passes each instruction that computes is a kernel (a fusion is one), a call of a library or a copy, and each
is a separate launch. A loop with a known trip count is launched without waiting; in each iteration of any other loop,
the host waits for the device to tell whether it continues.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

_BYTES: Final = {
    "pred": 1,
    "s8": 1,
    "u8": 1,
    "s16": 2,
    "u16": 2,
    "f16": 2,
    "bf16": 2,
    "s32": 4,
    "u32": 4,
    "f32": 4,
    "s64": 8,
    "u64": 8,
    "f64": 8,
    "c64": 8,
    "c128": 16,
}
#: Instructions without a launch: views of existing data, and the ends of asynchronous operations.
_FREE: Final = {
    "parameter",
    "constant",
    "tuple",
    "get-tuple-element",
    "bitcast",
    "after-all",
    "opt-barrier",
    "add-dependency",
    "copy-done",
    "async-done",
    "async-update",
    "partition-id",
    "replica-id",
}
_COPIES: Final = {"copy", "copy-start"}
_CONTROL: Final = {"while", "conditional", "call", "async-start"}
#: Instructions that read only as much of their first operand as their result holds.
_SLICES: Final = {"slice", "dynamic-slice", "gather"}

_HEAD: Final = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\{$")
_INSTRUCTION: Final = re.compile(
    r"^\s+(ROOT )?%?([\w.\-]+) = (\(.*?\)|\S+) ([a-z][a-z0-9\-]*)\(([^)]*)\)(.*)$"
)
_NAME: Final = re.compile(r"%([\w.\-]+)")
_SHAPE: Final = re.compile(r"\b([a-z]+\d*)\[([\d,]*)\]")
_TRIPS: Final = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_CALLED: Final = re.compile(
    r"\b(?:to_apply|calls|true_computation|false_computation|branch_computations)=\{?((?:%[\w.\-]+(?:, )?)+)"
)


@dataclasses.dataclass(frozen=True)
class Work:
    """Launches, how often the host waits to learn whether a loop continues, and bytes read and written."""

    kernels: float = 0.0
    libraries: float = 0.0
    copies: float = 0.0
    waits: float = 0.0
    bytes: float = 0.0

    @property
    def launches(self) -> float:
        """Number of launches: kernels, libraries and copies."""
        return self.kernels + self.libraries + self.copies

    def __add__(self, other: Work) -> Work:
        mine, theirs = dataclasses.astuple(self), dataclasses.astuple(other)
        return Work(*(a + b for a, b in zip(mine, theirs, strict=True)))

    def __mul__(self, times: float) -> Work:
        return Work(*(times * each for each in dataclasses.astuple(self)))


class Loop(NamedTuple):
    """A while loop: its computations, and its number of iterations; None if only the device knows."""

    condition: str
    body: str
    rounds: int | None


class Instruction(NamedTuple):
    """A line of a computation; `size` is of its result [bytes], `rest` what follows the operands."""

    name: str
    opcode: str
    size: int
    operands: tuple[str, ...]
    rest: str

    def called(self) -> list[str]:
        """The computations that it runs; of a conditional, each branch."""
        return [name for names in _CALLED.findall(self.rest) for name in _NAME.findall(names)]

    def loop(self) -> Loop:
        """The loop of a `while` instruction."""
        names = [re.search(rf"\b{key}=%?([\w.\-]+)", self.rest) for key in ("condition", "body")]
        condition, body = (match.group(1) for match in names if match)
        trips = _TRIPS.search(self.rest)
        return Loop(condition, body, int(trips.group(1)) if trips else None)


class Module:
    """A compiled program."""

    def __init__(self, text: str, rounds: int) -> None:
        """
        Args:
            text: optimized HLO, as of `compiled.as_text()`.
            rounds: see the attribute.
        """
        self.rounds = rounds
        self.computations, self.entry = _parsed(text)
        self._known: dict[str, Work] = {}

    def work(self, name: str) -> Work:
        """The total work of a computation, including all iterations of its loops."""
        if name not in self._known:
            self._known[name] = sum(
                (self._of(each, name) for each in self.computations[name].values()), Work()
            )
        return self._known[name]

    def loops(self, name: str) -> Iterator[tuple[Loop, float]]:
        """The loops in a computation, including nested ones, and how often each is started."""
        for each in self.computations[name].values():
            if each.opcode == "while":
                loop = each.loop()
                yield loop, 1.0
                rounds = self._rounds(loop)
                yield from ((inner, rounds * times) for inner, times in self.loops(loop.body))
            elif each.opcode in _CONTROL:
                for called in each.called():
                    yield from self.loops(called)

    def round(self, loop: Loop) -> Work:
        """One iteration of a loop."""
        body = self.work(loop.body)
        return body + self.work(loop.condition) + Work(waits=1.0) if loop.rounds is None else body

    def _rounds(self, loop: Loop) -> int:
        return self.rounds if loop.rounds is None else loop.rounds

    def _of(self, each: Instruction, computation: str) -> Work:
        if each.opcode == "while":
            loop = each.loop()
            return self.round(loop) * self._rounds(loop)
        if each.opcode == "conditional":
            # The host waits for the branch to be known; the most expensive one counts.
            return max(
                (self.work(name) for name in each.called()), key=lambda work: work.launches
            ) + Work(waits=1.0)
        if each.opcode in _CONTROL:
            return sum((self.work(name) for name in each.called()), Work())
        moved = 0 if each.opcode in _FREE else self._moved(each, computation)
        if moved == 0:
            return Work()
        kind = (
            "copies"
            if each.opcode in _COPIES
            else "libraries"
            if each.opcode == "custom-call"
            else "kernels"
        )
        return Work(**{kind: 1.0}, bytes=moved)

    def _moved(self, each: Instruction, computation: str) -> int:
        """Bytes that a kernel reads and writes; of values that are sliced or updated in place, only that part."""
        around = self.computations[computation]
        if each.opcode != "fusion":
            return _written(each, around) + sum(
                _read(around[name], {"": each}) for name in each.operands if name in around
            )
        inside = self.computations[each.called()[0]]
        root = next(reversed(inside.values()))
        parameters = (one for one in inside.values() if one.opcode == "parameter")
        return _written(root, inside) + sum(_read(one, inside) for one in parameters)


def _parsed(text: str) -> tuple[dict[str, dict[str, Instruction]], str]:
    computations: dict[str, dict[str, Instruction]] = {}
    entry, current = "", dict[str, Instruction]()
    for line in text.splitlines():
        if head := _HEAD.match(line):
            current = computations[head.group(2)] = {}
            entry = head.group(2) if head.group(1) else entry
        elif found := _INSTRUCTION.match(line):
            _, name, shape, opcode, operands, rest = found.groups()
            current[name] = Instruction(
                name, opcode, _size(shape), tuple(_NAME.findall(operands)), rest
            )
    if not entry:
        raise ValueError("The text is no HLO: it has no ENTRY.")
    return computations, entry


def _size(shape: str) -> int:
    return sum(
        _BYTES.get(kind, 0) * math.prod(int(each) for each in sides.split(",") if each)
        for kind, sides in _SHAPE.findall(shape)
    )


def _read(one: Instruction, inside: Mapping[str, Instruction]) -> int:
    """Bytes that are read of a value by the instructions that use it."""
    read = 0
    for user in inside.values():
        if one.name not in user.operands:
            continue
        first_only = user.operands[0] == one.name and one.name not in user.operands[1:]
        if user.opcode in _SLICES and first_only:
            read += user.size
        elif user.opcode == "bitcast":
            read += _read(user, inside)
        elif user.opcode != "dynamic-update-slice" or not first_only:
            return one.size
    return min(read, one.size)


def _written(root: Instruction, inside: Mapping[str, Instruction]) -> int:
    """Bytes that are written of a result."""
    if root.opcode == "tuple":
        return sum(_written(inside[name], inside) for name in root.operands)
    if root.opcode == "bitcast":
        return _written(inside[root.operands[0]], inside)
    if root.opcode == "dynamic-update-slice":
        return inside[root.operands[1]].size
    return root.size
