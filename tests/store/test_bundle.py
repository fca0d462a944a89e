"""A run goes out as a file and comes in elsewhere as what it was, once; all else is refused."""

from __future__ import annotations

import sqlite3
import stat
import sys
import zipfile
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.runs import Recorded
from webots_mcp import MCPBridge
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import DatabaseError, InvalidInputError
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.merging import BundleLimits, is_bundle, merge, settled, unpacked, write_bundle
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

OF_RUN = ("state", "kept_stretch", "kept_state", "log", "event", "image", "parameter_value")
# What a row is called, and where it stands, in each recording; and whether it is in chunks.
LOCAL = {
    "id", "run_id", "session_id", "robot_id", "command_id", "trial_set_id", "path",
    "is_chunked", "idempotency_key",
}  # fmt: skip


class Folder:
    """A recording in a folder of its own."""

    def __init__(self, path: Path) -> None:
        path.mkdir(exist_ok=True)
        self.path, self.database = path, path / DATABASE_NAME

    @contextmanager
    def opened(self) -> Generator[sqlite3.Connection]:
        with closing(connect(self.database, "writer", create=True)) as connection:
            create_schema(connection)
            yield connection

    def bundled(self, run_id: int) -> Path:
        file = self.path.parent / f"run{run_id}.zip"
        with closing(connect(self.database, "reader")) as connection:
            write_bundle(connection, self.database, self.path, run_id, file)
        return file

    def ingest(self, bundle: Path) -> list[int]:
        with unpacked(bundle) as source, self.opened() as connection:
            settled(source)
            return list(merge(connection, self.path, source).values())

    def everything(self, run_id: int) -> dict[str, Any]:
        """All of a run but what names it here, with the bytes of its pictures."""
        with self.opened() as connection:
            found = {
                each: rows(connection, each, f"run_id = {run_id} ORDER BY id") for each in OF_RUN
            }
            found["run"] = rows(connection, "run", f"id = {run_id}")
            session = f"(SELECT session_id FROM run WHERE id = {run_id})"
            found["session"] = rows(connection, "session", f"id = {session}")
            found["command"] = rows(connection, "command", f"session_id = {session} ORDER BY id")
            found["trial"] = rows(connection, "trial", f"run_id = {run_id} ORDER BY id")
            query = f"SELECT path FROM image WHERE run_id = {run_id} ORDER BY id"
            pictures = [self.path / path for (path,) in connection.execute(query)]
        found["pictures"] = [each.read_bytes() if each.exists() else None for each in pictures]
        return found


def rows(connection: sqlite3.Connection, table: str, where: str) -> list[Any]:
    names = [name for (_, name, *_) in connection.execute(f"PRAGMA table_info({table})")]
    columns = ", ".join(name for name in names if name not in LOCAL)
    return connection.execute(f"SELECT {columns} FROM {table} WHERE {where}").fetchall()


def counts(connection: sqlite3.Connection) -> dict[str, int]:
    tables = (*OF_RUN, "run", "session", "command", "trial", "trial_set", "robot")
    return {
        table: connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in tables
    }


@pytest.fixture
def there(tmp_path: Path) -> Folder:
    """Two runs of a session each, with pictures, commands, parameters and a trial."""
    folder = Folder(tmp_path / "there")
    with folder.opened() as connection:
        recorded = Recorded(connection, folder.path)
        for count in (10, 6):
            recorded.add_run(count)
        for table in ("session", "run"):
            for (key,) in connection.execute(f"SELECT id FROM {table}").fetchall():
                connection.execute(f"UPDATE {table} SET uuid = ? WHERE id = ?", (new_uuid(), key))
        connection.execute("UPDATE parameter_value SET command_id = run_id")
        set_id = create_trial_set(connection, "{}", [{"kp": 1.0}, {"kp": 2.0}, {"kp": 3.0}])
        for trial, run_id in zip(trials_of(connection, set_id), (1, 2), strict=False):
            finish_trial(connection, trial, TrialResult(run_id, 1.5 * run_id, None))
    return folder


@pytest.fixture
def here(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "here")


def test_a_run_comes_into_an_empty_recording_as_what_it_was(there: Folder, here: Folder) -> None:
    assert here.ingest(there.bundled(2)) == [1]
    before, after = there.everything(2), here.everything(1)
    assert after == before
    assert [len(before[name]) for name in ("state", "command", "trial")] == [6, 1, 1]
    with here.opened() as connection:
        (set_by,) = connection.execute("SELECT command_id FROM parameter_value").fetchone()
        assert connection.execute("SELECT action FROM command WHERE id = ?", (set_by,)).fetchone()


