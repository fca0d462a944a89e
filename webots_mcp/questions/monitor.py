"""Watch a robot for a while, or report what was recorded in a past window."""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Final

import anyio
from anyio import to_thread
from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from webots_mcp.answers.answer_models import MonitorAnswer
from webots_mcp.answers.budget import (
    answer_about,
    newest_runs,
    notes_of,
    row_budget_tokens,
)
from webots_mcp.answers.event_tables import fitting_events, not_shown_of, verdicts_of
from webots_mcp.answers.movement import movement
from webots_mcp.answers.trend_tables import MOST_SIGNALS, trend_tables
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_kinds import asked_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import search_events
from webots_mcp.judging.verdicts import Verdicts
from webots_mcp.questions.arguments import MAX_WAIT_S, RobotName
from webots_mcp.questions.declaration import READS, Caller, question
from webots_mcp.store.reading.ranges import Scope, Segment, TimeRange, find_range, row_before
from webots_mcp.store.reading.segment import in_one_snapshot
from webots_mcp.store.recording import RecordingAccess, RobotView

if TYPE_CHECKING:
    from webots_mcp.judging.trends import RunTrends

USUAL_DURATION_S: Final = 10.0
_ROWLESS: Final = EventOptions(kinds=("run", "command", "log", "bridge_event"))  # without any row
_WatchS = Annotated[float, Field(ge=1, le=MAX_WAIT_S)] | None


@dataclass(frozen=True)
class MonitorSizes:
    """How much of a watched window its answer shows.

    Attributes:
        signals: Signals with a trend, of each run.
        events: Events.
        rows_tokens: Budget of events and trends together.
        events_share: Share of it for events.
        runs: Runs with trends: the one before a reset, and the one after it.
    """

    signals: int = 12
    events: int = 30
    rows_tokens: int = 1_100
    events_share: float = 0.45
    runs: int = 2


_SIZES: Final = MonitorSizes()


@question("Watch the robot", READS, quotes=True)
async def webots_monitor(
    recording: RecordingAccess,
    caller: Caller,
    duration_wall_s: Annotated[
        _WatchS, Field(description="Wall-clock seconds to watch. Default 10.")
    ] = None,
    lookback_wall_s: Annotated[
        float | None,
        Field(
            gt=0,
            le=86_400,
            description="Report the last N wall-clock seconds at once instead.",
        ),
    ] = None,
    duration: SkipJsonSchema[_WatchS] = None,
    robot: RobotName = None,
) -> MonitorAnswer:
    """Watch the robot live for some seconds, then report its movement, trends and events.

    It takes that long; for the newest values at once use webots_get_robot_state. For recorded
    time use webots_get_trends and webots_find_events, which answer at once.
    """
    asked = {
        "duration": duration,
        "duration_wall_s": duration_wall_s,
        "lookback_wall_s": lookback_wall_s,
    }
    given = [name for name, value in asked.items() if value is not None]
    if len(given) > 1:
        raise InvalidInputError(
            f"{' and '.join(given)} exclude each other. Give duration_wall_s alone to watch from "
            "now on, or lookback_wall_s alone to read the past at once."
        )
    duration_wall_s = duration_wall_s or duration or USUAL_DURATION_S
    if lookback_wall_s is not None:
        return await to_thread.run_sync(look_back, recording, robot, lookback_wall_s)
    name, started_s, is_live = await to_thread.run_sync(_start, recording, robot)
    for second in range(1, math.ceil(duration_wall_s) + 1) if is_live else ():
        await anyio.sleep(min(1.0, duration_wall_s - second + 1))
        doing = await to_thread.run_sync(_doing, recording, name)
        await caller.report(min(second, duration_wall_s), duration_wall_s, doing)
    return await to_thread.run_sync(_watched, recording, name, started_s)


def _start(recording: RecordingAccess, robot: str | None) -> tuple[str, float, bool]:
    """Return the robot, the start of the window, and whether any controller can write."""
    with recording.view(robot) as view:
        view.require_run()
        is_live = view.session is not None and view.session.is_alive(view.now_s)
        return view.robot.name, time.time(), is_live


def _doing(recording: RecordingAccess, robot: str) -> str:
    with recording.view(robot) as view:
        at = f", simulation time {view.state.sim_time_s:.2f} s" if view.state else ""
        return f"{robot}: {view.status.text}{at}"


def _watched(recording: RecordingAccess, robot: str, started_s: float) -> MonitorAnswer:
    with recording.view(robot) as view:
        return _report(view, started_s, view.now_s - started_s)


def look_back(
    recording: RecordingAccess, robot: str | None, lookback_wall_s: float
) -> MonitorAnswer:
    """Return a report of the wall seconds before the newest row."""
    with recording.view(robot) as view:
        run = view.require_run()
        newest_s = view.state.wall_time_s if view.state else run.last_wall_time_s
        return _report(view, newest_s - lookback_wall_s, lookback_wall_s)


def _report(view: RobotView, wall_start_s: float, window_s: float) -> MonitorAnswer:
    return answer_about(
        view,
        MonitorAnswer,
        lambda: {
            "window_wall_s": round(window_s, 2),
            **_found(view.connection, view, wall_start_s),
        },
    )


