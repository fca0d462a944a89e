"""The command that shows the main job without Webots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from webots_mcp.cli.options import Json, Parameter


def demo(
    *,
    data_dir: Annotated[
        Path | None,
        Parameter("--data-dir", metavar="DIR", help="Where to record (~/.webots-mcp/demo)."),
    ] = None,
    keep: Annotated[
        bool, Parameter("--keep", help="Leave the robot running until Ctrl-C.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Run a robot on the stand-in simulator and talk to it: no Webots needed, under 30 s.

    With --json the conversation appears on stderr, and then its answers as one object on stdout.
    """
    from webots_mcp.contract import full_path
    from webots_mcp.plugins.demo.conversation import DEFAULT_DATA_DIR, run

    chosen = full_path(data_dir) if data_dir is not None else None
    run(chosen or DEFAULT_DATA_DIR, keep=keep, as_json=as_json)