def test_what_a_bridge_recorded_comes_with_kept_stretches_and_frames(
    tmp_path: Path, here: Folder
) -> None:
    there = Folder(tmp_path / "there")
    robot = InProcessSupervisor("rover")
    camera = robot.getDevice("camera")
    camera.enable(16)
    with MCPBridge(robot, database=there.database) as bridge:
        bridge.keep_camera(camera)
        bridge.parameter("kp", 2.0)
        for number in range(100):
            robot.step(16)
            bridge.publish({"n": number, "odd": float("nan")})
        bridge.log("a line")
        bridge.keep("a look")
    assert here.ingest(there.bundled(1)) == [1]
    before = there.everything(1)
    assert here.everything(1) == before
    assert all(before[name] for name in ("kept_stretch", "kept_state", "image", "log", "event"))


def test_a_run_that_is_there_is_not_doubled(there: Folder, here: Folder) -> None:
    bundle = there.bundled(1)
    with here.opened() as connection:
        Recorded(connection, here.path).add_run(3)
        assert here.ingest(bundle) == [2]
        once = counts(connection)
        assert here.ingest(bundle) == [2]
        assert counts(connection) == once


def test_runs_of_one_session_come_one_by_one(there: Folder, here: Folder) -> None:
    with there.opened() as connection:
        connection.execute(
            "UPDATE run SET session_id = 1, started_wall_time_s = started_wall_time_s"
        )
        connection.execute("UPDATE command SET session_id = 1")
    bundles = [there.bundled(run_id) for run_id in (1, 2)]
    for bundle in (bundles[1], bundles[0], bundles[1]):
        here.ingest(bundle)
    with there.opened() as before, here.opened() as after:
        runs = "SELECT uuid FROM run ORDER BY uuid"
        assert after.execute(runs).fetchall() == before.execute(runs).fetchall()
        assert counts(after) == counts(before) | {"session": 1, "trial": 2}
        merge(after, here.path, there.database)
        assert counts(after) == counts(before)


def test_a_bundle_of_a_bundle_is_the_same(there: Folder, here: Folder, tmp_path: Path) -> None:
    here.ingest(there.bundled(1))
    last = Folder(tmp_path / "last")
    last.ingest(here.bundled(1))
    assert last.everything(1) == there.everything(1)
    with here.opened() as one, last.opened() as other:
        paths = "SELECT path FROM image"
        assert other.execute(paths).fetchall() == one.execute(paths).fetchall()


def test_of_a_session_that_goes_on_a_run_that_is_over_can_be_sent(
    there: Folder, here: Folder
) -> None:
    with there.opened() as connection:
        connection.execute("UPDATE session SET ended_wall_time_s = NULL")
    here.ingest(there.bundled(1))
    with here.opened() as connection:
        query = (
            "SELECT s.end_reason, s.ended_wall_time_s = r.ended_wall_time_s FROM session s, run r"
        )
        assert connection.execute(query).fetchall() == [("finished", 1)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("UPDATE run SET ended_wall_time_s = NULL WHERE id = 2", "still records run 2"),
        ("UPDATE run SET uuid = NULL WHERE id = 2", "run 2 has no UUID"),
    ],
)
def test_what_goes_on_or_has_no_name_is_no_bundle_and_no_matter_for_others(
    there: Folder, change: str, said: str
) -> None:
    with there.opened() as connection:
        connection.execute(change)
    with pytest.raises(InvalidInputError, match=said):
        there.bundled(2)
    assert there.bundled(1).exists()


def test_an_export_that_breaks_off_leaves_nothing(there: Folder) -> None:
    file = there.path.parent / "run.zip"

    def fail(*_: int) -> None:
        raise OSError("the disk is full")

    with closing(connect(there.database, "reader")) as connection, pytest.raises(OSError):
        write_bundle(connection, there.database, there.path, 1, file, fail)
    assert not list(there.path.parent.glob(".bundle-*"))


# -- what others may send -------------------------------------------------------------------------


def changed(bundle: Path, change: Callable[[zipfile.ZipFile], None]) -> Path:
    with zipfile.ZipFile(bundle, "a") as archive:
        change(archive)
    return bundle


def called(name: str) -> Callable[[zipfile.ZipFile], None]:
    return lambda archive: archive.writestr(name, "x")


def link(archive: zipfile.ZipFile) -> None:
    entry = zipfile.ZipInfo("camera/a.png")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    archive.writestr(entry, "/etc/passwd")


