from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.test_parameters import TunableDriver


@pytest.fixture
def robot(file: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(file)
    driving.start()
    yield driving
    driving.stop()
