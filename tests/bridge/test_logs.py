"""Log lines: their levels, where they come from, and what of a long one is kept."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from typing import Any

import pytest

from tests.bridge.conftest import Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor

LINES = "SELECT level, logger, message FROM log ORDER BY id"


@pytest.fixture
def logger(bridge: MCPBridge) -> logging.Logger:
    """A controller's own logger, which tells the bridge of everything, and nobody else."""
    logger = logging.Logger("arm.gripper")
    logger.addHandler(bridge.log_handler())
    return logger


@pytest.mark.parametrize(
    ("level", "meant"),
    [
        ("warn", "warning"),
        ("WARNING", "warning"),
        (logging.WARNING, "warning"),
        ("Error", "error"),
        ("critical", "critical"),
        ("FATAL", "critical"),
        (logging.CRITICAL, "critical"),
        (logging.DEBUG, "debug"),
        (5, "debug"),
        (0, "debug"),
        (25, "info"),
        (1000, "critical"),
        (float("inf"), "critical"),
        (float("-inf"), "debug"),
        (-1, "debug"),
    ],
)
def test_a_level_means_what_it_says(
    bridge: MCPBridge, recording: Recording, level: Any, meant: str
) -> None:
    bridge.log("text", level=level)
    assert recording.rows("SELECT level FROM log") == [meant]


@pytest.mark.parametrize("level", ["loud", None, True, float("nan"), ["error"], b"error"])
def test_a_level_that_is_none_counts_as_info_and_is_said(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    recording: Recording,
    capfd: pytest.CaptureFixture[str],
    level: Any,
) -> None:
    with MCPBridge(robot, database=database) as bridge:
        bridge.log("text", level=level)
    assert recording.rows("SELECT level, message FROM log") == [("info", "text")]
    assert "is not one of debug, info, warning, error, critical" in capfd.readouterr().err


def test_a_long_line_is_cut_and_says_so(bridge: MCPBridge, recording: Recording) -> None:
    bridge.log("ab" * 1_000_000)
    (message,) = recording.rows("SELECT message FROM log")
    assert message == "ab" * 5000 + "... (cut: it had 2000000 characters)"


def test_a_message_that_would_never_end_is_cut(bridge: MCPBridge, recording: Recording) -> None:
    node: Any = [0.5]
    for _ in range(60):
        node = [node, node]
    bridge.log({"tree": node, "x": 1})
    bridge.log({"small": (1, None)})
    sql = "SELECT message FROM log ORDER BY id"
    assert recording.rows(sql) == ['{"tree":null,"x":1}', "{'small': (1, None)}"]


def test_pythons_logging_lands_with_its_level_and_the_name_of_its_logger(
    recording: Recording, logger: logging.Logger
) -> None:
    logger.warning("grip %.1f N", 2.5)
    logger.debug("open")
    try:
        _ = 1 / 0
    except ZeroDivisionError:
        logger.exception("failed")
    warning, debug, error = recording.rows(LINES)
    assert warning == ("warning", "arm.gripper", "grip 2.5 N")
    assert debug == ("debug", "arm.gripper", "open")
    assert error[:2] == ("error", "arm.gripper")
    assert error[2].startswith("failed\nTraceback")
    assert error[2].endswith("ZeroDivisionError: division by zero")


def test_a_line_of_the_bridge_itself_has_no_logger(bridge: MCPBridge, recording: Recording) -> None:
    bridge.log("text")
    assert recording.rows(LINES) == [("info", None, "text")]


class Silent:
    def __str__(self) -> str:
        raise RuntimeError("no text")

    __repr__ = __str__


def test_what_cannot_be_formatted_is_recorded_as_it_was_given(
    recording: Recording, logger: logging.Logger
) -> None:
    logger.error("grip %d N", "hard")
    logger.error("of %s", Silent())
    logger.error(Silent())
    assert recording.rows(LINES) == [
        ("error", "arm.gripper", "grip %d N (not formatted: TypeError)"),
        ("error", "arm.gripper", "of %s (not formatted: RuntimeError)"),
        ("error", "arm.gripper", "a Silent without text (not formatted: RuntimeError)"),
    ]


def test_a_line_that_is_logged_while_one_is_recorded_does_not_go_round(
    recording: Recording, logger: logging.Logger
) -> None:
    class Chatty:
        def __str__(self) -> str:
            logger.info("asked for a text")
            return "chatty"

    logger.info(Chatty())
    assert recording.rows(LINES) == [("info", "arm.gripper", "chatty")]


def test_any_thread_may_log(
    bridge: MCPBridge, recording: Recording, logger: logging.Logger
) -> None:
    def work(number: int) -> None:
        for _ in range(50):
            logger.info("from %d", number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    bridge.get_command()
    bridge.close()
    assert len(recording.rows(LINES)) == 200


def test_a_handler_passes_on_its_level_and_above(bridge: MCPBridge, recording: Recording) -> None:
    handler = bridge.log_handler("warning")
    for level in (logging.INFO, logging.ERROR):
        record = logging.LogRecord("name", level, "file", 1, "text", None, None)
        if level >= handler.level:
            handler.handle(record)
    assert recording.rows(LINES) == [("error", "name", "text")]


def test_logging_is_imported_only_for_its_handler() -> None:
    program = (
        "import sys\n"
        "from webots_mcp import MCPBridge\n"
        "assert 'logging' not in sys.modules, 'too early'\n"
    )
    line = [sys.executable, "-S", "-c", program]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
