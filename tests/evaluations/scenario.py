"""Scenarios: a subject, a question, the calls that answer it, and the facts of a right answer."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from tests.server.story import rows_of

FILE: Final = Path(__file__).with_name("scenarios.toml")
_STEP: Final = re.compile(r"([^.\[\]]+)|\[([^=\]]+)=([^\]]*)\]|\[(\d+)\]")
_NUMBER: Final = re.compile(r"(?<![\w.])-?\d+(?:[.,]\d+)?(?:e-?\d+)?")
_ROUNDED: Final = 0.01  # of a number: a person is told 1.3 m, not 1.3263 m


@dataclass(frozen=True)
class Fact:
    """What an answer has to hold, and where the tools' answers have it."""

    at: str
    value: Any
    within: float = 0.0
    says: str | None = None

    def is_in(self, answers: Sequence[Any]) -> bool:
        """Whether one of the tools' answers has it."""
        return any(self._matches(found) for each in answers for found in _found(each, self.at))

    def is_said(self, text: str) -> bool:
        """Whether a text holds it: the number, rounded perhaps, or the words."""
        if self.says is not None:
            return re.search(self.says, text, re.IGNORECASE) is not None
        if isinstance(self.value, (int, float)):
            numbers = [
                float(each.replace(",", "."))
                for each in _NUMBER.findall(text.replace("\N{MINUS SIGN}", "-"))
            ]
            most = max(self.within, abs(self.value) * _ROUNDED)
            return any(abs(each - self.value) <= most for each in numbers)
        return str(self.value).lower() in text.lower()

    def _matches(self, found: Any) -> bool:
        if isinstance(found, (int, float)) and not isinstance(found, bool):
            return abs(found - self.value) <= self.within + 1e-9
        if isinstance(found, str) and isinstance(self.value, str):
            return self.value in found
        return found == self.value


@dataclass(frozen=True)
class Scenario:
    """One of them; `calls` is how many a client may make."""

    name: str
    of: str
    question: str
    calls: int
    plan: tuple[tuple[str, dict[str, Any]], ...]
    facts: tuple[Fact, ...]


def read_scenarios() -> list[Scenario]:
    """All, in the order of the file."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    tables = toml.loads(FILE.read_text("utf-8"))["scenario"]
    return [
        Scenario(
            **{key: table[key] for key in ("name", "of", "question", "calls")},
            plan=tuple((call.pop("tool"), call) for call in table["plan"]),
            facts=tuple(
                Fact(each["at"], each["is"], each.get("within", 0.0), each.get("says"))
                for each in table["facts"]
            ),
        )
        for table in tables
    ]


def _found(answer: Any, path: str) -> list[Any]:
    """What a path leads to: `events[kind=stuck].start_s`; of rows that match, each."""
    reached: list[Any] = [answer]
    for name, column, value, place in _STEP.findall(path):
        if place:
            reached = [each[int(place)] for each in reached if int(place) < len(each)]
        elif column:
            rows = [row for each in reached for row in _rows(each)]
            reached = [row for row in rows if str(row.get(column)) == value]
        else:
            reached = [each[name] for each in reached if isinstance(each, dict) and name in each]
    return reached


def _rows(table: Any) -> list[dict[str, Any]]:
    return rows_of(table) if "columns" in table else list(table)
