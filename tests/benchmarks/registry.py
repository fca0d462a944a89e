"""Which benchmarks there are, and what each is given to work with."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks import families
from tests.benchmarks.table import Line, Section


class NotMeasurableError(Exception):
    """Something that the benchmark needs is not on this machine; the text says what."""


@dataclass(frozen=True)
class Bench:
    """What a benchmark works with.

    Args:
        folder: An empty folder of its own.
        effort: 1 for a full run; counts shrink with it.
        say: Shows on a terminal what is going on.
        rows: How long the long recording is, where that was asked for.
        kills: How many controllers are killed beside others, where that was asked for.
    """

    folder: Path
    effort: float
    say: Callable[[str], None]
    rows: int | None = None
    kills: int | None = None

    def count(self, full: int, least: int = 1) -> int:
        """How often to do what a full run does `full` times."""
        return max(least, round(full * self.effort))

    def place(self, name: str) -> Path:
        """A new folder inside the benchmark's own."""
        place = self.folder / name
        place.mkdir()
        return place


Measure = Callable[[Bench], Iterable[Line]]


@dataclass(frozen=True)
class Benchmark:
    """A family of lines under one name."""

    name: str
    title: str
    measure: Measure

    def run(self, bench: Bench) -> Section:
        """Its section of the table."""
        lines: list[Line] = []
        try:
            lines.extend(self.measure(bench))
        except NotMeasurableError as missing:
            return Section(self.title, lines, str(missing))
        return Section(self.title, lines)


_benchmarks: dict[str, Benchmark] = {}


def benchmark(name: str, title: str) -> Callable[[Measure], Measure]:
    """Enter a function that yields lines; its module has to stand in `families`."""

    def enter(measure: Measure) -> Measure:
        _benchmarks[name] = Benchmark(name, title, measure)
        return measure

    return enter


def all_benchmarks() -> list[Benchmark]:
    """Every benchmark of every module in `families`, in the order of their module names."""
    for module in sorted(pkgutil.iter_modules(families.__path__), key=lambda found: found.name):
        importlib.import_module(f"{families.__name__}.{module.name}")
    return list(_benchmarks.values())
