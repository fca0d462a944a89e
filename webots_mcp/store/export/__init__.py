"""Exporting states or trials as flat tables: CSV, JSON lines, Parquet; in constant memory."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from webots_mcp.contract import PRIVATE_FILE
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.export.parquet import write_parquet
from webots_mcp.store.export.rows import Progress, Source, Table
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
    aside = file.with_name(f"{file.name}.part")
    try:
        with aside.open("wb") as sink:
            aside.chmod(PRIVATE_FILE)
            rows = export(connection, wanted, form, sink, progress, safe_cells=safe_cells)
        os.replace(aside, file)  # noqa: PTH105
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error
    finally:
        aside.unlink(missing_ok=True)
    return rows


def format_of(file: Path) -> str:
    """The format that a file's name asks for.

    Raises:
        InvalidInputError: None does.
    """
    ending = file.suffix.lower().lstrip(".")
    form = {"json": "jsonl", "ndjson": "jsonl", "pq": "parquet"}.get(ending, ending)
    if form not in FORMATS:
        raise InvalidInputError(
            f"{file.name} does not tell its format: end it in .csv, .jsonl or .parquet, or give "
            "the format"
        )
    return form
