"""What a benchmark is, how its contenders take turns, and the table of its lines."""

from __future__ import annotations

import gc
import textwrap
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TypeVar

T = TypeVar("T")
_COLUMNS = ("what", "ours", "beside", "measured", "target", "")


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
        kills: How many controllers are killed with others around, where that was asked for.
    """

    folder: Path
    effort: float
    say: Callable[[str], None]
    rows: int | None = None
    kills: int | None = None

    def count(self, full: int, least: int = 1) -> int:
        """How often to do what a full run does `full` times."""
        return max(least, round(full * self.effort))

    def sample(self, items: Iterable[T]) -> list[T]:
        """Return all items in a full run, and fewer of them, in their order, in a smaller one."""
        each = list(items)
        wanted = min(len(each), self.count(len(each)))
        return [each[at * len(each) // wanted] for at in range(wanted)]

    def place(self, name: str) -> Path:
        """A new folder inside the benchmark's own."""
        place = self.folder / name
        place.mkdir()
        return place


Measure = Callable[[Bench], "Iterable[Line]"]


@dataclass(frozen=True)
class Benchmark:
    """Some lines of the table under one name."""

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


def benchmark(name: str, title: str) -> Callable[[Measure], Benchmark]:
    """Declare a function that yields lines as a benchmark."""
    return lambda measure: Benchmark(name, title, measure)


# -- measuring -----------------------------------------------------------------------------------


def alternate(
    contenders: Mapping[str, Callable[[], T]], blocks: int, *, warm_up: bool = True
) -> dict[str, list[T]]:
    """Run the contenders in turn: A B A B ...

    Args:
        contenders: Name to what runs one block and returns what it measured.
        blocks: How many blocks of each are kept.
        warm_up: Run one more block of each in front and forget it.
    """
    if warm_up:
        for run_block in contenders.values():
            run_block()
    rounds = [{name: run_block() for name, run_block in contenders.items()} for _ in range(blocks)]
    return {name: [taken[name] for taken in rounds] for name in contenders}


def time_calls(call: Callable[[int], object], calls: int) -> list[float]:
    """Durations in seconds of so many calls in a row; the garbage collector runs in between."""
    gc.collect()
    clock, durations = time.perf_counter, [0.0] * calls
    for i in range(calls):
        started = clock()
        call(i)
        durations[i] = clock() - started
    return durations


def processor_s(work: Callable[[], object]) -> float:
    """Seconds of this process's processor time that some work takes."""
    started_s = time.process_time()
    work()
    return time.process_time() - started_s


@dataclass(frozen=True)
class Samples:
    """What one contender needed, block by block (seconds, or any other unit)."""

    blocks: list[list[float]]

    @classmethod
    def of(cls, singles: Iterable[float]) -> Samples:
        """Blocks of one value each."""
        return cls([[value] for value in singles])

    @property
    def p50(self) -> float:
        """The median of a typical block."""
        return median(median(block) for block in self.blocks)

    def above(self, fraction: float) -> float:
        """The value below which that fraction of all values lies."""
        values = sorted(value for block in self.blocks for value in block)
        return values[min(len(values) - 1, int(len(values) * fraction))]

    @property
    def p999(self) -> float:
        """One value in a thousand is above it."""
        return self.above(0.999)

    @property
    def worst(self) -> float:
        """The largest value."""
        return self.above(1)


def ratio(ours: Samples, theirs: Samples) -> float:
    """The median of the ratios of neighbouring blocks: what drifts meanwhile falls out."""
    pairs = zip(ours.blocks, theirs.blocks, strict=True)
    return median(median(our) / median(their) for our, their in pairs)


# -- the table -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """What is aimed at; `least` turns "at most" into "at least"."""

    limit: float
    least: bool = False

    def verdict(self, measured: float) -> str:
        """Met, or missed and by how much of the limit."""
        met = measured >= self.limit if self.least else measured <= self.limit
        if met:
            return "met"
        if not self.limit:
            return f"missed by {_digits(measured)}"
        return f"missed by {_digits(100 * abs(measured / self.limit - 1))} %"


@dataclass(frozen=True)
class Line:
    """One line of the table.

    Args:
        what: What was measured.
        ours: Its value, with the unit.
        beside: What it is compared with, and that value.
        measured: The figure that the target speaks of.
        unit: Its unit; "x" for a ratio.
        target: What is aimed at, if anything is.
    """

    what: str
    ours: str
    beside: str
    measured: float
    unit: str = "x"
    target: Target | None = None

    @property
    def cells(self) -> tuple[str, ...]:
        """The texts of the columns."""
        measured = f"{_digits(self.measured)} {self.unit}"
        if self.target is None:
            return (self.what, self.ours, self.beside, measured, "", "")
        sign = ">=" if self.target.least else "<="
        target = f"{sign} {_digits(self.target.limit)} {self.unit}"
        verdict = self.target.verdict(self.measured)
        return (self.what, self.ours, self.beside, measured, target, verdict)


@dataclass(frozen=True)
class Section:
    """The lines of one benchmark; where it cannot be measured here, why."""

    title: str
    lines: list[Line]
    skipped: str = ""


def compared(
    what: str, ours: float, name: str, theirs: float, times: float, limit: float | None = None
) -> Line:
    """A line of two durations in seconds, and of how many times theirs ours is."""
    target = None if limit is None else Target(limit)
    return Line(what, duration(ours), f"{name} {duration(theirs)}", times, target=target)


def added(
    what: str, ours: float, name: str, theirs: float, unit: str, limit: float | None = None
) -> Line:
    """A line of two durations in seconds, and of how much longer ours is, in "us" or "ms"."""
    more = (ours - theirs) * {"us": 1e6, "ms": 1e3}[unit]
    beside = f"{name} {duration(theirs)}" if name else ""
    target = None if limit is None else Target(limit)
    return Line(what, duration(ours), beside, more, unit, target)


def duration(seconds: float) -> str:
    """A duration with three digits and a fitting unit."""
    if seconds < 1e-3:
        return f"{_digits(seconds * 1e6)} us"
    return f"{_digits(seconds * 1e3)} ms" if seconds < 1 else f"{_digits(seconds)} s"


def render(sections: Iterable[Section]) -> str:
    """The table as text."""
    sections = list(sections)
    rows = [_COLUMNS, *(line.cells for section in sections for line in section.lines)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    texts = [_row(_COLUMNS, widths), _row(["-" * width for width in widths], widths)]
    for section in sections:
        texts += ["", section.title, *(_row(line.cells, widths) for line in section.lines)]
        if section.skipped:
            texts.append(textwrap.indent(f"not measured: {section.skipped}", "  "))
    return "\n".join(texts)


def _row(cells: Iterable[str], widths: list[int]) -> str:
    cells = [cell.ljust(width) for cell, width in zip(cells, widths, strict=True)]
    return "  ".join(cells).rstrip()


def _digits(value: float) -> str:
    """Three digits that count; whole numbers from 100."""
    if value == int(value) or abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.3g}"
