"""The questions whose answers are judged; all that depends on the form of an answer is here."""

from __future__ import annotations

import re
import sqlite3
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from tests.detection.labelled import Measure
from webots_mcp.store.detection.events import find_events
from webots_mcp.store.detection.kinds import Event, EventOptions
from webots_mcp.store.questions.compare import Comparison, compare_runs
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
_OTHERS: Final = re.compile(r"not in \d+ of |not with a period of more than 5 s ")
# By how much a distance may be too short, of some runs or of all.
_LONGER: Final = re.compile(r"(?:run ([\d, ]+): )?the path may be up to ([\d.]+) (%|m) longer")
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


@dataclass(frozen=True)
class ToldDistance:
    """How far a robot is said to have travelled, and by how much that may be too little."""

    distance_m: float
    longer_m: float


def told_distances(
    connection: sqlite3.Connection, run_ids: Sequence[int]
) -> list[ToldDistance | None]:
    """Of each of the runs, 2 to 10 of them, over the same stretch."""
    comparison = compare_runs(connection, run_ids, deadline_s=UNHURRIED_S)
    way = next((each for each in comparison.measures if each.name == "distance_m"), None)
    spread = way.spread if way else [None] * len(run_ids)
    doubts = comparison.unknown.get("distance_m, mean_speed_m_s", "")
    return [
        each and ToldDistance(each.median, _longer_m(doubts, run_id, each.median))
        for run_id, each in zip(run_ids, spread, strict=True)
    ]


def _longer_m(doubts: str, run_id: int, distance_m: float) -> float:
    """What the sentence about a run says, or the one about all."""
    for runs, figure, unit in _LONGER.findall(doubts):
        if not runs or str(run_id) in runs.split(", "):
            return float(figure) * (distance_m / 100 if unit == "%" else 1)
    return 0.0


def compared_edits(connection: sqlite3.Connection) -> Comparison:
    """The runs before the last edit and those after it."""
    return compare_runs(connection, limit=_ALL, deadline_s=UNHURRIED_S)


def claimed_differences(comparison: Comparison) -> Iterable[tuple[str, float]]:
    """What is claimed to be different since the last edit: names, and how much more it is."""
    figures = [(each.name, each.spread, each.different) for each in comparison.measures]
    figures += [(each.name, each.mean, each.different) for each in comparison.differences]
    for name, spread, different in figures:
        before, after = spread[0], spread[-1]
        if different[-1] and before is not None and after is not None:
            yield name, after.median - before.median


def undecided(comparison: Comparison) -> list[str]:
    """What may be different, but for which more runs are wanted."""
    return [each.name for each in comparison.measures if each.runs_wanted[-1] is not None]
