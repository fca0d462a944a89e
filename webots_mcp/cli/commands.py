"""Every command: its group in the help, and the question or the function that it calls.

Only the command that is called is imported, so that it answers at once.
"""

from __future__ import annotations

import importlib
from typing import Any, Final, NamedTuple

from webots_mcp.extras.plugins import plugin_commands

_STEERING: Final = "webots_mcp.cli.steering"


class Command(NamedTuple):
    """Where a command is found: a question, or a function whose parameters are its options."""

    group: str
    module: str
    name: str

    def declared(self) -> Any:
        """What the module has under its name: a `Question`, or a function."""
        return getattr(importlib.import_module(self.module), self.name)


NOW, PAST, STEER, DATA, SETUP = (
    "What is recorded now", "The past", "Steering", "Recordings", "Setting up and running",
)  # fmt: skip
GROUPS: Final = (SETUP, NOW, PAST, STEER, DATA)
_Q: Final = "webots_mcp.questions"
_OF_THE_CORE: Final = {
    "events": Command(PAST, f"{_Q}.events", "webots_find_events"),
    "check": Command(PAST, "webots_mcp.cli.judging", "check"),
    "compare": Command(PAST, f"{_Q}.compare_runs", "webots_compare_runs"),
    "diff": Command(PAST, "webots_mcp.cli.judging", "diff"),
    "logs": Command(PAST, f"{_Q}.get_logs", "webots_get_logs"),
    "history": Command(PAST, f"{_Q}.history", "webots_query_history"),
    "label": Command(DATA, f"{_Q}.compare_runs", "webots_annotate_run"),
    "runs": Command(PAST, f"{_Q}.compare_runs", "webots_list_runs"),
    "signals": Command(PAST, f"{_Q}.history", "webots_list_signals"),
    "sql": Command(PAST, f"{_Q}.query_sql", "webots_query_sql"),
    "status": Command(NOW, f"{_Q}.robot_state", "webots_list_robots"),
    "trends": Command(PAST, f"{_Q}.history", "webots_get_trends"),
    "export": Command(DATA, "webots_mcp.cli.data", "export"),
    "import": Command(DATA, "webots_mcp.cli.data", "import_"),
    "prune": Command(DATA, "webots_mcp.cli.data", "prune"),
    "retain": Command(DATA, "webots_mcp.cli.data", "retain"),
    "completion": Command(SETUP, "webots_mcp.cli.setting_up", "completion"),
    "doctor": Command(SETUP, "webots_mcp.cli.setting_up", "doctor"),
    "header": Command(SETUP, "webots_mcp.cli.setting_up", "header"),
    "init": Command(SETUP, "webots_mcp.cli.setting_up", "init"),
    "observe": Command(SETUP, "webots_mcp.cli.serving", "observe"),
    "serve": Command(SETUP, "webots_mcp.cli.serving", "serve"),
    "token": Command(SETUP, "webots_mcp.cli.serving", "token"),
    "run": Command(STEER, f"{_Q}.control_simulation", "webots_run"),
    "send": Command(STEER, f"{_Q}.send_command", "webots_send_command"),
    "wait": Command(STEER, f"{_Q}.send_command", "webots_wait_for_command"),
    "scene": Command(NOW, f"{_Q}.edit_scene", "webots_get_scene"),
    "commands": Command(NOW, f"{_Q}.send_command", "webots_list_commands"),
    "field": Command(NOW, _STEERING, "field"),
    "parameters": Command(NOW, _STEERING, "parameters"),
    "pause": Command(STEER, _STEERING, "pause"),
    "resume": Command(STEER, _STEERING, "resume"),
    "step": Command(STEER, _STEERING, "step"),
    "keep": Command(STEER, _STEERING, "keep"),
    "breakpoint": Command(STEER, _STEERING, "breakpoint_"),
    "requests": Command(STEER, _STEERING, "requests"),
    "trials": Command(STEER, "webots_mcp.cli.steering", "trials"),
    "repeat": Command(STEER, "webots_mcp.cli.judging", "repeat"),
    "launch": Command(SETUP, "webots_mcp.cli.serving", "launch"),
    "profile": Command(NOW, "webots_mcp.cli.judging", "profile"),
    "plot": Command(PAST, "webots_mcp.cli.data", "plot"),
    "tail": Command(NOW, "webots_mcp.cli.data", "tail"),
}
COMMANDS: Final[dict[str, Command]] = _OF_THE_CORE | {
    each.name: Command(each.group, *each.function.split(":")) for each in plugin_commands()
}
