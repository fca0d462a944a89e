"""Which Webots run: found among all processes, with what they were started with."""

from __future__ import annotations

import os
import socket
import subprocess
from pathlib import Path

import pytest

from tests.simulator.conftest import StartWebots, free_port, wait_for_line
from webots_mcp.simulator.instances import Instance, _arguments, instance_at, instances
from webots_mcp.simulator.orders import give_order


def of(process: subprocess.Popen[str]) -> Instance:
    (found,) = [each for each in instances() if each.pid == process.pid]
    return found


@pytest.mark.slow
def test_how_a_webots_was_started_is_told(start_webots: StartWebots, world: Path) -> None:
    port = free_port()
    process = start_webots("--stream", "--mode=fast", "--stdout", f"--port={port}", world)
    wait_for_line(process, "ready")
    found = of(process)
    assert found == Instance(process.pid, port, True, "fast", True, world)
    assert instance_at(port) == found
    assert give_order(found.address, "pause", 10).text == "paused by client"
    assert wait_for_line(process, "pause") == "pause\n"


def test_where_the_port_was_taken_the_one_that_it_has_is_told(
    start_webots: StartWebots, world: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:
        taken = int(door.getsockname()[1])
        process = start_webots("--stdout", f"--port={taken}", world)
        wait_for_line(process, "ready")
        found = of(process)
    assert taken < found.port <= taken + 10
    assert (found.is_listening, found.streams, found.mode) == (True, False, None)


def test_only_webots_itself_is_one() -> None:
    home = "/usr/local/webots"
    assert _arguments([f"{home}/bin/webots-bin", "--batch", "a.wbt"]) == ["--batch", "a.wbt"]
    assert _arguments(["/bin/bash", f"{home}/webots", "a.wbt"]) == ["a.wbt"]
    assert _arguments(["C:\\Program Files\\Webots\\msys64\\mingw64\\bin\\webots-bin.exe"]) == []
    for other in (
        ["vim", "webots"],
        ["python3", "-u", "rover.py"],
        [f"{home}/webots-controller", "rover.py"],
        ["/usr/bin/python3", "/usr/bin/webots-mcp", "serve"],
        [],
    ):
        assert _arguments(other) is None
    assert os.getpid() not in [each.pid for each in instances()]
