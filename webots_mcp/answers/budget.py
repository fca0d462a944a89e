"""Answers that stay short: rounded numbers, shortened values, and as many rows as fit."""

from __future__ import annotations

import json
import math
import re
import sqlite3
import sys
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final, Literal, NamedTuple, TypeVar, cast

from webots_mcp.answers.models import Answer, Table
from webots_mcp.errors import AmbiguousRobotError, NothingRecordedError
from webots_mcp.signals.naming import listed
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range, shown_time
from webots_mcp.store.recording import RecordingAccess, RobotView, storage, view_robot

# -- values, made short enough to be read whole by rules that are stated in the answer --

Client = Literal["mcp", "cli"]
reader: Final[ContextVar[Client]] = ContextVar("reader", default="mcp")
STATE_BUDGET_TOKENS: Final = 1_500
RESULT_BUDGET_TOKENS: Final = 1_200
DETAIL_BUDGET_TOKENS: Final = 120

# A rule, for the tokenizer of one model tells little about another's: a word of up to 12 letters,
# three digits, or some signs together are one token, and so is any other character.
_TOKEN: Final = re.compile(r" ?[A-Za-z]{1,12}|\d{1,3}| ?[!-/:-@\[-`{-~]{1,4}|\s{1,16}|.")
_LONGEST_TOKEN: Final = 16  # characters
_DIGITS: Final = 4
_DECIMALS: Final = 3
_DUST: Final = 1e-12
_ODD_NUMBERS: Final = ("nan", "inf", "-inf")
ANSWER_TOKENS: Final = 2_000
LARGE_ANSWER_TOKENS: Final = 10_000  # where it was said how much: clients warn of longer answers
BUDGET_TOKENS: Final = 1_250  # of rows; the header, notes and verdicts have what is left
_BESIDE_TOKENS: Final = ANSWER_TOKENS - BUDGET_TOKENS
_HEADER_TOKENS: Final = 150  # with a hint
_FOR_A_PERSON_TOKENS: Final = 10_000_000
LONGEST_NAME: Final = 80
_LONGEST_NOTE: Final = 300
_MOST_NOTES: Final = 5
MOST_RUNS: Final = 5  # of which one answer tells


@dataclass(frozen=True)
class Limits:
    """How much of one value is shown."""

    items: int
    text: int
    keys: int
    depth: int
    exact: bool = False

    def rule(self) -> str:
        """The rule in words."""
        return (
            f"arrays over {self.items} items are summarised; texts over {self.text} characters, "
            f"objects over {self.keys} keys and what is nested over {self.depth} deep are cut"
        )


# From generous to tight: the first under which a value fits its budget is taken. Names go last.
GLANCE: Final = (
    Limits(items=16, text=200, keys=64, depth=8),
    Limits(items=8, text=80, keys=32, depth=5),
    Limits(items=4, text=40, keys=20, depth=3),
    Limits(items=2, text=20, keys=10, depth=2),
    Limits(items=2, text=12, keys=6, depth=1),
)


WHOLE: Final = tuple(
    replace(limits, exact=True)
    for limits in (
        Limits(items=2000, text=4000, keys=1000, depth=20),
        Limits(items=16, text=200, keys=1000, depth=20),
        *GLANCE,
    )
)


class Shortened(NamedTuple):
    """A value that fits its budget, and the rule by which something was left out (else None)."""

    value: Any
    rule: str | None


def is_for_a_person() -> bool:
    """Whether the answer is read in a terminal, where nothing is cut to save a model's context."""
    return reader.get() == "cli"


def wall_clock(wall_time_s: float) -> str:
    """A moment of wall time in this machine's zone, as ISO 8601 with that zone."""
    try:
        return datetime.fromtimestamp(wall_time_s).astimezone().isoformat("T", "milliseconds")
    except (OverflowError, OSError, ValueError):  # no bridge has written this
        return f"{wall_time_s}"


