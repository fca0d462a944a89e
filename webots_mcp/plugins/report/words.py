"""How a report says things: numbers, times, events, tables and comparisons as texts."""

from __future__ import annotations

import json
import math
import re
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from html import escape
from typing import Any, Final, NamedTuple, cast

from webots_mcp.analysis.summary import Spread
from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.comparison import Comparison, Difference, compare_runs
from webots_mcp.judging.detection.kinds import Event
from webots_mcp.signals import naming

LONGEST_TEXT: Final = 1_000  # characters of a cell
_LONGEST_VALUE: Final = 400  # of a value within one
_NOTHING: Final = 1e-9  # of a signal's span: what is left when numbers cancel each other out
_UNIT: Final = re.compile(r"(.+)_(s|m|rad)")
_UNTOLD: Final = ("id", "image_id", "first_times_s")
_ROW_BYTES: Final = 32  # of marks around a row
_SHORT: Final = 24  # characters
_CELL_BYTES: Final = 24  # of marks around a cell
MOST_DIFFERENCES: Final = 30
_MOST_SAID: Final = 5
_SHARE_OF_TEXTS: Final = 0.1
_LARGE: Final = ((0.8, "large"), (0.5, "medium"), (0.2, "small"))  # Cohen's words for his d


def cut(text: str, longest: int = LONGEST_TEXT) -> str:
    """A text, a long one with how long it is."""
    if len(text) <= longest:
        return text
    return f"{text[:longest]} … ({len(text)} characters)"


def number(value: float | None, span: float = 0.0) -> str:
    """Four digits, which tell what a person can see; nothing where there is no number.

    Args:
        value: Any.
        span: From the least to the greatest value of its signal: what is nothing beside it is 0.
    """
    if value is None:
        return ""
    is_nothing = abs(value) <= _NOTHING * span < math.inf
    return f"{0.0 if is_nothing else value:.4g}"


def pace_text(factor: float) -> str:
    """How fast simulation time went by."""
    text = f"{factor:.2g}"
    return "at the pace of real time" if text == "1" else f"at {text} times real time"


def time_at(time_s: float | None) -> str:
    """A simulation time, to the millisecond."""
    return "" if time_s is None else f"{time_s:.3f}"


def length(duration_s: float) -> str:
    """A duration: 12.3 s, 4 min 5 s, 2 h 3 min."""
    if duration_s < 120:
        return f"{duration_s:.3g} s"
    minutes, rest_s = divmod(round(duration_s), 60)
    if minutes < 120:
        return f"{minutes} min {rest_s} s"
    return f"{minutes // 60} h {minutes % 60} min"


def clock(wall_time_s: float) -> str:
    """A wall time; in UTC, which means the same wherever the file is read."""
    moment = datetime.fromtimestamp(wall_time_s, timezone.utc)
    return moment.strftime("%Y-%m-%d %H:%M:%S UTC")


def size(size_bytes: int) -> str:
    """The size of a file."""
    return f"{size_bytes / 1e6:.{1 if size_bytes >= 1e6 else 2}f} MB"


def share(part: float, whole: float) -> str:
    """A part as a percentage."""
    return f"{100 * part / whole:.3g} %" if whole > 0 else ""


def counted(count: int, what: str) -> str:
    """1 event, 2 events."""
    return f"{count:,} {what}" + ("" if count == 1 else "s")


