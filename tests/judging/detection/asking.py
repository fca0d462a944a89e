"""The questions whose answers are judged; all that depends on the form of an answer is here."""

from __future__ import annotations

import re
import sqlite3
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from tests.judging.detection.labelled import Measure
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.reading.ranges import Scope, find_range

# Without a deadline that a busy machine would meet; how long it took is measured beside.
UNHURRIED_S: Final = 300.0
_ALL: Final = 1_000_000

# The kinds of events that tell each measure.
_KINDS: Final[dict[Measure, tuple[str, ...]]] = {
    "standstill": ("standstill", "stuck"),
    "stuck": ("stuck",),
    "missing": ("missing",),
    "flat": ("flat",),
    "dropout": ("jump",),
    "leap": ("jump",),
    "swing": ("oscillation",),
    "gap": ("gap",),
}
# Signals that are never searched, and periods that are not drawn.
_OTHERS: Final = re.compile(
    r"\d+ of \d+ numeric signals? (was|were) not searched|not with a period of more than 5 s "
)
_OF_ROBOT: Final = frozenset[Measure]({"standstill", "stuck", "leap", "gap"})


@dataclass(frozen=True)
class Claim:
    """What an answer says that happened.

    Attributes:
        name: The published signal; None where it is about the robot.
        count: How often, where several are told as one.
        source: The kind of the event and the name that it gives.
    """

    measure: Measure
    run_id: int
    start_s: float
    end_s: float
    name: str | None = None
    period_s: float | None = None
    amplitude: float | None = None
    count: int = 1
    source: tuple[str, str | None] = ("", None)


@dataclass(frozen=True)
class Answer:
    """What a question was answered.

    Attributes:
        not_searched: By kind of event, what was not looked for and why.
        took_s: Wall time.
    """

    claims: tuple[Claim, ...]
    not_searched: dict[str, str]
    took_s: float

    def of(self, measure: Measure, run_id: int) -> list[Claim]:
        """What it claims of one kind in one run."""
        return [each for each in self.claims if (each.measure, each.run_id) == (measure, run_id)]

    def admits(self, measure: Measure) -> bool:
        """Whether it says that something of that kind may have been missed."""
        reasons = [self.not_searched.get(kind, "") for kind in _KINDS[measure]]
        parts = [part for reason in reasons for part in reason.split("; ")]
        return any(part and not _OTHERS.match(part) for part in parts)


def ask_run(
    connection: sqlite3.Connection,
    measures: Sequence[Measure],
    run_id: int,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Answer:
    """What happened in a run, all of it or from and up to a time."""
    return _asked(connection, measures, run_id=run_id, start_s=start_s, end_s=end_s)


def ask_since(
    connection: sqlite3.Connection, measures: Sequence[Measure], since_wall_s: float
) -> Answer:
    """What happened in all runs since a wall time."""
    return _asked(connection, measures, since_wall_time=since_wall_s)


def _asked(
    connection: sqlite3.Connection, measures: Sequence[Measure], **bounds: float | None
) -> Answer:
    kinds = tuple({kind for measure in measures for kind in _KINDS[measure]})
    started_s = time.perf_counter()
    time_range = find_range(connection, Scope(**bounds))  # pyright: ignore[reportArgumentType]
    told = find_events(
        connection,
        time_range,
        EventOptions(kinds=kinds),
        limit=_ALL,
        around=(),
        group=False,
        deadline_s=UNHURRIED_S,
    )
    took_s = time.perf_counter() - started_s
    claims = [each for measure in measures for each in claims_of(told.events, measure)]
    return Answer(tuple(claims), told.verdicts.not_searched, took_s)


def claims_of(events: Iterable[Event], measure: Measure) -> list[Claim]:
    """The events of a measure; what several signals of one array tell at once is one claim.

    So is a standstill with the parts of it in which the robot was stuck.
    """
    found: list[Claim] = []
    for claim in sorted(_claims(events, measure), key=lambda each: each.start_s):
        same = (at for at, each in enumerate(found) if _is_one(each, claim))
        if (at := next(same, None)) is None:
            found.append(claim)
        else:
            end_s = max(found[at].end_s, claim.end_s)
            found[at] = replace(found[at], end_s=end_s, source=claim.source)
    return found


def _claims(events: Iterable[Event], measure: Measure) -> Iterable[Claim]:
    for event in events:
        of_position = event.kind == "jump" and event.name == "position"
        if event.kind in _KINDS[measure] and of_position == (measure == "leap"):
            named = event.name is not None and measure not in _OF_ROBOT
            yield Claim(
                measure,
                event.run_id,
                event.start_s,
                event.end_s,
                event.name.split(".")[0] if named and event.name else None,
                event.details.get("period_s"),
                event.details.get("amplitude"),
                event.count,
                (event.kind, event.name),
            )


def _is_one(one: Claim, other: Claim) -> bool:
    """Two events that overlap are one where they differ in kind or in the item of an array."""
    alike = (one.run_id, one.name) == (other.run_id, other.name) and one.source != other.source
    return alike and other.start_s <= one.end_s and one.start_s <= other.end_s
