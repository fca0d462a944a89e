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
    int | None, Field(ge=0, description="From the previous answer, to continue with older ones.")
]
