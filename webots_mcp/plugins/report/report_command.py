"""The command that writes a report, to any file; an assistant's question is in `write_report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

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
from webots_mcp.cli.terminal import print_json, print_notes, printable, shown_progress
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.report.making import file_name, make_report, require_free, write_report
from webots_mcp.questions.answers import NotedAnswer
from webots_mcp.questions.budget import notes_of
from webots_mcp.questions.declaring import DESTROYS, AnyNames, RobotName, RunIds, question
from webots_mcp.store.recording import Recording


@only_reading
def report(
    *run_ids: Annotated[
        Id, Parameter("RUN", help="One run, or two beside each other; none: the newest.")
    ],
    output: Annotated[
        Path | None,
        Parameter(
            ("--output", "-o"),
            metavar="FILE",
            help="A .html file; else run-RUN.html in this folder.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, Parameter("--overwrite", help="Also if it is there already.")
    ] = False,
    signals: Annotated[
        list[str] | None,
        Parameter(
            "--signal",
            metavar="NAME",
            help="Draw this signal, with '*'; may be repeated. Else those that changed most.",
        ),
    ] = None,
    max_mb: Annotated[
        float,
        Parameter("--max-mb", metavar="MB", help="How large the file may become, 2 to 100 (10)."),
    ] = 10.0,
    robot: Robot = None,
    as_json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Write a run, or two beside each other, as one HTML file to read and to send.

    What ran (code, commit, parameters, world), what happened (events with the seconds around them,
    trends and the timeline in words), interactive figures, the way, pictures, commands and log. The
    file needs nothing else and opens without a network.
    """
    from webots_mcp.plugins.report.making import (
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
    print(f"{file}: {printable(made.title)}, {size(len(made.html))}{held}")
    print_notes([f"left out: {each}" for each in made.left_out])


# The question that writes a report.


FOLDER: Final = "reports"  # in the data folder


class ReportAnswer(NotedAnswer):
    """A report that was written."""

    file: str | None = None
    size_bytes: int | None = None
    holds: dict[str, int] | None = Field(default=None, description="How many of each.")
    left_out: list[str] | None = Field(default=None, description="What had no room, and why.")


@question("Write a report", DESTROYS)
def webots_report(
    recording: Recording,
    run_ids: RunIds = None,
    file: Annotated[str, Field(max_length=500, description="In the data folder.")] = "",
    overwrite: Annotated[bool, Field(description="A file that is there.")] = False,
    signals: AnyNames = None,
    robot: RobotName = None,
) -> ReportAnswer:
    """Write a run, or two compared, as one HTML file for people, which opens offline.

    Events, trends, plots, pictures, log.
    """
    with recording.view(robot, run_ids[0] if run_ids else None) as view:
        chosen = run_ids or [view.require_run().id]
        path = _inside(recording.data_dir, file or f"{FOLDER}/{file_name(chosen)}")
        require_free(path, overwrite=overwrite)
        made = make_report(view.connection, chosen, recording.data_dir, names=signals or ())
        write_report(path, made.html, overwrite=overwrite)
        return ReportAnswer(
            **view.header(),
            file=str(path),
            size_bytes=len(made.html),
            holds=made.holds,
            left_out=notes_of(made.left_out),
            hint=None if made.holds.get("figures") else "nothing in it could be drawn",
        )


def _inside(data_dir: Path, file: str) -> Path:
    """The file, which has to lie in the data folder."""
    try:
        path = (data_dir / file).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise InvalidInputError(f"file={file[:100]!r} is not a usable path: {error}") from error
    if not path.is_relative_to(data_dir.resolve()):
        raise InvalidInputError(
            f"file={file[:100]!r} lies outside the data folder {data_dir}: name one in it, or "
            "write it by 'webots-mcp report -o FILE'"
        )
    return path
