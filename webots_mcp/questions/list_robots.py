"""Questions about the robots and their world: which there are, and whether they are live.

What an observer sees of the world is part of the answer.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.answers.answer_models import (
    AnswerTable,
    RobotsAnswer,
    WorldAnswer,
)
from webots_mcp.answers.budget import (
    fitting,
    row_budget_tokens,
)
from webots_mcp.answers.shortening import (
    cut_for_a_model,
    cut_text,
    is_for_a_person,
    round_number,
    shorten,
)
from webots_mcp.contract import CUSTOM_DATA
from webots_mcp.database.session_cleanup import find_dead_sessions
from webots_mcp.errors import NothingRecordedError
from webots_mcp.questions.arguments import RobotName, RunId
from webots_mcp.questions.declaration import READS, question
from webots_mcp.questions.lint_world import lint_in_short
from webots_mcp.store.loop_evidence import rows_waiting
from webots_mcp.store.recording import (
    GETTING_STARTED,
    RecordingAccess,
    RobotView,
    name_of,
    storage,
    view_of,
)
from webots_mcp.store.retention_limits import described, unheeded
from webots_mcp.store.retention_plan import file_sizes
from webots_mcp.store.robots import (
    RobotRecord,
    WorldSeen,
    console_trouble,
    list_robots,
    nothing_recorded,
    world_seen,
)
from webots_mcp.store.run_rows import (
    RunRecord,
    count_runs,
    pace_of,
    real_time_factor,
)
from webots_mcp.store.sessions import SessionRecord, companions, fetch_session

BODY_COLUMNS: Final = ("key", "type", "def", "name", "controller", "on_robot")  # as they differ
PLACE_COLUMNS: Final = ("x_m", "y_m", "z_m", "heading_rad", "speed_mps")
RECORDER_COLUMNS: Final = (
    "row_count", "why", "pace", "rows_waiting", "waiting_in", "rows_dropped", "last_error",
)  # fmt: skip
BY_OBSERVER: Final = "the observer, from customData: it has no bridge and takes no commands"
ROBOT_COLUMNS: Final = (
    "robot", "kind", "live", "status", "run_id", "sim_time_s", "age_s", "run_count",
    "action_count",
)  # fmt: skip


@dataclass(frozen=True)
class RobotListSizes:
    """How much of robots and world an answer shows.

    Attributes:
        robots: Robots.
        bodies: Bodies in the world.
        devices_tokens: Budget of the devices.
        others_tokens: Budget of the other robots.
        name_characters: Characters of a name.
        error_characters: Characters of the last error.
    """

    robots: int = 50
    bodies: int = 40
    devices_tokens: int = 300
    others_tokens: int = 200
    name_characters: int = 100
    error_characters: int = 300


_SIZES: Final = RobotListSizes()


@question("List the robots", READS, command="status", tier="core")
def webots_list_robots(recording: RecordingAccess) -> RobotsAnswer:
    """List every robot recorded here: whether it is live, whether its time advances, its run.

    Start here to learn the robots' names. For the values of one robot use webots_get_robot_state;
    if a robot is missing or silent use webots_diagnose_setup.
    """
    in_full = is_for_a_person()
    with recording.reader() as connection:
        now_s = time.time()
        robots = list_robots(connection, now_s)
        none = f"{nothing_recorded(connection)}. {GETTING_STARTED}"
        if not robots and not in_full:
            raise NothingRecordedError(none)
        views = _fitting([view_of(connection, robot, now_s) for robot in _liveliest(robots)])
        live = [view for view in views if view.robot.live]
        return RobotsAnswer(
            **(live[0].header() if len(live) == 1 else storage(connection)),
            robots=_robots(views, in_full=in_full) if views else None,
            database=name_of(recording.database) if in_full else None,
            retention=_retention(recording, connection) if in_full else None,
            hint=_hint_of_robots(connection, robots, len(views)) if robots else none,
        )


def _hint_of_robots(
    connection: sqlite3.Connection, robots: Sequence[RobotRecord], shown: int
) -> str | None:
    if len(robots) > shown:
        return f"{len(robots)} robots in all, the latest {shown} are shown"
    is_any_live = any(robot.live for robot in robots)
    return None if is_any_live else console_trouble(connection)


@question("Get world information", READS)
def webots_get_world_info(
    recording: RecordingAccess, robot: RobotName = None, run_id: RunId = None
) -> WorldAnswer:
    """Show which world is simulated: its file, time step, speed, controller file and robots.

    With an observer in the world (webots-mcp init --observer) it also gives where all robots are.
    For the objects in the world use webots_get_scene.
    """
    with recording.view(robot, run_id) as view:
        run = view.require_run()
        session = fetch_session(view.connection, run.session_id)
        others = _companions(view)
        shown = others if is_for_a_person() else fitting(others, _SIZES.others_tokens)
        more = f"{len(others) - len(shown)} more robots beside it: webots_list_robots"
        answer = WorldAnswer(
            **view.header(),
            world=run.world,
            basic_time_step_ms=run.basic_time_step_ms,
            real_time_factor=_pace(view, run),
            supervisor=session.supervisor if session else None,
            run=_run(view, run),
            run_count=count_runs(view.connection, view.robot.id),
            controller=_controller(view, session),
            devices=_devices(view.robot.devices),
            other_robots=AnswerTable(columns=["robot", "kind", "pause_state"], rows=shown)
            if shown
            else None,
            database=name_of(recording.database),
            retention=_retention(recording, view.connection),
            data_dir=str(recording.data_dir),
            lint=lint_in_short(run.world),
        )
        space_tokens = row_budget_tokens(others=answer.model_dump(exclude_none=True))
        seen = _seen(world_seen(view.connection, run), space_tokens)
        hints = [seen.pop("hint", None), more if len(shown) < len(others) else None]
        return answer.model_copy(update=seen | {"hint": "; ".join(filter(None, hints)) or None})


def _robots(views: list[RobotView], *, in_full: bool) -> AnswerTable:
    """Return a row for each robot; counts of losses only if there are any, or for a person."""
    columns, rows = [*ROBOT_COLUMNS], [_row(view) for view in views]
    recorders = [_recorder(view) for view in views]
    for name in RECORDER_COLUMNS:
        values = [recorder[name] for recorder in recorders]
        if any(values) and (in_full or name not in ("row_count", "why")):
            columns.append(name)
            for row, value in zip(rows, values, strict=True):
                row.append(value)
    return AnswerTable(columns=columns, rows=rows)


def _recorder(view: RobotView) -> dict[str, Any]:
    """Return what a robot's session has recorded of its run, and what it could not."""
    session = view.session
    error = session.last_error if session else None
    return {
        "row_count": view.run.row_count if view.run else 0,
        "why": view.header().get("why"),
        "pace": view.run and pace_of(view.connection, view.robot.name, view.run.id),
        "waiting_in": None,
        **rows_waiting(view.connection, session),
        "rows_dropped": session.rows_dropped if session else 0,
        "last_error": error and cut_for_a_model(error, _SIZES.error_characters),
    }


