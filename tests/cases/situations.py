"""What a situation is: columns as a controller would publish them, and what has to be answered.

`HEALTHY` and `PROBLEMS` are filled by the decorator when their modules are imported.
"""

from __future__ import annotations

import re
import sqlite3
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np

from tests.cases.columns import Array
from tests.memory import memory_connection
from tests.recordings.rover import WALL_PER_SIM, WALL_START_S, start_run
from webots_mcp.bridge.encoding import encode
from webots_mcp.judging.checks.check_run import CheckedRun, check_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import one_reading

Columns = Mapping[str, Any]
Draw = Callable[[Array, np.random.Generator], Columns]
Expectation = Callable[["Recording"], str | None]  # what is wrong with the answer, or None

UNHURRIED_S: Final = 300.0  # no machine is so slow that a deadline decides
_MOST_EVENTS: Final = 1_000
_INSERT: Final = (
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data, replaced) VALUES (?, ?, ?, ?, ?)"
)


@dataclass(frozen=True)
class Situation:
    """A robot in a situation, and what must be answered about it.

    Attributes:
        name: What the robot does, as a phrase.
        draw: Columns of what it publishes, by dotted name, given times and a random generator.
            A column `recorded` of flags leaves rows out. Two dimensions are an array per row.
        expect: What each answer must fulfil.
        known_gap: Why it is not answered yet; None where it must be.
        source: The public report of which it is a model; empty if there is none.
    """

    name: str
    draw: Draw
    expect: tuple[Expectation, ...]
    lasts_s: float
    interval_s: float
    known_gap: str | None = None
    source: str = ""

    def columns(self) -> tuple[Array, Columns]:
        """Return the times of its rows, and its columns; each call returns the same."""
        count = int(self.lasts_s / self.interval_s)
        steps = [round(step * self.interval_s, 6) for step in range(1, count + 1)]
        times = np.array(steps, dtype=np.float64)
        random = np.random.default_rng(zlib.crc32(self.name.encode()))
        return times, self.draw(times, random)


HEALTHY: Final[dict[str, Situation]] = {}
PROBLEMS: Final[dict[str, Situation]] = {}


def situation(
    registry: dict[str, Situation],
    name: str,
    *expect: Expectation,
    lasts_s: float,
    interval_s: float = 0.032,
    known_gap: str | None = None,
    source: str = "",
) -> Callable[[Draw], Draw]:
    """Register a function that draws the columns of a situation."""

    def register(draw: Draw) -> Draw:
        assert name not in registry, name
        registry[name] = Situation(name, draw, expect, lasts_s, interval_s, known_gap, source)
        return draw

    return register


# -- recordings ------------------------------------------------------------------------------------


@dataclass
class Recording:
    """A situation that was recorded, and the questions that expectations ask of it."""

    connection: sqlite3.Connection
    run_id: int = 1
    _answers: dict[EventOptions, Events] = field(default_factory=dict[EventOptions, Events])

    @cached_property
    def checked(self) -> CheckedRun:
        """What all checks come to."""
        return check_run(self.connection, self.run_id, deadline_s=UNHURRIED_S)

    def events(self, *kinds: str, signals: Sequence[str] = ("*",), where: str | None = None):
        """Return the answer about some kinds of events, each event by itself."""
        options = EventOptions(kinds=kinds, signals=tuple(signals), where=where)
        if options not in self._answers:
            self._answers[options] = find_events(
                self.connection,
                find_range(self.connection, Scope(run_id=self.run_id)),
                options,
                limit=_MOST_EVENTS,
                group=False,
                deadline_s=UNHURRIED_S,
            )
        return self._answers[options]


@contextmanager
def recorded(each: Situation) -> Generator[Recording]:
    """Write the rows of a situation as a bridge does, into a database in memory."""
    times, columns = each.columns()
    with memory_connection() as connection:
        record(connection, times, columns)
        with one_reading(connection):  # events and checks are asked of the same rows
            yield Recording(connection)


def record(connection: sqlite3.Connection, times: Array, columns: Columns) -> None:
    """Write a run that ended by itself."""
    recorder = start_run(connection)
    connection.execute("BEGIN")
    connection.executemany(_INSERT, _rows(recorder.run_id, times, columns))
    recorder.at(float(times[-1]))
    recorder.end_run("finished")
    connection.execute("COMMIT")


