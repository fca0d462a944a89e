"""The interactive figures of a report, as marks for its page; Bokeh's script goes in with them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.report.chapter import Chapter, Moment
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.signals.catalogue import signals_of

if TYPE_CHECKING:
    from webots_mcp.charts import Chart

MOST_SIGNALS: Final = 16
_PANELS: Final = 12
_POINTS: Final = 500
_MOMENT_POINTS: Final = 200


def require_view() -> None:
    """See that there is what a page is made with, before anything is read.

    Raises:
        InvalidInputError: The extra `view` is not installed.
    """
    try:
        import_module("bokeh")
        import_module("jinja2")
    except ImportError as error:
        raise InvalidInputError(
            "a report needs Bokeh: pip install 'webots-mcp[view]' (the extra [view] of webots-mcp)"
        ) from error


def library() -> str:
    """Bokeh's own script, as it stands in the page."""
    from bokeh.resources import Resources

    return Resources(mode="inline", components=["bokeh"]).render_js()


@dataclass(frozen=True)
class Figures:
    """Figures as marks.

    Attributes:
        script: What draws them all.
        marks: Where each goes, by its key.
        titles: What each shows.
        notes: What is not in each.
        left_out: What is in none.
    """

    script: str = ""
    marks: Mapping[str, str] = field(default_factory=dict[str, str])
    titles: Mapping[str, str] = field(default_factory=dict[str, str])
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    left_out: Sequence[str] = ()

    @property
    def size_bytes(self) -> int:
        """What they take in the page."""
        return len(self.script.encode()) + sum(len(mark) for mark in self.marks.values())


def figures_of(
    connection: sqlite3.Connection,
    chapters: Sequence[Chapter],
    names: Sequence[str],
    room_bytes: float,
) -> Figures:
    """All figures of a report, with as many signals as have room.

    Args:
        connection: Any.
        chapters: Its runs; two are laid over each other as well.
        names: Signals, with `*`; none for those that changed most.
        room_bytes: How much they may take.

    Raises:
        UnknownSignalError: A name meets nothing.
    """
    chosen = {each.info.run_id: _chosen(connection, each, names) for each in chapters}
    count = max(map(len, chosen.values()), default=0)
    while True:
        first = {run_id: had[:count] for run_id, had in chosen.items()}
        made = _embedded(dict(_charts(connection, chapters, first, with_moments=count > 1)))
        if made.size_bytes <= room_bytes:
            return replace(made, left_out=_not_drawn(chapters, first))
        if count <= 1:
            return Figures(left_out=("the figures: they would take more than the file may",))
        count //= 2


def _not_drawn(
    chapters: Sequence[Chapter], drawn: Mapping[int, Sequence[str]]
) -> tuple[str, ...]:
    """How many numbers have no curve."""
    return tuple(
        f"curves of {missing} of {len(each.changed_most)} numeric signals of run "
        f"{each.info.run_id}: those that changed most are drawn, or those that are named"
        for each in chapters
        if (missing := len(set(each.changed_most) - {*drawn[each.info.run_id]})) > 0
    )


def moment_key(chapter: Chapter, moment: Moment) -> str:
    """Under which the figure of a moment stands."""
    return f"moment {chapter.info.run_id} {list(chapter.moments).index(moment)}"


def _chosen(connection: sqlite3.Connection, chapter: Chapter, names: Sequence[str]) -> list[str]:
    """The signals to draw of a run."""
    if chapter.range is None:
        return []
    if names:
        return [signal.name for signal in signals_of(connection, chapter.range, names)]
    return list(chapter.changed_most[:MOST_SIGNALS])


def _charts(
    connection: sqlite3.Connection,
    chapters: Sequence[Chapter],
    chosen: Mapping[int, Sequence[str]],
    *,
    with_moments: bool,
) -> Iterator[tuple[str, Chart]]:
    recorded = [each for each in chapters if each.range is not None]
    ranges = [each.range for each in recorded if each.range is not None]
    if len(ranges) > 1:
        names = list(dict.fromkeys(name for each in chosen.values() for name in each))
        shared = [each for each in names if all(each in had for had in chosen.values())]
        yield from _pair(connection, ranges, shared or names, "both")
    for chapter, whole in zip(recorded, ranges, strict=True):
        run_id = chapter.info.run_id
        yield from _pair(connection, [whole], chosen[run_id], str(run_id))
        for moment in chapter.moments if with_moments else ():
            yield from _around(connection, chapter, moment)


def _pair(
    connection: sqlite3.Connection, ranges: Sequence[TimeRange], names: Sequence[str], key: str
) -> Iterator[tuple[str, Chart]]:
    """Signals over time, and the way; what cannot be drawn is left out."""
    from webots_mcp.charts import signals_chart, way_chart
    from webots_mcp.plotting.canvas import Room

    room = Room(points=_POINTS, panels=_PANELS, lanes=8, rows=16)
    try:
        yield f"signals {key}", signals_chart(connection, ranges, names or ["*"], room=room)
    except NothingRecordedError:
        pass  # there is no number and no text in these rows: the tables say so
    try:
        yield f"way {key}", way_chart(connection, ranges)
    except (InvalidInputError, NothingRecordedError):
        pass  # no position is among the signals


def _around(
    connection: sqlite3.Connection, chapter: Chapter, moment: Moment
) -> Iterator[tuple[str, Chart]]:
    """The signals that an event is about, in the seconds around it."""
    from webots_mcp.charts import signals_chart
    from webots_mcp.plotting.canvas import Room

    room = Room(points=_MOMENT_POINTS, panels=2, lanes=1, rows=0)
    scope = Scope(run_id=chapter.info.run_id, start_s=moment.start_s, end_s=moment.end_s)
    about = [moment.event.name] if moment.event.name else []
    for names in (about, list(moment.event.around)):
        if not names:
            continue
        try:
            around = find_range(connection, scope)
            chart = signals_chart(connection, [around], names, events=False, room=room)
        except (InvalidInputError, NothingRecordedError):
            continue  # it is named after no signal, or that has no value there
        chart.layout.toolbar_location = None  # type: ignore[attr-defined]
        yield moment_key(chapter, moment), chart
        return


def _embedded(charts: Mapping[str, Chart]) -> Figures:
    from bokeh.embed import components

    if not charts:
        return Figures()
    embed: Any = components
    script, marks = embed({key: chart.layout for key, chart in charts.items()})
    titles = {key: chart.title for key, chart in charts.items()}
    return Figures(script, marks, titles, {key: chart.notes for key, chart in charts.items()})
