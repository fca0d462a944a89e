"""The questions that can be asked of a recording, and of the simulation behind it."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Final

from webots_mcp.plugins import question_modules
from webots_mcp.questions.declaring import Question, questions_in

# In the order in which clients list them; those of plugins follow.
MODULES: Final = (
    "world_info", "diagnose", "robot_state", "get_camera", "get_logs", "monitor", "list_signals",
    "query_history", "get_trends", "find_events", "get_timeline", "compare_runs", "draw_plot",
    "query_sql", "control_simulation", "launch_world", "run_simulation",
    "run_trials", "set_breakpoint", "send_command", "set_parameters", "edit_scene",
    "merged_questions",
)  # fmt: skip


def all_questions() -> Iterator[Question]:
    """Every question there is."""
    for name in MODULES:
        yield from questions_in(importlib.import_module(f"{__name__}.{name}"))
    for module in question_modules():
        yield from questions_in(module)
