"""The connection of a controller process to the simulator that started it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NoReturn

from .session import exit_process
from .wire import ADDRESS_FILE, Inbox, Message, connect, pack


class SocketLink:
    """Talks to the simulator that the `WEBOTS_...` environment variables name."""

    def __init__(self) -> None:
        port, token, robot_name = _address()
        self._socket = connect(port)
        self._inbox = Inbox()
        self.send(("hello", token, robot_name))
        kind, answer = self.receive()
        if kind != "welcome":
            raise ConnectionRefusedError(f"the simulation refused this controller: {answer}")
        self.description: dict[str, Any] = answer

    def send(self, message: Message) -> None:
        """Send a request; if the simulator is gone, so is this process."""
        try:
            self._socket.sendall(pack(message))
        except OSError:
            exit_process(1)

    def receive(self) -> Message:
        """Wait for an answer; if the simulator goes away meanwhile, so does this process."""
        while (message := self._inbox.take()) is None:
            try:
                data = self._socket.recv(1 << 20)
            except OSError:
                data = b""
            if not data:
                exit_process(1)
            self._inbox.feed(data)
        return message

    def exit(self) -> NoReturn:
        """The API was used after the end."""
        exit_process(0)

    def close(self) -> None:
        """Let the simulator know that this controller is done."""
        self._socket.close()


def _address() -> tuple[int, str, str]:
    """Port, token and robot name; the real library looks in this order, too."""
    name, folder = os.environ.get("WEBOTS_ROBOT_NAME"), os.environ.get("WEBOTS_INSTANCE_PATH")
    if name and folder:
        port, token = (Path(folder) / ADDRESS_FILE).read_text(encoding="utf-8").split()
        return int(port), token, name
    if url := os.environ.get("WEBOTS_CONTROLLER_URL"):
        place, _, name = url.partition("://")[2].partition("/")
        return int(place.rpartition(":")[2]), os.environ.get("WEBOTS_STANDIN_TOKEN", ""), name
    raise ConnectionError(
        "no simulation has started this process. Run the controller from a world: "
        "python -m webots_mcp.standin WORLD; in a test use webots_mcp.standin.InProcessRobot"
    )
