"""An id that a state had is never given to another one, whatever was deleted in between."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.older_recording import make_older
from tests.recordings.runs import Recorded, states
from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.database.schema_migration import in_current_schema
from webots_mcp.database.waiting_file import STATEMENTS
from webots_mcp.errors import ForeignDatabaseError
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.merging import merge, settled
from webots_mcp.store.purge import prune

ROWS = 10


def recording(folder: Path) -> sqlite3.Connection:
    """A recording with two runs of ten states each."""
    folder.mkdir()
    connection = connect(folder / "webots.db", "writer", create=True)
    create_schema(connection)
    recorded = Recorded(connection, folder)
    for _ in range(2):
        run_id = recorded.add_run(ROWS)
        for table in ("session", "run"):
            connection.execute(
                f"UPDATE {table} SET uuid = ? WHERE id = (SELECT max(id) FROM {table})",
                (new_uuid(),),
            )
        assert chunk_whole_run(connection, run_id)
    return connection


def publish(connection: sqlite3.Connection) -> int:
    """Write a state as a bridge does, and return its id."""
    (run_id,) = connection.execute("SELECT min(id) FROM run").fetchone()
    if run_id is None:
        (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
        connection.execute("DELETE FROM robot")
        run_id = Recorded(connection, Path(file).parent).add_run(0)
    cursor = connection.execute(STATEMENTS["state"], (run_id, 99.0, 99.0, "{}", None))
    return int(cursor.lastrowid or 0)


def newest(connection: sqlite3.Connection) -> int:
    return int(connection.execute("SELECT max(id) FROM state").fetchone()[0])


DELETIONS: dict[str, Callable[[sqlite3.Connection], object]] = {
    "the newest": lambda c: c.execute("DELETE FROM state WHERE id = (SELECT max(id) FROM state)"),
    "several, oldest first": lambda c: c.execute("DELETE FROM state WHERE id > 7"),
    "several, newest first": lambda c: [
        c.execute("DELETE FROM state WHERE id = ?", (row_id,)) for row_id in range(2 * ROWS, 7, -1)
    ],
    "all": lambda c: c.execute("DELETE FROM state"),
    "the newest run": lambda c: c.execute("DELETE FROM run WHERE id = (SELECT max(id) FROM run)"),
    "all runs": lambda c: c.execute("DELETE FROM run"),
    "all sessions": lambda c: c.execute("DELETE FROM session"),
}


@pytest.mark.parametrize("then", ["at once", "VACUUM", "opened again"])
@pytest.mark.parametrize("deleted", DELETIONS)
def test_no_id_returns_after_a_deletion(tmp_path: Path, deleted: str, then: str) -> None:
    connection = recording(tmp_path / "here")
    before = newest(connection)
    DELETIONS[deleted](connection)
    if then == "VACUUM":
        connection.execute("VACUUM")
    if then == "opened again":
        connection.close()
        connection = connect(tmp_path / "here" / "webots.db", "writer")
    with closing(connection):
        assert publish(connection) == before + 1
        assert publish(connection) == before + 2


def test_no_id_returns_after_retention_has_deleted_all_states(tmp_path: Path) -> None:
    with closing(recording(tmp_path / "here")) as connection:
        before = newest(connection)
        prune(connection, tmp_path / "here", states(size_bytes=0), rest=False)
        assert connection.execute("SELECT count(*) FROM state").fetchone() == (0,)
        assert publish(connection) == before + 1


def test_ids_of_an_imported_run_without_states_are_not_given_to_others(tmp_path: Path) -> None:
    with closing(recording(tmp_path / "there")) as there:
        prune(there, tmp_path / "there", states(size_bytes=0), rest=False)
    with closing(recording(tmp_path / "here")) as here:
        merge(here, tmp_path / "here", tmp_path / "there" / "webots.db")
        (last,) = here.execute("SELECT max(max_state_id) FROM row_group").fetchone()
        assert last == 4 * ROWS
        assert publish(here) == last + 1


def test_an_import_after_a_deletion_gives_no_id_again(tmp_path: Path) -> None:
    recording(tmp_path / "there").close()
    with closing(recording(tmp_path / "here")) as here:
        here.execute("DELETE FROM state WHERE id > 5")
        merge(here, tmp_path / "here", tmp_path / "there" / "webots.db")
        ids = [row_id for (row_id,) in here.execute("SELECT id FROM state ORDER BY id")]
        assert ids == [1, 2, 3, 4, 5, *range(2 * ROWS + 1, 4 * ROWS + 1)]
        assert publish(here) == 4 * ROWS + 1


# -- a recording of the version before ---------------------------------------------------------


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """A recording of the previous schema, with the rows of a current one."""
    recording(tmp_path / "current").close()
    folder = tmp_path / "older"
    folder.mkdir()
    shutil.copytree(tmp_path / "current" / "camera", folder / "camera")
    make_older(folder / "webots.db")
    with closing(connect(folder / "webots.db", "writer")) as connection:
        connection.execute("PRAGMA foreign_keys=OFF")
        connection.execute("ATTACH ? AS current", (f"{tmp_path / 'current' / 'webots.db'}",))
        query = "SELECT name FROM main.sqlite_master WHERE type = 'table'"
        for (table,) in connection.execute(query).fetchall():
            if table not in ("alembic_version", "recording") and not table.startswith("sqlite_"):
                connection.execute(f"INSERT INTO main.{table} SELECT * FROM current.{table}")
    return folder / "webots.db"


def test_a_recording_of_the_version_before_comes_in_whole_and_stays_as_it_was(
    tmp_path: Path, older: Path
) -> None:
    content = older.read_bytes()
    with in_current_schema(older) as current, closing(recording(tmp_path / "here")) as here:
        assert current != older
        settled(current)
        merge(here, tmp_path / "here", current, pictures=older.parent)
        assert here.execute("SELECT count(*) FROM state").fetchone() == (4 * ROWS,)
        assert here.execute("SELECT count(*) FROM log").fetchone() == (2 * ROWS,)
        assert len(list((tmp_path / "here").rglob("*.png"))) == 4
    assert older.read_bytes() == content
    assert not current.exists()


def test_a_current_recording_is_read_where_it_is(tmp_path: Path) -> None:
    recording(tmp_path / "here").close()
    with in_current_schema(tmp_path / "here" / "webots.db") as current:
        assert current == tmp_path / "here" / "webots.db"


def test_an_older_recording_that_runs_code_of_others_is_refused(older: Path) -> None:
    with closing(sqlite3.connect(older)) as connection:
        connection.executescript(
            "DROP TABLE log; CREATE VIEW log AS SELECT randomblob(100) AS message;"
        )
    with pytest.raises(ForeignDatabaseError, match="'log'"), in_current_schema(older):
        pass
