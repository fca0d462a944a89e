"""The recording whose story is known, and how a client asks about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.server.conftest import ask, fail
from tests.server.story import client_on, write_story

STORY = 1  # the run of which the story tells
EVERY: tuple[tuple[str, dict[str, Any]], ...] = (
    ("webots_list_signals", {}),
    ("webots_query_history", {"signals": ["pose"]}),
    ("webots_get_trends", {}),
    ("webots_find_events", {}),
    ("webots_get_timeline", {}),
    ("webots_monitor", {"lookback_wall_s": 5}),
    ("webots_compare_runs", {}),
    ("webots_list_runs", {}),
    ("webots_query_sql", {"sql": "SELECT 1"}),
)


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_story(tmp_path_factory.mktemp("story") / "webots.db")


async def tell(file: Path, tool: str, **arguments: Any) -> dict[str, Any]:
    async with client_on(file) as client:
        return await ask(client, tool, **arguments)


async def refuse(file: Path, tool: str, **arguments: Any) -> str:
    async with client_on(file) as client:
        return await fail(client, tool, **arguments)
