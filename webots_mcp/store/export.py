"""Exporting in constant memory: states or trials as flat tables, all of a range for viewers."""

from __future__ import annotations

import csv
import io
import json
import math
import sqlite3
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Final, NamedTuple

from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins import ExportFormat, export_formats, load
from webots_mcp.store.analysis.summary import Ranked
from webots_mcp.store.export_rows import Column, Progress, Row, Source, Table, as_text
from webots_mcp.store.parameters import Trial, best_of, fetch_trial_set, ranking_of, trials_of
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
    ExportFormat("csv", ("csv",), "webots_mcp.store.export:write_csv", passes=2, is_text=True),
    ExportFormat(
        "jsonl",
        ("jsonl", "json", "ndjson"),
        "webots_mcp.store.export:write_json_lines",
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


# Rows as CSV and as JSON lines.


_SPELLED: Final = ("bool", "text", "numbers")
_FORMULAS: Final = ("=", "+", "-", "@", "\t", "\r")
_encode: Final = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode


def write_csv(source: Table, sink: BinaryIO, *, safe_cells: bool = False) -> None:
    r"""One line per row under a line of column names; UTF-8, lines end as in RFC 4180.

    What a row lacks, or is null, is empty; flags are `true` and `false`; what was not finite is
    `nan`, `inf` or `-inf`; a long array is its JSON text; a NUL character is `\0`, because many
    readers of CSV end there.

    A spreadsheet runs a text that begins with =, +, - or @ as a formula. With `safe_cells` such a
    text (also a name) gets an apostrophe before it; numbers are left as they are.
    """
    spell = _harmless if safe_cells else _without_nul
    columns = source.columns()
    names = [column.name for column in columns]
    # The writer itself turns numbers into text, and null into nothing.
    spelled = [i for i, column in enumerate(columns, len(source.head)) if column.kind in _SPELLED]
    text = io.TextIOWrapper(sink, "utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(map(spell, (*(column.name for column in source.head), *names)))
    for row in source.rows(pass_number=2):
        cells: list[object] = [*row.head, *map(row.values.get, names)]
        for i in spelled:
            value = cells[i]
            cells[i] = (spell if isinstance(value, str) else _without_nul)(as_text(value))
        writer.writerow(cells)
    text.detach()


def _without_nul(text: str | None) -> str | None:
    return text.replace("\0", "\\0") if text else text


def _harmless(text: str | None) -> str | None:
    plain = _without_nul(text)
    return f"'{plain}" if plain and plain.startswith(_FORMULAS) else plain


def write_json_lines(source: Table, sink: BinaryIO) -> None:
    """One JSON object per row and line: what it holds by dotted name, null where it is not finite.

    `replaced`, where a row has it, names the path of every value that JSON cannot hold, and what
    it was.
    """
    head = [column.name for column in source.head]
    for row in source.rows():
        line: dict[str, Any] = dict(zip(head, row.head, strict=True)) | row.values
        if row.replaced:
            line["replaced"] = row.replaced
        sink.write(_line(line))


def json_text(value: dict[str, Any]) -> str:
    """Strict JSON: null where a number is not finite."""
    try:
        return _encode(value)
    except ValueError:
        return _encode(_finite(value))


def _line(line: dict[str, Any]) -> bytes:
    return f"{json_text(line)}\n".encode()


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return [_finite(item) for item in value] if isinstance(value, list) else value  # pyright: ignore[reportUnknownVariableType]


# The trials of a set as a flat table: one row per trial, with the figures of its parameters.


_OF_TRIAL: Final = (
    "trial_set_id", "number", "run_id", "status", "score", "ended_by", "ended_sim_time_s", "error",
    "started_wall_time_s", "finished_wall_time_s",
)  # fmt: skip
_OF_PARAMETERS: Final = ("rank", "mean", "least", "greatest", "scores", "pruned", "failed")


@dataclass(frozen=True)
class TrialTable(Table):
    """The trials of a set, in order.

    Columns are those of the table `trial`, the parameters by name, and how trials with the same
    parameters did: rank (1 is the best), mean, least and greatest score, and how many gave a
    score, were pruned, and failed. A parameter called like one of those is `parameter NAME`.
    """

    head: ClassVar[tuple[Column, ...]] = ()
    trials: Sequence[Trial]
    figures: dict[str, tuple[Any, ...]]
    notes: Sequence[str] = ()

    @classmethod
    def of(cls, connection: sqlite3.Connection, set_id: int) -> TrialTable:
        """The trials as they are now.

        Raises:
            InvalidInputError: There is no such set.
        """
        trials = trials_of(connection, set_id)
        plan = json.loads(fetch_trial_set(connection, set_id).plan)
        sets = ranking_of(trials, best_of(plan)).sets
        return cls(
            trials, {_key(each.parameters): _figures(i, each) for i, each in enumerate(sets, 1)}
        )

    @property
    def total(self) -> int:
        """How many there are."""
        return len(self.trials)

    def rows(self, pass_number: int = 1) -> Iterator[Row]:
        """All of them; `pass_number` makes no difference."""
        for each in self.trials:
            values: dict[str, Any] = {name: getattr(each, name) for name in _OF_TRIAL}
            for name, value in each.values.items():
                values[_column(name)] = value
            figures = self.figures.get(_key(each.values), (None,) * len(_OF_PARAMETERS))
            yield Row((), values | dict(zip(_OF_PARAMETERS, figures, strict=True)), {})


def _figures(rank: int, ranked: Ranked) -> tuple[Any, ...]:
    spread = ranked.score or (None, None, None)
    return (rank, *spread, len(ranked.scores), ranked.pruned, len(ranked.failures))


def _key(parameters: dict[str, Any]) -> str:
    return json.dumps(parameters, sort_keys=True)


def _column(parameter: str) -> str:
    taken = parameter in (*_OF_TRIAL, *_OF_PARAMETERS)
    return f"parameter {parameter}" if taken else parameter
