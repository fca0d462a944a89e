"""The tool that lists what was recorded."""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.questions.argument_types import Cursor, Limit, RobotName, RunId
from webots_mcp.questions.budget import (
    answer_about,
    figure,
    fitting,
    notes_of,
    seconds,
    short_name,
    shown,
    without_empty,
)
from webots_mcp.questions.declaring import READS, question
from webots_mcp.questions.history_answers import SignalsAnswer
from webots_mcp.store.reading.catalogue import SignalInfo, list_signals
from webots_mcp.store.recording import Recording, View

SIGNAL_COLUMNS: Final = ("signal", "kind", "unit", "last", "min", "max", "missing")


@question("List the signals", READS, command="signals", positional=("pattern",), example="'front*'")
def webots_list_signals(
    recording: Recording,
    pattern: Annotated[
        str, Field(max_length=200, description="Of signals; '*' is any text.")
    ] = "*",
    limit: Limit = 100,
    cursor: Cursor = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> SignalsAnswer:
    """The dotted names of all that was published in a run: kind, last value, range, missing values.

    Arrays of more than 16 items are kept as .count, .min, .max, .mean and .argmin.
    """
    with recording.view(robot, run_id) as view:
        return answer_about(view, SignalsAnswer, lambda: _found(view, pattern, limit, cursor or 0))


def _signal_row(info: SignalInfo, rows: int) -> list[Any]:
    """A signal of a run of that many rows, as a row under `SIGNAL_COLUMNS`."""
    return [
        short_name(info.name),
        info.kind,
        info.unit,
        *(_value(info, each) for each in (shown(info.last), figure(info.min), figure(info.max))),
        _missing(info, rows),
    ]


def _value(info: SignalInfo, value: Any) -> Any:
    return bool(value) if info.kind == "bool" and value is not None else value


def _missing(info: SignalInfo, rows: int) -> str | None:
    """In how many rows it has no value, and between which times it has some."""
    if not info.missing:
        return None
    if info.first_s is None:
        return f"in all {rows} rows"
    told = f"in {info.missing} of {rows} rows; values"
    return f"{told} from {seconds(info.first_s)} to {seconds(info.last_s)} s"


def _found(view: View, pattern: str, limit: int, start: int) -> dict[str, Any]:
    found = list_signals(
        view.connection,
        robot=view.robot.name,
        run_id=view.require_run().id,
        pattern=pattern,
        limit=start + limit,
    )
    rows = fitting([_signal_row(info, found.rows) for info in found.signals[start:]])
    end = start + len(rows)
    more = end < found.total
    return {
        "signals": without_empty(SIGNAL_COLUMNS, rows),
        "total": found.total,
        "cursor": end if more else None,
        "notes": notes_of(found.notes),
        "hint": _hint(start, end, found.total),
    }


def _hint(start: int, end: int, total: int) -> str | None:
    if total == 0:
        return "no state row with values was recorded in this run yet"
    if start >= total:
        return f"there are only {total}: leave cursor out"
    return (
        f"{end - start} of {total}: go on with cursor, or narrow pattern" if end < total else None
    )
