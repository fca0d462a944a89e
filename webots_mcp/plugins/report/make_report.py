"""How a report is made within its size limit and written to a file."""

from __future__ import annotations

import sqlite3
import time
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.contract import VERSION
from webots_mcp.database.files import make_folder, whole_file
from webots_mcp.errors import InvalidInputError
from webots_mcp.plotting.interactive_svg import figure_part
from webots_mcp.plugins.clip.clip import camera_film
from webots_mcp.plugins.report.chapter import Chapter, chapter_of
from webots_mcp.plugins.report.embedded_pictures import (
    EmbeddedPicture,
    EmbeddedPictures,
    picture_near,
    pictures_of,
)
from webots_mcp.plugins.report.figures import Figures, figures_of, moment_key
from webots_mcp.plugins.report.run_comparison import RunComparison, compare_two_runs
from webots_mcp.plugins.report.words import clock, counted, size, time_at
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.invalid_rows import left_out_so_far
from webots_mcp.store.reading.segment import in_one_snapshot
from webots_mcp.store.run_rows import fetch_run

if TYPE_CHECKING:
    from jinja2 import Template


@dataclass(frozen=True)
class _ReportLimits:
    """Limits of a report, and how its size is divided."""

    max_mb: float = 10.0
    """Default of the maximum size."""
    min_mb: float = 2.0
    """Smallest size that can be asked for."""
    runs: int = 2
    deadline_s: float = 12.0
    """Time limit of all searches in values."""
    picture_within_s: float = 3.0
    """Time between a moment and the picture that is shown with it."""
    share_of_a_film: float = 0.03
    """Fraction of the size that the film of a moment may take."""
    frame_bytes: int = 60_000
    """Style, script, headings and facts, which always fit."""
    share_of_texts: float = 0.35
    """Fraction of the size that is for texts."""
    share_of_figures: float = 0.7
    """Fraction of the rest that is for figures; pictures get what remains."""


_LIMITS: Final = _ReportLimits()


_TEMPLATES: Final = Path(__file__).parent / "templates"
FOLDER: Final = "reports"  # In the data folder.


ReportProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class Report:
    """A finished report.

    Attributes:
        html: Content of the file.
        title: Its title.
        holds: Number of rows, figures and pictures, by what they are.
        left_out: Notes on what it lacks, and why.
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
    max_mb: float = _LIMITS.max_mb,
    progress: ReportProgress | None = None,
) -> Report:
    """Make a report of one run, or of two compared.

    Args:
        connection: Connection to the recording.
        run_ids: Ids of one or two runs.
        data_dir: Folder of the pictures.
        names: Names of signals to draw, with `*`; empty for the signals that changed most.
        max_mb: Maximum size of the file, 2 to 100 (1 MB is 1,000,000 bytes).
        progress: Called now and then with the steps done and the number of all steps.

    Raises:
        InvalidInputError: There is no run, more than two, or one twice; or the size is out of
            bounds.
        UnknownRunError: A run does not exist.
        UnknownSignalError: A name matches no signal.
    """
    _require_sound(run_ids, max_mb)
    for run_id in run_ids:
        fetch_run(connection, run_id)
    done = _Steps(progress, 2 * len(run_ids) + 3)
    budget_bytes = max_mb * 1e6 - _LIMITS.frame_bytes
    texts_bytes = _LIMITS.share_of_texts * budget_bytes
    chapters: list[Chapter] = []
    count = len(run_ids)
    for run_id in run_ids:
        chapters.append(
            chapter_of(connection, run_id, texts_bytes / count, _LIMITS.deadline_s / count)
        )
        done.step()
    compared = None
    if count > 1:
        checked = [chapter.checked for chapter in chapters]
        compared = compare_two_runs(connection, run_ids, texts_bytes, checked)
    done.step()
    figures_bytes = _LIMITS.share_of_figures * (budget_bytes - texts_bytes)
    differing = compared.differing if compared is not None else ()
    figures = figures_of(connection, chapters, names, differing, figures_bytes)
    done.step()
    page = ReportContent(_title(chapters), time.time(), max_mb, chapters, compared, figures)
    page.moment_pictures.update(_pictures_of_moments(chapters, data_dir))
    film_bytes = int(_LIMITS.share_of_a_film * max_mb * 1e6)
    page.moment_films.update(_films_of_moments(connection, chapters, data_dir, film_bytes))
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


def _pictures_of_moments(chapters: Sequence[Chapter], data_dir: Path) -> dict[str, EmbeddedPicture]:
    """Return the picture nearest to each moment, by the key of its figure."""
    found: dict[str, EmbeddedPicture] = {}
    for chapter in chapters:
        for moment in chapter.moments:
            at_s, within_s = moment.event.start_s, _LIMITS.picture_within_s
            picture = picture_near(chapter.images, data_dir, at_s, within_s)
            if picture is not None:
                found[moment_key(chapter, moment)] = picture
    return found


def _films_of_moments(
    connection: sqlite3.Connection, chapters: Sequence[Chapter], data_dir: Path, max_bytes: int
) -> dict[str, EmbeddedPicture]:
    """Return the film of the camera frames around each moment, by the key of its figure."""
    found: dict[str, EmbeddedPicture] = {}
    for chapter in chapters:
        for moment in chapter.moments:
            at_s, within_s = moment.event.start_s, _LIMITS.picture_within_s
            span = (at_s - within_s, at_s + within_s)
            # What base64 makes of it is a third larger.
            made = camera_film(
                connection, data_dir, chapter.info.run_id, span, at_s, max_bytes * 3 // 4
            )
            if made is not None:
                film, camera = made
                caption = f"{time_at(film.times[0])} to {time_at(film.times[-1])} s, {camera}"
                uri = f"data:image/webp;base64,{b64encode(film.data).decode()}"
                found[moment_key(chapter, moment)] = EmbeddedPicture(uri, caption)
    return found


class _Steps:
    """Counts and reports the steps of the work."""

    def __init__(self, progress: ReportProgress | None, of: int) -> None:
        self._progress, self._of, self._done = progress, of, 0

    def step(self) -> None:
        """Count one more step, and report it."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._of)


