"""How a report is put together in the room that it may take, as a file that a question writes."""

from __future__ import annotations

import io
import math
import sqlite3
import time
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from pydantic import Field

from webots_mcp.answers.budget import notes_of
from webots_mcp.answers.models import NotedAnswer
from webots_mcp.contract import VERSION
from webots_mcp.database.files import make_folder, whole_file
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.kinds import Event
from webots_mcp.plotting.canvas import Room
from webots_mcp.plotting.on_a_page import Figure, figure_part, signals_figure, way_figure
from webots_mcp.plotting.signals import compose_signals
from webots_mcp.plotting.trajectory import Obstacle, compose_trajectory
from webots_mcp.plugins.report.chapter import Chapter, Moment, chapter_of
from webots_mcp.plugins.report.words import Beside, beside, clock, counted, size, time_at
from webots_mcp.questions.declaring import DESTROYS, AnyNames, RobotName, RunIds, question
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.invalid_rows import left_out_so_far
from webots_mcp.store.reading.catalogue import known_signals, resolve_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.reading.segment import in_one_snapshot
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.robots import world_seen
from webots_mcp.store.run_rows import RunRecord, fetch_run, inside, opened
from webots_mcp.store.signals import RegisteredSignal

if TYPE_CHECKING:
    from jinja2 import Template
if TYPE_CHECKING:
    from webots_mcp.standin.arena import Body
    from webots_mcp.standin.geometry import Shape


MOST_SIGNALS: Final = 16
_ROOM: Final = Room(points=500, panels=12, lanes=8, rows=16)
_ROOM_OF_A_MOMENT: Final = Room(points=200, panels=2, lanes=1, rows=0)
_MOMENT_PX: Final = 700
_MOST_BYTES: Final = 1_000_000  # of a world file: reading a larger one would take seconds
_CORNERS: Final = ((1, 1), (-1, 1), (-1, -1), (1, -1))
_SIDES: Final = 24  # of what a circle is drawn as
MOST_PICTURES: Final = 24  # of a run
LONGEST_SIDE_PX: Final = 640
_SMALL_BYTES: Final = 60_000  # such a file goes in as it is
_JPEG_QUALITY: Final = 82
_AROUND_BYTES: Final = 400  # of marks around a picture
MAX_MB: Final = 10.0
MIN_MB: Final = 2.0
MOST_RUNS: Final = 2
DEADLINE_S: Final = 12.0  # for all searches in values: a report may take a while
_SHARE_OF_TEXTS: Final = 0.35  # of the room; then the figures have
_SHARE_OF_FIGURES: Final = 0.7  # of the rest, and the pictures what remains
_FRAME_BYTES: Final = 60_000  # style, script, headings, facts: all that is not shared out
_TEMPLATES: Final = Path(__file__).parent / "templates"
# Nothing may be loaded, whatever a text of the recording says; the script of the figures is inside.
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
)
FOLDER: Final = "reports"  # in the data folder


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


def _known(connection: sqlite3.Connection, chapter: Chapter) -> dict[str, RegisteredSignal]:
    return {} if chapter.range is None else known_signals(connection, chapter.range)


