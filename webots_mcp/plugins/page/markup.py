"""What a tab says in markup. Everything that was recorded is escaped here, and nowhere else."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from webots_mcp.errors import NoDatabaseError, NothingRecordedError, WebotsMCPError
from webots_mcp.naming import spelled_out
from webots_mcp.plugins.page.tab_data import Look
from webots_mcp.store.logs import LogLine
from webots_mcp.store.robots import RUNNING
from webots_mcp.store.run_rows import StoredImage, opened

_LONGEST_LINE: Final = 1000  # characters of a log line
_DEFECT: Final = (
    "a defect of webots-mcp, or rows that it did not write; webots-mcp view has written more about "
    "it to its terminal"
)
_SIDE_PX: Final = 640
_JPEG_QUALITY: Final = 80
_LEVELS: Final = {"warning": "warning", "error": "error", "critical": "error"}


def escape(text: str) -> str:
    """A text that was recorded, as one that is only shown."""
    return html.escape(spelled_out(text))


def status_markup(shown: Look) -> str:
    """Whether the robot's time is moving, and how old what is shown is."""
    header = shown.header
    time_text = "no data yet"
    if header["sim_time_s"] is not None:
        time_text = f"simulation time {header['sim_time_s']:.2f} s, {header['age_s']:.1f} s old"
    kind = "running" if header["status"] == RUNNING else "standing"
    why = f'<span class="why">{escape(header["why"])}</span>' if header["why"] else ""
    run = f"run {header['run_id']}, " if header["run_id"] is not None else ""
    return (
        f'<span class="pill {kind}">{escape(header["status"])}</span> '
        f"<span>{escape(run + time_text)}</span> {why}"
    )


def problem_markup(error: Exception) -> str:
    """Why nothing can be read now, and of what nobody foresaw where more about it stands."""
    waits = isinstance(error, (NoDatabaseError, NothingRecordedError))
    pill = "nothing recorded yet" if waits else "cannot be read"
    kind = "standing" if waits else "problem"
    why = str(error)
    if not isinstance(error, WebotsMCPError):
        why = f"{_DEFECT} ({type(error).__name__}: {why[:_LONGEST_LINE]})"
    return f'<span class="pill {kind}">{pill}</span> <span>{escape(why)}</span>'


def log_markup(lines: Sequence[LogLine]) -> str:
    """The lines of a log, the newest last and in sight."""
    rows = "".join(_line_markup(line) for line in reversed(lines))
    return f'<div class="log">{rows or "<p>no log line yet</p>"}</div>'


def _line_markup(line: LogLine) -> str:
    at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
    text = escape(line.message[:_LONGEST_LINE])
    level = _LEVELS.get(line.level, "plain")
    return f'<p class="{level}"><time>{at}</time><b>{escape(line.level)}</b>{text}</p>'


def notes_markup(notes: Sequence[str]) -> str:
    """What is not in the figures."""
    return "".join(f"<p>{escape(note)}</p>" for note in notes)


def picture_markup(image: StoredImage | None, data_dir: Path) -> str:
    """A picture with its time, as part of the page itself."""
    if image is None:
        return '<p class="none">no picture recorded yet</p>'
    what = f"{image.device or image.kind} at {image.sim_time_s:.3f} s"
    try:
        data = base64.b64encode(_as_jpeg(image.file(data_dir))).decode("ascii")
    except WebotsMCPError as error:
        return f'<p class="none">{escape(what)}: {escape(str(error))}</p>'
    return f'<img alt="" src="data:image/jpeg;base64,{data}"><p>{escape(what)}</p>'


def _as_jpeg(file: Path) -> bytes:
    buffer = io.BytesIO()
    with opened(file) as picture:
        scaled: Any = picture.convert("RGB")
        scaled.thumbnail((_SIDE_PX, _SIDE_PX))
        scaled.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()
