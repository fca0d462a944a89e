"""Recordings, servers on them, and real MCP clients."""

from __future__ import annotations

import json
import threading
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.types import CallToolResult, ImageContent, TextContent

from tests.recordings.rows import Recorded
from tests.simulator.conftest import start_webots as start_webots
from tests.simulator.conftest import webots as webots
from tests.waiting import until
from webots_mcp import MCPBridge
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import InProcessSupervisor

STEP_MS = 16
Connect = Callable[..., AbstractAsyncContextManager[Client]]
DATA_TOOLS = (  # that read the present
    "webots_list_robots",
    "webots_get_world_info",
    "webots_get_robot_state",
    "webots_get_sensors",
    "webots_get_full_state",
    "webots_get_logs",
    "webots_list_commands",
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "webots.db"


@pytest.fixture
def recorded(file: Path) -> Iterator[Recorded]:
    recording = Recorded(file)
    yield recording
    recording.close()


@pytest.fixture
def connect(file: Path) -> Connect:
    """A client of a server on the test's database, which may not exist."""

    @asynccontextmanager
    async def connected(*, mode: Any = "auto", **options: Any) -> AsyncGenerator[Client]:
        server = create_server(file, file.parent, **options)
        async with Client(server, mode=mode) as client:
            yield client

    return connected


def text_of(result: CallToolResult) -> str:
    return "".join(block.text for block in result.content if isinstance(block, TextContent))


def pictures_of(result: CallToolResult) -> list[ImageContent]:
    return [block for block in result.content if isinstance(block, ImageContent)]


async def ask(client: Client, tool: str, **arguments: Any) -> dict[str, Any]:
    """The data of an answer that is no error; its text says the same."""
    result = await client.call_tool(tool, arguments)
    assert not result.is_error, text_of(result)
    assert result.structured_content is not None
    assert json.loads(text_of(result)) == result.structured_content
    return result.structured_content


async def ask_until(
    client: Client, tool: str, reached: Callable[[dict[str, Any]], object]
) -> dict[str, Any]:
    """The data of the first answer that is what is waited for."""
    return await until(lambda: ask(client, tool), reached)


async def fail(client: Client, tool: str, **arguments: Any) -> str:
    """The text of an answer that is an error."""
    result = await client.call_tool(tool, arguments)
    assert result.is_error, text_of(result)
    return text_of(result)


class Driver(threading.Thread):
    """A controller's loop in a thread: a robot of the stand-in, recorded by a real bridge."""

    def __init__(self, file: Path, *, registers: bool = True) -> None:
        super().__init__(name="controller", daemon=True)
        self.robot = InProcessSupervisor("rover")
        self.bridge = MCPBridge(self.robot, throttle_interval=1, database=file)
        if registers:
            self.bridge.register_command("set_speed", self.set_speed)
            self.bridge.register_command("break_down", self.break_down)
        self.bridge.on_reload(self.rewind)
        self.speed = 1.0
        self._pace = threading.Event()

    def run(self) -> None:
        step = 0
        while self.robot.step(STEP_MS) != -1:
            step += 1
            mode = "cruise" if step // 20 % 2 else "turn"
            self.bridge.publish({"pose": [step * 0.01, 0.0, 0.1], "mode": mode, "steps": step})
            self.bridge.get_command()
            self._pace.wait(0.008)

    def stop(self) -> None:
        self.robot.simulation.quit()
        self.join(timeout=60)
        assert not self.is_alive()
        self.bridge.close()

    def rewind(self) -> None:
        self.speed = 1.0

    def set_speed(self, command: dict[str, Any]) -> dict[str, float]:
        """Set the speed: `speed` in rad/s."""
        self.speed = float(command["speed"])
        return {"speed": self.speed}

    def break_down(self, _: dict[str, Any]) -> None:
        raise RuntimeError("the gear is gone")


@pytest.fixture
def driver(file: Path) -> Iterator[Driver]:
    driving = Driver(file)
    driving.start()
    yield driving
    driving.stop()
