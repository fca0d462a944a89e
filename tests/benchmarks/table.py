"""The lines of the table: what was measured, beside what, and beside which target."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass

_COLUMNS = ("what", "ours", "beside", "measured", "target", "")


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
    """The lines of one family; where it cannot be measured here, why."""

    title: str
    lines: list[Line]
    skipped: str = ""


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