def _chosen(
    chapters: Sequence[Chapter], known: Sequence[dict[str, RegisteredSignal]], names: Sequence[str]
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


def _why_none(known: Sequence[dict[str, RegisteredSignal]], names: Sequence[str]) -> str:
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


def _of_file(run: RunRecord) -> tuple[Obstacle, ...]:
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


def _seen(connection: sqlite3.Connection, run: RunRecord) -> tuple[Obstacle, ...]:
    world = world_seen(connection, run)
    solids = world.content.get("solids", ()) if world else ()
    places = world.places if world else {}
    told = [(each["key"], each | places.get(each["key"], {})) for each in solids]
    return tuple(
        Obstacle(str(key), float(body["x_m"]), float(body["y_m"]))
        for key, body in told
        if body.get("x_m") is not None and body.get("y_m") is not None
    )


# -- the report ------------------------------------------------------------------------------------


# The pictures of a run: as many as have room, downscaled, inside the page.


class Picture(NamedTuple):
    """A picture in the page: its data URI, and what it shows."""

    uri: str
    caption: str

    @property
    def size_bytes(self) -> int:
        """What it takes in the page."""
        return len(self.uri) + _AROUND_BYTES


class Pictures(NamedTuple):
    """Those that are shown, of how many, and how many of their files could not be used."""

    shown: Sequence[Picture]
    total: int
    unusable: int


def pictures_of(found: Sequence[Event], data_dir: Path, room_bytes: float) -> Pictures:
    """Pictures that are spread evenly over the run, the first and the newest among them."""
    tried = [_picture(event, data_dir) for event in spread(found, MOST_PICTURES)]
    made = [picture for picture in tried if picture is not None]
    return Pictures(_within(made, room_bytes), len(found), len(tried) - len(made))


def spread(items: Sequence[Event], most: int) -> list[Event]:
    """At most so many of the items, evenly chosen, the first and the last among them."""
    if len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


def _within(pictures: Sequence[Picture], room_bytes: float) -> list[Picture]:
    """All of them, else every second, every third and so on, until they have room."""
    for step in range(1, len(pictures) + 1):
        kept = list(pictures[::step])
        if sum(picture.size_bytes for picture in kept) <= room_bytes:
            return kept
    return []


def _picture(event: Event, data_dir: Path) -> Picture | None:
    """None where the file is gone, or holds no picture."""
    try:
        media_type, data = _content(inside(data_dir, str(event.details["path"])))
    except (InvalidInputError, NothingRecordedError):
        return None
    kind = "" if event.details["kind"] == "camera" else f", {event.details['kind']}"
    caption = f"{time_at(event.start_s)} s, {event.name or 'main view'}{kind}"
    return Picture(f"data:{media_type};base64,{b64encode(data).decode()}", caption)


def _content(file: Path) -> tuple[str, bytes]:
    """Media type and content of a picture within 640 pixels."""
    with opened(file) as picture:
        picture.load()
        fits = max(picture.size) <= LONGEST_SIDE_PX and file.stat().st_size <= _SMALL_BYTES
        if fits and picture.format:
            return f"image/{picture.format.lower()}", file.read_bytes()
        scaled = picture.convert("RGB")
        scaled.thumbnail((LONGEST_SIDE_PX, LONGEST_SIDE_PX))
        buffer = io.BytesIO()
        scaled.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return "image/jpeg", buffer.getvalue()


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Report:
    """A finished report.

    Attributes:
        html: The file's content.
        title: What it is about, in one line.
        holds: How many there are of what it holds.
        left_out: What is not in it, and why.
    """

    html: bytes
    title: str
    holds: dict[str, int]
    left_out: tuple[str, ...]


@in_one_snapshot
def make_report(
    connection: sqlite3.Connection,
    run_ids: Sequence[int],
    data_dir: Path,
    *,
    names: Sequence[str] = (),
    max_mb: float = MAX_MB,
    progress: Progress | None = None,
) -> Report:
    """Put a report of one run together, or of two beside each other.

    Args:
        connection: Any.
        run_ids: One run, or two.
        data_dir: Where the pictures are.
        names: The signals to draw, with `*`; none for those that changed most.
        max_mb: What the file may take at most, 2 to 100 (1 MB is 1,000,000 bytes).
        progress: Called now and then with how much is done and how much there is to do.

    Raises:
        InvalidInputError: No run, more than two, or one twice; or a size out of bounds.
        UnknownRunError, UnknownSignalError: As they say.
    """
    _require_sound(run_ids, max_mb)
    for run_id in run_ids:
        fetch_run(connection, run_id)
    done = _Steps(progress, 2 * len(run_ids) + 3)
    room_bytes = max_mb * 1e6 - _FRAME_BYTES
    texts_bytes = _SHARE_OF_TEXTS * room_bytes
    chapters: list[Chapter] = []
    count = len(run_ids)
    for run_id in run_ids:
        chapters.append(chapter_of(connection, run_id, texts_bytes / count, DEADLINE_S / count))
        done.step()
    compared = beside(connection, run_ids, texts_bytes) if len(run_ids) > 1 else None
    done.step()
    figures_bytes = _SHARE_OF_FIGURES * (room_bytes - texts_bytes)
    differing = compared.differing if compared is not None else ()
    figures = figures_of(connection, chapters, names, differing, figures_bytes)
    done.step()
    page = Page(_title(chapters), time.time(), max_mb, chapters, compared, figures)
    rest_bytes = max_mb * 1e6 - len(render(page))
    share_bytes = rest_bytes / len(chapters)
    for chapter in chapters:
        pictures = pictures_of(chapter.images, data_dir, share_bytes)
        page.pictures[chapter.info.run_id] = pictures
        done.step()
    page = replace(page, left_out=_left_out(page))
    html = render(replace(page, size_bytes=len(render(page))))
    done.step()
    return Report(html, page.title, _holds(page), tuple(page.left_out))


class _Steps:
    """Tells how far the work has come."""

    def __init__(self, progress: Progress | None, of: int) -> None:
        self._progress, self._of, self._done = progress, of, 0

    def step(self) -> None:
        """One more is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._of)


def _require_sound(run_ids: Sequence[int], max_mb: float) -> None:
    if not 1 <= len(run_ids) <= MOST_RUNS:
        raise InvalidInputError(
            f"a report is about one run or two, not {len(run_ids)}: compare more of them with "
            "webots_compare_runs"
        )
    if len(set(run_ids)) < len(run_ids):
        raise InvalidInputError(f"run {run_ids[0]} is named twice: name another one, or it alone")
    if not MIN_MB <= max_mb <= 100:
        raise InvalidInputError(f"max_mb={max_mb:g} must be from {MIN_MB:g} to 100")


def _title(chapters: Sequence[Chapter]) -> str:
    return " and ".join(chapter.title for chapter in chapters)


def _left_out(page: Page) -> list[str]:
    """What a reader would miss, and why it is not there."""
    said: list[str] = []
    for chapter in page.chapters:
        of_run = f"of run {chapter.info.run_id}"
        for name, grid in chapter.grids.items():
            if grid.left_out:
                said.append(f"{grid.missing} of the {name} {of_run}")
        pictures = page.pictures[chapter.info.run_id]
        if missing := pictures.total - len(pictures.shown):
            gone = f" ({counted(pictures.unusable, 'file')} cannot be read)"
            gone = gone if pictures.unusable else ""
            said.append(f"{missing:,} of the pictures {of_run}{gone}")
    return [*said, *page.figures.left_out, *left_out_so_far()]


def _holds(page: Page) -> dict[str, int]:
    """How many rows, figures and pictures there are."""
    counts: dict[str, int] = {"figures": len(page.figures.marks)}
    for chapter in page.chapters:
        for name, grid in chapter.grids.items():
            counts[name] = counts.get(name, 0) + len(grid.rows)
    counts["pictures"] = sum(len(each.shown) for each in page.pictures.values())
    return {name: count for name, count in counts.items() if count}


@dataclass(frozen=True)
class Page:
    """All that a report shows.

    Attributes:
        made_wall_time_s: When it was made.
        max_mb: What it may take.
        beside: The comparison of two runs; None of one.
        pictures: By run.
        left_out: What is not in it.
        size_bytes: What it takes, about; None while that is not known.
    """

    title: str
    made_wall_time_s: float
    max_mb: float
    chapters: Sequence[Chapter]
    beside: Beside | None
    figures: Figures
    pictures: dict[int, Pictures] = field(default_factory=dict[int, Pictures])
    left_out: Sequence[str] = ()
    size_bytes: int | None = None


def _spelled_out(value: object) -> object:
    """Texts, but for what is markup of ours."""
    return spelled_out(value) if type(value) is str else value


def render(page: Page) -> bytes:
    """The file. Every text of the recording is escaped: it is shown, and never run."""
    from markupsafe import Markup

    told: Mapping[str, Any] = {
        "page": page,
        "policy": _POLICY,
        "version": VERSION,
        "made": clock(page.made_wall_time_s),
        "size": size(page.size_bytes or 0),
        "counted": counted,
        "moment_key": moment_key,
        "script": Markup(figure_part("figure.js")),
        "figure_style": Markup(figure_part("figure.css")),
    }
    return _template().render(told).encode("utf-8", "replace")


@cache
def _template() -> Template:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        finalize=_spelled_out,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html")


def file_name(run_ids: Sequence[int]) -> str:
    """How the file is called if nobody says: run-3.html, run-3-5.html."""
    return f"run-{'-'.join(map(str, run_ids))}.html"


def require_free(file: Path, *, overwrite: bool) -> None:
    """See that the file may be written, before the work is done.

    Raises:
        InvalidInputError: Something is there already, or it is no page's name.
    """
    try:
        is_folder, is_there = file.is_dir(), file.exists()
    except OSError as error:  # too long a name
        raise InvalidInputError(f"{str(file)[:200]} cannot be written: {error.strerror}") from error
    if is_folder:
        raise InvalidInputError(f"{file} is a folder: name a file in it")
    if file.suffix.lower() not in (".html", ".htm"):
        raise InvalidInputError(f"{file.name!r} is no page's name: end it in .html")
    if is_there and not overwrite:
        raise InvalidInputError(
            f"{file} is there already: name another one, or give overwrite (--overwrite)"
        )


def require_folder(file: Path) -> None:
    """See that there is a folder to write into.

    Raises:
        InvalidInputError: There is none.
    """
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent}: make it, or name another file")


def write_report(file: Path, html: bytes, *, overwrite: bool = False) -> None:
    """Write it as a file of its owner alone that appears only when it is complete.

    A folder that is not there is made.

    Raises:
        InvalidInputError: It cannot be written, or something is there already.
    """
    require_free(file, overwrite=overwrite)
    try:
        make_folder(file.parent)
        with whole_file(file) as aside:
            aside.write_bytes(html)
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error


# -- the question ----------------------------------------------------------------------------------


class ReportAnswer(NotedAnswer):
    """A report that was written."""

    file: str | None = None
    size_bytes: int | None = None
    holds: dict[str, int] | None = Field(default=None, description="How many of each.")
    left_out: list[str] | None = Field(default=None, description="What had no room, and why.")


@question("Write a report", DESTROYS)
def webots_report(
    recording: RecordingAccess,
    run_ids: RunIds = None,
    file: Annotated[str, Field(max_length=500, description="In the data folder.")] = "",
    overwrite: Annotated[bool, Field(description="A file that is there.")] = False,
    signals: AnyNames = None,
    robot: RobotName = None,
) -> ReportAnswer:
    """Write a run, or two compared, as one HTML file for people, which opens offline.

    Events, trends, plots, pictures, log.
    """
    with recording.view(robot, run_ids[0] if run_ids else None) as view:
        chosen = run_ids or [view.require_run().id]
        path = _inside(recording.data_dir, file or f"{FOLDER}/{file_name(chosen)}")
        require_free(path, overwrite=overwrite)
        made = make_report(view.connection, chosen, recording.data_dir, names=signals or ())
        write_report(path, made.html, overwrite=overwrite)
        return ReportAnswer(
            **view.header(),
            file=str(path),
            size_bytes=len(made.html),
            holds=made.holds,
            left_out=notes_of(made.left_out),
            hint=None if made.holds.get("figures") else "nothing in it could be drawn",
        )


def _inside(data_dir: Path, file: str) -> Path:
    """The file, which has to lie in the data folder."""
    try:
        path = (data_dir / file).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise InvalidInputError(f"file={file[:100]!r} is not a usable path: {error}") from error
    if not path.is_relative_to(data_dir.resolve()):
        raise InvalidInputError(
            f"file={file[:100]!r} lies outside the data folder {data_dir}: name one in it, or "
            "write it by 'webots-mcp report -o FILE'"
        )
    return path