@in_one_snapshot
def _found(connection: sqlite3.Connection, view: RobotView, wall_start_s: float) -> dict[str, Any]:
    from webots_mcp.judging.trends import trends

    window = window_from(view, wall_start_s)
    recorded, shown = bool(window.rows.segments), _SIZES.signals
    # The events are searched in a row more, so that trends find the values that these read.
    found = search_events(connection, window.around, None if recorded else _ROWLESS)
    described = (
        trends(connection, window.rows, limit=MOST_SIGNALS, shown=shown) if recorded else None
    )
    runs = described.runs if described else ()
    newest = runs[-_SIZES.runs :]
    happened = [event for event in found.events if _in_window(event, window, wall_start_s)]
    in_window = found.only(happened)
    known = in_window.verdicts if recorded else _unlooked(in_window.verdicts)
    verdicts = verdicts_of(known, in_short=recorded)
    moved = movement(view, window.rows) if recorded else None
    notes = notes_of(tuple(dict.fromkeys((*window.rows.notes, *found.notes, *_of_earlier(runs)))))
    others = [verdicts.model_dump(exclude_none=True), moved, notes]
    space_tokens = row_budget_tokens(others=others, usual_tokens=_SIZES.rows_tokens)
    shown, events = fitting_events(
        in_window, _SIZES.events, int(space_tokens * _SIZES.events_share), view
    )
    of_a_run = int(space_tokens * (1 - _SIZES.events_share)) // max(len(newest), 1)
    rows = sum(run.rows for run in runs)
    return {
        "row_count": rows,
        "movement": moved,
        "trends": [trend_tables(run, _SIZES.signals, of_a_run) for run in newest] or None,
        "events": events,
        "verdicts": verdicts,
        "not_shown": not_shown_of(shown),
        "notes": notes,
        "hint": _hint(recorded, bool(shown.left_out), wall_start_s, view),
    }


def _unlooked(verdicts: Verdicts) -> Verdicts:
    """Add the kinds that were not searched because there is no row."""
    others = [each.name for each in asked_kinds(EventOptions()) if each.name not in _ROWLESS.kinds]
    why = dict.fromkeys(others, ("no row was recorded in that time",))
    return replace(verdicts, reasons=verdicts.reasons | why)


def _of_earlier(runs: Sequence[RunTrends]) -> list[str]:
    """Return where the trends of all runs but the newest are."""
    earlier = ", ".join(str(run.run_id) for run in runs[: -_SIZES.runs])
    return [f"the trends of run {earlier}: webots_get_trends(run_id)"] if earlier else []


def _in_window(event: Event, window: WatchedWindow, wall_start_s: float) -> bool:
    """Return whether it began in the window, or had begun before and lasted into it."""
    starts = (each.start_s for each in window.rows.segments if each.run_id == event.run_id)
    lasted = event.start_s < min(starts, default=math.inf) <= event.end_s
    return event.wall_time_s >= wall_start_s or lasted


def _hint(recorded: bool, left_out: bool, wall_start_s: float, view: RobotView) -> str | None:
    if not recorded:
        return _why_nothing(view)
    if not left_out:
        return None
    call = f"webots_find_events(since_wall_time={wall_start_s:.3f})"
    return f"more events: {call} shows what is left out"


def _why_nothing(view: RobotView) -> str:
    if view.status.is_moving:
        return (
            "time moves but no state was recorded: is bridge.publish() called in the loop? By "
            "default every 5th call is recorded (throttle_interval)"
        )
    if view.status.why is None:
        return "nothing was recorded because the simulation is paused: resume it and watch again"
    return (
        "nothing was recorded, for the reason that stands under why; lookback_wall_s tells the past"
    )


# -- a window of wall time: the rows that were recorded in it, and the distance travelled --


@dataclass(frozen=True)
class WatchedWindow:
    """The recording since a moment.

    Attributes:
        rows: The time range of the rows; without segments if there are none.
        around: The same range, extended to the row before and to everything after the last row,
            since a pause or a log line lies between rows.
    """

    rows: TimeRange
    around: TimeRange


def window_from(view: RobotView, wall_start_s: float) -> WatchedWindow:
    """Return the window of a robot from that wall time (Unix) on."""
    found = find_range(view.connection, Scope(since_wall_time=wall_start_s), view.subject)
    found = newest_runs(found if found.segments else replace(found, notes=()))
    around = [
        replace(segment, start_s=_from_row_before(view.connection, segment))
        for segment in found.segments or [_standing(view, wall_start_s)]
    ]
    around[-1] = replace(around[-1], end_s=math.inf)
    return WatchedWindow(found, replace(found, segments=tuple(around)))


def _from_row_before(connection: sqlite3.Connection, segment: Segment) -> float:
    before_s = row_before(connection, segment.run_id, segment.start_s)
    return segment.start_s if before_s is None else before_s


def _standing(view: RobotView, wall_start_s: float) -> Segment:
    """Return the current run from its newest row on, limited to what was recorded in the window."""
    run = view.require_run()
    newest_s = view.state.sim_time_s if view.state else run.started_sim_time_s
    return Segment(run.id, newest_s, math.inf, wall_start_s)
