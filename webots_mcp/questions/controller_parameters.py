"""Parameters that a controller declares: shown, and set while it runs.

All parameters of a call are set between two rounds of its loop, or none.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Annotated, Any, Final, Literal

from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.answer_models import (
    CommandAnswer,
    ParametersAnswer,
)
from webots_mcp.answers.budget import (
    DETAIL_BUDGET_TOKENS,
    fitting,
    seconds,
    without_empty,
)
from webots_mcp.answers.shortening import WHOLE, shorten
from webots_mcp.questions.arguments import RobotName, RunId, TimeoutS, Value
from webots_mcp.questions.declaration import READS, SETS, Caller, question
from webots_mcp.questions.send_command import (
    NO_BRIDGE,
)
from webots_mcp.signals.parameter import MOST_PARAMETERS, require_known
from webots_mcp.steering.dispatch import Dispatcher, ProgressReport
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.run_parameters import COLUMNS, Declared, declared_by, described

SET_WAIT_S: Final = 10.0
_ACTION: Final = "set_parameters"
When = Literal["now", "reset"]


async def set_parameters(
    recording: RecordingAccess,
    report: ProgressReport,
    values: Mapping[str, Value],
    *,
    when: When = "now",
    robot: str | None = None,
    timeout_s: float = SET_WAIT_S,
) -> CommandAnswer:
    """Set parameters, all or none, and wait for the outcome.

    Raises:
        InvalidInputError: A name is unknown, or a value is out of bounds or of another type.
        CommandRefusedError: No live controller could set them.
        NothingRecordedError: There is no robot.
    """
    declared = await to_thread.run_sync(settable, recording, robot)
    require_known(list(values), list(declared))
    for name, value in values.items():
        declared[name].declaration.checked(value)
    params = {"values": dict(values), "when": when}
    return await Dispatcher(recording, report).ask(robot, _ACTION, timeout_s, params)


def settable(recording: RecordingAccess, robot: str | None) -> dict[str, Declared]:
    """Return the parameters that a live controller declares.

    Raises:
        InvalidInputError, CommandRefusedError, NothingRecordedError: As `set_parameters`.
    """
    with recording.reader() as connection:
        session = find_target(connection, robot, _ACTION).session
        return declared_by(connection, session.id) if session else {}


def _none(view: RobotView) -> str:
    if view.session is not None and not view.session.has_bridge:
        return NO_BRIDGE
    return (
        'this run has none: declare one in the controller with kp = bridge.parameter("kp", 2.0, '
        "low=0.0, high=10.0) and read kp.value in its loop"
    )


@question("Get the parameters", READS, quotes=True)
def webots_get_parameters(
    recording: RecordingAccess,
    names: Annotated[
        list[str] | None,
        Field(max_length=50, description="Only these parameters; '*' means any text."),
    ] = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> ParametersAnswer:
    """List what can be tuned while the controller runs: each parameter with value and bounds.

    `since_s` is the simulated time since which it has its value; `next` is the value from the
    next reset on. To change parameters use webots_set_parameters.
    """
    with recording.view(robot, run_id) as view:
        rows = _shown_rows(view, names)
        shown = fitting(rows)
        hints = [f"{len(shown)} of {len(rows)}: names shows others"] * (len(shown) < len(rows))
        return ParametersAnswer(
            **view.header(),
            parameters=without_empty(COLUMNS, shown),
            total=len(rows),
            hint="; ".join(hints) or (None if rows else _none(view)),
        )


@question("Set parameters", SETS, of_controller="values", tier="core")
async def webots_set_parameters(
    recording: RecordingAccess,
    values: Annotated[
        dict[str, Value],
        Field(
            min_length=1,
            max_length=MOST_PARAMETERS,
            description='Parameters with new values: {"kp": 3.0, "gait": "trot"}.',
        ),
    ],
    caller: Caller,
    when: Annotated[When, Field(description="Apply at once, or from the next reset on.")] = "now",
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = SET_WAIT_S,
) -> CommandAnswer:
    """Set parameters of the running controller, all or none, between two steps of its loop.

    Answers with old and new values. A reset keeps them; a reload starts with the values in the
    code. To find the best values use webots_run_trials.
    """
    return await set_parameters(
        recording, caller.report, values, when=when, robot=robot, timeout_s=timeout_wall_s
    )


def _shown_rows(view: RobotView, names: list[str] | None) -> list[list[Any]]:
    found = described(view.connection, view.run) if view.run else []
    meant = _meant(names, [each["name"] for each in found])
    return [
        [_shown(column, each[column]) for column in COLUMNS]
        for each in found
        if each["name"] in meant
    ]


def _shown(column: str, value: Any) -> Any:
    """Times as everywhere; values and bounds as they are, for they may be sent back."""
    if column == "since_s":
        return seconds(value)
    return shorten(value, DETAIL_BUDGET_TOKENS, WHOLE).value


def _meant(patterns: list[str] | None, known: list[str]) -> set[str]:
    """Return the known names that match.

    Raises:
        InvalidInputError: A pattern matches none.
    """
    meant = set(known) if patterns is None else set[str]()
    for pattern in patterns or ():
        found = {name for name in known if fnmatchcase(name, pattern)}
        if not found:
            require_known([pattern], known)
        meant |= found
    return meant
