"""Runs are told, compared, labelled and plotted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.server.conftest import ask, fail, pictures_of, text_of
from tests.server.history.conftest import STORY, tell
from tests.server.story import client_on, copy_of, rows_of

pytestmark = pytest.mark.anyio


async def test_runs_tell_their_code_and_how_they_ended(story: Path) -> None:
    answer = await tell(story, "webots_list_runs")
    runs = rows_of(answer["runs"])
    assert [(run["run_id"], run["ended_by"]) for run in runs] == [
        (3, "finished"), (2, "crashed"), (1, "reset"),
    ]  # fmt: skip
    assert (runs[0]["controller"], runs[0]["sha256"], runs[0]["git_commit"]) == (
        "rover.py", "b" * 10, "beef",
    )  # fmt: skip
    assert runs[2]["notable"] == {"log error": 1, "log warning": 1, "dropped": 1}
    assert runs[2]["real_time_factor"] == pytest.approx(2.0, abs=0.01)
    older = await tell(story, "webots_list_runs", limit=1, cursor=3)
    assert [run["run_id"] for run in rows_of(older["runs"])] == [2]
    assert older["cursor"] == 2


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


async def test_a_label_is_kept_and_can_be_taken_away(story: Path, tmp_path: Path) -> None:
    file = copy_of(story, tmp_path / "webots.db")
    async with client_on(file, read_only=False) as client:
        answer = await ask(client, "webots_annotate_run", run_id=2, label="7", note="too slow")
        run = answer["run"]
        assert (run["run_id"], run["label"], run["note"]) == (2, "7", "too slow")
        answer = await ask(client, "webots_annotate_run", run_id=2, label="-")
        run = answer["run"]
        assert (run.get("label"), run["note"]) == (None, "too slow")
        assert "give a label or a note" in await fail(client, "webots_annotate_run", run_id=2)
        assert "no run 9" in await fail(client, "webots_annotate_run", run_id=9, label="x")


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
