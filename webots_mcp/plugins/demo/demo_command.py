"""The command that shows the main job without Webots."""

from __future__ import annotations

import argparse

from webots_mcp.cli.command import argument, command


@command(
    "demo",
    argument("--data-dir", metavar="DIR", help="where to record (default: ~/.webots-mcp/demo)"),
    argument("--keep", action="store_true", help="leave the robot running until Ctrl-C"),
)
def demo(arguments: argparse.Namespace) -> None:
    """Run a robot on the stand-in simulator and talk to it: no Webots needed, under 30 s."""
    from webots_mcp.contract import full_path
    from webots_mcp.plugins.demo.conversation import DEFAULT_DATA_DIR, run

    chosen = full_path(arguments.data_dir) if arguments.data_dir else None
    run(chosen or DEFAULT_DATA_DIR, keep=arguments.keep)
