"""List every command: its group in the help, and the question or the function that it calls.

Only the called command is imported, so that it answers at once.
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
# The commands of everyday use, in their order; `--help --all` shows the rest. Their sentences stand
# here too, so that `--help` need not import what carries them out.
EVERYDAY: Final = {
    "demo": "Drive a simulated robot and ask it questions, in under 30 s and without Webots.",
    "init": "Set up a Webots project: register the MCP server and list what each controller needs.",
    "launch": (
        "Start Webots on a world, record its console, and report the first controller that records."
    ),
    "doctor": "Check every step from controller to client, and show how to fix what is wrong.",
    "status": "Show what each robot is doing, since when, and any warnings.",
    "view": "Show a recording live in the browser: signals, the path, pictures and the log.",
    "logs": "Read what the controller printed and logged: the newest lines, oldest first.",
    "check": "Check a run: motion against commands, sensors, pace, log, end, lost rows and goal.",
    "events": (
        "Find what went wrong, since when and how often: stuck, falls, sensor faults and more."
    ),
    "plot": "Draw signals over time, the robot's path, or the scores of runs or trials.",
    "compare": "Find out whether an edit or a parameter helped; with --score, how a training went.",
    "report": "Write a report about a run, or a comparison of two runs, as one HTML file.",
}
FORMER_NAMES: Final = {
    "requests": "audit", "keep": "capture", "label": "annotate", "retain": "retention",
    "diff": "first-difference", "repeat": "repeatability", "page": "view",
}  # fmt: skip


class CommandEntry(NamedTuple):
    """The place of a command: a question, or a function whose parameters are its options."""

    group: str
    module: str
    name: str

    def declared(self) -> Any:
        """Return the object of that name in the module: a `Question` or a function."""
        return getattr(importlib.import_module(self.module), self.name)


_OF_THE_CORE: Final = {
    "init": CommandEntry(START, f"{_CLI}.setup_commands", "init"),
    "launch": CommandEntry(START, f"{_CLI}.server_commands", "launch"),
    "doctor": CommandEntry(START, f"{_CLI}.setup_commands", "doctor"),
    "lint": CommandEntry(START, f"{_CLI}.lint_command", "lint"),
    "help": CommandEntry(START, f"{_CLI}.help_pages", "help_"),
    "status": CommandEntry(NOW, f"{_CLI}.status_command", "status"),
    "tail": CommandEntry(NOW, f"{_CLI}.recording_commands", "tail"),
    "logs": CommandEntry(NOW, f"{_Q}.get_logs", "webots_get_logs"),
    "camera": CommandEntry(NOW, f"{_CLI}.picture_commands", "camera"),
    "screenshot": CommandEntry(NOW, f"{_CLI}.picture_commands", "screenshot"),
    "scene": CommandEntry(NOW, f"{_Q}.edit_scene", "webots_get_scene"),
    "inspect": CommandEntry(NOW, f"{_Q}.inspect_controller", "webots_inspect_controller"),
    "commands": CommandEntry(NOW, f"{_Q}.send_command", "webots_list_commands"),
    "profile": CommandEntry(NOW, f"{_CLI}.judging_commands", "profile"),
    "check": CommandEntry(PAST, f"{_CLI}.judging_commands", "check"),
    "events": CommandEntry(PAST, f"{_Q}.find_events", "webots_find_events"),
    "runs": CommandEntry(PAST, f"{_Q}.list_and_compare_runs", "webots_list_runs"),
    "compare": CommandEntry(PAST, f"{_Q}.list_and_compare_runs", "webots_compare_runs"),
    "plot": CommandEntry(PAST, f"{_CLI}.recording_commands", "plot"),
    "history": CommandEntry(PAST, f"{_Q}.query_history", "webots_query_history"),
    "trends": CommandEntry(PAST, f"{_Q}.query_history", "webots_get_trends"),
    "signals": CommandEntry(PAST, f"{_CLI}.steering_commands", "signals"),
    "sql": CommandEntry(PAST, f"{_Q}.query_sql", "webots_query_sql"),
    "pause": CommandEntry(STEER, f"{_CLI}.steering_commands", "pause"),
    "resume": CommandEntry(STEER, f"{_CLI}.steering_commands", "resume"),
    "fast": CommandEntry(STEER, f"{_CLI}.steering_commands", "fast"),
    "step": CommandEntry(STEER, f"{_CLI}.steering_commands", "step"),
    "reset": CommandEntry(STEER, f"{_CLI}.steering_commands", "reset"),
    "reload": CommandEntry(STEER, f"{_CLI}.steering_commands", "reload"),
    "run": CommandEntry(STEER, f"{_Q}.control_simulation", "webots_run"),
    "breakpoint": CommandEntry(STEER, f"{_CLI}.steering_commands", "breakpoint_"),
    "parameters": CommandEntry(STEER, f"{_CLI}.steering_commands", "parameters"),
    "watch": CommandEntry(STEER, f"{_Q}.inspect_controller", "webots_watch"),
    "field": CommandEntry(STEER, f"{_CLI}.steering_commands", "field"),
    "send": CommandEntry(STEER, f"{_Q}.send_command", "webots_send_command"),
    "wait": CommandEntry(STEER, f"{_Q}.send_command", "webots_wait_for_command"),
    "record-scene": CommandEntry(STEER, f"{_Q}.record_scene", "webots_record_scene"),
    "capture": CommandEntry(STEER, f"{_CLI}.steering_commands", "capture"),
    "branch": CommandEntry(RUNS, f"{_CLI}.steering_commands", "branch"),
    "trials": CommandEntry(RUNS, f"{_CLI}.steering_commands", "trials"),
    "repeatability": CommandEntry(RUNS, f"{_CLI}.judging_commands", "repeatability"),
    "rerun": CommandEntry(RUNS, f"{_CLI}.rerun_command", "rerun"),
    "first-difference": CommandEntry(RUNS, f"{_CLI}.judging_commands", "first_difference"),
    "export": CommandEntry(DATA, f"{_CLI}.recording_commands", "export"),
    "import": CommandEntry(DATA, f"{_CLI}.recording_commands", "import_"),
    "annotate": CommandEntry(DATA, f"{_Q}.list_and_compare_runs", "webots_annotate_run"),
    "retention": CommandEntry(DATA, f"{_CLI}.recording_commands", "retention"),
    "prune": CommandEntry(DATA, f"{_CLI}.recording_commands", "prune"),
    "serve": CommandEntry(SERVER, f"{_CLI}.server_commands", "serve"),
    "token": CommandEntry(SERVER, f"{_CLI}.server_commands", "token"),
    "observe": CommandEntry(SERVER, f"{_CLI}.server_commands", "observe"),
    "header": CommandEntry(SERVER, f"{_CLI}.setup_commands", "header"),
    "audit": CommandEntry(SERVER, f"{_CLI}.steering_commands", "audit"),
    "completion": CommandEntry(SERVER, f"{_CLI}.setup_commands", "completion"),
}
COMMANDS: Final[dict[str, CommandEntry]] = _OF_THE_CORE | {
    each.name: CommandEntry(each.group, *each.function.split(":")) for each in plugin_commands()
}
