"""Parameters that several tools share: the same name, bounds and words everywhere."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

RobotName = Annotated[
    str | None,
    Field(
        max_length=200,
        description="Robot name (webots_list_robots); may be left out while only one is live.",
    ),
]
RunId = Annotated[
    int | None, Field(ge=1, description="That run instead of the robot's current one.")
]
LastS = Annotated[
    float | None,
    Field(gt=0, description="Only the last so many seconds of simulation time."),
]
StartS = Annotated[float | None, Field(description="From this simulation time on, s.")]
EndS = Annotated[float | None, Field(description="Up to, not including, this simulation time, s.")]
TimeoutS = Annotated[
    float, Field(ge=0.1, le=600, description="How long to wait for the outcome, wall seconds.")
]
Cursor = Annotated[
    int | None, Field(ge=0, description="From the previous answer, to go on where it ended.")
]
Since = Annotated[
    float | str | None,
    Field(
        description="From this wall time on, across runs: ISO 8601 or Unix seconds. Instead of "
        "simulation times."
    ),
]
Until = Annotated[
    float | str | None, Field(description="Up to, not including, this wall time; see since.")
]
Names = Annotated[
    list[str],
    Field(
        min_length=1,
        max_length=50,
        description="Signal names (webots_list_signals); 'pose' means all below it, '*' any text.",
    ),
]
AnyNames = Annotated[
    list[str] | None,
    Field(max_length=50, description="Signal names, as webots_list_signals has them; all if none."),
]
MaxPoints = Annotated[
    int | None,
    Field(
        ge=1,
        le=500,
        description="At most so many buckets (with raw: rows); by default as many as fit.",
    ),
]
ShownLimit = Annotated[
    int | None,
    Field(ge=1, le=500, description="At most so many; by default as many as a short answer holds."),
]
Limit = Annotated[int, Field(ge=1, le=500, description="At most so many.")]
RunIds = Annotated[
    list[int], Field(max_length=20, description="Runs by their ids (webots_list_runs).")
]
