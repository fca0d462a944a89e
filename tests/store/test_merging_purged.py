"""Of a run that lost rows what is left comes along: its chunks, and all answers from them."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.answers import answers
from tests.recordings.rounds import PART, ROWS, record_rounds
from tests.recordings.rover import Recorder, rover_state, start_run
from tests.store.retention.test_chunks import framed
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.merging import merge, unpacked, write_bundle
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.runs import run_info

pytestmark = pytest.mark.slow

SIGNALS = (
    "SELECT name, kind, unit, path, reduction, role FROM signal "
    "WHERE robot_id = (SELECT id FROM robot WHERE name = 'rover') AND name NOT GLOB 'pose*' "
    "AND name <> 'mode'"
)


@pytest.fixture(scope="module")
def _whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("whole") / DATABASE_NAME
    record_rounds(file)
    return file


NONE_OR_SOME_LEFT = pytest.mark.parametrize("source", [0, 1500], indirect=True)


@pytest.fixture
def source(_whole: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """With that many rows left of the long run: some, if nobody asks for others."""
    left = getattr(request, "param", 1500)
    folder = tmp_path / "there"
    folder.mkdir()
    shutil.copy(_whole, folder / DATABASE_NAME)
    with closing(connect(folder / DATABASE_NAME, "writer")) as connection:
        connection.execute("UPDATE run SET keep = 1 WHERE id = 2")
        prune(connection, folder, Retention(state=Limit(rows=left), outlive=0), rest=False)
    return folder / DATABASE_NAME


@pytest.fixture
def target(tmp_path: Path) -> Iterator[sqlite3.Connection]:
    """The same robot recorded here before, after another: its signals have other ids."""
    folder = tmp_path / "here"
    folder.mkdir()
    with closing(connect(folder / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        for robot in ("truck", "rover"):
            recorder = start_run(connection, robot)
            for step in range(40):
                recorder.publish(step * 1.0, {"mode": "cruise", "pose": [step, 0.0]})
            recorder.end_run("finished")
        connection.execute("UPDATE session SET ended_wall_time_s = 2e9, end_reason = 'finished'")
        assert make_chunks(connection, 1000).done
        yield connection


@NONE_OR_SOME_LEFT
def test_a_purged_run_comes_once_with_every_answer_and_is_left_as_it_is(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    tables = ("state", "signal", "row_group", "chunk", "run")
    with closing(connect(source, "reader")) as there:
        (uuid,) = there.execute("SELECT uuid FROM run WHERE id = 1").fetchone()
        merged = merge(target, tmp_path / "here", source)
        run = merged[uuid]
        before, after = run_info(there, 1), run_info(target, run)
        assert after.purged_rows == before.purged_rows > 0
        assert answers(target, run, PART) == answers(there, 1, PART)
        assert target.execute(SIGNALS).fetchall() == there.execute(SIGNALS).fetchall()
        known, here = framed(there, 1), framed(target, run)
        for name in ("battery_v", "mode", "pose.0"):
            assert here.values(name) == known.values(name)
    assert len(here) == ROWS and here.unread == ()
    left = target.execute("SELECT id FROM state WHERE run_id = ? ORDER BY id", (run,)).fetchall()
    assert [row_id for (row_id,) in left] == here.ids.tolist()[ROWS - len(left) :]
    everything = [target.execute(f"SELECT * FROM {table}").fetchall() for table in tables]
    assert merge(target, tmp_path / "here", source) == merged
    assert [target.execute(f"SELECT * FROM {each}").fetchall() for each in tables] == everything
    made = [f"SELECT * FROM {table} WHERE run_id = {run}" for table in ("row_group", "chunk")]
    chunks = [target.execute(each).fetchall() for each in made]
    assert make_chunks(target, 100_000).done
    assert [target.execute(each).fetchall() for each in made] == chunks


def test_rows_that_were_in_no_chunk_there_are_put_into_one_here(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    with closing(connect(source, "writer")) as there:
        late = Recorder(there)
        late.run_id, late.run_start_s = 1, late.wall_s
        for step in range(300):
            late.publish((ROWS + step) * 0.2, *rover_state(0.0))
        late.end_run("finished")
        there.execute("UPDATE run SET row_count = row_count + 300, is_chunked = 0 WHERE id = 1")
    run = merge(target, tmp_path / "here", source, run_id=1).popitem()[1]

    assert make_chunks(target, 100_000).done

    chunked = "SELECT sum(row_count), max(end_sim_time_s) FROM row_group WHERE run_id = ?"
    assert target.execute(chunked, (run,)).fetchone() == (ROWS + 300, (ROWS + 299) * 0.2)


def test_a_purged_run_goes_as_a_bundle_from_one_to_the_next(source: Path, tmp_path: Path) -> None:
    with closing(connect(source, "reader")) as there:
        expected = answers(there, 1, PART)
    database = source
    for name in ("second", "third"):
        folder = tmp_path / name
        folder.mkdir()
        with closing(connect(database, "reader")) as reader:
            write_bundle(reader, database, database.parent, 1, folder / "run.zip")
        database = folder / DATABASE_NAME
        with (
            closing(connect(database, "writer", create=True)) as writer,
            unpacked(folder / "run.zip") as small,
        ):
            create_schema(writer)
            merge(writer, folder, small)
            assert answers(writer, 1, PART) == expected


def test_a_signal_that_is_text_here_and_a_number_there_is_text(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    recorder = Recorder(target)
    recorder.run_id, recorder.run_start_s = 2, recorder.wall_s
    recorder.publish(41.0, {"battery_v": "full"})
    assert chunk_whole_run(target, 2)

    run = merge(target, tmp_path / "here", source, run_id=1).popitem()[1]

    (kind,) = target.execute("SELECT kind FROM signal WHERE name = 'battery_v'").fetchone()
    assert kind == "text"
    assert answers(target, run, PART)["trends"]


def test_ids_that_no_bridge_gives_are_refused(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    with closing(connect(source, "writer")) as there:
        there.execute("UPDATE row_group SET max_state_id = ? WHERE id = 1", (2**52,))
    with pytest.raises(InvalidInputError, match=f"to {2**52}, which no bridge gives"):
        merge(target, tmp_path / "here", source)
    assert target.execute("SELECT count(*) FROM run").fetchone() == (2,)
