"""A browser, and servers of the page as real processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from tests.browsing import chromium
from tests.recordings.rover import record_rover, start_run
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.standin import Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.store.chunk_making import make_chunks

__all__ = ["chromium"]
NAME = "<img src=x onerror=hacked=1>"
LINE = "<script>window.hacked = 1</script>"
_VIEW = """
from dataclasses import replace
from webots_mcp.cli import main
from webots_mcp.plugins.page import page_server
page_server.LIMITS = replace(page_server.LIMITS, request_s={})
raise SystemExit(main())
"""


class Server:
    """`webots-mcp view` on a data folder."""

    def __init__(self, data_dir: Path, *options: str, request_s: float = 10) -> None:
        where = ["--data-dir", str(data_dir)]
        arguments = ["view", "--port", "0", "--no-browser", "--json", *where, *options]
        self.data_dir = data_dir
        self._home = {**os.environ, "HOME": str(data_dir), "USERPROFILE": str(data_dir)}
        self.process = subprocess.Popen(
            [sys.executable, "-c", _VIEW.format(request_s), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self._home,
        )
        assert self.process.stdout is not None
        said = self.process.stdout.readline()
        assert '"url"' in said, self.process.communicate(timeout=30)
        self.url: str = json.loads(said)["url"]
        self.path = "/" + self.url.split("/", 3)[3]
        self.port = int(self.url.split(":")[2].partition("/")[0])

    def ask(self, path: str) -> dict[str, Any]:
        """What the page is answered to a question."""
        with urlopen(self.url + path, timeout=60) as response:
            return json.load(response)

    def run(self, *command: str) -> str:
        """What another command of the same user prints."""
        line = [sys.executable, "-m", "webots_mcp", *command]
        return subprocess.check_output(line, text=True, env=self._home).strip()

    def stop(self) -> str:
        """End it as Ctrl-C does; returns what it said on stderr."""
        self.process.terminate()
        return self.process.communicate(timeout=30)[1]


@pytest.fixture(scope="session")
def serve() -> Iterator[Callable[..., Server]]:
    """Start servers, which end with the tests."""
    running: list[Server] = []

    def start(data_dir: Path, *options: str, **limits: float) -> Server:
        running.append(Server(data_dir, *options, **limits))
        return running[-1]

    yield start
    for server in running:
        if server.process.poll() is None:
            server.stop()


@pytest.fixture(scope="session")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of the rover's story, and of a robot that has markup for everything."""
    data_dir = tmp_path_factory.mktemp("story")
    write_story(data_dir)
    return data_dir


def write_story(data_dir: Path) -> None:
    with closing(connect(data_dir / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        record_rover(connection)
        hostile = start_run(connection, NAME)
        for step in range(50):
            hostile.publish(step / 10, {"$$x$$": step, "mode": LINE, NAME: step % 2 == 0})
        logged = {"level": "info", "source": "controller", "message": LINE}
        hostile.insert("log", **hostile.at(5.0), **logged)
        frame = {"at": "nav.py:7", "function": LINE, "source": [LINE], "variables": {NAME: LINE}}
        inspected = json.dumps({"cause": "error", "frames": [frame, frame]})
        event = {"kind": "inspection", "name": LINE, "data": inspected}
        hostile.insert("event", **hostile.at(4.9), **event)
        still = start_run(connection, "still")
        (session_id, robot_id) = connection.execute(
            "SELECT session_id, robot_id FROM run WHERE id = ?", (still.run_id,)
        ).fetchone()
        still.run(session_id, robot_id, "reset")
        still.publish(0.0, {"x": 1.0})
        make_chunks(connection, 100_000)


@pytest.fixture(scope="session")
def told(serve: Callable[..., Server], story: Path) -> Server:
    """A server of the story that may only read."""
    return serve(story, "--read-only")


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The data folder of a rover that drives on the stand-in."""
    data_dir = tmp_path_factory.mktemp("arena")
    with Simulation(DEFAULT_WORLD, environment={DATA_DIR_VARIABLE: str(data_dir)}):
        yield data_dir


@pytest.fixture(scope="module")
def driven(serve: Callable[..., Server], arena: Path) -> Server:
    """A server of the rover that drives."""
    return serve(arena)