def _rows(run_id: int, times: Array, columns: Columns) -> Iterator[tuple[Any, ...]]:
    spread = {
        name: values.tolist() if isinstance(values, np.ndarray) else list(values)
        for name, values in columns.items()
    }
    kept = spread.pop("recorded", [True] * len(times))
    for at, time_s in enumerate(times.tolist()):
        if kept[at]:
            encoded = encode(_nested((name, values[at]) for name, values in spread.items()))
            wall_s = WALL_START_S + time_s * WALL_PER_SIM
            yield run_id, time_s, wall_s, encoded.text, encoded.replaced_text


def _nested(items: Iterator[tuple[str, Any]]) -> dict[str, Any]:
    """Return a state, with a dict for each point in the names."""
    state: dict[str, Any] = {}
    for name, value in items:
        *branches, leaf = name.split(".")
        inner = state
        for branch in branches:
            inner = inner.setdefault(branch, {})
        inner[leaf] = value
    return state


# -- expectations ----------------------------------------------------------------------------------


def quiet(asked: Recording) -> str | None:
    """Expect that no check warns or fails, and that something was judged."""
    return None if asked.checked.outcome == "pass" else _alarms(asked)


def noticed(asked: Recording) -> str | None:
    """Expect that a check warns or fails."""
    return None if asked.checked.outcome in ("warn", "fail") else _alarms(asked)


def fails(asked: Recording) -> str | None:
    """Expect that a check fails."""
    return None if asked.checked.outcome == "fail" else _alarms(asked)


def says(pattern: str) -> Expectation:
    """Expect a check that warns or fails with such words."""

    def wrong(asked: Recording) -> str | None:
        found = asked.checked.of("warn", "fail")
        said = any(re.search(pattern, f"{each.name}: {each.evidence}", re.I) for each in found)
        return None if said else f"no alarm says {pattern!r}; {_alarms(asked)}"

    return wrong


def finds(
    kind: str,
    start_s: float,
    end_s: float,
    within_s: float = 1.0,
    signals: Sequence[str] = ("*",),
) -> Expectation:
    """Expect one event of a kind, with this start and end."""

    def wrong(asked: Recording) -> str | None:
        found = asked.events(kind, signals=signals).events
        spans = [(each.start_s, each.end_s) for each in found]
        fits = [abs(a - start_s) <= within_s and abs(b - end_s) <= within_s for a, b in spans]
        if fits == [True]:
            return None
        shown = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in spans[:4]) or "none"
        return f"one {kind} from {start_s:g} to {end_s:g} s expected, found {shown}"

    return wrong


def counts(kind: str, number: int) -> Expectation:
    """Expect so many events of a kind."""

    def wrong(asked: Recording) -> str | None:
        found = sum(each.count for each in asked.events(kind).events)
        return None if found == number else f"{number} of {kind} expected, found {found}"

    return wrong


def none_of(kind: str) -> Expectation:
    """Expect no event of a kind."""

    def wrong(asked: Recording) -> str | None:
        found = asked.events(kind).events
        return f"{len(found)} of {kind}, {described(found[0])}" if found else None

    return wrong


def never_denies(kind: str, signals: Sequence[str] = ("*",)) -> Expectation:
    """Expect events of a kind, or that it is said not to have been searched."""

    def wrong(asked: Recording) -> str | None:
        verdicts = asked.events(kind, signals=signals).verdicts
        denied = kind in verdicts.not_found and kind not in verdicts.reasons
        return f"{kind}: not found" if denied else None

    return wrong


def holds_with(where: str, pattern: str) -> Expectation:
    """Expect events of a condition whose details match."""

    def wrong(asked: Recording) -> str | None:
        found = asked.events("condition", where=where).events
        shown = "; ".join(str(each) for each in found)
        return None if re.search(pattern, shown) else f"{where!r}: {shown[:200] or 'never'}"

    return wrong


def described(event: Event) -> str:
    """Return kind, signal and start of an event."""
    return f"{event.kind} {event.name or ''} at {event.start_s:.1f} s"


def _alarms(asked: Recording) -> str:
    found = asked.checked.of("warn", "fail")
    said = "; ".join(f"{each.name}: {each.evidence}" for each in found)
    return f"the checks come to {asked.checked.outcome}" + (f": {said}" if said else "")


def failures(each: Situation) -> list[str]:
    """Ask what the situation expects; return what is wrong with the answers."""
    with recorded(each) as asked:
        return [wrong for expected in each.expect if (wrong := expected(asked))]
