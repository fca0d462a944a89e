"""The command that writes a report to any file; the question of assistants is in `making`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from webots_mcp.cli.options import (
    HERE,
    Id,
    Json,
    Parameter,
    Robot,
    Where,
    make_chunks_first,
    only_reading,
)
from webots_mcp.cli.streams import shown_progress
from webots_mcp.cli.terminal import print_json, print_notes, printable


@only_reading
def report(
    *run_ids: Annotated[
        Id, Parameter("RUN", help="One run, or two to compare. Default: the newest run.")
    ],
    output: Annotated[
        Path | None,
        Parameter(
            ("--output", "-o"),
            metavar="FILE",
            help="File to write (.html). Default: run-RUN.html in this folder.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, Parameter("--overwrite", help="Overwrite the file if it exists.")
    ] = False,
    signals: Annotated[
        list[str] | None,
        Parameter(
            "--signal",
            metavar="SIGNAL",
            help="Signal to draw; '*' means any text. Can be repeated. Default: those that changed "
            "most.",
        ),
    ] = None,
    max_mb: Annotated[
        float,
        Parameter(
            "--max-mb",
            metavar="MB",
            help="Maximum size of the file in megabytes, from 2 to 100. Default: 10.",
        ),
    ] = 10.0,
    robot: Robot = None,
    as_json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Write a report about a run, or a comparison of two runs, as one HTML file.

        webots-mcp report 3 4 -o comparison.html

    The report shows what ran (code, commit, parameters, world), what happened (events, trends,
    timeline), interactive figures, the path, pictures, commands and the log. The file is
    self-contained and needs no network.
    """
    from webots_mcp.plugins.report.make_report import (
        file_name,
        make_report,
        require_folder,
        require_free,
        write_report,
    )
    from webots_mcp.plugins.report.words import size
    from webots_mcp.store.reading.ranges import find_subject

    recording = recorded.recording()
    make_chunks_first(recording)
    with recorded.reader() as connection, shown_progress("reporting") as progress:
        chosen = run_ids or [find_subject(connection, robot).run_id]
        file = output or Path(file_name(chosen))
        require_free(file, overwrite=overwrite)
        require_folder(file)
        made = make_report(
            connection, chosen, recording.data_dir, names=signals or (), max_mb=max_mb,
            progress=progress,
        )  # fmt: skip
        write_report(file, made.html, overwrite=overwrite)
    if as_json:
        return print_json(
            {
                "file": str(file),
                "title": made.title,
                "size_bytes": len(made.html),
                "holds": made.holds,
                "left_out": made.left_out,
            }
        )
    held = "".join(f", {name} {count}" for name, count in made.holds.items()).replace(",", ";", 1)
    print(f"Wrote {file}: {printable(made.title)}, {size(len(made.html))}{held}")
    print_notes([f"left out: {each}" for each in made.left_out])
