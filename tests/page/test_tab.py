"""What a tab does where it cannot read or draw what it was asked for."""

from __future__ import annotations

import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import pytest
from bokeh.document import Document

from tests.recordings.long import build
from tests.recordings.rover import start_run
from webots_mcp.connection import connect, create_schema
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.plugins.page.chunk_maker import ChunkMaker
from webots_mcp.plugins.page.tab import Tab
from webots_mcp.store.chunk_making import LEAST_ROWS
from webots_mcp.store.chunks import watermark
from webots_mcp.store.recording import Recording


def record(folder: Path, robot: str, state: dict[str, Any]) -> None:
    folder.mkdir(exist_ok=True)
    (folder / DATABASE_NAME).unlink(missing_ok=True)
    with closing(connect(folder / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        run = start_run(connection, robot)
        for step in range(20):
            run.publish(step / 10, state)
        run.insert("log", **run.at(1.0), level="info", source="controller", message="hello")


def opened(folder: Path) -> Tab:
    recording = Recording(folder / DATABASE_NAME, folder, read_only=True)
    return Tab(recording, Document(), read_only=True)


def go_on(tab: Tab) -> str:
    """One look, of which the browser says that it took it in; returns the line of the status."""
    anyio.run(tab.go_on)
    sent, answered = tab.layout.tags
    answered.start = sent.start
    return "".join(tab.layout.select_one({"name": name}).text for name in ("status", "said"))


def test_a_robot_that_another_database_lacks_is_chosen_no_more(tmp_path: Path) -> None:
    record(tmp_path, "first", {"x": 1.0})
    tab = opened(tmp_path)
    go_on(tab)
    tab.layout.select_one({"name": "run"}).value = "1"
    record(tmp_path, "other", {"y": 1.0})
    assert "first" in go_on(tab)
    assert "run 1" in go_on(tab)
    assert tab.layout.select_one({"name": "robot"}).value == "other"


def test_what_no_bridge_writes_is_said_on_the_page_and_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    record(tmp_path, "rover", {"x": 1.0})
    tab = opened(tmp_path)
    go_on(tab)
    with closing(connect(tmp_path / DATABASE_NAME, "writer")) as connection:
        connection.execute("UPDATE log SET message = x'00ff'")
    tab.layout.select_one({"name": "window"}).value = "10"
    assert "rows that it did not write" in go_on(tab)
    assert "rows that it did not write" in go_on(tab)
    assert len([each for each in caplog.records if each.exc_info]) == 1


def test_what_no_server_puts_into_chunks_is_beside_the_page(tmp_path: Path) -> None:
    build(tmp_path / DATABASE_NAME, 2 * LEAST_ROWS, chunked=False)
    recording = Recording(tmp_path / DATABASE_NAME, tmp_path, read_only=True)
    chunk_maker = ChunkMaker(recording)
    chunk_maker.start()
    while not chunk_maker.rounds:
        assert chunk_maker.is_alive()
        threading.Event().wait(0.01)
    chunk_maker.stop()
    assert chunk_maker.says == ""
    with recording.reader() as connection:
        assert watermark(connection) == 2 * LEAST_ROWS


def test_of_a_page_without_a_recording_no_chunk_is_made(tmp_path: Path) -> None:
    chunk_maker = ChunkMaker(Recording(tmp_path / DATABASE_NAME, tmp_path, read_only=True))
    chunk_maker.look()
    assert (chunk_maker.rounds, chunk_maker.says) == (0, "")
