"""Commands that steer a simulation, where one asks several questions or a part of one.

What an assistant can ask for, a person can: each is answered as the MCP tool answers it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final

from webots_mcp.cli.recordings import Json, RunId, ToRobot, ToWebots, Waiting
from webots_mcp.cli.values import Count, Id, Parameter, whole_number
from webots_mcp.contract import BreakpointAction
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.questions.declaring import Question


_ROBOT: Final = ToRobot()
_WAITING: Final = Waiting()
_WEBOTS: Final = ToWebots()


def pause(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Pause the simulation; its controller goes on answering."""
    _control("pause", asked, as_json=json)


def resume(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Let a paused simulation go on, in real time."""
    _control("resume", asked, as_json=json)


def step(
    steps: Annotated[
        int, Parameter("N", converter=whole_number, help="Rounds of its loop (1).")
    ] = 1,
    /,
    *,
    asked: ToWebots = _WEBOTS,
    json: Json = False,
) -> None:
    """Let the controller's own loop come round N times, then pause."""
    _control("step", asked, as_json=json, steps=steps)


def _control(command: str, asked: ToWebots, *, as_json: bool, **given: Any) -> None:
    from webots_mcp.questions.control_simulation import webots_simulation_control

    _show(webots_simulation_control, asked, as_json=as_json, command=command, **given)


def keep(
    reason: Annotated[str, Parameter("REASON", help="Why, as it is shown with the stretch.")],
    /,
    *,
    asked: Waiting = _WAITING,
    json: Json = False,
) -> None:
    """Keep the last seconds of a running controller at full rate, and the two that follow.

    Each call of publish in them becomes a row, also those that the throttle drops.
    """
    from webots_mcp.questions.send_command import webots_send_command

    params = {"reason": reason}
    _show(webots_send_command, asked, as_json=json, action="keep", params=params)


def parameters(
    *settings: Annotated[str, Parameter("NAME=VALUE", help="Set these, all or none.")],
    asked: Waiting = _WAITING,
    run_id: RunId = None,
    from_reset: Annotated[
        bool, Parameter("--from-reset", help="Not now, but from the next reset on.")
    ] = False,
    json: Json = False,
) -> None:
    """Show the parameters that a controller declares, or set some while it runs.

    All are set between two rounds of its loop, or none. A reset keeps them; a reload begins with
    those in the code.

        webots-mcp parameters kp=3.5 gait=trot
    """
    from webots_mcp.questions.set_parameters import webots_get_parameters, webots_set_parameters

    if from_reset and not settings:
        raise InvalidInputError("--from-reset needs what is set then: NAME=VALUE")
    if not settings:
        return _show(webots_get_parameters, asked, as_json=json, run_id=run_id)
    if run_id is not None:
        raise InvalidInputError("--run shows an earlier run; parameters are set in the current one")
    when = "reset" if from_reset else "now"
    _show(webots_set_parameters, asked, as_json=json, values=settings, when=when)


def breakpoint_(
    condition: Annotated[
        str | None, Parameter("CONDITION", help="Such as 'front_m < 0.1 for 0.5'.")
    ] = None,
    /,
    *,
    action: Annotated[BreakpointAction, Parameter("--action", help="At a hit (pause).")] = "pause",
    after_hits: Annotated[
        Count, Parameter("--after-hits", metavar="N", help="Act from this hit of a run on (1).")
    ] = 1,
    breakpoint_id: Annotated[
        Id | None, Parameter("--remove", metavar="ID", help="Remove the one with this id.")
    ] = None,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Pause, or take note, when a condition begins to hold; without one, list the breakpoints.

        webots-mcp breakpoint 'front_m < 0.1' --action log

    It is asked of every published state, stored, and armed again after a reset or reload.
    """
    from webots_mcp.questions import set_breakpoint as questions

    if condition is not None and breakpoint_id is not None:
        raise InvalidInputError("give a condition to set, or --remove ID, not both")
    if breakpoint_id is not None:
        remove = questions.webots_remove_breakpoint
        return _show(remove, asked, as_json=json, breakpoint_id=breakpoint_id)
    if condition is None:
        return _show(questions.webots_list_breakpoints, asked, as_json=json)
    given = {"condition": condition, "action": action, "after_hits": after_hits}
    _show(questions.webots_breakpoint, asked, as_json=json, **given)


def field(
    path: Annotated[str, Parameter("PATH", help="Such as ROVER.translation or BALL.physics.mass.")],
    value: Annotated[
        str | None,
        Parameter(
            "VALUE",
            help="Set it: '[0, 1, 0.04]', 0.5, true, a text.",
            allow_leading_hyphen=True,
        ),
    ] = None,
    /,
    *,
    start: Annotated[
        int | None,
        Parameter(
            "--start",
            metavar="N",
            converter=whole_number,
            help="Show its entries from this one on.",
        ),
    ] = None,
    stop: Annotated[bool, Parameter("--stop", help="Take the speed of its node too.")] = False,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Show a field of the scene tree, or all fields of a node; or set one.

    What is set is recorded as an event; a reset puts it back.

        webots-mcp field ROVER.translation '[0, 1, 0.04]'
    """
    from webots_mcp.questions.edit_scene import webots_get_field, webots_set_field

    if stop and value is None:
        raise InvalidInputError("--stop goes with a VALUE that is set")
    if value is None:
        return _show(webots_get_field, asked, as_json=json, path=path, start=start)
    _show(webots_set_field, asked, as_json=json, path=path, value=value, stop=stop)


def _show(question: Question, asked: ToRobot, *, as_json: bool, **given: Any) -> None:
    """Ask a question, with those options that it has, and print the answer."""
    from webots_mcp.cli.asking import ask_and_show

    of_options = {name: value for name, value in vars(asked).items() if _has(question, name)}
    ask_and_show(question, of_options | given, asked, as_json=as_json)


def _has(question: Question, argument: str) -> bool:
    return any(each.name == argument for each in question.parameters)
