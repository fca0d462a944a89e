"""Tools for the parameters that a controller declares: what they are, and setting them."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import nearest_first
from webots_mcp.parameter import MOST_PARAMETERS
from webots_mcp.questions.answers import CommandAnswer, ParametersAnswer
from webots_mcp.questions.argument_types import RobotName, RunId, TimeoutS, Value
from webots_mcp.questions.budget import fitting, seconds, without_empty
from webots_mcp.questions.declaring import READS, SETS, Caller, question
from webots_mcp.questions.shortening import DETAIL_BUDGET_TOKENS, WHOLE, shorten
from webots_mcp.steering.tuning import SET_WAIT_S, When, set_parameters
from webots_mcp.store.parameters import COLUMNS, described
from webots_mcp.store.recording import Recording, View

_MOST_NEAR: Final = 5
_NONE: Final = (
    'this run has none: declare one in the controller with kp = bridge.parameter("kp", 2.0, '
    "low=0.0, high=10.0) and read kp.value in its loop"
)

Values = Annotated[
    dict[str, Value],
    Field(min_length=1, max_length=MOST_PARAMETERS, description='{"kp": 3.0, "gait": "trot"}'),
]


@question("Get the parameters", READS)
def webots_get_parameters(
    recording: Recording,
    names: Annotated[
        list[str] | None,
        Field(max_length=50, description="Of parameters; '*' is any text."),
    ] = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> ParametersAnswer:
    """What can be tuned while the controller runs: each parameter with value, bounds and setter.

    `since_s` is the simulation time from which on it has the value, `next` what it will have from
    the next reset on. Of an earlier run: its last values.
    """
    with recording.view(robot, run_id) as view:
        rows = _shown_rows(view, names)
        told = fitting(rows)
        hints = [f"{len(told)} of {len(rows)}: names shows others"] * (len(told) < len(rows))
        return ParametersAnswer(
            **view.header(),
            parameters=without_empty(COLUMNS, told),
            total=len(rows),
            hint="; ".join(hints) or (None if rows else _NONE),
        )


@question("Set parameters", SETS, core=True)
async def webots_set_parameters(
    recording: Recording,
    values: Values,
    caller: Caller,
    when: Annotated[When, Field(description="reset: from the next one on.")] = "now",
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = SET_WAIT_S,
) -> CommandAnswer:
    """Set parameters of a running controller, all or none, between two rounds of its loop.

    Answers with old and new values and from which simulation time on. A reset keeps them; a reload
    begins with those in the code.
    """
    return await set_parameters(
        recording, caller.report, values, when=when, robot=robot, timeout_s=timeout_wall_s
    )


def _shown_rows(view: View, names: list[str] | None) -> list[list[Any]]:
    found = described(view.connection, view.run) if view.run else []
    meant = _meant(names, [each["name"] for each in found])
    return [
        [_shown(column, each[column]) for column in COLUMNS]
        for each in found
        if each["name"] in meant
    ]


def _shown(column: str, value: Any) -> Any:
    """Times as everywhere; values and bounds as they are, for they may be sent back."""
    return (
        seconds(value) if column == "since_s" else shorten(value, DETAIL_BUDGET_TOKENS, WHOLE).value
    )


def _meant(patterns: list[str] | None, known: list[str]) -> set[str]:
    """The known names that match.

    Raises:
        InvalidInputError: A pattern matches none.
    """
    meant = set(known) if patterns is None else set[str]()
    for pattern in patterns or ():
        found = {name for name in known if fnmatchcase(name, pattern)}
        if not found:
            near = ", ".join(nearest_first(pattern, known)[:_MOST_NEAR]) or "none"
            raise InvalidInputError(f"no parameter {pattern!r:.80}; the nearest are: {near}")
        meant |= found
    return meant
