"""Every command: its group in the help, and the question or the function that it calls.

Only the command that is called is imported, so that it answers at once.
"""

from __future__ import annotations

import importlib
from typing import Any, Final, NamedTuple

from webots_mcp.extras.plugin_registry import plugin_commands

START, NOW, PAST, STEER, RUNS, DATA, SERVER = (
    "Start", "Watch", "Ask", "Steer", "Experiments", "Recordings", "Server and set-up",
)  # fmt: skip
GROUPS: Final = (START, NOW, PAST, STEER, RUNS, DATA, SERVER)
_Q: Final = "webots_mcp.questions"
_CLI: Final = "webots_mcp.cli"
# The commands of everyday use, in their order; `--help --all` shows the rest.
EVERYDAY: Final = (
    "demo", "init", "launch", "doctor", "status", "view", "logs", "check", "events", "plot",
    "compare", "report",
)  # fmt: skip
FORMER_NAMES: Final = {
    "requests": "audit", "keep": "capture", "label": "annotate", "retain": "retention",
    "diff": "first-difference", "repeat": "repeatability",
}  # fmt: skip


class CommandEntry(NamedTuple):
    """Where a command is found: a question, or a function whose parameters are its options."""

    group: str
    module: str
    name: str

    def declared(self) -> Any:
        """Return what the module has under its name: a `Question`, or a function."""
        return getattr(importlib.import_module(self.module), self.name)


_OF_THE_CORE: Final = {
    "init": CommandEntry(START, f"{_CLI}.setting_up", "init"),
    "launch": CommandEntry(START, f"{_CLI}.serving", "launch"),
    "doctor": CommandEntry(START, f"{_CLI}.setting_up", "doctor"),
    "help": CommandEntry(START, f"{_CLI}.help_pages", "help_"),
    "status": CommandEntry(NOW, f"{_CLI}.status", "status"),
    "tail": CommandEntry(NOW, f"{_CLI}.data", "tail"),
    "logs": CommandEntry(NOW, f"{_Q}.get_logs", "webots_get_logs"),
    "camera": CommandEntry(NOW, f"{_CLI}.pictures", "camera"),
    "screenshot": CommandEntry(NOW, f"{_CLI}.pictures", "screenshot"),
    "scene": CommandEntry(NOW, f"{_Q}.edit_scene", "webots_get_scene"),
    "inspect": CommandEntry(NOW, f"{_Q}.inspect_controller", "webots_inspect_controller"),
    "commands": CommandEntry(NOW, f"{_Q}.send_command", "webots_list_commands"),
    "profile": CommandEntry(NOW, f"{_CLI}.judging", "profile"),
    "check": CommandEntry(PAST, f"{_CLI}.judging", "check"),
    "events": CommandEntry(PAST, f"{_Q}.find_events", "webots_find_events"),
    "runs": CommandEntry(PAST, f"{_Q}.compare_runs", "webots_list_runs"),
    "compare": CommandEntry(PAST, f"{_Q}.compare_runs", "webots_compare_runs"),
    "plot": CommandEntry(PAST, f"{_CLI}.data", "plot"),
    "history": CommandEntry(PAST, f"{_Q}.history", "webots_query_history"),
    "trends": CommandEntry(PAST, f"{_Q}.history", "webots_get_trends"),
    "signals": CommandEntry(PAST, f"{_CLI}.steering", "signals"),
    "sql": CommandEntry(PAST, f"{_Q}.query_sql", "webots_query_sql"),
    "pause": CommandEntry(STEER, f"{_CLI}.steering", "pause"),
    "resume": CommandEntry(STEER, f"{_CLI}.steering", "resume"),
    "fast": CommandEntry(STEER, f"{_CLI}.steering", "fast"),
    "step": CommandEntry(STEER, f"{_CLI}.steering", "step"),
    "reset": CommandEntry(STEER, f"{_CLI}.steering", "reset"),
    "reload": CommandEntry(STEER, f"{_CLI}.steering", "reload"),
    "run": CommandEntry(STEER, f"{_Q}.control_simulation", "webots_run"),
    "breakpoint": CommandEntry(STEER, f"{_CLI}.steering", "breakpoint_"),
    "parameters": CommandEntry(STEER, f"{_CLI}.steering", "parameters"),
    "watch": CommandEntry(STEER, f"{_Q}.inspect_controller", "webots_watch"),
    "field": CommandEntry(STEER, f"{_CLI}.steering", "field"),
    "send": CommandEntry(STEER, f"{_Q}.send_command", "webots_send_command"),
    "wait": CommandEntry(STEER, f"{_Q}.send_command", "webots_wait_for_command"),
    "capture": CommandEntry(STEER, f"{_CLI}.steering", "capture"),
    "trials": CommandEntry(RUNS, f"{_CLI}.steering", "trials"),
    "repeatability": CommandEntry(RUNS, f"{_CLI}.judging", "repeatability"),
    "rerun": CommandEntry(RUNS, f"{_CLI}.rerunning", "rerun"),
    "first-difference": CommandEntry(RUNS, f"{_CLI}.judging", "first_difference"),
    "export": CommandEntry(DATA, f"{_CLI}.data", "export"),
    "import": CommandEntry(DATA, f"{_CLI}.data", "import_"),
    "annotate": CommandEntry(DATA, f"{_Q}.compare_runs", "webots_annotate_run"),
    "retention": CommandEntry(DATA, f"{_CLI}.data", "retention"),
    "prune": CommandEntry(DATA, f"{_CLI}.data", "prune"),
    "serve": CommandEntry(SERVER, f"{_CLI}.serving", "serve"),
    "token": CommandEntry(SERVER, f"{_CLI}.serving", "token"),
    "observe": CommandEntry(SERVER, f"{_CLI}.serving", "observe"),
    "header": CommandEntry(SERVER, f"{_CLI}.setting_up", "header"),
    "audit": CommandEntry(SERVER, f"{_CLI}.steering", "audit"),
    "completion": CommandEntry(SERVER, f"{_CLI}.setting_up", "completion"),
}
COMMANDS: Final[dict[str, CommandEntry]] = _OF_THE_CORE | {
    each.name: CommandEntry(each.group, *each.function.split(":")) for each in plugin_commands()
}
