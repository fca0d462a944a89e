"""The figures of a report as markup, with as many signals as fit into its size limit."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.plotting.canvas import Room
from webots_mcp.plotting.interactive_svg import Figure, signals_figure, way_figure
from webots_mcp.plotting.signal_plot import compose_signals
from webots_mcp.plotting.trajectory import compose_trajectory
from webots_mcp.plugins.report.chapter import Chapter, EventContext
from webots_mcp.plugins.report.obstacles import obstacles_of, with_bodies
from webots_mcp.store.reading.catalogue import known_signals, resolve_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.registered_signals import RegisteredSignal

MOST_SIGNALS: Final = 16
_ROOM: Final = Room(points=500, panels=12, lanes=8, rows=16)
_EVENT_ROOM: Final = Room(points=200, panels=3, lanes=1, rows=0)
_EVENT_PX: Final = 460  # so narrow that its letters can be read on a telephone


@dataclass(frozen=True)
class Figures:
    """Figures as markup.

    Attributes:
        marks: Markup by key of the figure.
        titles: Titles by key.
        notes: Notes on what a figure lacks, by key.
        left_out: Notes on what is in no figure.
    """

    marks: Mapping[str, str] = field(default_factory=dict[str, str])
    titles: Mapping[str, str] = field(default_factory=dict[str, str])
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    left_out: Sequence[str] = ()

    @property
    def size_bytes(self) -> int:
        """Return the bytes that they take in the report."""
        return sum(len(mark.encode()) for mark in self.marks.values())


def figures_of(
    connection: sqlite3.Connection,
    chapters: Sequence[Chapter],
    names: Sequence[str],
    differing: Sequence[str],
    budget_bytes: float,
) -> Figures:
    """Draw all figures of a report, with as many signals as fit.

    Args:
        connection: Connection to the recording.
        chapters: The runs. Two runs are also drawn over each other.
        names: Names of signals, with `*`; empty for the signals that changed most.
        differing: Signals that differ between two runs, drawn over each other if `names` is empty.
        budget_bytes: Maximum size of the figures.

    Raises:
        UnknownSignalError: A name matches no signal.
    """
    known = [_known(connection, each) for each in chapters]
    chosen = _chosen(chapters, known, names)
    both = list(dict.fromkeys(name for had in chosen.values() for name in had))
    both = both if names else [*differing[:MOST_SIGNALS]] or both
    both = [name for name in both if all(name in each for each in known)]
    count = max(map(len, chosen.values()), default=0)
    with_events = True
    while True:
        first = {run_id: had[:count] for run_id, had in chosen.items()}
        drawn = _draw_all(connection, chapters, first, both[:count], with_events=with_events)
        if not both[:count] and len([each for each in chapters if each.range is not None]) > 1:
            drawn.not_drawn.append(f"the signals of both runs: {_why_none(known, names)}")
        made = _embedded(drawn.drawn)
        if made.size_bytes <= budget_bytes:
            return replace(made, left_out=[*_curves_missing(chapters, first), *drawn.not_drawn])
        if count <= 1 and not with_events:
            return Figures(left_out=("the figures: they would take more than the file may",))
        with_events = count > 1
        count = max(count // 2, 1)


def _curves_missing(chapters: Sequence[Chapter], drawn: Mapping[int, Sequence[str]]) -> list[str]:
    """Return notes on numeric signals without a curve."""
    return [
        f"curves of {missing} of {each.numbers} numeric signals of run {each.info.run_id} (drawn "
        "is what changed most, or is named)"
        for each in chapters
        if (missing := each.numbers - len(drawn[each.info.run_id])) > 0
    ]


def moment_key(chapter: Chapter, moment: EventContext) -> str:
    """Return the key of the figure of an event."""
    return f"moment {chapter.info.run_id} {list(chapter.moments).index(moment)}"


def _known(connection: sqlite3.Connection, chapter: Chapter) -> dict[str, RegisteredSignal]:
    return {} if chapter.range is None else known_signals(connection, chapter.range)


def _chosen(
    chapters: Sequence[Chapter], known: Sequence[dict[str, RegisteredSignal]], names: Sequence[str]
) -> dict[int, list[str]]:
    """Return the signals to draw of each run. Runs of two robots may have different signals."""
    if not names:
        return {each.info.run_id: [*each.changed_most[:MOST_SIGNALS]] for each in chapters}
    of_any = {name: signal for each in known for name, signal in each.items()}
    asked = {signal.name for signal in resolve_signals(of_any, names)}
    return {
        chapter.info.run_id: [name for name in had if name in asked]
        for chapter, had in zip(chapters, known, strict=True)
    }


def _why_none(known: Sequence[dict[str, RegisteredSignal]], names: Sequence[str]) -> str:
    """Return why no signals are drawn over each other."""
    if names:
        return "none that was asked for is in both"
    shared = [name for name in known[0] if all(name in each for each in known)]
    if any(each[name].is_number for name in shared for each in known):
        return "none of those that changed most is in both"
    return "they share no numeric signals"


class _FigureSet:
    """The figures of a report by key, and the reasons why others could not be drawn."""

    def __init__(self, connection: sqlite3.Connection, chapters: Sequence[Chapter]) -> None:
        self._connection = connection
        self._found = {each.info.run_id: each.found for each in chapters if each.found}
        self.drawn: dict[str, Figure] = {}
        self.not_drawn: list[str] = []

    def alone(self, run_id: int, whole: TimeRange, names: Sequence[str]) -> None:
        """Draw signals of a run over time, and its path."""
        key, drawn = f"signals {run_id}", names or ["*"]
        self._add(key, f"the signals of run {run_id}", self._signals, [whole], drawn)
        self._add(f"way {run_id}", f"the path of run {run_id}", self._way, [whole])

    def overlaid(self, ranges: Sequence[TimeRange], names: Sequence[str]) -> None:
        """Draw the same of two runs over each other."""
        if names:
            self._add("signals both", "the signals of both runs", self._signals, ranges, names)
        self._add("way both", "the ways of both runs", self._way, ranges)

    def _add(self, key: str, what: str, draw: Callable[..., Figure], *asked: Any) -> None:
        try:
            self.drawn[key] = draw(*asked)
        except (InvalidInputError, NothingRecordedError) as error:
            self.not_drawn.append(f"{what}: {error}")

    def _signals(self, ranges: Sequence[TimeRange], names: Sequence[str]) -> Figure:
        composed = compose_signals(self._connection, ranges, names, found=self._found, room=_ROOM)
        return signals_figure(*composed)

    def _way(self, ranges: Sequence[TimeRange]) -> Figure:
        plot, notes = compose_trajectory(self._connection, ranges, found=self._found)
        plot = replace(plot, tracks=with_bodies(self._connection, plot.tracks, ranges))
        return way_figure(plot, notes, obstacles_of(self._connection, ranges))

    def around(self, chapter: Chapter, moment: EventContext) -> None:
        """Draw the signals that show an event, or the usual ones, in the seconds around it."""
        usual = chapter.changed_most[: _EVENT_ROOM.panels]
        for names in filter(None, (moment.signals, list(moment.event.around), usual)):
            # The event may have no signal, or one without a value at that time.
            with suppress(InvalidInputError, NothingRecordedError):
                self.drawn[moment_key(chapter, moment)] = self._seconds(chapter, moment, names)
                return

    def _seconds(self, chapter: Chapter, moment: EventContext, names: Sequence[str]) -> Figure:
        scope = Scope(run_id=chapter.info.run_id, start_s=moment.start_s, end_s=moment.end_s)
        around = find_range(self._connection, scope)
        composed = compose_signals(
            self._connection, [around], names, events=False, room=_EVENT_ROOM
        )
        return signals_figure(*composed, width_px=_EVENT_PX)


def _draw_all(
    connection: sqlite3.Connection,
    chapters: Sequence[Chapter],
    chosen: Mapping[int, Sequence[str]],
    both: Sequence[str],
    *,
    with_events: bool,
) -> _FigureSet:
    drawn = _FigureSet(connection, chapters)
    ranges = [each.range for each in chapters if each.range is not None]
    if len(ranges) > 1:
        drawn.overlaid(ranges, both)
    for chapter in chapters:
        if chapter.range is not None:
            run_id = chapter.info.run_id
            drawn.alone(run_id, chapter.range, chosen[run_id])
        for moment in chapter.moments if with_events else ():
            drawn.around(chapter, moment)
    return drawn


def _embedded(figures: Mapping[str, Figure]) -> Figures:
    return Figures(
        {key: figure.markup for key, figure in figures.items()},
        {key: figure.title for key, figure in figures.items()},
        {key: figure.notes for key, figure in figures.items()},
    )
