from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.test_parameters import TunableDriver


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name in ("worlds", "controllers", "mcp_data"):
        (tmp_path / name).mkdir()
    return tmp_path


@pytest.fixture
def file(project: Path) -> Path:
    return project / "mcp_data" / "webots.db"


@pytest.fixture
def robot(file: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(file)
    driving.start()
    yield driving
    driving.stop()
