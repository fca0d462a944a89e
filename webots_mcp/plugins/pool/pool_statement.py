"""The answer to one SELECT over a pool, within the limits that `query_sql` has as well.

The engine of the pool cuts long values itself: what nobody will read is neither sent nor held here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.questions.sql import (
    MAX_BYTES,
    MAX_COLUMNS,
    MAX_TEXT,
    Budget,
    Cell,
    Result,
    fetch_rows,
)

Kind = Literal["number", "bytes", "text"]  # text: whatever is neither of the others
_TEXT: Final = "CAST({column} AS VARCHAR)"
_LENGTH: Final = f"length({_TEXT})"
_CUT: Final = (
    f"CASE WHEN {_LENGTH} > {MAX_TEXT} THEN left({_TEXT}, {MAX_TEXT}) || '... (' || "
    f"CAST({_LENGTH} AS VARCHAR) || ' characters)' ELSE {_TEXT} END"
)
_SHOWN: Final[dict[Kind, str]] = {
    "number": "{column}",
    "bytes": "'<blob of ' || CAST(octet_length({column}) AS VARCHAR) || ' bytes>'",
    "text": _CUT,
}


def bounded(columns: Sequence[tuple[str, Kind]]) -> list[str]:
    """The expressions, in SQL, of these columns as they are shown, and how many of them are cut.

    Raises:
        InvalidInputError: They are too many.
    """
    if len(columns) > MAX_COLUMNS:
        raise InvalidInputError(
            f"{len(columns)} columns are too many: name at most {MAX_COLUMNS} of them"
        )
    texts = [column for column, kind in columns if kind == "text"]
    are_cut = [
        f"CASE WHEN {_LENGTH.format(column=column)} > {MAX_TEXT} THEN 1 ELSE 0 END"
        for column in texts
    ]
    shown = [_SHOWN[kind].format(column=column) for column, kind in columns]
    return [*shown, " + ".join(are_cut) or "0"]


def answered(names: Iterable[str], rows: Sequence[Sequence[Any]], max_rows: int) -> Result:
    """The first of the rows, whose columns are those of `bounded`.

    Args:
        names: Of the columns that were asked for.
        rows: One more than `max_rows`, where there are as many.
        max_rows: The most to answer with.
    """
    budget = Budget(MAX_BYTES)
    taken: list[tuple[Cell, ...]] = []
    why = fetch_rows((row[:-1] for row in rows), taken, max_rows, budget)
    shortened = sum(row[-1] for row in rows[: len(taken)])
    return Result(tuple(names), tuple(taken), why, shortened)
