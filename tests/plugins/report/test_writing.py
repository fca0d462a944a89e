"""A report as a file: by the command, and by the tool."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from tests.server.conftest import ask, fail
from tests.server.story import client_on
from webots_mcp.cli import main


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    """A recording of one short run that is labelled."""
    recorded = Recorded(tmp_path / "data" / "webots.db")
    robot = recorded.robot()
    for step in range(20):
        robot.state(step * 0.1, {"battery_v": 12 - step * 0.1})
    recorded.connection.execute("UPDATE run SET label = 'short'")
    recorded.close()
    yield tmp_path / "data" / "webots.db"


def test_the_command_writes_a_file_says_what_it_holds_and_never_overwrites_unasked(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "run.html"
    line = ["report", "-o", str(report), "--database", str(file)]
    assert main(line) == 0
    said = capsys.readouterr().out
    assert f"{report}: Run 1 of rover: short, 0." in said
    assert "figures 1" in said
    assert b"Run 1 of rover: short" in report.read_bytes()

    report.write_text("mine")
    assert main(line) == 2
    assert "is there already" in capsys.readouterr().err
    assert report.read_text() == "mine"
    assert main([*line, "--overwrite", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["file"], told["holds"]["figures"]) == (str(report), 1)
    assert told["size_bytes"] == report.stat().st_size
    assert sorted(each.name for each in tmp_path.iterdir()) == ["data", "run.html"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["9"], "No run 9 is recorded. Use one of the newest runs: 1."),
        (["1", "1", "1"], "one run or two, not 3"),
        (["-o", "run.pdf"], "end it in .html"),
        (["-o", "nowhere/run.html"], "there is no folder nowhere"),
        (["-o", "."], "is a folder"),
        (["-o", f"{'a' * 300}.html"], "cannot be written"),
        (["--max-mb", "1"], "--max-mb 1 must be from 2 to 100"),
        (["--signal", "nope"], "No signal 'nope' is recorded"),
        (["--robot", "nobody"], "nobody"),
    ],
)
def test_the_command_says_what_was_asked_wrongly(
    file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["report", *options, "--database", str(file)]) == 2
    assert says in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["data"]


@pytest.mark.anyio
async def test_the_tool_writes_into_the_data_folder_and_tells_the_truth_about_it(
    file: Path,
) -> None:
    async with client_on(file, read_only=False) as client:
        answer = await ask(client, "webots_report")
        written = Path(answer["file"])
        assert written == file.parent / "reports" / "run-1.html"
        assert answer["size_bytes"] == written.stat().st_size
        assert answer["holds"]["figures"] == 1
        assert "is there already" in await fail(client, "webots_report", run_ids=[1])
        again = await ask(client, "webots_report", run_ids=[1], overwrite=True)
        assert again["file"] == answer["file"]


@pytest.mark.anyio
async def test_the_tool_writes_nowhere_else_and_refuses_what_is_not_there(file: Path) -> None:
    async with client_on(file, read_only=False) as client:
        for outside in ("../run.html", "/tmp/run.html"):
            assert "outside the data folder" in await fail(client, "webots_report", file=outside)
        assert "not a usable path" in await fail(client, "webots_report", file="a\0.html")
        assert "No run 8 is" in await fail(client, "webots_report", run_ids=[8])
        assert "two" in await fail(client, "webots_report", run_ids=[1, 2, 3])
        assert "end it in .html" in await fail(client, "webots_report", file="webots.db")
    assert not (file.parent / "reports").exists()
