"""The tool that writes a report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from webots_mcp.answers.answer_models import NotedAnswer
from webots_mcp.answers.budget import notes_of
from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.arguments import AnyNames, RobotName, RunIds
from webots_mcp.questions.declaration import DESTROYS, question
from webots_mcp.store.recording import RecordingAccess


class ReportAnswer(NotedAnswer):
    """A report that was written."""

    file: str | None = Field(default=None, description="Path of the file.")
    size_bytes: int | None = Field(default=None, description="Size of the file.")
    holds: dict[str, int] | None = Field(
        default=None, description="Number of figures, pictures and rows of each table."
    )
    left_out: list[str] | None = Field(
        default=None, description="What did not fit into the file, and why."
    )


@question("Write a report", DESTROYS, tier="all")
def webots_report(
    recording: RecordingAccess,
    run_ids: RunIds = None,
    file: Annotated[
        str,
        Field(
            max_length=500,
            description="File to write, in the data folder. Default: report-RUN.html.",
        ),
    ] = "",
    overwrite: Annotated[bool, Field(description="Overwrite the file if it exists.")] = False,
    signals: AnyNames = None,
    robot: RobotName = None,
) -> ReportAnswer:
    """Write a report of one run, or of two compared, as an HTML file for people.

    It holds events, trends, plots, pictures and the log. To answer a question here use
    webots_check_run or webots_compare_runs.
    """
    from webots_mcp.plugins.report.make_report import (
        FOLDER,
        file_name,
        make_report,
        require_free,
        write_report,
    )

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
    """Return the path of a file, which has to be in the data folder."""
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
