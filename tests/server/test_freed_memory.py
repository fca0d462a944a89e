"""After a question its arrays are gone, and the memory is the system's again."""

from __future__ import annotations

import gc
import platform
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import pytest

from tests.recordings.long import build
from webots_mcp.database.connection import connect
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.trends import trends
from webots_mcp.plotting import plot
from webots_mcp.questions.monitor import look_back
from webots_mcp.store.reading.catalogue import list_signals
from webots_mcp.store.reading.frame_source import FrameSource
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.recording import RecordingAccess

QUESTIONS: Final[dict[str, Callable[[Any, Path], object]]] = {
    "events": lambda db, _: find_events(db, find_range(db, Scope())),
    "check": lambda db, _: check_run(db, 1),
    "trends": lambda db, _: trends(db, find_range(db, Scope()), ("*",)),
    "signals": lambda db, _: list_signals(db),
    "monitor": lambda _, file: look_back(RecordingAccess(file, file.parent), None, 60),
    "plot": lambda db, _: plot(db, "signals", ["pose.0"]),
}
_FREES: Final = """
import numpy
from webots_mcp.server.freed_memory import give_back
def resident_kb():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))
kept = [numpy.ones(3_000) for _ in range(4_000)]  # each too small to be given back alone
del kept[:-1]
before = resident_kb()
give_back()
print(before - resident_kb())
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recorded") / "webots.db"
    build(file, 3_000)
    return file


@pytest.mark.parametrize("ask", QUESTIONS.values(), ids=QUESTIONS)
def test_no_array_waits_for_the_garbage_collector(
    ask: Callable[[Any, Path], object], file: Path
) -> None:
    gc.collect()
    gc.disable()
    try:
        with closing(connect(file, "reader")) as connection:
            ask(connection, file)
        assert not [each for each in gc.get_objects() if isinstance(each, FrameSource)]
    finally:
        gc.enable()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory")
def test_freed_memory_goes_back_to_the_system() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _FREES], check=True, capture_output=True, text=True
    )
    assert int(done.stdout) > 50_000  # of the 96 MB that the arrays took
