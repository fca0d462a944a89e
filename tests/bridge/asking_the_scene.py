"""A loop that serves commands about the scene, and what became of them."""

from __future__ import annotations

from typing import Any

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor


class Scene:
    """Sends commands to a robot's bridge, whose loop makes some rounds for each."""

    def __init__(self, robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording) -> None:
        self.robot = robot
        self.bridge = bridge
        self.recording = recording

    def rounds(self, count: int = 3) -> None:
        for _ in range(count):
            assert self.robot.step(STEP_MS) == 0
            self.bridge.publish({"x": 1})
            eager(self.bridge)

    def fate(self, action: str, **params: Any) -> tuple[str, Any, str | None]:
        sent = self.recording.send(action, **params)
        for _ in range(20):
            self.rounds(1)
            fate = self.recording.fate(sent)
            if fate[0] != "claimed":
                return fate
        raise AssertionError(f"{action} is not done after 20 rounds")

    def ask(self, action: str, **params: Any) -> dict[str, Any]:
        """The result of a command that is done."""
        status, result, error = self.fate(action, **params)
        assert status == "done", error
        return result

    def fail(self, action: str, **params: Any) -> str:
        """Why a command was not done."""
        status, result, error = self.fate(action, **params)
        assert status == "failed" and error is not None, result
        return error

    def get(self, path: str) -> Any:
        return self.ask("get_field", path=path)["value"]

    def reset(self) -> None:
        self.ask("reset")
        self.rounds()

    def events(self, kind: str) -> list[tuple[str | None, str]]:
        return self.recording.rows("SELECT name, data FROM event WHERE kind = ? ORDER BY id", kind)
