"""Reword texts for the command line, where `last_s=-3` is `--last -3`.

The questions name their arguments as the MCP tools do. While a command runs, the option of each of
its arguments is known. Hints that name a tool name the command with the same answer instead.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from contextvars import ContextVar
from typing import Final, NamedTuple

_UNQUOTED: Final = r"(?<![\w'\".-])"  # a quoted name is data of the user
_NOT_ON: Final = r"(?![\w'\"])"
_OTHERS: Final = {  # by tool, for tools whose command has another name or function
    "get_full_state": "tail", "get_robot_state": "tail", "monitor": "tail",
    "breakpoint": "breakpoint", "list_breakpoints": "breakpoint",
    "remove_breakpoint": "breakpoint --remove",
    "get_parameters": "parameters", "set_parameters": "parameters",
    "wait_for_command": "wait", "get_trials": "trials", "run_trials": "trials",
    "list_signals": "signals", "describe_signals": "signals --describe",
    "list_meanings": "signals --meanings", "get_field": "field", "diagnose_setup": "doctor",
    "plot": "plot", "report": "report", "get_clip": "clip",
    "simulation_control": "pause", "set_field": "field", "get_timeline": "events --one-by-one",
    "world_reset": "reset", "world_reload": "reload",
    "launch_world": "launch", "list_robots": "status", "get_world_info": "status --verbose",
    "get_camera": "camera", "take_screenshot": "screenshot", "check_run": "check",
}  # fmt: skip
_FOR_A_CLIENT: Final = {  # what only an MCP client can do, and what a person does instead
    "start the server with --data-dir or --database": "give --data-dir or --database",
    "the resource webots://schema": "'.schema' in the sqlite3 shell",
    "pause, step or reset use webots_simulation_control": "pause, step or reset use the commands "
    "of these names",
    "For all fields of one node use webots_get_field; to change one use webots_set_field": "To "
    "show or change the fields of one node use webots_get_field",
    "what no other tool answers": "what no other command answers",
}
_CONTROL: Final = re.compile(  # the tool whose argument is the name of a command
    r"webots_simulation_control\((?:command=)?['\"](\w+)['\"](?:, robot=['\"]([\w .-]+)['\"])?\)"
)
_running: ContextVar[tuple[Typed, ...]] = ContextVar("running", default=())


def speak_of(arguments: Iterable[Typed]) -> None:
    """Let `as_typed` use these arguments: those of the command that runs."""
    _running.set(tuple(arguments))


def running() -> tuple[Typed, ...]:
    """Return the arguments of the command that runs."""
    return _running.get()


class Typed(NamedTuple):
    """An argument as a person types it.

    Attributes:
        turned_off: The option that turns a flag off; empty if there is none.
    """

    name: str
    typed: str
    value_name: str
    turned_off: str = ""


def value_name(option: str) -> str:
    """Return the word for an option's value, as help shows it."""
    return option.lstrip("-").replace("-", "_").upper()


def as_typed(text: str) -> str:
    """Return the text with a person's options instead of the names of arguments.

    A name that is a common word (`since`) is replaced only before a value, or next to another name
    ("since and until").
    """
    # Calls in a controller do not change.
    parts = re.split(r"(\b(?:bridge\.\w+|MCPBridge)\([^()]*\))", text)
    parts[::2] = map(_text_as_typed, parts[::2])
    return "".join(parts)


def _text_as_typed(text: str) -> str:
    for of_a_client, of_a_person in _FOR_A_CLIENT.items():
        words = r"\s+".join(map(re.escape, of_a_client.split()))
        text = re.sub(words, lambda _, said=of_a_person: said, text)
    text = _CONTROL.sub(_control_as_typed, text)
    text = re.sub(r"webots_(?P<tool>\w+)(?:\(\w+=(?P<id>\d+)\))?", _command_for, text)
    typed = {each.name: each.typed for each in _running.get()}
    for each in _running.get():
        shown = f"{each.typed} {each.value_name}" if each.typed.startswith("-") else each.typed
        text = re.sub(rf"{_UNQUOTED}{each.name}=(\[['.]+\]|\.\.\.)", shown, text)
        text = re.sub(
            rf"{_UNQUOTED}{each.name}=\[('?[\w.*]+'?)(?:, ('?[\w.*]+'?))?\]",
            lambda found, typed=each.typed: " ".join(filter(None, (typed, found[1], found[2]))),
            text,
        )
        text = re.sub(rf"{_UNQUOTED}{each.name}=true\b", each.typed, text)
        text = re.sub(rf"{_UNQUOTED}{each.name}=false\b", each.turned_off or each.typed, text)
        text = re.sub(rf"{_UNQUOTED}{each.name}=", f"{each.typed} ", text)
        if "_" in each.name:
            text = re.sub(rf"{_UNQUOTED}{each.name}{_NOT_ON}", each.typed, text)
    words = "|".join(name for name in typed if "_" not in name)
    if not words:
        return text
    for form in (
        rf"(?<=\b[Ww]ith )(?:this )?({words}){_NOT_ON}",
        rf"(?<=\bsee )({words}){_NOT_ON}",
        rf"{_UNQUOTED}({words})(?= for more)",
    ):
        text = re.sub(form, lambda found: typed[found[1]], text)
    joined = rf"{_UNQUOTED}({words}) (and|or) ({words}){_NOT_ON}"
    return re.sub(joined, lambda found: f"{typed[found[1]]} {found[2]} {typed[found[3]]}", text)


def commands_by_tool() -> dict[str, str]:
    """Return the command that corresponds to a tool, by the tool's name without `webots_`."""
    from webots_mcp.cli.commands import COMMANDS

    return {each.name.removeprefix("webots_"): name for name, each in COMMANDS.items()} | _OTHERS


def _control_as_typed(found: re.Match[str]) -> str:
    """Return the command that gives the same order to the same robot."""
    robot = f" --robot {shlex.quote(found[2])}" if found[2] else ""
    return f"'webots-mcp {found[1]}{robot}'"


def _command_for(found: re.Match[str]) -> str:
    """Return the command that corresponds to a tool, or the tool itself."""
    tool, number = found["tool"], found["id"]
    command = commands_by_tool().get(tool)
    whole = f"{command} {number}" if number else command
    return f"'webots-mcp {whole}'" if command else found[0]