def bomb(archive: zipfile.ZipFile) -> None:
    for number in range(3):
        archive.writestr(f"camera/{number}.png", b"\0" * 4_000_000, zipfile.ZIP_DEFLATED)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (called("../evil.png"), r"'\.\./evil\.png', which no"),
        (called("camera/../../evil.png"), "which no bundle does"),
        (called("/tmp/evil.png"), "which no bundle does"),
        (called("C:\\evil.png"), "which no bundle does"),
        (called("camera/run.sh"), "which no bundle does"),
        (called("webots.db-wal"), "which no bundle does"),
        (link, "which no bundle does"),
        (bomb, "would unpack to"),
    ],
)  # fmt: skip
def test_what_is_no_part_of_a_bundle_is_not_unpacked(
    there: Folder,
    here: Folder,
    change: Callable[[zipfile.ZipFile], None],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("webots_mcp.store.merging._BUNDLE", BundleLimits(harmless_bytes=1_000_000))
    with pytest.raises(InvalidInputError, match=said):
        here.ingest(changed(there.bundled(1), change))
    assert not here.database.exists()
    assert not list(here.path.parent.rglob("evil*"))


def test_an_archive_without_a_database_is_no_bundle(tmp_path: Path, here: Folder) -> None:
    file = tmp_path / "photos.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("camera/a.png", "x")
    with pytest.raises(InvalidInputError, match=r"holds no webots\.db"):
        here.ingest(file)


@pytest.mark.parametrize("where", [-30, 200, 20_000])
def test_a_damaged_bundle_is_told_as_such(there: Folder, here: Folder, where: int) -> None:
    bundle = there.bundled(1)
    data = bytearray(bundle.read_bytes())
    place = where if where < 0 else min(where, len(data) // 2)
    data[place : place + 8] = bytes(each ^ 0xFF for each in data[place : place + 8])
    bundle.write_bytes(data)
    assert is_bundle(bundle)
    with pytest.raises(InvalidInputError, match="damaged"):
        here.ingest(bundle)
    bundle.write_bytes(data[: len(data) // 2])
    with pytest.raises(InvalidInputError, match="damaged"):
        here.ingest(bundle)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ("PRAGMA user_version = 999", DatabaseError, "upgrade"),
        ("PRAGMA application_id = 1", DatabaseError, "another application|not"),
        ("UPDATE image SET path = '../secret.png'", InvalidInputError, "outside the data folder"),
        ("UPDATE run SET uuid = '../../../x'", InvalidInputError, "outside the data folder"),
    ],
)
def test_a_database_that_is_none_of_ours_is_refused(
    there: Folder, here: Folder, change: str, error: type[Exception], said: str
) -> None:
    bundle = there.bundled(1)
    with unpacked(bundle) as source:
        (source.parent.parent / "secret.png").write_bytes(b"secret")
        with closing(sqlite3.connect(source)) as connection:
            connection.execute(change)
            connection.commit()
        with zipfile.ZipFile(bundle) as archive:
            pictures = {each: archive.read(each) for each in archive.namelist() if "/" in each}
        with zipfile.ZipFile(bundle, "w") as archive:
            archive.write(source, DATABASE_NAME)
            for name, data in pictures.items():
                archive.writestr(name, data)
        (source.parent.parent / "secret.png").unlink()
    with pytest.raises(error, match=said):
        here.ingest(bundle)
    with here.opened() as connection:
        assert counts(connection)["run"] == 0
    assert not list(here.path.rglob("*.png"))


@pytest.mark.parametrize(
    ("uuid", "path", "said"),
    [
        ("webots", "webots.db", "not the name of a picture"),
        ("front", "camera/front.000001.png", None),
    ],
)
def test_no_file_that_is_here_is_replaced_whatever_a_foreign_recording_calls_its_pictures(
    there: Folder, here: Folder, uuid: str, path: str, said: str | None
) -> None:
    here.ingest(there.bundled(2))
    own = here.path / "camera" / "front.000001.png"
    own.parent.mkdir(exist_ok=True)
    own.write_bytes(b"own")
    before = here.everything(1)
    bundle = there.bundled(1)
    with unpacked(bundle) as source:
        with closing(sqlite3.connect(source)) as foreign, foreign:
            foreign.execute("UPDATE run SET uuid = ?", (uuid,))
            foreign.execute("UPDATE image SET path = ?", (path,))
        with zipfile.ZipFile(bundle, "w") as archive:
            archive.write(source, DATABASE_NAME)
            archive.writestr("camera/front.000001.png", b"theirs")
    with pytest.raises(InvalidInputError, match=said) if said else nullcontext():
        here.ingest(bundle)
    assert here.everything(1) == before
    assert own.read_bytes() == b"own"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no file's size")
def test_where_there_is_no_room_to_unpack_a_bundle_that_is_said(there: Folder) -> None:
    import resource

    bundle = there.bundled(1)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(InvalidInputError, match="cannot be unpacked in"), unpacked(bundle):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
