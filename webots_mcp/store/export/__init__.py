"""Exporting in constant memory: states or trials as flat tables, all of a range for viewers."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins import ExportFormat, export_formats, load
from webots_mcp.store.export.export_rows import Progress, Source
from webots_mcp.store.export.text_formats import write_csv
from webots_mcp.store.export.trial_table import TrialTable
from webots_mcp.store.reading.ranges import TimeRange


class Exported(NamedTuple):
    """What was written for viewers.

    Attributes:
        counts: How many there are of each kind: states, log lines, events, commands, pictures.
        beside: Which other file was written, and what for; empty where none was.
        notes: What could not be given back of deleted rows.
    """

    counts: Counter[str]
    beside: str = ""
    notes: Sequence[str] = ()


_OWN: Final = (
    ExportFormat(
        "csv", ("csv",), "webots_mcp.store.export.text_formats:write_csv", passes=2, is_text=True
    ),
    ExportFormat(
        "jsonl",
        ("jsonl", "json", "ndjson"),
        "webots_mcp.store.export.text_formats:write_json_lines",
        is_text=True,
    ),
)
_ALL: Final = (*_OWN, *export_formats())
FORMATS: Final = {each.name: each for each in _ALL if not each.for_viewers}  # of tables
FOR_VIEWERS: Final = {each.name: each for each in _ALL if each.for_viewers}
BUNDLE: Final = "zip"


def export(
    connection: sqlite3.Connection,
    wanted: TimeRange | TrialTable,
    form: str,
    sink: BinaryIO,
    progress: Progress | None = None,
    *,
    safe_cells: bool = False,
    notes: list[str] | None = None,
) -> int:
    """Write the state rows of a range, as many as there are now, flattened.

    Those that retention has deleted are given back from their chunks.

    Columns are run, state id, simulation and wall time, then the dotted names in the order in
    which they first appear; one that has the name of those or `replaced` is called `state.NAME`.

    Args:
        connection: Any; it is never kept busy for more than an instant.
        wanted: From `find_range`; or trials, which are a table as they are.
        form: One of `FORMATS`.
        sink: Takes bytes; need not be seekable.
        progress: Called now and then with the rows read so far and in all.
        safe_cells: See `write_csv`; the other formats have no cells that could be formulas.
        notes: Takes what could not be given back of deleted rows.

    Returns:
        The number of rows.

    Raises:
        InvalidInputError: There is no such format, or it needs what is not installed.
        OSError: The sink takes no more.
    """
    chosen = FORMATS.get(form)
    if chosen is None:
        raise InvalidInputError(f"no format {form!r}: choose one of {', '.join(FORMATS)}")
    if isinstance(wanted, TrialTable):
        source = wanted
    else:
        source = Source.of(connection, wanted.segments, chosen.passes, progress)
    if safe_cells and form == "csv":
        write_csv(source, sink, safe_cells=True)
    else:
        load(chosen.write)(source, sink)
    if notes is not None and isinstance(source, Source):
        notes += source.notes
    return source.total


def export_file(
    connection: sqlite3.Connection,
    wanted: TimeRange | TrialTable,
    form: str,
    file: Path,
    progress: Progress | None = None,
    *,
    safe_cells: bool = False,
    notes: list[str] | None = None,
) -> int:
    """As `export`, into a file of its owner alone that appears only when it is complete.

    Raises:
        InvalidInputError: Also where the file cannot be written.
    """
    with placed(file) as aside, aside.open("wb") as sink:
        return export(connection, wanted, form, sink, progress, safe_cells=safe_cells, notes=notes)


def export_for_viewers(
    connection: sqlite3.Connection,
    data_dir: Path,
    wanted: TimeRange,
    form: str,
    file: Path,
    progress: Progress | None = None,
) -> Exported:
    """Write all of a range in a format that viewers read.

    The files are of their owner alone and appear when they are complete.

    Args:
        connection: Any; it is never kept busy for more than an instant.
        data_dir: The folder of the pictures.
        wanted: From `find_range`.
        form: One of `FOR_VIEWERS`.
        file: Where to.
        progress: Called now and then with the rows read so far and in all.

    Raises:
        InvalidInputError: The library is not installed, or a file cannot be written.
    """
    exported: Exported = load(FOR_VIEWERS[form].write)(connection, data_dir, wanted, file, progress)
    return exported


@contextmanager
def placed(file: Path) -> Generator[Path]:
    """A file next to it to write to, private to its owner, which replaces it when complete.

    Raises:
        InvalidInputError: It cannot be written.
    """
    try:
        with whole_file(file) as aside:
            yield aside
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error


def format_of(file: Path) -> str:
    """The format that a file's name asks for.

    Raises:
        InvalidInputError: None does.
    """
    ending = file.suffix.lower().lstrip(".")
    if ending == BUNDLE:
        return BUNDLE
    for each in _ALL:
        if ending in each.suffixes:
            return each.name
    endings = ", ".join(f".{each.name}" for each in _ALL)
    raise InvalidInputError(
        f"{file.name} does not tell its format: end it in {endings} or .{BUNDLE}, or say it "
        "with --format"
    )
