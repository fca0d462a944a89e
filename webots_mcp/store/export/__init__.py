"""Exporting in constant memory: states or trials as flat tables, all of a range for viewers."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.export.contents import Contents
from webots_mcp.store.export.layout import layout
from webots_mcp.store.export.mcap import write_mcap
from webots_mcp.store.export.parquet import write_parquet
from webots_mcp.store.export.rows import Progress, Source, Table
from webots_mcp.store.export.rrd import write_rrd
from webots_mcp.store.export.text import write_csv, write_json_lines
from webots_mcp.store.export.trials import TrialTable
from webots_mcp.store.reading.ranges import TimeRange


class Format(NamedTuple):
    """How rows are written, and how often they are read for it."""

    write: Callable[[Table, BinaryIO], None]
    passes: int


FORMATS: Final = {
    "csv": Format(write_csv, 2),
    "jsonl": Format(write_json_lines, 1),
    "parquet": Format(write_parquet, 2),
}
FOR_VIEWERS: Final = ("mcap", "rrd")
BUNDLE: Final = "zip"


def export(
    connection: sqlite3.Connection,
    wanted: TimeRange | TrialTable,
    form: str,
    sink: BinaryIO,
    progress: Progress | None = None,
    *,
    safe_cells: bool = False,
) -> int:
    """Write the state rows of a range, as many as there are now, flattened.

    Columns are run, state id, simulation and wall time, then the dotted names in the order in
    which they first appear; one that has the name of those or `odd` is called `state.NAME`.

    Args:
        connection: Any; it is never kept busy for more than an instant.
        wanted: From `find_range`; or trials, which are a table as they are.
        form: One of `FORMATS`.
        sink: Takes bytes; need not be seekable.
        progress: Called now and then with the rows read so far and in all.
        safe_cells: See `write_csv`; the other formats have no cells that could be formulas.

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
        chosen.write(source, sink)
    return source.total


def export_file(
    connection: sqlite3.Connection,
    wanted: TimeRange | TrialTable,
    form: str,
    file: Path,
    progress: Progress | None = None,
    *,
    safe_cells: bool = False,
) -> int:
    """As `export`, into a file of its owner alone that appears only when it is complete.

    Raises:
        InvalidInputError: Also where the file cannot be written.
    """
    with placed(file) as aside, aside.open("wb") as sink:
        return export(connection, wanted, form, sink, progress, safe_cells=safe_cells)


def export_for_viewers(
    connection: sqlite3.Connection,
    data_dir: Path,
    wanted: TimeRange,
    form: str,
    file: Path,
    progress: Progress | None = None,
) -> Counter[str]:
    """Write all of a range as MCAP, with a layout beside it, or as a recording of Rerun's.

    The files are of their owner alone and appear when they are complete.

    Args:
        connection: Any; it is never kept busy for more than an instant.
        data_dir: The folder of the pictures.
        wanted: From `find_range`.
        form: One of `FOR_VIEWERS`.
        file: Where to; the layout is `layout_file` of it.
        progress: Called now and then with the rows read so far and in all.

    Returns:
        How many there are of each kind: states, log lines, events, commands, pictures.

    Raises:
        InvalidInputError: The library is not installed, or a file cannot be written.
    """
    if form == "rrd":
        with placed(file) as aside:
            return write_rrd(Contents.of(connection, data_dir, wanted, 1, progress), aside)
    contents = Contents.of(connection, data_dir, wanted, 2, progress)
    with placed(file) as aside, aside.open("wb") as sink:
        counts = write_mcap(contents, sink)
    with placed(layout_file(file)) as aside:
        aside.write_text(json.dumps(layout(contents), indent=2), "utf-8")
    return counts


def layout_file(file: Path) -> Path:
    """The layout beside a file for viewers."""
    return file.with_suffix(".layout.json")


@contextmanager
def placed(file: Path) -> Generator[Path]:
    """A file beside it to write to, of its owner alone, which takes its place when it is whole.

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
    form = {"json": "jsonl", "ndjson": "jsonl", "pq": "parquet"}.get(ending, ending)
    if form not in (*FORMATS, *FOR_VIEWERS, BUNDLE):
        raise InvalidInputError(
            f"{file.name} does not tell its format: end it in .csv, .jsonl, .parquet, .mcap, .rrd "
            "or .zip, or give the format"
        )
    return form
