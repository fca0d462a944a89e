"""Whether a controller's calls are recorded: by the environment, or a line of the project's file.

Each controller imports this module: it imports little.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from webots_mcp.contract import PROJECT_FILE
from webots_mcp.database.location import find_project

TAPE_VARIABLE: Final = "WEBOTS_MCP_TAPE"  # 1 or true; "images" with the pictures of sensors as well
IMAGES: Final = "images"
_OFF: Final = ("", "0", "false", "no", "off")
_KEY: Final = "tape"


def wanted(environment: str | None, folder: Path) -> str | None:
    """Return `on` or `images` where a tape is asked for; None where it is not.

    Args:
        environment: The value of `WEBOTS_MCP_TAPE`, which holds if it is set.
        folder: A folder of the project, whose `webots-mcp.toml` may have the line `tape = true`.
    """
    if environment is not None:
        text = environment.strip().lower()
        return None if text in _OFF else IMAGES if text == IMAGES else "on"
    project = find_project(folder)
    if project is None:
        return None
    try:
        lines = (project / PROJECT_FILE).read_text("utf-8-sig").splitlines()
    except (OSError, ValueError):
        return None
    for line in lines:
        name, _, value = line.partition("#")[0].partition("=")
        if name.strip().startswith("["):  # in the tables that follow it means something else
            return None
        if name.strip() == _KEY:
            said = value.strip().strip("\"'")
            return IMAGES if said == IMAGES else "on" if said == "true" else None
    return None
