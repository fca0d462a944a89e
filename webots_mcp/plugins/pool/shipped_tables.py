"""Which tables are shipped to a pool, and how: derived from the models."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Final, TypeAlias, cast

SQLValue: TypeAlias = "int | float | str | bytes | None"
Kind: TypeAlias = type[int] | type[float] | type[str] | type[bytes]

_DATED: Final = ("state", "kept_state", "log", "event", "image", "parameter_value")
CHUNKS: Final = ("row_group", "chunk")
# Of one machine or one moment: who maintains it, what is kept there, and console lines that wait
# to become log lines.
_LOCAL: Final = ("lease", "watermark", "retention_limit", "console_line")
# How many rows wait for chunks there, how many of a group are left, and what they take on the disk.
_LOCAL_COLUMNS: Final = {
    "run": ("is_chunked",),
    "row_group": ("stored_row_count", "stored_row_bytes", "chunk_bytes", "is_complete"),
}
_OF_TRIALS: Final = ("trial_set", "trial")
_TYPES: Final[dict[str, Kind]] = {
    "INTEGER": int, "BIGINT": int, "FLOAT": float, "TEXT": str, "VARCHAR": str, "BLOB": bytes,
}  # fmt: skip


@dataclass(frozen=True)
class Table:
    """A table that is shipped; its columns in the order in which a batch has their values.

    Attributes:
        key: Its primary key in a recording; in a pool the recording's UUID stands before it.
        columns: Those of the key and all others that are shipped, by their names in the recording.
        types: Of the columns, as the model declares them; SQLite may hold others.
        json_columns: Those that hold JSON as text.
        json_values: Of them, those in which a text is as good as an object.
        nullable: Those that may be null.
        lasting: References that retention sets to null where it deletes what they name: a null
            does not replace the value that the pool has.
        is_appended: Rows come with rising ids and never change; otherwise a row replaces the one
            of the same key.
        time_column: The wall time by which a pool may cut it into parts, of appended tables but
            row groups and chunks.
        run_column: The column that names the row's run, where it belongs to one.
        session_column: The column that names its session.
        outlasts_runs: It stays where the run or session that it names is not shipped.
    """

    name: str
    key: tuple[str, ...]
    columns: tuple[str, ...]
    types: tuple[Kind, ...]
    json_columns: frozenset[str]
    json_values: frozenset[str]
    nullable: frozenset[str]
    lasting: frozenset[str]
    is_appended: bool
    time_column: str | None
    run_column: str | None
    session_column: str | None
    outlasts_runs: bool


@cache
def tables() -> tuple[Table, ...]:
    """All that are shipped, each after those that it refers to. Importing the models costs."""
    from webots_mcp.store import models

    ordered: list[Any] = cast("Any", models).SQLModel.metadata.sorted_tables
    return tuple(_table(each) for each in ordered if each.name not in _LOCAL)


def table(name: str) -> Table:
    """The table of that name.

    Raises:
        KeyError: None of that name is shipped.
    """
    return {each.name: each for each in tables()}[name]


def _table(model: Any) -> Table:
    name: str = model.name
    local = _LOCAL_COLUMNS.get(name, ())
    shipped: list[Any] = [column for column in model.columns if column.name not in local]
    columns = tuple(str(column.name) for column in shipped)
    return Table(
        name=name,
        key=tuple(column.name for column in model.primary_key.columns),
        columns=columns,
        types=tuple(_TYPES[str(column.type)] for column in shipped),
        json_columns=frozenset(column.name for column in shipped if _is_json(column)),
        json_values=frozenset(column.name for column in shipped if _is_value(column)),
        nullable=frozenset(column.name for column in shipped if column.nullable),
        lasting=frozenset(column.name for column in shipped if _is_lasting(column)),
        is_appended=name in _DATED + CHUNKS,
        time_column="wall_time_s" if name in _DATED else None,
        run_column=_column_of("run", name, columns),
        session_column=_column_of("session", name, columns),
        outlasts_runs=name in _OF_TRIALS,
    )


def _column_of(owner: str, name: str, columns: tuple[str, ...]) -> str | None:
    if name == owner:
        return "id"
    return f"{owner}_id" if f"{owner}_id" in columns else None


def _is_json(column: Any) -> bool:
    return (column.comment or "").startswith("JSON") or column.name == "replaced"


def _is_value(column: Any) -> bool:
    return (column.comment or "").startswith("JSON value")


def _is_lasting(column: Any) -> bool:
    return any(key.ondelete == "SET NULL" for key in column.foreign_keys)