def shorten(
    value: Any, budget_tokens: int = STATE_BUDGET_TOKENS, levels: Sequence[Limits] = GLANCE
) -> Shortened:
    """Make a JSON value fit `budget_tokens` of compact JSON, as `tokens_in` counts them.

    Long arrays of numbers become `{"count", "min", "max", "mean", "argmin"}`, the names that the
    same array's signals have. With the levels `GLANCE` numbers are rounded (see
    `round_number`), which is the stated default and not reported; with `WHOLE` they are exact.
    """
    for limits in levels:
        shortener = _Shortener(limits)
        short = shortener.shorten(value, 0)
        if _fits(short, budget_tokens):
            return Shortened(short, limits.rule() if shortener.cut else None)
    text, longest = compact_json(value), 4 * budget_tokens
    while longest and not _fits(_cut(text, longest), budget_tokens):
        longest //= 2
    return Shortened(_cut(text, longest), f"cut to {longest} characters")


def compact_json(value: Any) -> str:
    """JSON without blanks, as the model reads it; an infinity, which JSON has not, is null."""
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return compact_json(json.loads(json.dumps(value), parse_constant=lambda _: None))


def tokens_in(text: str) -> int:
    """About how many tokens a model reads: of JSON in words 4 characters each, in numbers 1.8."""
    return len(_TOKEN.findall(text))


def tokens_of(value: Any) -> int:
    """How many tokens of compact JSON an answer has, or a part of it."""
    return tokens_in(compact_json(value))


def _fits(value: Any, budget_tokens: int) -> bool:
    """Whether it has no more tokens; of most values their length tells it, without a count."""
    text = compact_json(value)
    if len(text) <= budget_tokens or len(text) > budget_tokens * _LONGEST_TOKEN:
        return len(text) <= budget_tokens
    return tokens_in(text) <= budget_tokens


def round_number(value: float) -> float:
    """A number with 4 significant digits, but never coarser than a thousandth.

    So a time of 1234.567 s and a position far from the origin keep what moves. What adding leaves
    of a sum, as 2.25e-16, is the 0 that it means.
    """
    if abs(value) < _DUST:
        return 0.0
    return round(value, _DECIMALS) if abs(value) >= 1 else float(f"{value:.{_DIGITS}g}")


def cut_text(text: str, longest: int) -> str:
    """A text with its true length at the end where something was left out."""
    return text if len(text) <= longest else _cut(text, longest)


def _cut(text: str, longest: int) -> str:
    return f"{text[:longest]}… [{len(text)} characters]"


class _Shortener:
    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self.cut = False

    def shorten(self, value: Any, depth: int) -> Any:
        if isinstance(value, float):
            return value if self._limits.exact else round_number(value)
        if isinstance(value, str):
            return self._text(value)
        if isinstance(value, dict):
            return self._object(cast("dict[str, Any]", value), depth)
        if isinstance(value, list):
            return self._array(cast("list[Any]", value), depth)
        return value

    def _text(self, text: str) -> str:
        self.cut |= len(text) > self._limits.text
        return cut_text(text, self._limits.text)

    def _object(self, members: dict[str, Any], depth: int) -> Any:
        if depth >= self._limits.depth and members:
            self.cut = True
            return f"{{{len(members)} keys}}"
        shown: dict[str, Any] = {}
        for key, item in list(members.items())[: self._limits.keys]:
            name = self._text(key)
            shown[key if name in shown else name] = self.shorten(item, depth + 1)
        if len(members) > len(shown):
            self.cut = True
            first, last = [*members][len(shown)], [*members][-1]
            more = f"{len(members) - len(shown)} more keys"
            shown["…"] = f"{more}: {self._text(first)} to {self._text(last)}"
        return shown

    def _array(self, items: list[Any], depth: int) -> Any:
        if len(items) > self._limits.items:
            self.cut = True
            return self._summary(items, depth)
        if depth >= self._limits.depth and any(isinstance(item, (dict, list)) for item in items):
            self.cut = True
            return f"[{len(items)} items]"
        return [self.shorten(item, depth + 1) for item in items]

    def _summary(self, items: list[Any], depth: int) -> dict[str, Any]:
        numbers = [item for item in items if _is_figure(item)]
        others = [item for item in items if not _is_figure(item)]
        if all(item is None or item in _ODD_NUMBERS for item in others):
            return {**self._statistics(items, numbers), **_counts(others)}
        first = [self.shorten(item, depth + 1) for item in items[: min(3, self._limits.items)]]
        return {"count": len(items), "first": first}

    @staticmethod
    def _statistics(items: list[Any], numbers: list[float]) -> dict[str, Any]:
        if not numbers:
            return {"count": len(items)}
        low, high = min(numbers), max(numbers)
        mean = sum(number / len(numbers) for number in numbers)
        return {
            "count": len(items),
            "min": round_number(low),
            "max": round_number(high),
            "mean": round_number(mean),
            "argmin": items.index(low),
        }


