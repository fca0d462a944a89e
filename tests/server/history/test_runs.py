"""Runs are told, compared, labelled and plotted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.server.conftest import pictures_of, text_of
from tests.server.history.conftest import STORY, tell
from tests.server.story import client_on, rows_of

pytestmark = pytest.mark.anyio


async def test_before_and_after_the_last_edit_are_compared(story: Path) -> None:
    answer = await tell(story, "webots_compare_runs")
    before, after = rows_of(answer["groups"])
    assert (before["runs"], after["runs"]) == ([1, 2], [3])
    measures = {row["name"]: row for row in rows_of(answer["measures"])}
    assert answer["compared_s"] == pytest.approx(29.9, abs=0.01)
    assert measures["distance_m"]["median"][1] == pytest.approx(0.3 * 29.9, abs=0.01)
    differences = {row["signal"]: row for row in rows_of(answer["differences"])}
    assert differences["commanded_m_s"]["mean"] == [0.2, 0.3]
    assert "target" not in differences and "are equal" in answer["hint"]


@pytest.mark.parametrize(
    "arguments",
    [
        {"run_id": STORY},
        {"kind": "trajectory", "run_id": STORY},
        {"signals": ["pose.0"], "run_ids": [2, 3]},
    ],
)
async def test_a_plot_is_a_caption_and_a_picture(story: Path, arguments: dict[str, Any]) -> None:
    async with client_on(story) as client:
        result = await client.call_tool("webots_plot", arguments)
    assert not result.is_error, text_of(result)
    assert result.structured_content is None
    (picture,) = pictures_of(result)
    assert picture.mime_type == "image/png"
    assert '"robot":"rover"' in text_of(result)
    assert '"shows":' in text_of(result)


async def test_a_comparison_explains_its_columns_and_what_makes_before_and_after(
    story: Path,
) -> None:
    answer = await tell(story, "webots_compare_runs")
    assert answer["legend"].startswith("lists: before, after; range, mean_range: minimum and ")
    assert answer["notes"][0] == (
        "around the last edit of the controller; before: runs 1, 2 with code c0ffee, "
        "after: run 3 with code beef"
    )


async def test_a_check_that_passed_says_what_it_rests_on(story: Path) -> None:
    answer = await tell(story, "webots_check_run", run_id=STORY)
    assert [*answer["passed_on"]] == answer["passed"]
    assert "limit" in answer["passed_on"]["sensors live"]
    assert "(pose.0, pose.1, heading and " in answer["passed_on"]["sensors live"]


async def test_a_timeline_says_that_it_does_not_search_for_faults(story: Path) -> None:
    answer = await tell(story, "webots_get_timeline", run_id=STORY)
    assert "not searched for faults (webots_find_events)" in answer["summary"]


async def test_limits_that_nobody_set_are_one_line(story: Path) -> None:
    kept = (await tell(story, "webots_get_world_info"))["retention"]["kept"]
    assert [*kept] == ["defaults"] and "states 1.00 GB" in kept["defaults"]