def format_value(value: Any) -> str:
    """A value of any kind in one line."""
    if value is None:
        return "null"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, str):
        return cut(value, _LONGEST_VALUE)
    return cut(json.dumps(_rounded(value), ensure_ascii=False, default=str), _LONGEST_VALUE)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(number(value))
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in cast("dict[str, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(each) for each in cast("list[Any]", value)]
    return value


def format_named_values(values: Mapping[str, Any]) -> str:
    """Named values in one line; a unit at the end of a name stands behind its value."""
    return "; ".join(_named(name, value) for name, value in values.items())


def format_signal_values(values: Mapping[str, Any]) -> str:
    """Values of signals or parameters in one line, under the names that they have."""
    return ", ".join(f"{name} {format_value(value)}" for name, value in values.items())


def _named(name: str, value: Any) -> str:
    found = _UNIT.fullmatch(name)
    if isinstance(value, str) and " " in value:
        return f"{name.replace('_', ' ')}: {format_value(value)}"
    if found is None or not isinstance(value, (int, float)):
        return f"{name.replace('_', ' ')} {format_value(value)}"
    return f"{found[1].replace('_', ' ')} {format_value(value)} {found[2]}"


def describe_event(event: Event) -> str:
    """What happened, without when."""
    if event.count > 1:
        return _describe_many(event)
    return cut(_WORDS.get(event.kind, _describe_others)(event))


def _describe_many(event: Event) -> str:
    details = {name: each for name, each in event.details.items() if name not in _UNTOLD}
    says = details.pop("says", f"{event.count} times {event.kind}")
    of = f"{event.name}: " if event.name else ""
    return cut("; ".join(filter(None, (f"{of}{says}", format_named_values(details)))))


def _describe_change(event: Event) -> str:
    before, after = event.details["before"], event.details["after"]
    return f"{event.name}: {format_value(before)} → {format_value(after)}"


def _describe_log(event: Event) -> str:
    return f"{event.name} ({event.details['source']}): {event.details['message']}"


def _describe_command(event: Event) -> str:
    details = dict(event.details)
    params = format_signal_values(details.get("params") or {})
    outcome = details["status"]
    if "took_wall_s" in details:
        outcome += f" after {length(details['took_wall_s'])} of wall time"
    outcome += f", answer {format_value(details['result'])}" if details.get("result") else ""
    outcome += f", {details['error']}" if details.get("error") else ""
    return f"{event.name}({params}): {outcome}"


def _describe_run(event: Event) -> str:
    return f"the run {event.details['what']} ({event.details['reason'] or 'unknown cause'})"


def _describe_noticed(event: Event) -> str:
    name = f" {event.name}" if event.name else ""
    data = event.details.get("data")
    said = (
        format_named_values(cast("dict[str, Any]", data))
        if isinstance(data, dict)
        else format_value(data)
    )
    return f"{event.details['what']}{name}" + (f": {said}" if data else "")


def _describe_image(event: Event) -> str:
    return f"picture of {event.name or 'the main view'}"


def _describe_gap(event: Event) -> str:
    usual_s = event.details.get("usual_interval_s")
    return "no rows" + (f", else one each {number(usual_s)} s" if usual_s else "")


def _describe_others(event: Event) -> str:
    details = {name: each for name, each in event.details.items() if name not in _UNTOLD}
    said = [str(details.pop("says"))] if "says" in details else []
    said += [format_named_values(details)] if details else []
    return ": ".join(filter(None, (event.name, "; ".join(said))))


_WORDS: Final[Mapping[str, Callable[[Event], str]]] = {
    "change": _describe_change,
    "log": _describe_log,
    "command": _describe_command,
    "run": _describe_run,
    "bridge_event": _describe_noticed,
    "image": _describe_image,
    "gap": _describe_gap,
}


class GridRow(NamedTuple):
    """Texts, and a mark that shows in the page: `warning`, `error` or nothing."""

    cells: Sequence[str]
    mark: str = ""

    @property
    def size_bytes(self) -> int:
        """About what the row takes in the page."""
        texts = sum(len(escape(cell).encode("utf-8", "replace")) for cell in self.cells)
        return _ROW_BYTES + _CELL_BYTES * len(self.cells) + texts


@dataclass(frozen=True)
class Grid:
    """A table.

    Attributes:
        columns: Their names; a unit stands in brackets.
        notes: What is said below it.
        left_out: How many rows are not shown for want of room.
        or_more: There may be more than these, which nobody counted.
    """

    columns: Sequence[str]
    rows: Sequence[GridRow]
    notes: Sequence[str] = field(default=())
    left_out: int = 0
    or_more: bool = False

    @property
    def missing(self) -> str:
        """How many rows are not shown, in words."""
        return f"{self.left_out:,}" + (" or more" if self.or_more else "")

    @property
    def classes(self) -> list[str]:
        """How each column is set: digits below each other, short texts in one line."""
        return [
            self._class_of([row.cells[i] for row in self.rows]) for i in range(len(self.columns))
        ]

    def within(self, room_bytes: float, *, newest: bool = False) -> Grid:
        """As many of the first rows, or of the newest, as have room; empty columns are dropped."""
        rows = list(reversed(self.rows)) if newest else list(self.rows)
        kept: list[GridRow] = []
        for row in rows:
            room_bytes -= row.size_bytes
            if room_bytes < 0:
                break
            kept.append(row)
        left_out = self.left_out + len(rows) - len(kept)
        shown = replace(self, rows=kept[::-1] if newest else kept, left_out=left_out)
        return shown._without_empty_columns()

    def _class_of(self, cells: Sequence[str]) -> str:
        if all(map(_is_number, cells)):
            return "number"
        return "short" if max(map(len, cells)) <= _SHORT else ""

    def _without_empty_columns(self) -> Grid:
        kept = [i for i in range(len(self.columns)) if any(row.cells[i] for row in self.rows)]
        rows = [GridRow([row.cells[i] for i in kept], row.mark) for row in self.rows]
        return replace(self, columns=[self.columns[i] for i in kept], rows=rows)


def _is_number(text: str) -> bool:
    try:
        float(text or "0")
    except ValueError:
        return False
    return True


# -- two runs beside each other: the answer of `compare_runs`, in words too ------------------------


@dataclass(frozen=True)
class RunComparison:
    """Two runs beside each other.

    Attributes:
        says: The comparison in words.
        differing: The signals that differ, what differs most first.
        why_not: Why they could not be compared; empty where they were.
    """

    says: Sequence[str] = ()
    differing: Sequence[str] = ()
    parameters: Grid | None = None
    measures: Grid | None = None
    differences: Grid | None = None
    notes: Sequence[str] = ()
    why_not: str = ""


def compare_two_runs(
    connection: sqlite3.Connection, run_ids: Sequence[int], room_bytes: float
) -> RunComparison:
    """Compare two runs, in texts of about a tenth of so many bytes at most.

    Raises:
        UnknownRunError: No run has such an id.
    """
    try:
        found = compare_runs(connection, run_ids, limit=MOST_DIFFERENCES)
    except NothingRecordedError as error:
        return RunComparison(why_not=str(error))
    names = [group.name for group in found.groups]
    differences = _differences(found, names).within(_SHARE_OF_TEXTS * room_bytes)
    notes = [f"not known: {figures}: {why}" for figures, why in found.unknown.items()]
    notes += [
        f"only in {' and '.join(groups)}: {naming.listed(only)}" for groups, only in _only_in(found)
    ]
    return RunComparison(
        _says(found),
        [each.name for each in found.differences if each.effect[1]],
        _parameters(found, names),
        _measures(found, names),
        differences if differences.rows else None,
        (*found.notes, *notes),
    )


def _says(found: Comparison) -> list[str]:
    """In words: how long, what the runs came to, and the signals that differ most."""
    first, second = (group.name for group in found.groups)
    said = [
        f"Compared are the first {length(found.compared_s)} of each run: {second} with {first}."
    ]
    said += [
        f"{name}: {first} {_values(first_had)}, {second} {_values(second_had)}."
        for name, first_had, second_had in _unlike_parameters(found)
    ]
    for each in found.measures:
        one, other = each.spread
        if one is not None and other is not None and one.median != other.median:
            said.append(f"{each.name}: {_change(one, other)}.")
    large = [each for each in found.differences if abs(each.effect[1] or 0.0) >= _LARGE[-1][0]]
    for each in large[:_MOST_SAID]:
        one, other = each.mean
        if one is not None and other is not None:
            said.append(f"mean of {each.name}: {_change(one, other)}{_effect(each)}.")
    return said if len(said) > 1 else [*said, "No figure differs."]


def _change(one: Spread, other: Spread) -> str:
    by = other.median - one.median
    change = f"{100 * by / abs(one.median):+.3g} %" if one.median else f"{by:+.3g}"
    return f"{number(other.median)} instead of {number(one.median)} ({change})"


def _effect(difference: Difference) -> str:
    size = difference.effect[1]
    if size is None:
        return ""
    word = next((word for least, word in _LARGE if abs(size) >= least), "hardly any")
    return f"; beside how much it varies within a run that is {word} (effect {number(size)})"


def _unlike_parameters(found: Comparison) -> list[tuple[str, Sequence[object], Sequence[object]]]:
    first, second = (group.parameters for group in found.groups)
    names = dict.fromkeys((*first, *second))
    return [(name, first.get(name, ()), second.get(name, ())) for name in names]


def _values(values: Sequence[object]) -> str:
    return "; ".join(map(format_value, values)) or "without it"


def _parameters(found: Comparison, names: Sequence[str]) -> Grid | None:
    rows = [
        GridRow([name, _values(one), _values(other)])
        for name, one, other in _unlike_parameters(found)
    ]
    return Grid(("parameter", *names), rows) if rows else None


def _measures(found: Comparison, names: Sequence[str]) -> Grid | None:
    rows = [GridRow([each.name, *map(_median, each.spread)]) for each in found.measures]
    return Grid(("figure", *names), rows) if rows else None


def _differences(found: Comparison, names: Sequence[str]) -> Grid:
    first, second = names
    columns = ("signal", "unit", f"mean, {first}", f"mean, {second}", "effect",
               f"deviation, {first}", f"deviation, {second}")  # fmt: skip
    rows = [
        GridRow([
            each.name, each.unit or "", *map(_median, each.mean), number(each.effect[1]),
            *map(_median, each.deviation),
        ])
        for each in found.differences
    ]  # fmt: skip
    return Grid(columns, rows, left_out=found.total - len(rows))


def _median(spread: Spread | None) -> str:
    return number(None if spread is None else spread.median)


def _only_in(found: Comparison) -> list[tuple[tuple[str, ...], list[str]]]:
    """Signals that one of the runs lacks, by the runs that have them."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, groups in found.only_in.items():
        names.setdefault(groups, []).append(name)
    return list(names.items())
