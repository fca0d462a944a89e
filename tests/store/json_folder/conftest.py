"""The data folder of a bridge that writes JSON files."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from webots_mcp.connection import connect, create_schema

NOON = datetime(2026, 5, 4, 12, 0, 0)
STATUS = {"pose": [1.0, 2.0, 0.5], "mode": "navigate", "timestamp": "2026-05-04T12:00:00.250000"}


class Peer:
    """Writes what such a bridge writes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, name: str, content: str | bytes, moment: datetime = NOON) -> Path:
        file = self.folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.encode() if isinstance(content, str) else content)
        os.utime(file, (moment.timestamp(), moment.timestamp()))
        return file

    def picture(self, name: str, moment: datetime = NOON) -> Path:
        file = self.folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 6), "red").save(file)
        os.utime(file, (moment.timestamp(), moment.timestamp()))
        return file

    def everything(self) -> None:
        self.write("status.json", json.dumps(STATUS, indent=2))
        self.write(
            "logs/controller.log", "[11:59:00] start\n[11:59:30] turn\nleft\n[12:00:00] go\n"
        )
        self.picture("camera/frame_0000.png")
        self.picture("camera/frame_0001.png")
        self.picture("screenshots/shot.png")
        command = {"action": "grasp", "force": 3, "timestamp": "2026-05-04T11:59:59"}
        self.write("commands.json", json.dumps(command))


@pytest.fixture
def peer(tmp_path: Path) -> Peer:
    return Peer(tmp_path / "peer")


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def database(data_dir: Path) -> Iterator[sqlite3.Connection]:
    with closing(connect(data_dir / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        yield connection


def rows(connection: sqlite3.Connection, sql: str) -> list[Any]:
    return connection.execute(sql).fetchall()


def counts(connection: sqlite3.Connection) -> dict[str, int]:
    tables = ("robot", "session", "run", "state", "log", "event", "command", "image")
    return {table: rows(connection, f"SELECT count(*) FROM {table}")[0][0] for table in tables}