def _require_sound(run_ids: Sequence[int], max_mb: float) -> None:
    if not 1 <= len(run_ids) <= _LIMITS.runs:
        raise InvalidInputError(
            f"a report is about one run or two, not {len(run_ids)}: compare more of them with "
            "webots_compare_runs"
        )
    if len(set(run_ids)) < len(run_ids):
        raise InvalidInputError(f"run {run_ids[0]} is named twice: name another one, or it alone")
    if not _LIMITS.min_mb <= max_mb <= 100:
        raise InvalidInputError(f"max_mb={max_mb:g} must be from {_LIMITS.min_mb:g} to 100")


def _title(chapters: Sequence[Chapter]) -> str:
    return " and ".join(chapter.title for chapter in chapters)


def _left_out(page: ReportContent) -> list[str]:
    """Return notes on what the report lacks, and why."""
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


def _holds(page: ReportContent) -> dict[str, int]:
    """Return the number of rows, figures and pictures."""
    counts: dict[str, int] = {"figures": len(page.figures.marks)}
    for chapter in page.chapters:
        for name, grid in chapter.grids.items():
            counts[name] = counts.get(name, 0) + len(grid.rows)
    counts["pictures"] = sum(len(each.shown) for each in page.pictures.values())
    return {name: count for name, count in counts.items() if count}


@dataclass(frozen=True)
class ReportContent:
    """The content of a report.

    Attributes:
        made_wall_time_s: When it was made.
        max_mb: Maximum size.
        comparison: The comparison of two runs; None for one run.
        pictures: Pictures by run.
        moment_pictures: The picture nearest to a moment, by the key of its figure.
        moment_films: Camera frames around a moment that move, by the same key.
        left_out: Notes on what it lacks.
        size_bytes: Approximate size; None while unknown.
    """

    title: str
    made_wall_time_s: float
    max_mb: float
    chapters: Sequence[Chapter]
    comparison: RunComparison | None
    figures: Figures
    pictures: dict[int, EmbeddedPictures] = field(default_factory=dict[int, EmbeddedPictures])
    moment_pictures: dict[str, EmbeddedPicture] = field(default_factory=dict[str, EmbeddedPicture])
    moment_films: dict[str, EmbeddedPicture] = field(default_factory=dict[str, EmbeddedPicture])
    left_out: Sequence[str] = ()
    size_bytes: int | None = None


def _spelled_out(value: object) -> object:
    """Make characters of recorded texts visible; markup of the report stays as it is."""
    return spelled_out(value) if type(value) is str else value


def render(page: ReportContent) -> bytes:
    """Return the file. Every text of the recording is escaped: it is shown, and never run."""
    from markupsafe import Markup

    # Under this policy the report loads nothing, whatever a text of the recording contains.
    values: Mapping[str, Any] = {
        "page": page,
        "policy": (
            "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
            "img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
        ),
        "version": VERSION,
        "made": clock(page.made_wall_time_s),
        "size": size(page.size_bytes or 0),
        "counted": counted,
        "moment_key": moment_key,
        "script": Markup(figure_part("figure.js")),
        "figure_style": Markup(figure_part("figure.css")),
    }
    return _template().render(values).encode("utf-8", "replace")


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
    """Return the default name of the file: run-3.html, run-3-5.html."""
    return f"run-{'-'.join(map(str, run_ids))}.html"


def require_free(file: Path, *, overwrite: bool) -> None:
    """Check before the work that the file may be written.

    Raises:
        InvalidInputError: The file exists, or its name does not end in .html.
    """
    try:
        is_folder, is_there = file.is_dir(), file.exists()
    except OSError as error:  # The name is too long.
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
    """Check that the folder of a file exists.

    Raises:
        InvalidInputError: It does not exist.
    """
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent}: make it, or name another file")


def write_report(file: Path, html: bytes, *, overwrite: bool = False) -> None:
    """Write a report as a private file that appears only when it is complete.

    The folder is made if it does not exist.

    Raises:
        InvalidInputError: The file cannot be written, or exists already.
    """
    require_free(file, overwrite=overwrite)
    try:
        make_folder(file.parent)
        with whole_file(file) as aside:
            aside.write_bytes(html)
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error
