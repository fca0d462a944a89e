"""What the page is answered where it cannot read or draw what it was asked for."""

from __future__ import annotations

import json
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.plugins.page.conftest import Server, write_story
from tests.recordings.long import build
from tests.waiting import wait_for
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.plugins.page.page_data import draw, page_request
from webots_mcp.plugins.page.page_server import ChunkMaker
from webots_mcp.store.chunk_making import MIN_ROWS_ON_DEMAND
from webots_mcp.store.chunks import watermark
from webots_mcp.store.recording import RecordingAccess


@pytest.fixture(scope="module")
def recording(story: Path) -> RecordingAccess:
    return RecordingAccess(story / DATABASE_NAME, story, read_only=True)


def drawn(recording: RecordingAccess, **asked: Any) -> dict[str, Any]:
    texts = {name: each if isinstance(each, str) else json.dumps(each)
             for name, each in asked.items()}  # fmt: skip
    return draw(recording, page_request({"robot": "rover", "run": "1"} | texts))


def values(markup: str) -> dict[str, Any]:
    return json.loads(markup.partition('application/json">')[2].removesuffix("</script>"))


def test_what_is_new_is_a_figure_of_what_was_asked_for(recording: RecordingAccess) -> None:
    answer = drawn(recording, signals=["pose.0", "heading"])
    assert answer["names"] == ["pose.0", "heading"]
    assert values(answer["signals"])["panels"] == [["pose.0"], ["heading"]]
    assert answer["bounds"] == (0.0, 119.9)


def test_signals_stand_in_the_panels_that_they_were_moved_to(recording: RecordingAccess) -> None:
    panels = [["pose.0", "battery_v"], ["heading"]]
    answer = drawn(recording, panels=panels)
    assert values(answer["signals"])["panels"] == panels
    assert "battery_v [V]" in answer["signals"]


def test_a_zoom_reads_each_row_of_what_it_shows(recording: RecordingAccess) -> None:
    whole, part = (
        values(drawn(recording, signals=["ir"], view=view)["signals"])["curves"][0]["t"]
        for view in (None, [60.0, 70.0])
    )
    assert min(b - a for a, b in pairwise(part)) == pytest.approx(0.1)
    assert whole[1] - whole[0] > 0.2


def test_what_cannot_be_drawn_is_a_note(recording: RecordingAccess) -> None:
    answer = drawn(recording, view=[900.0, 901.0])
    assert answer["signals"] is None
    assert "begins after the newest row" in answer["notes"][0]


def test_a_robot_that_another_database_lacks_is_chosen_no_more(told: Server) -> None:
    answer = told.ask("look?robot=nobody")
    assert "'nobody' is not in this database" in answer["text"]
    assert {"robot", "run"} <= set(answer["unknown"])


def test_what_the_page_cannot_read_is_said(told: Server) -> None:
    assert "cannot be read" in told.ask("look?run=one")["text"]


@pytest.mark.slow
def test_what_no_bridge_writes_is_said_on_the_page_and_logged_once(
    serve: Any, tmp_path: Path
) -> None:
    write_story(tmp_path)
    server: Server = serve(tmp_path)
    with closing(connect(tmp_path / DATABASE_NAME, "writer")) as connection:
        connection.execute("UPDATE log SET message = x'00ff'")
    for _ in range(3):
        assert "rows that it did not write" in server.ask("look?robot=rover&run=1")["text"]
    assert server.stop().count("Traceback") == 1


@pytest.mark.slow
def test_what_no_server_puts_into_chunks_is_beside_the_page(tmp_path: Path) -> None:
    build(tmp_path / DATABASE_NAME, 2 * MIN_ROWS_ON_DEMAND, chunked=False)
    recording = RecordingAccess(tmp_path / DATABASE_NAME, tmp_path, read_only=True)
    chunk_maker = ChunkMaker(recording)
    chunk_maker.start()
    wait_for(lambda: chunk_maker.rounds or not chunk_maker.is_alive())
    chunk_maker.stop()
    assert chunk_maker.says == ""
    with recording.reader() as connection:
        assert watermark(connection) == 2 * MIN_ROWS_ON_DEMAND


def test_of_a_page_without_a_recording_no_chunk_is_made(tmp_path: Path) -> None:
    chunk_maker = ChunkMaker(RecordingAccess(tmp_path / DATABASE_NAME, tmp_path, read_only=True))
    chunk_maker.make_chunks()
    assert (chunk_maker.rounds, chunk_maker.says) == (0, "")
