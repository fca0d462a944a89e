"""The question that writes a report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.report.making import file_name, make_report, require_free, write_report
from webots_mcp.questions.answers import NotedAnswer
from webots_mcp.questions.budget import notes_of
from webots_mcp.questions.declaring import DESTROYS, AnyNames, RobotName, RunIds, question
from webots_mcp.store.recording import Recording

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