def _seen(world: WorldSeen | None, budget_tokens: int) -> dict[str, Any]:
    """Return what an observer has seen of the world, robots first."""
    if world is None:
        return {}
    bodies = [*world.content.get("robots", ()), *world.content.get("solids", ())]
    shown = [body | world.places.get(body["key"], {}) for body in bodies[: _SIZES.bodies]]
    used = [
        column
        for column in (*BODY_COLUMNS, *PLACE_COLUMNS)
        if any(body.get(column) is not None for body in shown)
    ]
    rows = fitting([_in_world(body, used) for body in shown], budget_tokens)
    more = f"the first {len(rows)} of {len(bodies)} bodies are shown"
    return {
        "title": world.content.get("title"),
        "observer": world.observer,
        "in_world": AnswerTable(columns=used, rows=rows),
        "hint": more if len(rows) < len(bodies) or world.content.get("more") else None,
    }


def _in_world(body: dict[str, Any], columns: list[str]) -> list[Any]:
    values = [body.get(column) for column in columns]
    return [
        round_number(value)
        if isinstance(value, float)
        else cut_text(value, _SIZES.name_characters)
        if isinstance(value, str)
        else value
        for value in values
    ]


def _retention(recording: RecordingAccess, connection: sqlite3.Connection) -> dict[str, Any]:
    """Return the limits of the recording, its size, and which of our limits do not apply."""
    notes = unheeded(connection, recording.limits)
    return {
        "kept": _limits(described(connection)),
        **file_sizes(connection),
        **({"not_in_force": notes} if notes else {}),
    }