def _is_figure(item: Any) -> bool:
    """Whether it is a number that a float can hold, unlike an integer of 400 digits."""
    return type(item) in (int, float) and abs(item) <= sys.float_info.max


def _counts(others: list[Any]) -> dict[str, int]:
    """How many items are no numbers, by what they are."""
    names = ["null" if item is None else str(item) for item in others]
    return {name: names.count(name) for name in dict.fromkeys(names)}


_AT_LENGTH: Final = (Limits(items=2000, text=20_000, keys=1000, depth=20),)

_A = TypeVar("_A", bound=Answer)
_T = TypeVar("_T")


def answer_about(view: RobotView, model: type[_A], find: Callable[[], dict[str, Any]]) -> _A:
    """The header with what was found; where nothing was recorded, with the reason as the hint."""
    answer: dict[str, Any] = view.header() | view.position_by()
    try:
        answer |= find()
    except NothingRecordedError as error:
        answer["hint"] = str(error)
    return model(**answer)


def header_of(recording: RecordingAccess, robot: str | None) -> dict[str, Any]:
    """The header of a robot, now."""
    with recording.view(robot) as view:
        return view.header()


def header_of_only(connection: sqlite3.Connection) -> dict[str, Any]:
    """The header of the only robot that can be meant; empty where several can, or none."""
    try:
        return view_robot(connection, None).header()
    except (AmbiguousRobotError, NothingRecordedError):
        return {**storage(connection)}


def room_tokens(
    asked: int | None = None, beside: Any = None, usual_tokens: int = BUDGET_TOKENS
) -> int:
    """The tokens for rows: more where it was said how many rows, in a terminal as many as come.

    Args:
        asked: The most rows or points that were asked for.
        beside: What stands beside the rows and the header; where it is long, rows have less room.
        usual_tokens: The most, where it was not said how many rows.
    """
    if is_for_a_person():
        return _FOR_A_PERSON_TOKENS
    least_beside = _HEADER_TOKENS + tokens_of(beside)
    if asked is None:
        return min(usual_tokens, ANSWER_TOKENS - least_beside)
    return LARGE_ANSWER_TOKENS - max(_BESIDE_TOKENS, least_beside)


def cut_for_a_model(text: str, longest: int) -> str:
    """A text that is cut where it would fill a model's context."""
    return text if is_for_a_person() else cut_text(text, longest)


def detailed(value: Any, budget_tokens: int = DETAIL_BUDGET_TOKENS) -> Any:
    """A value of any kind, rounded, and for a model cut where it is long."""
    if is_for_a_person():
        return shorten(value, _FOR_A_PERSON_TOKENS, _AT_LENGTH).value
    return shorten(value, budget_tokens).value


def figure(value: float | None) -> float | None:
    """A number as it is shown; None where there is none, or none that JSON could hold.

    Adding zero makes -0.0 the 0.0 that it means.
    """
    return None if value is None or not math.isfinite(value) else round_number(value) + 0.0


