"""What Webots says becomes rows: once, whoever listens, and however badly Webots behaves."""

from __future__ import annotations

import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.recordings.rows import Recorded
from tests.simulator.webots_server import WebotsServer
from tests.waiting import wait_for
from webots_mcp.contract import host_name
from webots_mcp.database.job_leases import holder_of
from webots_mcp.simulator import console, console_lines
from webots_mcp.simulator.console import follow_console, job_of
from webots_mcp.simulator.instances import Instance
from webots_mcp.store.recording import RecordingAccess


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    recording = Recorded(tmp_path / "webots.db")
    yield recording
    recording.close()


def instance_at(port: int, pid: int | None = None) -> Instance:
    """A Webots at a port: this process, or another."""
    process = psutil.Process(pid)
    return Instance(process.pid, port, True, None, False, None, process.create_time())


def recording_of(recorded: Recorded) -> RecordingAccess:
    assert isinstance(recorded.database, Path)
    return RecordingAccess(recorded.database, recorded.database.parent)


def begin_run(recorded: Recorded, port: int, name: str = "rover") -> None:
    recorded.robot(name, instance=f"{host_name()}:{port}")


def messages(recorded: Recorded, source: str | None = None) -> list[str]:
    query = "SELECT message FROM log WHERE :source IS NULL OR source = :source ORDER BY id"
    return [message for (message,) in recorded.connection.execute(query, {"source": source})]


