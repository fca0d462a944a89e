"""What the assistant learns of what is not well."""

from __future__ import annotations

import json
import time

import pytest

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask
from webots_mcp.setup.doctor import all_checks

pytestmark = pytest.mark.anyio


async def test_what_is_wrong_comes_first_with_what_mends_it(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot(rows_dropped=3, last_poll_wall_time_s=None, now=time.time() - 60)
    async with connect(read_only=True) as client:
        answer = await ask(client, "webots_diagnose_setup")
    assert answer["verdict"] == "wrong"
    verdicts = [each["verdict"] for each in answer["failed"]]
    assert verdicts == sorted(verdicts, reverse=True)
    told = {each["check"]: each for each in answer["failed"]}
    assert told["Rows"]["seen"] == "3 rows of rover were dropped"
    assert told["Simulation"]["fix"]


async def test_each_check_is_told_once_also_where_nothing_was_recorded(connect: Connect) -> None:
    async with connect() as client:
        answer = await ask(client, "webots_diagnose_setup")
    names = [each["check"] for each in answer["failed"]]
    for listed in (answer["passed"], *answer["not_checked"].values()):
        names += listed.split(", ")
    assert sorted(names) == sorted(check.name for check in all_checks())


async def test_the_answer_stays_short_however_much_is_wrong(
    connect: Connect, recorded: Recorded
) -> None:
    for n in range(60):
        recorded.robot(f"robot{n}" * 20, rows_dropped=n + 1, last_error="disk full " * 100)
    async with connect() as client:
        answer = await ask(client, "webots_diagnose_setup")
    assert len(json.dumps(answer)) < 6_000  # characters: 1,500 tokens
