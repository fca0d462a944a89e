"""Setting the parameters of a controller: refused before anything is sent, or sent and awaited."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from anyio import to_thread

from webots_mcp.parameter import Value, require_known
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.steering.dispatch import Dispatcher, Report
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.parameters import Declared, declared_by
from webots_mcp.store.recording import Recording

When = Literal["now", "reset"]

SET_WAIT_S: Final = 10.0
_ACTION: Final = "set_parameters"


async def set_parameters(
    recording: Recording,
    report: Report,
    values: Mapping[str, Value],
    *,
    when: When = "now",
    robot: str | None = None,
    timeout_s: float = SET_WAIT_S,
) -> CommandAnswer:
    """Set parameters, all or none, and wait for the outcome.

    Args:
        recording: Where the robot records.
        report: Called with the time that it has waited.
        values: The values by name.
        when: Now, or from the next reset of the world on.
        robot: The robot's name; None for the only live robot.
        timeout_s: How long to wait, in wall seconds.

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


def settable(recording: Recording, robot: str | None) -> dict[str, Declared]:
    """The parameters that a live controller declares.

    Raises:
        InvalidInputError, CommandRefusedError, NothingRecordedError: As `set_parameters`.
    """
    with recording.reader() as connection:
        session = find_target(connection, robot, _ACTION).session
        return declared_by(connection, session.id) if session else {}
