"""What holds for all tests, however they were started."""

from __future__ import annotations

import gc
import math
import os
import shutil
import signal
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest
from hypothesis import HealthCheck, settings

from tests.recordings.bridge import record
from tests.recordings.fixtures import (
    database,
    empty,
    looked_at,
    recorded,
    rover,
    rover_recordings,
)
from webots_mcp.database.connection import connect

__all__ = ["database", "empty", "looked_at", "recorded", "rover", "rover_recordings"]

pytest_plugins = ["tests.progress"]

# Hundreds of processes import the package: none of them compiles it anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Recordings of tests need not outlast the machine: in memory, no commit waits for a disk.
_MEMORY = Path("/dev/shm")
_MEMORY_BYTES = 4_000_000_000  # all tests at once take a tenth of it
if _MEMORY.is_dir() and shutil.disk_usage(_MEMORY).free > _MEMORY_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))

# Files that take longest begin first where several processes share the tests, so that these end
# at about the same time. `python -m pytest --durations=60` shows what belongs in this list.
_LONGEST = (
    "tests/plugins/page/test_in_a_browser.py",
    "tests/setup/test_skills.py",
    "tests/examples/test_conversation.py",
    "tests/plugins/prove/test_prove.py",
    "tests/server/test_blocked_loops.py",
    "tests/bridge/processes/test_hangs.py",
    "tests/plugins/cluster/test_cluster.py",
    "tests/server/test_http.py",
    "tests/accuracy/test_accuracy.py",
    "tests/steering/trials/test_killed.py",
    "tests/server/test_observer.py",
    "tests/server/test_routes.py",
    "tests/judging/checks/test_judged.py",
    "tests/cli/test_launch.py",
    "tests/benchmarks/test_benchmarks.py",
    "tests/store/journal/test_c_header.py",
    "tests/judging/detection/test_detected.py",
    "tests/testing/test_plugin.py",
    "tests/bridge/test_interrupts.py",
    "tests/plugins/page/test_server.py",
    "tests/plugins/pool/parquet/test_reading.py",
    "tests/store/journal/test_long_lines.py",
    "tests/server/test_answer_sizes.py",
    "tests/steering/trials/test_trials.py",
    "tests/store/policy/test_policy_fuzz.py",
    "tests/steering/trials/test_search.py",
)

# Tests spend a third of their time waiting for simulations, servers and locks: three processes
# keep two cores busy. Each of them collects all tests, and takes 0.7 GB at its end.
_PROCESSES_PER_CORE = 1.5
_MOST_PROCESSES = 6

# The same examples each time, so that a red run was made red by the change that it tests;
# `pytest --hypothesis-profile=explore` looks for new ones. No machine is too slow for them.
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("explore", derandomize=False, print_blob=True)
settings.load_profile("repeatable")

# A script's background jobs ignore Ctrl-C and hand that down to the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def anyio_backend() -> str:
    """The event loop of tests that are coroutines: old anyio would ask for trio too."""
    return "asyncio"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="leave out what is marked slow")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return how many processes `-n auto` starts."""
    return min(math.ceil(_PROCESSES_PER_CORE * (os.cpu_count() or 1)), _MOST_PROCESSES)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow tests on request, and put all in the order in which they begin.

    In one process slow tests run last: what fails quickly is seen quickly. Where several share
    the tests, the longest files begin first.
    """
    slow = [item for item in items if item.get_closest_marker("slow")]
    fast = [item for item in items if not item.get_closest_marker("slow")]
    if config.getoption("--fast"):
        config.hook.pytest_deselected(items=slow)
        slow = []
    items[:] = [*fast, *slow]
    if hasattr(config, "workerinput"):
        items.sort(key=_rank_of_file)


def _rank_of_file(item: pytest.Item) -> int:
    file = item.nodeid.partition("::")[0]
    return _LONGEST.index(file) if file in _LONGEST else len(_LONGEST)


def pytest_collection_finish() -> None:
    """What is here until the end is not looked through again by each collection of garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def no_webots_but_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Webots that somebody runs beside the tests is neither found nor steered by them."""
    everywhere = psutil.process_iter

    def begun_here(*arguments: Any, **options: Any) -> Iterator[psutil.Process]:
        ours = set(psutil.Process().children(recursive=True))
        return (each for each in everywhere(*arguments, **options) if each in ours)

    monkeypatch.setattr(psutil, "process_iter", begun_here)


@pytest.fixture(scope="session")
def bridge_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The database of two runs of the rover; do not change it."""
    return record(tmp_path_factory.mktemp("recorded"))


@pytest.fixture
def reader(bridge_recording: Path) -> Iterator[sqlite3.Connection]:
    with closing(connect(bridge_recording, "reader")) as connection:
        yield connection
