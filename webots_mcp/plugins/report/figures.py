"""The figures of a report, as markup for its page."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.plotting.canvas import Room
from webots_mcp.plotting.on_a_page import Figure, signals_figure, way_figure
from webots_mcp.plotting.signals import compose_signals
from webots_mcp.plotting.trajectory import Obstacle, compose_trajectory
from webots_mcp.plugins.report.chapter import Chapter, Moment
from webots_mcp.store.reading.catalogue import known_signals, resolve_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.robots import world_seen
from webots_mcp.store.run_rows import Run, fetch_run
from webots_mcp.store.signals import Signal

if TYPE_CHECKING:
    from webots_mcp.standin.arena import Body
    from webots_mcp.standin.geometry import Shape

MOST_SIGNALS: Final = 16
_ROOM: Final = Room(points=500, panels=12, lanes=8, rows=16)
_ROOM_OF_A_MOMENT: Final = Room(points=200, panels=2, lanes=1, rows=0)
_MOMENT_PX: Final = 700


@dataclass(frozen=True)
class Figures:
    """Figures as markup.

    Attributes:
        marks: Each by its key.
        titles: What each shows.
        notes: What is not in each.
        left_out: What is in none.
    """

    marks: Mapping[str, str] = field(default_factory=dict[str, str])
    titles: Mapping[str, str] = field(default_factory=dict[str, str])
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    left_out: Sequence[str] = ()

    @property
    def size_bytes(self) -> int:
        """What they take in the page."""
        return sum(len(mark.encode()) for mark in self.marks.values())


def figures_of(
    connection: sqlite3.Connection,
    chapters: Sequence[Chapter],
    names: Sequence[str],
    differing: Sequence[str],
    room_bytes: float,
) -> Figures:
    """All figures of a report, with as many signals as have room.

    Args:
        connection: Any.
        chapters: Its runs; two are laid over each other as well.
        names: Signals, with `*`; none for those that changed most.
        differing: Of two runs those that differ, which are laid over each other if none is named.
        room_bytes: How much they may take.

    Raises:
        UnknownSignalError: A name meets nothing.
    """
    known = [_known(connection, each) for each in chapters]
    chosen = _chosen(chapters, known, names)
    both = list(dict.fromkeys(name for had in chosen.values() for name in had))
    both = both if names else [*differing[:MOST_SIGNALS]] or both
    both = [name for name in both if all(name in each for each in known)]
    count = max(map(len, chosen.values()), default=0)
    while True:
        first = {run_id: had[:count] for run_id, had in chosen.items()}
        drawn = _drawn_of(connection, chapters, first, both[:count], with_moments=count > 1)
        if not both[:count] and len([each for each in chapters if each.range is not None]) > 1:
            drawn.not_drawn.append(f"the signals of both runs: {_why_none(known, names)}")
        made = _embedded(drawn.drawn)
        if made.size_bytes <= room_bytes:
            return replace(made, left_out=[*_curves_missing(chapters, first), *drawn.not_drawn])
        if count <= 1:
            return Figures(left_out=("the figures: they would take more than the file may",))
        count //= 2


def _curves_missing(chapters: Sequence[Chapter], drawn: Mapping[int, Sequence[str]]) -> list[str]:
    """How many numbers have no curve."""
    return [
        f"curves of {missing} of {each.numbers} numeric signals of run {each.info.run_id} (drawn "
        "is what changed most, or is named)"
        for each in chapters
        if (missing := each.numbers - len(drawn[each.info.run_id])) > 0
    ]


def moment_key(chapter: Chapter, moment: Moment) -> str:
    """Under which the figure of a moment stands."""
    return f"moment {chapter.info.run_id} {list(chapter.moments).index(moment)}"


def _known(connection: sqlite3.Connection, chapter: Chapter) -> dict[str, Signal]:
    return {} if chapter.range is None else known_signals(connection, chapter.range)


def _chosen(
    chapters: Sequence[Chapter], known: Sequence[dict[str, Signal]], names: Sequence[str]
) -> dict[int, list[str]]:
    """The signals to draw of each run; of two robots each may lack what the other has."""
    if not names:
        return {each.info.run_id: [*each.changed_most[:MOST_SIGNALS]] for each in chapters}
    of_any = {name: signal for each in known for name, signal in each.items()}
    asked = {signal.name for signal in resolve_signals(of_any, names)}
    return {
        chapter.info.run_id: [name for name in had if name in asked]
        for chapter, had in zip(chapters, known, strict=True)
    }


def _why_none(known: Sequence[dict[str, Signal]], names: Sequence[str]) -> str:
    """Why none can be laid over each other: texts, and what rests, are chosen by name alone."""
    if names:
        return "none that was asked for is in both"
    shared = [name for name in known[0] if all(name in each for each in known)]
    if any(each[name].is_number for name in shared for each in known):
        return "none of those that changed most is in both"
    return "they share no numeric signals"


class _Drawn:
    """The figures of a report by their keys, and why others could not be drawn."""

    def __init__(self, connection: sqlite3.Connection, chapters: Sequence[Chapter]) -> None:
        self._connection = connection
        self._found = {each.info.run_id: each.found for each in chapters if each.found}
        self.drawn: dict[str, Figure] = {}
        self.not_drawn: list[str] = []

    def alone(self, run_id: int, whole: TimeRange, names: Sequence[str]) -> None:
        """Signals of a run over time, and its way."""
        key, drawn = f"signals {run_id}", names or ["*"]
        self._add(key, f"the signals of run {run_id}", self._signals, [whole], drawn)
        self._add(f"way {run_id}", f"the way of run {run_id}", self._way, [whole])

    def overlaid(self, ranges: Sequence[TimeRange], names: Sequence[str]) -> None:
        """The same of two runs over each other."""
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
        return way_figure(plot, notes, obstacles_of(self._connection, ranges))

    def around(self, chapter: Chapter, moment: Moment) -> None:
        """The signals that an event is about, or the usual ones, in the seconds around it."""
        about = [moment.event.name] if moment.event.name else []
        for names in filter(None, (about, list(moment.event.around))):
            # It may be named after no signal, or after one without a value there.
            with suppress(InvalidInputError, NothingRecordedError):
                self.drawn[moment_key(chapter, moment)] = self._seconds(chapter, moment, names)
                return

    def _seconds(self, chapter: Chapter, moment: Moment, names: Sequence[str]) -> Figure:
        scope = Scope(run_id=chapter.info.run_id, start_s=moment.start_s, end_s=moment.end_s)
        around = find_range(self._connection, scope)
        composed = compose_signals(
            self._connection, [around], names, events=False, room=_ROOM_OF_A_MOMENT
        )
        return signals_figure(*composed, width_px=_MOMENT_PX)


def _drawn_of(
    connection: sqlite3.Connection,
    chapters: Sequence[Chapter],
    chosen: Mapping[int, Sequence[str]],
    both: Sequence[str],
    *,
    with_moments: bool,
) -> _Drawn:
    drawn = _Drawn(connection, chapters)
    ranges = [each.range for each in chapters if each.range is not None]
    if len(ranges) > 1:
        drawn.overlaid(ranges, both)
    for chapter in chapters:
        if chapter.range is not None:
            run_id = chapter.info.run_id
            drawn.alone(run_id, chapter.range, chosen[run_id])
        for moment in chapter.moments if with_moments else ():
            drawn.around(chapter, moment)
    return drawn


def _embedded(figures: Mapping[str, Figure]) -> Figures:
    return Figures(
        {key: figure.markup for key, figure in figures.items()},
        {key: figure.title for key, figure in figures.items()},
        {key: figure.notes for key, figure in figures.items()},
    )


# What stands in a robot's world: from the world file where it can be read, else as it was seen.


_MOST_BYTES: Final = 1_000_000  # of a world file: reading a larger one would take seconds
_CORNERS: Final = ((1, 1), (-1, 1), (-1, -1), (1, -1))
_SIDES: Final = 24  # of what a circle is drawn as


def obstacles_of(
    connection: sqlite3.Connection, ranges: Sequence[TimeRange]
) -> tuple[Obstacle, ...]:
    """What stands in the world of the last run of the ranges.

    Fixed bodies of the world file, of the types that the stand-in knows; what can be moved is left
    out, since the file tells only where it began. Where there is no such file: the solids that an
    observer has seen.
    """
    run = fetch_run(connection, ranges[-1].segments[-1].run_id)
    return _of_file(run) or _seen(connection, run)


def _of_file(run: Run) -> tuple[Obstacle, ...]:
    file = Path(run.world or "")
    try:
        status = file.stat()
    except (OSError, ValueError):
        return ()
    if file.suffix != ".wbt" or not file.is_file() or status.st_size > _MOST_BYTES:
        return ()
    return _standing(file, status.st_mtime_ns)


@lru_cache(maxsize=8)
def _standing(file: Path, _changed_ns: int) -> tuple[Obstacle, ...]:
    from webots_mcp.standin.arena import Arena
    from webots_mcp.standin.vrml import WorldError
    from webots_mcp.standin.world import load_world

    try:
        bodies = Arena(load_world(file)).bodies
    except (WorldError, OSError):
        return ()  # the way is drawn without them
    return tuple(each for body in bodies for each in _outlines(body))


def _outlines(body: Body) -> Iterator[Obstacle]:
    if body.node.type_name == "Robot" or body.is_movable:
        return
    for shape in body.solid_shapes:
        yield Obstacle(body.name, shape.x, shape.y, _corners(shape))


def _corners(shape: Shape) -> tuple[tuple[float, float], ...]:
    from webots_mcp.standin.geometry import Disc

    if isinstance(shape, Disc):
        angles = [math.tau * side / _SIDES for side in range(_SIDES)]
        radius_m = shape.radius_m
        return tuple(
            (shape.x + radius_m * math.cos(angle), shape.y + radius_m * math.sin(angle))
            for angle in angles
        )
    halves = [(a * shape.half_x_m, b * shape.half_y_m) for a, b in _CORNERS]
    cos, sin = shape.cos_yaw, shape.sin_yaw
    return tuple((shape.x + cos * u - sin * v, shape.y + sin * u + cos * v) for u, v in halves)


def _seen(connection: sqlite3.Connection, run: Run) -> tuple[Obstacle, ...]:
    world = world_seen(connection, run)
    solids = world.told.get("solids", ()) if world else ()
    places = world.places if world else {}
    told = [(each["key"], each | places.get(each["key"], {})) for each in solids]
    return tuple(
        Obstacle(str(key), float(body["x_m"]), float(body["y_m"]))
        for key, body in told
        if body.get("x_m") is not None and body.get("y_m") is not None
    )