@pytest.fixture(autouse=True)
def at_short_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody else records these lines, and nothing has to be spared."""
    short = replace(console._TIMES, hold_s=0.05, receive_s=0.05, min_pause_s=0.05)
    monkeypatch.setattr(console, "_TIMES", short)


@pytest.fixture
def follow(recorded: Recorded) -> Iterator[Callable[..., Any]]:
    """Follow the console at a port until the test is over."""
    with ExitStack() as stack:

        def begin(port: int, pid: int | None = None) -> Any:
            begun = follow_console(instance_at(port, pid), recording_of(recorded))
            return stack.enter_context(begun)

        yield begin


@pytest.fixture
def followed(recorded: Recorded, follow: Callable[..., Any]) -> Iterator[tuple[WebotsServer, Any]]:
    """A Webots whose console is followed, and who follows it."""
    with WebotsServer(streams=False) as server:
        begin_run(recorded, server.port)
        follower = follow(server.port)
        wait_for(lambda: follower.problem is None)
        yield server, follower


def test_what_controllers_print_and_what_webots_says_become_rows_with_their_source(
    recorded: Recorded, follow: Callable[..., Any]
) -> None:
    with WebotsServer(streams=False) as server:
        begin_run(recorded, server.port)
        server.log("stdout", "INFO: rover: Starting controller: python3 -u rover.py")
        server.log("stdout", "hello\n")
        follow(server.port)
        wait_for(lambda: "hello" in messages(recorded))
        server.log("stderr", "Traceback (most recent call last):\n")
        server.log("stderr", "WARNING: 'rover' controller exited with status: 1.")
        wait_for(lambda: len(messages(recorded, "webots")) == 2)
    found = recorded.connection.execute(
        "SELECT level, source, message, logger FROM log WHERE logger IS NOT NULL ORDER BY id"
    )
    assert found.fetchall() == [
        ("info", "webots", "INFO: rover: Starting controller: python3 -u rover.py", "stdout"),
        ("info", "console", "hello", "stdout"),
        ("warning", "console", "Traceback (most recent call last):", "stderr"),
        ("warning", "webots", "WARNING: 'rover' controller exited with status: 1.", "stderr"),
    ]


def test_of_what_was_said_before_it_is_told_that_nobody_knows_when(
    recorded: Recorded, follow: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_lines, "MOST_OLD_LINES", 2)
    with WebotsServer(streams=False) as server:
        begin_run(recorded, server.port)
        for each in range(5):
            server.log("stdout", f"{each}\n")
        follow(server.port, os.getppid())  # which has run for a while
        wait_for(lambda: bool(messages(recorded)))
    assert messages(recorded) == [
        "(the next 2 lines were printed before the console was followed, the last of 5: when "
        "they were printed is not known)",
        "3",
        "4",
    ]


def test_two_who_follow_write_each_line_once_and_one_takes_over_from_the_other(
    recorded: Recorded,
) -> None:
    with WebotsServer(streams=False) as server:
        begin_run(recorded, server.port)
        instance, recording = instance_at(server.port), recording_of(recorded)
        with follow_console(instance, recording) as first:
            wait_for(lambda: first.problem is None)
            with follow_console(instance, recording) as second:
                wait_for(lambda: second.problem == "another process follows it")
                server.log("stdout", "once\n")
                wait_for(lambda: "once" in messages(recorded))
                first.stop()
                wait_for(lambda: not server.is_listened_to or second.problem is None)
                server.log("stdout", "then\n")
                wait_for(lambda: "then" in messages(recorded))
        assert [each for each in messages(recorded) if each[0] != "("] == ["once", "then"]
    assert holder_of(recorded.connection, job_of(instance)) is None


@pytest.mark.slow
def test_a_flood_is_cut_and_counted(recorded: Recorded, followed: tuple[WebotsServer, Any]) -> None:
    server, _ = followed
    server.log("stdout", "begin\n")
    wait_for(lambda: "begin" in messages(recorded))
    server.log("stdout", "\n".join(f"stdout:{each}" for each in range(3_000)))

    def counted() -> tuple[int, int]:
        """Lines of the flood that were recorded, and those that are said to have been left out."""
        said = "\n".join(messages(recorded))
        left_out = re.findall(r"(\d+) lines of the console: more than 500 in a second", said)
        return len(re.findall(r"^(?:stdout:)?\d+$", said, re.M)), sum(map(int, left_out))

    wait_for(lambda: sum(counted()) == 3_000)
    assert counted()[1] > 0  # how many depends on how many seconds it took to take them in


def test_a_huge_message_is_kept_in_part_and_that_is_said(
    recorded: Recorded, follow: Callable[..., Any]
) -> None:
    with WebotsServer(streams=False) as server:
        begin_run(recorded, server.port)
        server.log("stdout", "begin\n")
        follow(server.port)
        wait_for(lambda: "begin" in messages(recorded))
        server.log("stdout", "x" * (6 << 20))
        server.log("stdout", "after it\n")
        wait_for(lambda: "after it" in messages(recorded))
    assert "bytes of the console in one burst" in " ".join(messages(recorded))
    assert max(map(len, messages(recorded))) == 10_000


def test_what_was_said_last_is_recorded_when_webots_hangs_up_and_webots_that_comes_back_is_found(
    recorded: Recorded, follow: Callable[..., Any]
) -> None:
    with WebotsServer(streams=False) as server:
        port = server.port
        begin_run(recorded, port)
        follower = follow(port)
        wait_for(lambda: follower.problem is None)
        server.log("stderr", "FATAL: the end\n")
        server.hang_up()
    wait_for(lambda: "FATAL: the end" in messages(recorded))
    wait_for(lambda: follower.problem is not None)
    with WebotsServer(streams=False, port=port) as again:
        again.log("stdout", "back\n")
        wait_for(lambda: "back" in messages(recorded))


RUDE = {
    "never shakes hands": b"",
    "no Webots": b"HTTP/1.1 404 Not Found\r\n\r\n",
}


@pytest.mark.parametrize("greeting", RUDE.values(), ids=RUDE)
def test_who_does_not_answer_is_named_and_asked_again(
    recorded: Recorded,
    follow: Callable[..., Any],
    greeting: bytes,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(console, "_TIMES", replace(console._TIMES, connecting_s=0.3))
    callers: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as door:

        def answer() -> None:
            while True:
                try:
                    caller = door.accept()[0]
                except OSError:
                    return
                callers.append(caller)
                if greeting:
                    with suppress(OSError):  # who asked may have hung up meanwhile
                        caller.recv(4096)
                        caller.sendall(greeting)

        threading.Thread(target=answer, daemon=True).start()
        follower = follow(door.getsockname()[1])
        wait_for(lambda: len(callers) > 1)
        assert "what listens at 127.0.0.1:" in follower.problem
        door.shutdown(socket.SHUT_RDWR)
    for caller in callers:
        caller.close()


def test_a_frame_that_trickles_in_and_breaks_off_costs_only_itself(
    recorded: Recorded, followed: tuple[WebotsServer, Any]
) -> None:
    server, _ = followed
    server.log("stdout", "whole\n")
    frame = b"\x81\x7e" + struct.pack(">H", 400) + b"stdout:half"
    for byte in frame:
        server.send_raw(bytes([byte]))
    server.hang_up()
    server.log("stdout", "again\n")  # who connects next is told
    wait_for(lambda: "again" in messages(recorded))
    assert "half" not in " ".join(messages(recorded))


SERVER = """
import sys, time
from tests.simulator.webots_server import WebotsServer
with WebotsServer(streams=False, port=int(sys.argv[1])) as server:
    print(server.port, flush=True)
    for line in sys.stdin:
        server.log("stdout", line)