def _limits(limits: dict[str, str]) -> dict[str, str]:
    """Return the limits that somebody set, and all defaults as one text."""
    ends = " (default)"
    kept = {kind: text for kind, text in limits.items() if not text.endswith(ends)}
    defaults = [f"{kind} {t.removesuffix(ends)}" for kind, t in limits.items() if kind not in kept]
    return {**kept, **({"defaults": ", ".join(defaults)} if defaults else {})}


def _liveliest(robots: list[Any]) -> list[Any]:
    """Return those seen last, where there are too many to show; the latest first."""
    latest = sorted(robots, key=lambda robot: (robot.live, robot.last_seen_wall_time_s))
    return latest[::-1][: _SIZES.robots]


def _fitting(views: list[RobotView]) -> list[RobotView]:
    """Return the first that fit, in the order of their first appearance."""
    fitting_rows = fitting([[*_row(view), *_recorder(view).values()] for view in views])
    return sorted(views[: len(fitting_rows)], key=lambda view: view.robot.id)


def _row(view: RobotView) -> list[Any]:
    header, session = view.header(), view.session
    runs = count_runs(view.connection, view.robot.id)
    newest = [header[name] for name in ("status", "run_id", "sim_time_s", "age_s")]
    actions = len(session.actions) if session else 0
    name = cut_text(view.robot.name, _SIZES.name_characters)
    return [name, view.robot.kind, view.robot.live, *newest, runs, actions]


def _pace(view: RobotView, run: RunRecord) -> float | None:
    factor = real_time_factor(view.connection, run.id)
    return None if factor is None else round_number(factor)


def _run(view: RobotView, run: RunRecord) -> dict[str, Any]:
    """Return what the run is; `rows` is as of its last heartbeat."""
    end_reason = run.end_reason or dict(find_dead_sessions(view.connection)).get(run.session_id)
    ended = {"ended_by": end_reason} if end_reason is not None else {}
    return {
        "id": run.id,
        "began_by": run.start_reason,
        "began_ago_wall_s": view.age_s(run.started_wall_time_s),
        "sim_duration_s": round(run.last_sim_time_s - run.started_sim_time_s, 3),
        "row_count": run.row_count,
        **ended,
    }


def _controller(view: RobotView, session: SessionRecord | None) -> dict[str, Any] | None:
    if session is None:
        return None
    if view.robot.kind == CUSTOM_DATA:  # its own process and code are not known
        return {"file": session.controller, "recorded_by": BY_OBSERVER}
    return {
        "file": session.controller,
        "sha256": session.controller_sha256,
        "git_commit": session.git_commit,
        "pid": session.pid,
        "host": session.host,
        **session.versions,
    }


def _devices(devices: dict[str, str]) -> dict[str, str] | None:
    return shorten(devices, _SIZES.devices_tokens).value or None


def _companions(view: RobotView) -> list[list[str]]:
    if view.session is None:
        return []
    others = companions(view.connection, view.session, view.now_s)
    robots = {robot.id: robot for robot in list_robots(view.connection, view.now_s)}
    return [
        [robots[other.robot_id].name, robots[other.robot_id].kind, other.pause_state or ""]
        for other in others
    ]