def seconds(time_s: float | None) -> float | None:
    """A simulation time as it is shown: to the millisecond."""
    return None if time_s is None or not math.isfinite(time_s) else shown_time(time_s)


def figures(values: Sequence[float | None]) -> list[float | None]:
    """A column of numbers as they are shown."""
    return [figure(value) for value in values]


def shown(value: Any) -> Any:
    """A value of any kind, rounded, and for a model cut where it is long."""
    return detailed(value)


def short_name(name: str | None) -> str | None:
    """A name; an absurdly long one is cut."""
    return name and cut_for_a_model(name, LONGEST_NAME)


def fitting(items: Sequence[_T], budget_tokens: int | None = None) -> list[_T]:
    """The first items whose JSON fits the budget, at least one."""
    left = room_tokens() if budget_tokens is None else budget_tokens
    kept: list[_T] = []
    for item in items:
        left -= tokens_of(item)
        if left < 0 and kept:
            break
        kept.append(item)
    return kept


def table(columns: Sequence[str], rows: Sequence[list[Any]]) -> Table | None:
    """A table, or None without rows."""
    return Table(columns=list(columns), rows=list(rows)) if rows else None


def without_empty(columns: Sequence[str], rows: Sequence[list[Any]]) -> Table | None:
    """A table without the columns that have no value in any row."""
    kept = [index for index in range(len(columns)) if any(row[index] is not None for row in rows)]
    return table([columns[index] for index in kept], [[row[i] for i in kept] for row in rows])


def condensed(columns: Sequence[str], rows: Sequence[list[Any]]) -> Table | None:
    """A table that says once what all its rows share; the first column names the row."""
    full = without_empty(columns, rows)
    if full is None or len(rows) < 2:
        return full
    values = [[row[index] for row in full.rows] for index in range(len(full.columns))]
    kept = [i for i, column in enumerate(values) if not i or len({*map(compact_json, column)}) > 1]
    shared = {name: values[i][0] for i, name in enumerate(full.columns) if i not in kept}
    told = Table(
        columns=[full.columns[i] for i in kept], rows=[[row[i] for i in kept] for row in full.rows]
    )
    told.in_every_row = shared or None
    return told


def notes_of(notes: Sequence[str]) -> list[str] | None:
    """The notes of an answer, for a model of many the first and how many more; None without any."""
    if is_for_a_person():
        return [*notes] or None
    left_out = len(notes) - _MOST_NOTES
    more = [f"and {left_out} more notes"] if left_out > 0 else []
    return [cut_text(note, _LONGEST_NOTE) for note in notes[:_MOST_NOTES]] + more or None


def some(names: Sequence[str], most: int = 10) -> str:
    """The first names, and how many more there are; for a person all."""
    most = len(names) if is_for_a_person() else most
    return listed([cut_for_a_model(name, LONGEST_NAME) for name in names], most)


# -- the range of time that was asked about --


def range_in(view: RobotView, scope: Scope) -> TimeRange:
    """What a scope means for the robot of a view, in its newest few runs.

    Raises:
        InvalidRangeError: See `find_range`.
        NothingRecordedError: There is no row, or none in that wall time.
    """
    found = find_range(view.connection, scope, view.subject)
    if not found.segments:
        raise NothingRecordedError(
            f"{'; '.join(found.notes)}: webots_list_runs tells when each run was"
        )
    return newest_runs(found)


def newest_runs(found: TimeRange) -> TimeRange:
    """The range within its newest few runs; a note names earlier ones."""
    earlier = len(found.segments) - MOST_RUNS
    if earlier <= 0:
        return found
    runs = "1 earlier run" if earlier == 1 else f"{earlier} earlier runs"
    note = f"the range holds {runs} too (webots_list_runs): ask with run_id"
    return replace(found, segments=found.segments[-MOST_RUNS:], notes=(*found.notes, note))
