"""Every command: its group in the help, and the question or the function that it calls.

Only the command that is called is imported, so that it answers at once.
"""

from __future__ import annotations

import importlib
from typing import Any, Final, NamedTuple

from webots_mcp.extras.plugins import plugin_commands

_STEERING: Final = "webots_mcp.cli.steering"


class CommandEntry(NamedTuple):
    """Where a command is found: a question, or a function whose parameters are its options."""

    group: str
    module: str
    name: str

    def declared(self) -> Any:
        """Return what the module has under its name: a `Question`, or a function."""
        return getattr(importlib.import_module(self.module), self.name)


NOW, PAST, STEER, DATA, SETUP = (
    "What is recorded now", "The past", "Steering", "Recordings", "Setting up and running",
)  # fmt: skip
GROUPS: Final = (SETUP, NOW, PAST, STEER, DATA)
_Q: Final = "webots_mcp.questions"
_OF_THE_CORE: Final = {
    "events": CommandEntry(PAST, f"{_Q}.events", "webots_find_events"),
    "check": CommandEntry(PAST, "webots_mcp.cli.judging", "check"),
    "compare": CommandEntry(PAST, f"{_Q}.compare_runs", "webots_compare_runs"),
    "diff": CommandEntry(PAST, "webots_mcp.cli.judging", "diff"),
    "logs": CommandEntry(PAST, f"{_Q}.get_logs", "webots_get_logs"),
    "history": CommandEntry(PAST, f"{_Q}.history", "webots_query_history"),
    "label": CommandEntry(DATA, f"{_Q}.compare_runs", "webots_annotate_run"),
    "runs": CommandEntry(PAST, f"{_Q}.compare_runs", "webots_list_runs"),
    "signals": CommandEntry(PAST, _STEERING, "signals"),
    "sql": CommandEntry(PAST, f"{_Q}.query_sql", "webots_query_sql"),
    "status": CommandEntry(NOW, f"{_Q}.list_robots", "webots_list_robots"),
    "trends": CommandEntry(PAST, f"{_Q}.history", "webots_get_trends"),
    "export": CommandEntry(DATA, "webots_mcp.cli.data", "export"),
    "import": CommandEntry(DATA, "webots_mcp.cli.data", "import_"),
    "prune": CommandEntry(DATA, "webots_mcp.cli.data", "prune"),
    "retain": CommandEntry(DATA, "webots_mcp.cli.data", "retain"),
    "completion": CommandEntry(SETUP, "webots_mcp.cli.setting_up", "completion"),
    "doctor": CommandEntry(SETUP, "webots_mcp.cli.setting_up", "doctor"),
    "header": CommandEntry(SETUP, "webots_mcp.cli.setting_up", "header"),
    "help": CommandEntry(SETUP, "webots_mcp.cli.help_pages", "help_"),
    "init": CommandEntry(SETUP, "webots_mcp.cli.setting_up", "init"),
    "observe": CommandEntry(SETUP, "webots_mcp.cli.serving", "observe"),
    "serve": CommandEntry(SETUP, "webots_mcp.cli.serving", "serve"),
    "token": CommandEntry(SETUP, "webots_mcp.cli.serving", "token"),
    "run": CommandEntry(STEER, f"{_Q}.control_simulation", "webots_run"),
    "send": CommandEntry(STEER, f"{_Q}.send_command", "webots_send_command"),
    "wait": CommandEntry(STEER, f"{_Q}.send_command", "webots_wait_for_command"),
    "scene": CommandEntry(NOW, f"{_Q}.edit_scene", "webots_get_scene"),
    "commands": CommandEntry(NOW, f"{_Q}.send_command", "webots_list_commands"),
    "field": CommandEntry(NOW, _STEERING, "field"),
    "parameters": CommandEntry(NOW, _STEERING, "parameters"),
    "pause": CommandEntry(STEER, _STEERING, "pause"),
    "resume": CommandEntry(STEER, _STEERING, "resume"),
    "step": CommandEntry(STEER, _STEERING, "step"),
    "keep": CommandEntry(STEER, _STEERING, "keep"),
    "breakpoint": CommandEntry(STEER, _STEERING, "breakpoint_"),
    "requests": CommandEntry(STEER, _STEERING, "requests"),
    "trials": CommandEntry(STEER, "webots_mcp.cli.steering", "trials"),
    "repeat": CommandEntry(STEER, "webots_mcp.cli.judging", "repeat"),
    "launch": CommandEntry(SETUP, "webots_mcp.cli.serving", "launch"),
    "profile": CommandEntry(NOW, "webots_mcp.cli.judging", "profile"),
    "plot": CommandEntry(PAST, "webots_mcp.cli.data", "plot"),
    "tail": CommandEntry(NOW, "webots_mcp.cli.data", "tail"),
}
COMMANDS: Final[dict[str, CommandEntry]] = _OF_THE_CORE | {
    each.name: CommandEntry(each.group, *each.function.split(":")) for each in plugin_commands()
}
