"""Films in reports and on the live page."""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path

import pytest

from tests.plugins.clip.conftest import HIT_S, Crash
from webots_mcp.database.connection import connect as connected
from webots_mcp.plugins.page.page_data import film, page_request
from webots_mcp.plugins.report.make_report import make_report
from webots_mcp.store.recording import RecordingAccess


def test_a_report_shows_the_frames_around_a_moment_as_a_film_and_a_still(
    crash: Crash, file: Path
) -> None:
    crash.drive().film(5.0, 7.0)
    crash.hit()
    crash.robot.end_run("finished")
    with closing(connected(file, "reader")) as connection:
        html = make_report(connection, [1], file.parent, max_mb=2).html.decode()
    assert len(html) < 2_000_000
    (moving,) = set(re.findall(r'class="moment-picture moving"><img src="data:image/(\w+)', html))
    assert moving == "webp"
    assert 'class="moment-picture still"' in html


def test_a_report_has_no_film_of_two_frames(crash: Crash, file: Path) -> None:
    crash.drive().film(5.9, 6.1)
    crash.hit()
    crash.robot.end_run("finished")
    with closing(connected(file, "reader")) as connection:
        html = make_report(connection, [1], file.parent, max_mb=2).html.decode()
    assert "image/webp" not in html


@pytest.mark.slow
def test_the_page_shows_a_clip_at_the_cursor_or_says_why_not(crash: Crash, file: Path) -> None:
    crash.drive().film(5.0, 7.0)
    recording = RecordingAccess(file, file.parent)
    shown = film(recording, page_request({"at": str(HIT_S)}))
    assert str(shown["uri"]).startswith("data:image/webp;base64,")
    assert shown["caption"] == "frames of eye, 3.000 to 8.000 s"
    outside = film(recording, page_request({"at": "99"}))
    assert outside["uri"] is None
    assert "is not in run 1" in outside["caption"]
