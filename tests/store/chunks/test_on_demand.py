"""Who asks first puts into chunks what no server has."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.long import build
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.store.chunk_making import MIN_ROWS_ON_DEMAND, make_missing_chunks
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.slow

ROWS = 4 * MIN_ROWS_ON_DEMAND


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("long") / "webots.db"
    build(file, ROWS, chunked=False)
    return file


@pytest.fixture
def recording(built: Path, tmp_path: Path) -> Iterator[RecordingAccess]:
    shutil.copy(built, tmp_path / "webots.db")
    yield RecordingAccess(tmp_path / "webots.db", tmp_path, read_only=True)


def in_chunks(recording: RecordingAccess) -> int:
    with recording.reader() as connection:
        return connection.execute("SELECT total(row_count) FROM row_group").fetchone()[0]


def hold_lease(recording: RecordingAccess, holder: str) -> None:
    with closing(connect(recording.database, "writer")) as connection:
        values = ("maintainer", f"{holder} 1 ab", time.time() + 5)
        connection.execute("INSERT INTO lease VALUES (?, ?, ?)", values)


def test_all_rows_are_put_into_chunks_and_counted_on_the_way(recording: RecordingAccess) -> None:
    told: list[tuple[int, int]] = []
    assert make_missing_chunks(recording, lambda done, of: told.append((done, of))) == ""
    assert in_chunks(recording) == ROWS
    assert told == sorted(told)
    assert told[-1] == (ROWS, ROWS)


def test_a_server_that_maintains_it_is_left_to_it(recording: RecordingAccess) -> None:
    hold_lease(recording, "server")
    assert make_missing_chunks(recording).startswith(
        f"the newest {ROWS} rows are in no chunk yet: the serv"
    )
    assert in_chunks(recording) == 0


def test_beside_a_bridge_it_is_done_because_a_bridge_does_not(recording: RecordingAccess) -> None:
    hold_lease(recording, "bridge")
    assert make_missing_chunks(recording) == ""
    assert in_chunks(recording) == ROWS


def test_what_is_called_off_or_interrupted_goes_on_with_the_next_question(
    recording: RecordingAccess,
) -> None:
    assert "ask again" in make_missing_chunks(recording, called_off=lambda: True)
    first = in_chunks(recording)
    assert MIN_ROWS_ON_DEMAND <= first < ROWS

    def interrupt(_done: int, _of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_missing_chunks(recording, interrupt)
    assert first < in_chunks(recording)
    assert make_missing_chunks(recording) == ""
    assert in_chunks(recording) == ROWS


def test_a_database_that_another_holds_locked_is_read_as_it_is(recording: RecordingAccess) -> None:
    with closing(connect(recording.database, "writer")) as other:
        other.execute("BEGIN IMMEDIATE")
        assert "stayed locked by another process" in make_missing_chunks(recording)
    assert in_chunks(recording) == 0


@pytest.mark.parametrize(
    "command",
    [
        ["history", "mode"],
        ["trends"],
        ["events"],
        ["signals"],
        ["compare", "1"],
        ["plot", "mode", "-o", "x.png"],
        ["report", "-o", "x.html"],
    ],
    ids=lambda command: command[0],
)
def test_questions_of_the_command_line_make_chunks_before_they_answer(
    recording: RecordingAccess,
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--database", "webots.db"]) == 0
    assert in_chunks(recording) == ROWS
    told = (
        capsys.readouterr().err
    )  # nothing, or how far it was after the two seconds of a slow machine
    assert [line for line in told.splitlines() if "preparing statistics" not in line] == []


def test_a_question_says_that_another_is_still_at_it(
    recording: RecordingAccess, capsys: pytest.CaptureFixture[str]
) -> None:
    hold_lease(recording, "server")
    assert main(["history", "mode", "--database", str(recording.database)]) == 0
    assert f"the newest {ROWS} rows are in no chunk yet" in capsys.readouterr().err
