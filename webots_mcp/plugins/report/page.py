"""The page of a report: what is in it, and the HTML that it becomes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from webots_mcp import __version__
from webots_mcp.naming import spelled_out
from webots_mcp.plugins.report.chapter import Chapter
from webots_mcp.plugins.report.comparison import Beside
from webots_mcp.plugins.report.figures import Figures, moment_key
from webots_mcp.plugins.report.run_pictures import Pictures
from webots_mcp.plugins.report.words import clock, counted, size

_TEMPLATES: Final = Path(__file__).parent / "templates"
# Nothing may be loaded, whatever a text of the recording says; Bokeh's own parts are inside.
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True)
class Page:
    """All that a report shows.

    Attributes:
        made_wall_time_s: When it was made.
        max_mb: What it may take.
        library: Bokeh's script.
        beside: The comparison of two runs; None of one.
        pictures: By run.
        left_out: What is not in it.
        size_bytes: What it takes, about; None while that is not known.
    """

    title: str
    made_wall_time_s: float
    max_mb: float
    library: str
    chapters: Sequence[Chapter]
    beside: Beside | None
    figures: Figures
    pictures: dict[int, Pictures] = field(default_factory=dict[int, Pictures])
    left_out: Sequence[str] = ()
    size_bytes: int | None = None


def _spelled_out(value: object) -> object:
    """Texts, but for what is markup of ours."""
    return spelled_out(value) if type(value) is str else value


def render(page: Page) -> bytes:
    """The file. Every text of the recording is escaped: it is shown, and never run."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        finalize=_spelled_out,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    told: Mapping[str, Any] = {
        "page": page,
        "policy": _POLICY,
        "version": __version__,
        "made": clock(page.made_wall_time_s),
        "size": size(page.size_bytes or 0),
        "counted": counted,
        "moment_key": moment_key,
    }
    return environment.get_template("report.html").render(told).encode("utf-8", "replace")
