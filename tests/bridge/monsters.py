"""Values that are too large to be recorded, never come to an end, or hold themselves."""

from __future__ import annotations

import collections
import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

MANY = 200_000


def circle() -> list[Any]:
    round_and_round: list[Any] = []
    round_and_round.append(round_and_round)
    return round_and_round


def shared_lists() -> list[Any]:
    node: list[Any] = [1.5]
    for _ in range(60):
        node = [node, node]
    return node


def shared_dicts() -> dict[str, Any]:
    node: dict[str, Any] = {"x": 1.5}
    for _ in range(60):
        node = {"left": node, "right": node}
    return node


def family(depth: int = 10, parent: Any = None) -> dict[str, Any]:
    """A tree whose nodes know their parents."""
    node: dict[str, Any] = {"parent": parent, "name": "joint", "children": []}
    if depth:
        node["children"] = [family(depth - 1, node) for _ in range(2)]
    return node


class Lazy:
    """Each has two of its kind inside, made when it is asked."""

    asked = 0

    def tolist(self) -> list[Lazy]:
        Lazy.asked += 1
        return [Lazy(), Lazy()]


class Hidden:
    """Shown in a few characters, where a test fails."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make

    def tolist(self) -> Any:
        return self.make()


class Shy(Lazy):
    """It is a number to nobody, whatever it is added to."""

    def __radd__(self, other: float) -> float:
        return other


class Endless(Sequence[int]):
    """It says that it has three items, and never comes to an end."""

    asked = 0

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: Any) -> Any:
        Endless.asked += 1
        return index

    def __iter__(self) -> Iterator[int]:
        while True:
            yield self[0]


class EndlessList(list[int]):
    asked = 0

    def __iter__(self) -> Iterator[int]:
        while True:
            EndlessList.asked += 1
            yield 0


class EndlessDict(dict[str, int]):
    asked = 0

    def items(self) -> Any:
        while True:
            EndlessDict.asked += 1
            yield f"key {EndlessDict.asked}", 0


MONSTERS: dict[str, Callable[[], Any]] = {
    "a circle": circle,
    "shared lists": shared_lists,
    "shared dicts": shared_dicts,
    "links to parents": family,
    "a lazy tree": Lazy,
    "lazy trees among numbers": lambda: [0.5, *(Shy() for _ in range(100))],
    "no end": Endless,
    "a list without end": lambda: EndlessList([1, 2, 3]),
    "a dict without end": lambda: EndlessDict(a=1, b=2),
    "many keys": lambda: dict.fromkeys(map(str, range(MANY)), 0.5),
    "many ordered keys": lambda: collections.OrderedDict.fromkeys(range(MANY), 0.5),
    "many numbers": lambda: [0.5] * MANY,
    "many texts": lambda: ["x" * 1000] * MANY,
    "many rows": lambda: [[0.5] * 1000] * 200,
    "a set": lambda: set(range(MANY)),
    "a range": lambda: range(10**12),
    "a long text": lambda: "x" * 50_000_000,
    "a long text that is escaped": lambda: "\1" * 10_000_000,
    "a long text beyond ASCII": lambda: "\U0001f916" * 10_000_000,
    "a long key": lambda: {"x" * 50_000_000: 1},
    "long keys": lambda: {f"{i}" * 1000: math.nan for i in range(3000)},
    "bytes": lambda: b"x" * 200_000_000,
    "a view": lambda: memoryview(bytearray(200_000_000)),
    "an array": lambda: np.zeros(MANY),
    "an array of objects": lambda: np.array([circle() for _ in range(1000)], dtype=object),
    "a C array": lambda: (ctypes.c_double * MANY)(),
    "nothing but gaps": lambda: {f"key {i}": math.nan for i in range(3900)},
    "gaps of many kinds": lambda: [math.nan, math.inf] * 9000,
    "a chain": lambda: chain(100_000),
}


def chain(length: int) -> list[Any]:
    node: list[Any] = []
    for _ in range(length):
        node = [node]
    return node
