from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.store.recorded import Recorded
from webots_mcp.contract import Database, MemoryDatabase


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    recording = Recorded(tmp_path / "webots.db")
    yield recording
    recording.close()


@pytest.fixture(params=["file", "memory"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    if request.param == "file":
        yield tmp_path / "webots.db"
        return
    memory = MemoryDatabase()
    yield memory
    memory.close()
