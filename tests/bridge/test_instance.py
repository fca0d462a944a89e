"""Which simulator a controller belongs to, by what Webots tells it."""

from __future__ import annotations

import pytest

from tests.bridge.conftest import Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import host_name
from webots_mcp.standin import InProcessSupervisor

VARIABLES = ("WEBOTS_CONTROLLER_URL", "WEBOTS_INSTANCE_PATH", "WEBOTS_ROBOT_NAME")


def entered(
    monkeypatch: pytest.MonkeyPatch, database: MemoryDatabase, **told: str
) -> tuple[str, int]:
    """Simulator and kind of a controller that is started with these variables."""
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in told.items():
        monkeypatch.setenv(f"WEBOTS_{name.upper()}", value)
    MCPBridge(InProcessSupervisor("rover"), database=database).close()
    sql = "SELECT instance, extern FROM session ORDER BY id DESC LIMIT 1"
    return Recording(database).rows(sql)[0]


HERE = f"{host_name()}:1234"


@pytest.mark.parametrize(
    ("told", "simulator", "extern"),
    [
        ({"instance_path": "/tmp/webots/ada/1234/", "robot_name": "rover"}, HERE, 0),
        ({"instance_path": "C:\\Temp\\webots-1234\\", "robot_name": "rover"}, HERE, 0),
        ({"controller_url": "ipc://1234/rover"}, HERE, 1),
        ({"controller_url": "ipc://1234"}, HERE, 1),
        ({"controller_url": "tcp://127.0.0.1:1234/rover"}, HERE, 1),
        ({"controller_url": "tcp://localhost:1234/a/b"}, HERE, 1),
        ({"controller_url": "tcp://[::1]:1234/rover"}, HERE, 1),
        ({"controller_url": f"tcp://{host_name()}:1234/rover"}, HERE, 1),
        ({"controller_url": "tcp://192.168.1.5:1234/rover"}, "192.168.1.5:1234", 1),
        # Webots' library prefers what Webots itself set over a variable of the shell it came from.
        (
            {
                "instance_path": "/tmp/webots/ada/1234/",
                "robot_name": "rover",
                "controller_url": "ipc://1235/rover",
            },
            HERE,
            0,
        ),
        ({"instance_path": "/tmp/webots/ada/9/", "controller_url": "ipc://1234/r"}, HERE, 1),
    ],
)
def test_a_simulator_is_known_by_its_host_and_port(
    monkeypatch: pytest.MonkeyPatch,
    database: MemoryDatabase,
    told: dict[str, str],
    simulator: str,
    extern: int,
) -> None:
    assert entered(monkeypatch, database, **told) == (simulator, extern)


def test_two_simulators_of_one_shell_are_two(
    monkeypatch: pytest.MonkeyPatch, database: MemoryDatabase
) -> None:
    first = entered(monkeypatch, database, controller_url="ipc://1234/rover")
    second = entered(monkeypatch, database, controller_url="ipc://1235/rover")
    assert first != second
