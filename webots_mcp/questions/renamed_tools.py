"""Calls of tools as they were named before: they are answered by the tools of today.

Tools that an argument (`what`, `change`, `action`) made into several are several tools now. A rule
of a project's file that names a former tool also holds for those that it became.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple, cast

from webots_mcp.errors import InvalidInputError


class FormerTool(NamedTuple):
    """A tool that became several.

    Attributes:
        argument: The argument that chose among them.
        tools: The tools of today, by the values of that argument; the first was the default.
        must_choose: The argument had no default.
    """

    argument: str
    tools: Mapping[str, str]
    must_choose: bool = False


RENAMED: Final[Mapping[str, str]] = {"webots_diagnose": "webots_diagnose_setup"}
DIVIDED: Final[Mapping[str, FormerTool]] = {
    "webots_find_events": FormerTool(
        "what", {"events": "webots_find_events", "timeline": "webots_get_timeline"}
    ),
    "webots_get_trends": FormerTool(
        "what",
        {
            "trends": "webots_get_trends",
            "signals": "webots_list_signals",
            "meanings": "webots_list_meanings",
        },
    ),
    "webots_list_runs": FormerTool(
        "what", {"runs": "webots_list_runs", "trials": "webots_get_trials"}
    ),
    "webots_list_commands": FormerTool(
        "what",
        {
            "commands": "webots_list_commands",
            "outcome": "webots_wait_for_command",
            "parameters": "webots_get_parameters",
            "breakpoints": "webots_list_breakpoints",
        },
    ),
    "webots_breakpoint": FormerTool(
        "change", {"set": "webots_breakpoint", "remove": "webots_remove_breakpoint"}
    ),
    "webots_launch_world": FormerTool(
        "action",
        {"launch": "webots_launch_world", "load": "webots_load_world", "quit": "webots_quit"},
    ),
    "webots_get_scene": FormerTool(
        "what", {"nodes": "webots_get_scene", "field": "webots_get_field"}
    ),
    "webots_edit_scene": FormerTool(
        "action",
        {"set": "webots_set_field", "add": "webots_add_node", "remove": "webots_remove_node"},
        must_choose=True,
    ),
}


def current_call(name: str, arguments: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the tool of today that answers a call, and its arguments.

    Raises:
        InvalidInputError: The former tool needs the argument that chose, or has no such choice.
    """
    name = RENAMED.get(name, name)
    former = DIVIDED.get(name)
    if former is None:
        return name, arguments
    wrapped = arguments.get("params")
    if len(arguments) == 1 and isinstance(wrapped, dict):
        arguments = cast("dict[str, Any]", wrapped)  # as clients of the first server send them
    if former.argument not in arguments and not former.must_choose:
        return name, arguments
    choice = arguments.get(former.argument)
    if choice is None and not former.must_choose:
        choice = next(iter(former.tools))
    if not isinstance(choice, str) or choice not in former.tools:
        became = ", ".join(dict.fromkeys(former.tools.values()))
        raise InvalidInputError(
            f"Unknown {former.argument} {choice!r}. {name} is now several tools. Call one of "
            f"{became}."
        )
    rest = {key: value for key, value in arguments.items() if key != former.argument}
    return former.tools[choice], rest


def former_names(name: str) -> tuple[str, ...]:
    """Return the other names by which a tool was called before."""
    renamed = [former for former, today in RENAMED.items() if today == name]
    divided = [
        former for former, tool in DIVIDED.items() if former != name and name in tool.tools.values()
    ]
    return (*renamed, *divided)