"""


@pytest.mark.slow
def test_a_killed_webots_ends_what_follows_it_and_its_successor_is_another(
    recorded: Recorded, follow: Callable[..., Any]
) -> None:
    def start(port: int) -> subprocess.Popen[str]:
        arguments = [sys.executable, "-c", SERVER, str(port)]
        process = subprocess.Popen(
            arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        return process

    def say(process: subprocess.Popen[str], text: str) -> None:
        assert process.stdin is not None
        process.stdin.write(f"{text}\n")
        process.stdin.flush()

    first = start(0)
    assert first.stdout is not None
    port = int(first.stdout.readline())
    began_s = psutil.Process(first.pid).create_time()
    recorded.robot("rover", began_s - 0.9, instance=f"{host_name()}:{port}")
    follower = follow(port, first.pid)
    wait_for(lambda: follower.problem is None)
    say(first, "one")
    wait_for(lambda: "one" in messages(recorded))
    first.send_signal(signal.SIGKILL)
    first.communicate()
    follower.join(timeout=30)
    assert not follower.is_alive()
    second = start(port)
    assert second.stdout is not None
    second.stdout.readline()
    follow(port, second.pid)
    say(second, "two")
    waiting = "SELECT message FROM console_line"
    wait_for(lambda: recorded.connection.execute(waiting).fetchall() == [("two",)])
    second.kill()
    second.communicate()
    assert messages(recorded) == ["one"]


def test_a_database_that_comes_later_gets_what_was_said_before(tmp_path: Path) -> None:
    with WebotsServer(streams=False) as server:
        server.log("stdout", "first\n")
        recording = RecordingAccess(tmp_path / "webots.db", tmp_path)
        with follow_console(instance_at(server.port), recording) as follower:
            wait_for(lambda: "no database" in (follower.problem or ""))
            recorded = Recorded(tmp_path / "webots.db")
            begin_run(recorded, server.port)
            wait_for(lambda: "first" in messages(recorded))
            recorded.close()


@pytest.mark.slow
def test_lines_that_meet_a_locked_database_are_written_once_it_is_free(
    recorded: Recorded, followed: tuple[WebotsServer, Any]
) -> None:
    server, follower = followed
    recorded.connection.execute("BEGIN IMMEDIATE")
    server.log("stdout", "meanwhile\n")
    wait_for(lambda: "stayed locked" in (follower.problem or ""))
    recorded.connection.execute("ROLLBACK")
    wait_for(lambda: "meanwhile" in messages(recorded))
    assert messages(recorded).count("meanwhile") == 1
