"""The tool that watches for a while and reports from what was recorded meanwhile."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, cast

import anyio
from anyio import to_thread
from mcp.server.mcpserver import Context
from pydantic import Field

from webots_mcp.server.boundary import READS, reporter, tool
from webots_mcp.server.parameters import RobotName
from webots_mcp.server.results import MonitorAnswer, Table
from webots_mcp.server.shortening import DETAIL_BUDGET, cut_text, round_number, shorten
from webots_mcp.server.tools.commands import COMMAND_COLUMNS, command_row
from webots_mcp.server.tools.logs import LOG_COLUMNS, log_row
from webots_mcp.server.watching import Watched, evenly
from webots_mcp.store.events import Event, events_after, newest_event_id
from webots_mcp.store.logs import lines_after, newest_log_id
from webots_mcp.store.queue import commands_since
from webots_mcp.store.recording import Recording, View
from webots_mcp.store.runs import Run, runs_since
from webots_mcp.store.states import fetch_states, newest_state_id, state_ids_after

_REPORT_INTERVAL_S: Final = 1.0
_MOST_ROWS: Final = 3_000
_MOST_BYTES: Final = 20_000_000
_MOST_EVENTS: Final = 2_000
_SHOWN_CHANGES: Final = 30
_SHOWN_SIGNALS: Final = 12
_SHOWN_LOGS: Final = 12
_SHOWN_COMMANDS: Final = 10
_LONGEST_NAME: Final = 80
_CHANGE_KINDS: Final = ("change", "pause", "resume", "reset", "reload", "start")


@dataclass(frozen=True)
class Mark:
    """Where the recording stood when the watching began."""

    robot: str
    first_run_id: int
    sim_time_s: float
    wall_time_s: float
    state_id: int
    event_id: int
    log_id: int


class MonitorTools:
    """Watching a robot."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    @tool("Watch the robot", READS)
    async def webots_monitor(
        self,
        ctx: Context[Any],
        duration_s: Annotated[
            float, Field(ge=1, le=120, description="How long to watch, wall seconds.")
        ] = 10,
        robot: RobotName = None,
    ) -> MonitorAnswer:
        """Watch for some seconds, then report what was recorded meanwhile.

        Movement, changes of modes and flags with their times, pauses and resets, the numbers that
        changed most, warnings, commands. Nothing that was recorded in the window is missed.
        """
        mark = await to_thread.run_sync(self._mark, robot)
        report = reporter(ctx)
        for second in range(1, math.ceil(duration_s) + 1):
            await anyio.sleep(min(_REPORT_INTERVAL_S, duration_s - second + 1))
            doing = await to_thread.run_sync(self._doing, mark)
            await report(min(second, duration_s), duration_s, doing)
        return await to_thread.run_sync(self._report, mark)

    def _mark(self, robot: str | None) -> Mark:
        with self._recording.view(robot) as view:
            run = view.require_run()
            return Mark(
                view.robot.name,
                run.id,
                view.state.sim_time_s if view.state else -math.inf,
                time.time(),
                newest_state_id(view.connection),
                newest_event_id(view.connection),
                newest_log_id(view.connection),
            )

    def _doing(self, mark: Mark) -> str:
        with self._recording.view(mark.robot) as view:
            at = f", simulation time {view.state.sim_time_s:.2f} s" if view.state else ""
            return f"{mark.robot}: {view.status.text}{at}"

    def _report(self, mark: Mark) -> MonitorAnswer:
        with self._recording.view(mark.robot) as view:
            runs = runs_since(view.connection, view.robot.id, mark.first_run_id)
            ids = {run.id: _ids(view, mark, run) for run in runs}
            rows = sum(map(len, ids.values()))
            watched, sampled = _read(view, ids, rows)
            events = [event for run in runs for event in _events(view, mark, run)]
            return MonitorAnswer(
                **view.header(),
                watched_s=round(view.now_s - mark.wall_time_s, 2),
                from_sim_time_s=None if math.isinf(mark.sim_time_s) else round(mark.sim_time_s, 4),
                rows=rows,
                sampled=sampled if sampled < rows else None,
                runs=[run.id for run in runs] if len(runs) > 1 else None,
                movement=watched.movement(),
                changes=_changes(watched, events),
                signals=_signals(watched),
                steady=sum(number.relative_range == 0 for number in watched.numbers.values()),
                events=_other_events(events),
                logs=_logs(view, mark, runs),
                commands=_commands(view, mark),
                hint=None if rows else _why_nothing(view),
            )


