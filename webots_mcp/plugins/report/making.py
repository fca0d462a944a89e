"""How a report is put together in the room that it may take, as a file that a question writes."""

from __future__ import annotations

import io
import sqlite3
import time
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from pydantic import Field

from webots_mcp import __version__
from webots_mcp.contract import make_folder, whole_file
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.naming import spelled_out
from webots_mcp.plotting.on_a_page import figure_part
from webots_mcp.plugins.report.chapter import Chapter, chapter_of
from webots_mcp.plugins.report.figures import Figures, figures_of, moment_key
from webots_mcp.plugins.report.words import Beside, beside, clock, counted, size, time_at
from webots_mcp.questions.answers import NotedAnswer
from webots_mcp.questions.budget import notes_of
from webots_mcp.questions.declaring import DESTROYS, AnyNames, RobotName, RunIds, question
from webots_mcp.store.detection.kinds import Event
from webots_mcp.store.reading.segment import in_one_snapshot
from webots_mcp.store.recording import Recording
from webots_mcp.store.run_rows import fetch_run, inside, opened

if TYPE_CHECKING:
    from jinja2 import Template

# The pictures of a run: as many as have room, downscaled, inside the page.


MOST_PICTURES: Final = 24  # of a run
LONGEST_SIDE_PX: Final = 640
_SMALL_BYTES: Final = 60_000  # such a file goes in as it is
_JPEG_QUALITY: Final = 82
_AROUND_BYTES: Final = 400  # of marks around a picture


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


MAX_MB: Final = 10.0
MIN_MB: Final = 2.0
MOST_RUNS: Final = 2
DEADLINE_S: Final = 12.0  # for all searches in values: a report may take a while
_SHARE_OF_TEXTS: Final = 0.35  # of the room; then the figures have
_SHARE_OF_FIGURES: Final = 0.7  # of the rest, and the pictures what remains
_FRAME_BYTES: Final = 60_000  # style, script, headings, facts: all that is not shared out

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
    return [*said, *page.figures.left_out]


def _holds(page: Page) -> dict[str, int]:
    """How many rows, figures and pictures there are."""
    counts: dict[str, int] = {"figures": len(page.figures.marks)}
    for chapter in page.chapters:
        for name, grid in chapter.grids.items():
            counts[name] = counts.get(name, 0) + len(grid.rows)
    counts["pictures"] = sum(len(each.shown) for each in page.pictures.values())
    return {name: count for name, count in counts.items() if count}


_TEMPLATES: Final = Path(__file__).parent / "templates"
# Nothing may be loaded, whatever a text of the recording says; the script of the figures is inside.
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
)


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
        "version": __version__,
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

FOLDER: Final = "reports"  # in the data folder


class ReportAnswer(NotedAnswer):
    """A report that was written."""

    file: str | None = None
    size_bytes: int | None = None
    holds: dict[str, int] | None = Field(default=None, description="How many of each.")
    left_out: list[str] | None = Field(default=None, description="What had no room, and why.")


@question("Write a report", DESTROYS)
def webots_report(
    recording: Recording,
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
