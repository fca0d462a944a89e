"""The questions that can be asked of a recording, and of the simulation behind it.

Each is one declaration: its arguments, the function that answers, and its answer. The server
publishes them as tools and the command line as commands; nothing else imports them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

from webots_mcp.extras.plugin_registry import question_modules

if TYPE_CHECKING:
    from webots_mcp.questions.declaration import Question

# In the order in which clients list them; those of plugins follow.
MODULES: Final = (
    "list_robots", "diagnose", "robot_state", "show_pictures", "get_logs", "monitor",
    "query_history", "describe_signals", "find_events", "list_and_compare_runs",
    "rerun_controller", "query_sql", "control_simulation", "run_trials", "set_breakpoints",
    "send_command", "controller_parameters", "edit_scene", "inspect_controller",
    "record_scene", "lint_world", "branch_run",
)  # fmt: skip


def all_questions() -> list[Question]:
    """Return every question there is, once; a module may use those of others.

    It imports all of them: for the list of tools, the documentation and tests.
    """
    from webots_mcp.questions.declaration import Question

    modules = [importlib.import_module(f"{__name__}.{name}") for name in MODULES]
    found = (each for module in [*modules, *question_modules()] for each in vars(module).values())
    return list(dict.fromkeys(each for each in found if isinstance(each, Question)))
