"""What the tools answer: one compact object each, with the same header."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr


@dataclass(frozen=True)
class ShownPicture:
    """A picture beside the data: an encoded file.

    Attributes:
        format: Of the data, as in `image/png`.
    """

    data: bytes
    format: str


class Part(BaseModel):
    """A part of an answer."""

    model_config = ConfigDict(defer_build=True)  # most processes use one kind of answer


class Table(Part):
    """Rows under column names; a name says its unit."""

    columns: list[str]
    rows: list[list[Any]]
    in_every_row: dict[str, Any] | None = Field(
        default=None, description="Columns with the same value in all rows."
    )


class Answer(Part):
    """The header of every answer: about what, as of when, and whether time is moving."""

    robot: str | None = None
    run_id: int | None = None
    sim_time_s: float | None = Field(
        default=None, description="Simulation time of the newest data."
    )
    age_s: float | None = Field(default=None, description="Wall time since the newest data.")
    status: str | None = Field(
        default=None, description="running, paused, starting, 'stopped N s ago', 'never seen'."
    )
    why: str | None = Field(default=None, description="What the status rests on.")
    storage: str | None = Field(
        default=None, description="Where the recording cannot be written: how it was read."
    )
    hint: str | None = Field(default=None, description="What to do next.")
    left_out: list[str] | None = Field(
        default=None, description="Invalid rows and values, which are left out."
    )
    _pictures: list[ShownPicture] = PrivateAttr(default_factory=list[ShownPicture])

    @property
    def pictures(self) -> list[ShownPicture]:
        """What is shown beside the data, by clients that show both."""
        return self._pictures


class StateAnswer(Answer):
    """The newest published state."""

    state: Any = Field(default=None, description="Data published by the controller.")
    shortened: str | None = Field(default=None, description="Rule by which parts were left out.")
    kept_at_full_rate: str | None = Field(default=None, description="The run's last kept stretch.")


class SensorsAnswer(Answer):
    """The newest sensor values."""

    sensors: dict[str, Any] = Field(default_factory=dict[str, Any])
    replaced: dict[str, str] | None = Field(
        default=None, description="Values that JSON cannot hold: path to nan, inf, ..."
    )
    devices_not_named_in_state: str | None = Field(
        default=None, description="Sensors that the state lacks, or names differently than Webots."
    )
    shortened: str | None = None


class FullStateAnswer(Answer):
    """The newest state or a part of it, newest events, and the recorder's health."""

    state: Any = None
    path: str | None = None
    total: int | None = Field(
        default=None, description="How many members, items or characters it has."
    )
    next_offset: int | None = Field(
        default=None, description="Ask again with this offset for more."
    )
    shortened: str | None = None
    replaced: dict[str, str] | None = None
    events: Table | None = None
    recorder: dict[str, Any] | None = Field(
        default=None, description="Rows waiting and dropped, last kept stretch, error, controller."
    )


class WorldAnswer(Answer):
    """The world, the run, and who is in it."""

    world: str | None = None
    title: str | None = None
    basic_time_step_ms: float | None = None
    observer: str | None = Field(
        default=None,
        description="Its signals world.KEY.x_m and solid.KEY.x_m are places.",
    )
    in_world: Table | None = Field(
        default=None, description="What the observer sees: robots, and solids with a DEF."
    )
    real_time_factor: float | None = Field(
        default=None, description="Simulation time per wall time over the last seconds recorded."
    )
    supervisor: bool | None = Field(
        default=None, description="Whether it may control the simulation."
    )
    run: dict[str, Any] | None = None
    runs_recorded: int | None = None
    controller: dict[str, Any] | None = None
    devices: dict[str, str] | None = None
    other_robots: Table | None = Field(
        default=None, description="Other robots in the same simulation."
    )
    database: str | None = None
    retention: dict[str, Any] | None = Field(
        default=None, description="How much is kept, set by whom; size of the database."
    )
    data_dir: str | None = None


class RobotsAnswer(Answer):
    """All robots ever seen."""

    robots: Table | None = Field(
        default=None, description="rows_waiting, rows_dropped, last_error: where there are any."
    )
    database: str | None = None
    retention: dict[str, Any] | None = None


class DiagnosisAnswer(Answer):
    """What is not well between the controllers and their asker."""

    verdict: str | None = Field(default=None, description="ok, warning or wrong: the worst.")
    failed: list[dict[str, str]] | None = None
    not_checked: dict[str, str] | None = Field(default=None, description="Why, and which.")
    passed: str | None = Field(default=None, description="Checks that found nothing.")


class LogsAnswer(Answer):
    """Log lines, oldest first."""

    lines: Table | None = None
    matching: int | None = Field(
        default=None, description="How many lines match (with a cursor: how many older ones)."
    )
    cursor: int | None = Field(
        default=None, description="Ask again with this cursor for older lines."
    )


class CommandAnswer(Answer):
    """What became of a command."""

    command_id: int | None = None
    action: str | None = None
    outcome: str | None = Field(
        default=None, description="done, failed, expired, cancelled, lost, or claimed (under way)."
    )
    waited_s: float | None = None
    result: Any = Field(default=None, description="What the controller answered.")
    error: str | None = Field(default=None, description="What the controller or the bridge said.")
    route: str | None = Field(
        default=None, description="What steered: bridge, websocket (of Webots), keyboard, process."
    )
    evidence: str | None = Field(default=None, description="What shows that it happened.")
    failed_routes: dict[str, str] | None = Field(
        default=None, description="Why other routes did not work."
    )


class ParametersAnswer(Answer):
    """The parameters of a run."""

    parameters: Table | None = None
    total: int | None = None


class CommandsAnswer(Answer):
    """Commands, newest first, and what can be asked for."""

    commands: Table | None = None
    cursor: int | None = Field(
        default=None, description="Ask again with this cursor for older ones."
    )
    actions: dict[str, Any] | None = Field(
        default=None, description="The controller's own actions with their docstrings."
    )
    built_in: list[str] | None = None


class BreakpointAnswer(Answer):
    """A breakpoint that was set or removed."""

    breakpoint_id: int | None = None
    condition: str | None = None
    action: str | None = None
    armed: bool | None = Field(
        default=None, description="Whether the controller asks it now; null where it did not say."
    )
    notes: list[str] | None = None


class BreakpointsAnswer(Answer):
    """The breakpoints of a robot."""

    breakpoints: Table | None = None