def _ids(view: View, mark: Mark, run: Run) -> list[int]:
    from_s = mark.sim_time_s if run.id == mark.first_run_id else -math.inf
    return state_ids_after(view.connection, run.id, mark.state_id, from_s)


def _read(view: View, ids: dict[int, list[int]], rows: int) -> tuple[Watched, int]:
    """Read the rows, or evenly spread ones where there are too many or they are too big."""
    watched, sampled = Watched(), 0
    size = max(len(view.state.data) if view.state else 1, 1)
    most = max(2, min(_MOST_ROWS, _MOST_BYTES // size))
    for run_ids in ids.values():
        share = max(2, math.ceil(most * len(run_ids) / rows)) if rows else 0
        chosen = evenly(run_ids, share)
        sampled += len(chosen)
        watched.read(fetch_states(view.connection, chosen))
    return watched, sampled


def _events(view: View, mark: Mark, run: Run) -> list[Event]:
    return events_after(view.connection, run.id, mark.event_id, _MOST_EVENTS)


def _changes(watched: Watched, events: list[Event]) -> Table | None:
    """Bridge events tell of the top of the state exactly; the rows tell of what lies deeper."""
    rows = [row for event in events if (row := _event_row(event)) is not None]
    rows += [
        [round(change.sim_time_s, 3), change.name[:_LONGEST_NAME], change.before, change.after]
        for change in watched.changes
        if "." in change.name
    ]
    return _table(("sim_time_s", "name", "from", "to"), rows, _SHOWN_CHANGES)


def _event_row(event: Event) -> list[Any] | None:
    if event.kind not in _CHANGE_KINDS:
        return None
    at, details = round(event.sim_time_s, 3), event.details()
    if event.kind == "change" and isinstance(details, dict):
        change = cast("dict[str, Any]", details)
        before, after = (shorten(change.get(end), DETAIL_BUDGET).value for end in ("from", "to"))
        return [at, (event.name or "")[:_LONGEST_NAME], before, after]
    return [at, event.kind, None, shorten(details, DETAIL_BUDGET).value]


def _signals(watched: Watched) -> Table | None:
    rows = [
        [name[:_LONGEST_NAME], *map(round_number, (n.first, n.last, n.min, n.max)), n.missing]
        for name, n in watched.changed_most()[:_SHOWN_SIGNALS]
    ]
    columns = ["signal", "first", "last", "min", "max", "missing"]
    return Table(columns=columns, rows=rows) if rows else None


def _other_events(events: list[Event]) -> dict[str, int] | None:
    kinds = Counter(event.kind for event in events if event.kind not in _CHANGE_KINDS)
    return dict(kinds) or None


def _logs(view: View, mark: Mark, runs: list[Run]) -> Table | None:
    lines = [
        line
        for run in runs
        for line in lines_after(view.connection, run.id, mark.log_id, _MOST_EVENTS)
        if line.level in ("warning", "error")
    ]
    return _table(LOG_COLUMNS, [log_row(line) for line in lines], _SHOWN_LOGS)


def _commands(view: View, mark: Mark) -> Table | None:
    commands = commands_since(view.connection, view.robot.id, mark.wall_time_s)
    rows = [command_row(command, view.now_s) for command in commands]
    return _table(COMMAND_COLUMNS, rows, _SHOWN_COMMANDS)


def _table(columns: tuple[str, ...], rows: list[list[Any]], most: int) -> Table | None:
    """The newest rows; how many older ones were left out stands in the table itself."""
    if not rows:
        return None
    left_out = len(rows) - most
    shown = list(_with_note(rows[-most:], left_out)) if left_out > 0 else rows
    return Table(columns=list(columns), rows=shown)


def _with_note(rows: list[list[Any]], left_out: int) -> Iterator[list[Any]]:
    yield [None, cut_text(f"… {left_out} earlier left out", _LONGEST_NAME)]
    yield from rows


def _why_nothing(view: View) -> str:
    if view.status.is_moving:
        return (
            "time moves but no state was recorded: is bridge.publish() called in the loop? Every "
            "5th call is recorded (throttle_interval)"
        )
    if view.status.why is None:
        return "nothing was recorded because the simulation is paused: resume it and watch again"
    return f"nothing was recorded: {view.status.why}"
