"""The command that writes a report."""

from __future__ import annotations

import argparse
from pathlib import Path

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    ROBOT,
    argument,
    open_recording,
    question,
    reading_long,
    row_id,
)
from webots_mcp.cli.progress import shown_progress
from webots_mcp.cli.tables import print_notes, printable


@question(
    "report", DATA_DIR, DATABASE, ROBOT,
    argument("run_ids", type=row_id, nargs="*", metavar="RUN",
             help="one run, or two beside each other; none: the newest"),
    argument("-o", "--output", metavar="FILE",
             help="a .html file (default: run-RUN.html in this folder)"),
    argument("--overwrite", action="store_true", help="also if it is there already"),
    argument("--signal", action="append", metavar="NAME", default=[],
             help="draw this signal, with '*'; may be repeated (default: those that changed most)"),
    argument("--max-mb", type=float, default=10.0, metavar="MB",
             help="how large the file may become, 2 to 100 (10)"),
)  # fmt: skip
def report(arguments: argparse.Namespace) -> None:
    """Write a run, or two beside each other, as one HTML file to read and to send.

    What ran (code, commit, parameters, world), what happened (events with the seconds around them,
    trends and the timeline in words), interactive figures, the way, pictures, commands and log. The
    file needs nothing else and opens without a network.
    """
    from webots_mcp.plugins.report.making import make_report
    from webots_mcp.plugins.report.words import size
    from webots_mcp.plugins.report.writing import (
        file_name,
        require_folder,
        require_free,
        write_report,
    )
    from webots_mcp.store.reading.subject import find_subject

    data_dir = open_recording(arguments).data_dir
    with reading_long(arguments) as connection, shown_progress("reporting") as progress:
        run_ids = arguments.run_ids or [find_subject(connection, arguments.robot).run_id]
        file = Path(arguments.output or file_name(run_ids))
        require_free(file, overwrite=arguments.overwrite)
        require_folder(file)
        made = make_report(
            connection, run_ids, data_dir, names=arguments.signal, max_mb=arguments.max_mb,
            progress=progress,
        )  # fmt: skip
        write_report(file, made.html, overwrite=arguments.overwrite)
    held = ", ".join(f"{name} {count}" for name, count in made.holds.items())
    holds = f"; {held}" if held else ""
    print(f"{file}: {printable(made.title)}, {size(len(made.html))}{holds}")
    print_notes([f"left out: {each}" for each in made.left_out])
