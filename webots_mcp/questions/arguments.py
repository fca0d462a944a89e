"""Arguments that several questions share, with the same name, bounds and text everywhere.

Each is an annotated type: pydantic reads its bounds, and clients show its description.
"""

from __future__ import annotations

import re
from typing import (
    Annotated,
    Final,
)

from pydantic import (
    AfterValidator,
    Field,
    ValidationInfo,
    WithJsonSchema,
)

from webots_mcp import contract

# Clients put a call aside after two minutes; some of this time is for a busy database.
MAX_WAIT_S: Final = 90
FOR_A_PERSON: Final = "person"  # the context of a validation: a person who waits can press Ctrl-C
LONGEST_NAME: Final = 200
_CURSOR: Final = "Cursor of the previous answer, to continue it."


def _as_id(value: int) -> int:
    if value >= 2**63:  # what SQLite can compare with
        raise ValueError("be an id from an earlier answer")
    return value


def _as_seconds(value: float) -> float:
    if not abs(value) <= 1e12:  # NaN is none either
        raise ValueError("be a number of seconds")
    return value


def _as_wait(value: float, info: ValidationInfo) -> float:
    if info.context != FOR_A_PERSON and value > MAX_WAIT_S:
        raise ValueError(f"be less than or equal to {MAX_WAIT_S}")
    return _as_seconds(value)


# Bounds that only an absurd value meets stay out of the schemas, which every client carries along:
# `CheckedTool` leaves the lengths of texts out, a validator has the others. The bounds next to a
# validator stand before it: behind it pydantic does not know JSON Schema's words.
Id = Annotated[int, Field(ge=1), AfterValidator(_as_id)]
_Place = Annotated[int, Field(ge=0), AfterValidator(_as_id)]
Seconds = Annotated[float, AfterValidator(_as_seconds)]
_Duration = Annotated[float, Field(gt=0), AfterValidator(_as_seconds)]
RobotName = Annotated[
    Annotated[str, Field(max_length=LONGEST_NAME)] | None,
    Field(description="Name of the robot. Needed only if several robots are live."),
]
RunId = Annotated[
    Id | None, Field(description="Run to ask about, from webots_list_runs. Default: the newest.")
]
TrialSetId = Annotated[
    Id | None, Field(description="Number of a set of trials, from the answer that began it.")
]
LastS = Annotated[_Duration | None, Field(description="Only the last N simulated seconds.")]
StartS = Annotated[Seconds | None, Field(description="Start of the range in simulated seconds.")]
EndS = Annotated[Seconds | None, Field(description="End of the range in simulated seconds.")]
WaitS = Annotated[
    float, Field(ge=0.1, json_schema_extra={"maximum": MAX_WAIT_S}), AfterValidator(_as_wait)
]
TimeoutS = Annotated[WaitS, Field(description="Maximum wall-clock seconds to wait.")]
TimeOfDay = Annotated[bool, Field(description="Add the time of day to each row.")]
Cursor = Annotated[_Place | None, Field(description=_CURSOR)]
TextCursor = Annotated[str, Field(max_length=2000, description=_CURSOR)]
# A number is as good; one type that holds both is shorter than two.
_WallTime = Annotated[float | str | None, WithJsonSchema({"type": "string"})]
Since = Annotated[
    _WallTime, Field(description="Start as time of day, ISO 8601 with zone: 2026-05-01T03:00:00Z.")
]
Until = Annotated[_WallTime, Field(description="End as time of day, ISO 8601 with zone.")]
Names = Annotated[
    list[str],
    Field(
        min_length=1,
        max_length=50,
        description="Signals to read; 'pose' means all below it, '*' any text.",
    ),
]
AnyNames = Annotated[
    list[str] | None,
    Field(max_length=50, description="Only these signals; '*' means any text, as in 'wheel.*'."),
]
# Of a parameter. A whole number is a number as well, and stays one. What it may be is the
# parameter's to say, and would take as much room as all else.
Value = Annotated[float | int | bool | str, WithJsonSchema({})]
MaxPoints = Annotated[
    int | None, Field(ge=1, le=500, description="Maximum number of intervals, or of rows with raw.")
]
ShownLimit = Annotated[
    int | None, Field(ge=1, le=500, description="Maximum number of rows in the answer.")
]
LogLevel = Annotated[contract.LogLevel, Field(description="Lowest level of log lines that count.")]
Limit = Annotated[int, Field(ge=1, le=500, description="Maximum number of rows in the answer.")]
RunIds = Annotated[
    list[Id] | None, Field(max_length=10, description="Runs, from webots_list_runs.")
]


def _as_run_or_range(value: str | int) -> str | int:
    text = str(value)
    if re.fullmatch(r"[1-9][0-9]{0,17}-[1-9][0-9]{0,17}", text):
        return text
    if not re.fullmatch(r"[1-9][0-9]{0,17}", text):
        raise ValueError("be the number of a run, or a range such as '20-90'")
    return int(text)


# The text comes first: the command line has texts only.
_RunOrRange = Annotated[
    str | int,
    AfterValidator(_as_run_or_range),
    WithJsonSchema({}),
]
ComparedRunIds = Annotated[
    list[_RunOrRange] | None,
    Field(max_length=300, description="Runs, such as [3, 4] or ['20-90']."),
]
Position = Annotated[
    list[str] | None,
    Field(
        min_length=2, max_length=2, description="Signals of x and y, if they are not recognised."
    ),
]
Mode = Annotated[
    str | None,
    Field(max_length=LONGEST_NAME, description="Signal of the mode, if it is not recognised."),
]
# What a client gives for a `Scope`, which tools take whole.
SCOPE: Final = {
    "last_s": LastS,
    "start_s": StartS,
    "end_s": EndS,
    "since_wall_time": Since,
    "until_wall_time": Until,
    "robot": RobotName,
    "run_id": RunId,
}
