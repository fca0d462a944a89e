"""How a command ends that is ended: soon, with a word, and with a code that says so."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.test_cli import run
from tests.recordings.rows import Recorded

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="signals and terminals of POSIX"),
    pytest.mark.slow,
]

HELLO = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {
        "protocolVersion": "2025-11-25",
        "capabilities": {},
        "clientInfo": {"name": "a person", "version": "1"},
    },
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    for step in range(1000):
        robot.state(step * 0.1, {"mode": "cruise", "text": "x" * 1000})
    recorded.close()
    return tmp_path


class Terminal:
    """A process on a terminal of its own, as a person has it."""

    def __init__(self, *arguments: str) -> None:
        import pty

        self.pid, self._screen = pty.fork()
        if not self.pid:
            os.execv(sys.executable, [sys.executable, "-m", "webots_mcp", *arguments])
        self.shown = ""

    def type(self, text: str) -> None:
        os.write(self._screen, text.encode())

    def wait_for(self, words: str) -> None:
        while words not in self.shown:
            assert self._read(), self.shown

    def end(self) -> int:
        """Read to the end, and return the exit code."""
        while self._read():
            pass
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def _read(self) -> bool:
        assert select.select([self._screen], [], [], 30)[0], f"silence after {self.shown!r}"
        try:
            text = os.read(self._screen, 10_000)
        except OSError:  # Linux says so where the process has closed its side
            return False
        self.shown += text.decode()
        return bool(text)

    def close(self) -> None:
        os.close(self._screen)


@pytest.fixture
def serving(folder: Path) -> Iterator[Terminal]:
    terminal = Terminal("serve", "--data-dir", str(folder))
    yield terminal
    terminal.close()


def test_serving_on_a_terminal_ends_at_ctrl_c_as_it_says(serving: Terminal) -> None:
    serving.wait_for("Ctrl-C ends it")
    serving.type(f"{json.dumps(HELLO)}\n")
    serving.wait_for("serverInfo")
    serving.type("\x03")
    assert serving.end() == 130
    assert serving.shown.count("webots-mcp: ended by Ctrl-C") == 1
    assert "Traceback" not in serving.shown


def test_serving_ends_at_sigterm_with_a_word(folder: Path) -> None:
    with run("serve", "--data-dir", str(folder)) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{json.dumps(HELLO)}\n")
        process.stdin.flush()
        assert "serverInfo" in process.stdout.readline()
        process.terminate()
        assert process.wait(timeout=60) == 143
        assert process.stderr is not None
        assert process.stderr.read() == "webots-mcp: ended by SIGTERM\n"


def test_serving_ends_without_a_word_when_its_client_is_gone(folder: Path) -> None:
    ask = {"name": "webots_monitor", "arguments": {"duration_wall_s": 90}}
    call = {"jsonrpc": "2.0", "id": 2, "method": "tools/call", "params": ask}
    with run("serve", "--data-dir", str(folder)) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdin.write(f"{json.dumps(HELLO)}\n")
        process.stdin.flush()
        assert "serverInfo" in process.stdout.readline()
        process.stdout.close()
        process.stdin.write(f"{json.dumps(call)}\n")
        process.stdin.close()
        assert (process.wait(timeout=60), process.stderr.read()) == (0, "")


@pytest.mark.parametrize(
    ("number", "code", "word"),
    [(signal.SIGINT, 130, "ended by Ctrl-C"), (signal.SIGTERM, 143, "ended by SIGTERM")],
)
def test_a_job_that_is_ended_halfway_says_so(
    folder: Path, number: signal.Signals, code: int, word: str
) -> None:
    with run("export", "--format", "jsonl", "--data-dir", str(folder)) as process:
        assert process.stdout is not None
        process.stdout.read(100)  # it has begun, and waits until more is read: the pipe is full
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (code, f"webots-mcp: {word}\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(
    "command", [["status"], ["runs", "--json"], ["export"], ["tail", "--no-follow"], ["trends"]]
)
def test_a_full_disk_under_the_output_is_one_line(folder: Path, command: list[str]) -> None:
    line = [sys.executable, "-m", "webots_mcp", *command, "--data-dir", str(folder)]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(line, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 1
    assert ended.stderr.startswith("webots-mcp: [Errno 28] No space left on device")
    assert ended.stderr.count("\n") == 1


def test_a_home_where_nothing_can_be_written_is_one_line_at_once(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.write_text("a file, in which no folder can be made")
    began_s = time.monotonic()
    ended = subprocess.run(
        [sys.executable, "-m", "webots_mcp", "demo"],
        capture_output=True,
        text=True,
        env={**os.environ, "HOME": str(home)},
        cwd=tmp_path,
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith("webots-mcp: the folder")
    assert (ended.stdout, ended.stderr.count("\n")) == ("", 1)
    assert time.monotonic() - began_s < 25  # the demo's robot has 30 s to come up
