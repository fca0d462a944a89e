"""`python -m webots_mcp.standin WORLD` in the foreground."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.standin.conftest import WriteController
from tests.standin.running import LOOP

COMMAND = [sys.executable, "-m", "webots_mcp.standin"]


@contextmanager
def running(*arguments: str) -> Generator[subprocess.Popen[str]]:
    process = subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def lines_until(process: subprocess.Popen[str], text: str) -> list[str]:
    """The lines of the console up to the first one with this text."""
    assert process.stdout
    seen: list[str] = []
    for line in process.stdout:
        seen.append(line.rstrip())
        if text in line:
            return seen
    raise AssertionError(f"no {text!r} in {seen}")


def test_it_runs_for_a_while_and_ends_cleanly(
    world: Path, write_controller: WriteController
) -> None:
    file = write_controller(LOOP, name="other")
    arguments = [str(world), "--mode=fast", "--duration=1", f"--robot=rover={file}"]
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, check=True)
    assert "Starting controller" in done.stdout
    assert "[rover] ended" in done.stdout


@pytest.mark.parametrize(
    ("ending", "status"),
    [
        ("raise RuntimeError('broken')", 1),
        ("import sys; sys.exit(5)", 5),
        pytest.param(
            "import os; os.kill(os.getpid(), 9)",
            137,
            marks=pytest.mark.skipif(os.name != "posix", reason="signals"),
        ),
        ("robot.simulationQuit(7)", 7),
    ],
)
def test_its_exit_status_is_that_of_its_controllers(
    ending: str, status: int, world: Path, write_controller: WriteController
) -> None:
    file = write_controller(f"robot.step(160)\n{ending}", LOOP, name="other")
    arguments = [str(world), "--mode=fast", "--duration=60", f"--robot=rover={file}"]
    assert subprocess.run([*COMMAND, *arguments], check=False).returncode == status


@pytest.mark.slow
def test_it_ends_with_its_last_controller(world: Path, write_controller: WriteController) -> None:
    file = write_controller("import nothing_of_that_name", name="other")
    arguments = [str(world), f"--robot=rover={file}"]
    ended = subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, check=False, timeout=60
    )
    assert ended.returncode == 1
    assert "No module named 'nothing_of_that_name'" in ended.stdout


def test_a_bad_world_or_option_is_said_on_stderr(world: Path) -> None:
    for arguments, message in (
        (["missing.wbt"], "cannot read the world"),
        ([str(world), "--robot=rover"], "is not NAME=FILE"),
    ):
        done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert message in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_and_its_controllers_cleanly(
    number: signal.Signals, world: Path, write_controller: WriteController
) -> None:
    write_controller("robot.step(16)\nprint('running', flush=True)", LOOP)
    with running(str(world), "--mode=fast") as process:
        lines_until(process, "running")
        process.send_signal(number)
        lines_until(process, "[rover] ended")
        assert process.wait(10) == 0


def test_controllers_end_when_their_simulation_dies(
    world: Path, write_controller: WriteController
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10)
        port = server.getsockname()[1]
        write_controller(
            f"""
            import socket
            witness = socket.create_connection(("127.0.0.1", {port}))
            """,
            LOOP,
        )
        with running(str(world), "--mode=fast") as process:
            witness, _ = server.accept()
            with witness:
                witness.settimeout(10)
                process.kill()
                assert witness.recv(1) == b""  # the controller's end was closed: it is gone
