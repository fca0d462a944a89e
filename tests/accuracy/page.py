"""The pages: parts that are measured one by one, each with the figure that counts."""

from __future__ import annotations

import math
import os
import platform
import re
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.benchmarks.core import Bench
from webots_mcp import __version__

CHECKOUT: Final = Path(__file__).parents[2]
PAGE: Final = CHECKOUT / "docs" / "accuracy.md"
DETAILS: Final = CHECKOUT / "docs" / "accuracy"  # a page for each part
README: Final = CHECKOUT / "README.md"
FIGURES: Final = re.compile(r"(?<=<!-- figures -->\n).*?(?=\n\n)", re.S)
_CORES: Final = os.cpu_count()
_HEADLINE: Final = re.compile(r"(?m)^\*\*(.+)\*\*$")


@dataclass(frozen=True)
class Part:
    """A part of what is measured, which has a page of its own.

    Attributes:
        question: What a user wants to know.
        measure: Gives paragraphs and tables; the first is one sentence with the figure that counts.
    """

    name: str
    title: str
    question: str
    measure: Callable[[Bench], Iterator[str]]

    def measured(self, bench: Bench) -> str:
        """Its text, with when and on what it was measured."""
        started_s = time.monotonic()
        headline, *texts = self.measure(bench)
        took = f"{time.monotonic() - started_s:.0f} s"
        made = f"*Measured on {time.strftime('%Y-%m-%d')} in {took} on {_machine()}.*"
        return "\n\n".join([f"# {self.title}", f"**{headline}**", *texts, made]) + "\n"

    @property
    def file(self) -> Path:
        """The page of what was measured last."""
        return DETAILS / f"{self.name}.md"


def headline(details: str) -> str:
    """The sentence of a page with the figure that counts."""
    (found,) = _HEADLINE.findall(details)
    return found


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; what stands in the first column is said, the others are figures."""
    ruled = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ruled, *rows))


def share(count: int, of: int) -> str:
    """A share in per cent with the interval that holds it nineteen times of twenty.

    E. B. Wilson, Probable inference, the law of succession, and statistical inference, J. American
    Statistical Association 22, 1927.
    """
    if not of:
        return "-"
    z, part = 1.96, count / of
    centre = (part + z * z / (2 * of)) / (1 + z * z / of)
    reach = z * math.sqrt(part * (1 - part) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    low, high = (percent(max(0.0, min(1.0, each))) for each in (centre - reach, centre + reach))
    return f"{percent(part)} % ({low} to {high})"


def percent(part: float | None) -> str:
    """With a digit behind the point where it says something."""
    return "-" if part is None else f"{100 * part:.1f}".removesuffix(".0")


def _machine() -> str:
    python = f"{platform.python_implementation()} {platform.python_version()}"
    system = f"{platform.system()} {platform.machine()} with {_CORES} cores"
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{system}{load}; webots-mcp {__version__}, {python}, SQLite {sqlite3.sqlite_version}"
