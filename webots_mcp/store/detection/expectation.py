"""`violation`: what was expected of a robot did not hold; and how well it held in a whole run."""

from __future__ import annotations

import ast
import sqlite3
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from webots_mcp.conditions.compiler import Condition
from webots_mcp.conditions.expectation import Expectation, parse_expectation
from webots_mcp.conditions.signal_values import SAME_TIME_S
from webots_mcp.errors import ConditionFailedError, InvalidConditionError
from webots_mcp.pauses import EXPECTED, OF_PROJECT, VIOLATION
from webots_mcp.store.analysis.arrays import Flags, Runs, median, np, runs_of
from webots_mcp.store.detection.condition import holds_in, numbers_in, position_in, values_at
from webots_mcp.store.detection.kinds import (
    Alike,
    Event,
    EventKind,
    NotAskedError,
    NotSearchableError,
)
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.segment import Segment, just_after
from webots_mcp.store.signals import Signal

NONE_EXPECTED: Final = (
    "nothing is expected of this run: bridge.expect(...), webots-mcp.toml, or "
    "webots_check_run(expect=[...])"
)


@dataclass(frozen=True)
class Held:
    """How an expectation held in the rows of a run.

    Attributes:
        violations: Where it did not.
        rows: Of how many it was asked.
        meant_s: For how long it was asked, and `held_s` for how long of that it held: each row
            lasts to the next one, the last as long as usual, an only one not at all.
        lacking: Rows in which it was meant and had no value to be asked of.
        worst: The value that was farthest on the wrong side, where it compares with a number.
    """

    violations: Runs
    rows: int
    meant_s: float
    held_s: float
    lacking: int
    worst: tuple[str, float] | None


def expectations_of(
    connection: sqlite3.Connection, run_id: int, *, of_project: bool = True
) -> list[Expectation]:
    """What was expected of a run: by its controller's code, and by its project as compiled last.

    Args:
        connection: Any.
        run_id: The run.
        of_project: False leaves out what its project expects.
    """
    found = dict[tuple[str, str, str | None], Expectation]()
    for expects, during, name, by in connection.execute(EXPECTED, (run_id,)).fetchall():
        with suppress(InvalidConditionError):
            if of_project or by != OF_PROJECT:
                each = parse_expectation(expects, during, name)
                found[each.asks] = each
    return list(found.values())


def every_call_of(search: Search) -> Frame:
    """All rows of the run, in kept stretches each call: violations keep the seconds around them."""
    whole = Segment(search.segment.run_id, search.began_s, just_after(search.ended_s))
    return read_frame(search.connection, whole, search.deadline, every_call=True)


def judge_expectation(expectation: Expectation, frame: Frame, known: dict[str, Signal]) -> Held:
    """Ask an expectation of the rows of a run.

    Raises:
        ConditionFailedError: The values are not of the kinds that it can be asked of.
    """
    position = position_in(frame, known) if expectation.asks_position else None
    during, expected = expectation.during, expectation.expected
    meant: Flags = np.array(frame.was_read())
    if during is not None:
        meant &= holds_in(during.scanned, during.tree, frame, position)
    if len(frame):
        meant &= frame.times - frame.times[0] >= expectation.takes_s - SAME_TIME_S
        meant[0] &= not expectation.needs_two
    lacks: Flags = np.zeros(len(frame), np.bool_)
    if not expectation.asks_missing:
        for name in (*expected.signals, *(position or ())):
            lacks |= np.isnan(frame.numbers(name)) & (frame.texts(name).codes == 0)
        lacks |= expected.asks_position and position is None
    asked: Flags = meant & ~lacks
    violated: Flags = asked & ~holds_in(expected.scanned, expected.tree, frame, position)
    steps_s = np.diff(frame.times)
    lasts_s = np.append(steps_s, median(steps_s) if len(steps_s) else 0.0)[: len(frame)]
    meant_s, bad_s = (float(lasts_s[each].sum()) for each in (asked, violated))
    worst, runs = _worst(expected, frame, position, violated), runs_of(violated, frame.times)
    rows, lacking = (int(np.count_nonzero(each)) for each in (asked, meant & lacks))
    return Held(runs, rows, meant_s, meant_s - bad_s, lacking, worst)


def _worst(
    expected: Condition, frame: Frame, position: tuple[str, str] | None, violated: Flags
) -> tuple[str, float] | None:
    """Of a comparison of one value with a number: the value that is farthest from holding."""
    tree = expected.tree
    if not isinstance(tree, ast.Compare) or len(tree.ops) != 1 or not violated.any():
        return None
    left, right, op = tree.left, tree.comparators[0], tree.ops[0]
    flipped = isinstance(left, ast.Constant)
    side, other = (right, left) if flipped else (left, right)
    is_fit = isinstance(other, ast.Constant | ast.UnaryOp) and not isinstance(side, ast.Constant)
    if not is_fit or isinstance(op, ast.Eq | ast.NotEq):
        return None
    try:
        values = numbers_in(expected.scanned, side, frame, position)[violated]
    except ConditionFailedError:
        return None
    values = values[~np.isnan(values)]
    if not len(values):
        return None
    wants_more = isinstance(op, ast.Gt | ast.GtE) is not flipped
    start, end = side.col_offset, side.end_col_offset or 0
    columns = expected.scanned.columns
    text = expected.scanned.original[columns[start] : columns[end]]
    return text.strip(), float(values.min() if wants_more else values.max())


def violation_events(search: Search) -> Iterator[Event]:
    """Each stretch in which something that was expected did not hold."""
    expected = expectations_of(search.connection, search.segment.run_id)
    if not expected:
        if len(search.kinds) > 1:
            raise NotAskedError
        raise NotSearchableError(NONE_EXPECTED)
    frame = every_call_of(search)
    search.not_searched(VIOLATION, *map(str, frame.unread))
    for each in expected:
        try:
            held = judge_expectation(each, frame, search.known)
        except ConditionFailedError as error:
            search.not_searched(VIOLATION, str(error))
            continue
        position = position_in(frame, search.known) if each.asks_position else None
        values = values_at(each.violation, frame, position, held.violations)
        for run, details in zip(held.violations.each(), values, strict=True):
            here = search.segment
            if run.start_s < here.end_s and run.end_s >= here.start_s:
                details = {"expected": each.expected.text, **dict(list(details.items())[:8])}
                yield search.event(VIOLATION, run.start_s, run.end_s, each.name, **details)


VIOLATIONS: Final = EventKind(
    VIOLATION,
    "of what is expected",
    violation_events,
    lasts=True,
    drawn=1,
    alike=Alike(lambda events, unit: "violations"),
)
