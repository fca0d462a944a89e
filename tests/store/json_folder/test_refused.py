"""A folder that cannot be imported whole leaves nothing behind, and the message names why."""

from __future__ import annotations

import os
import sqlite3
import sys
from pathlib import Path

import pytest

from tests.store.json_folder.conftest import Peer, counts
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.json_folder import import_folder

BAD = [
    ("status.json", '{"pose": [1, 2,\n  }', r"status\.json, line 2, column 3: not valid JSON"),
    ("status.json", "", r"status\.json is empty: its controller ended"),
    ("status.json", "[1, 2]", r"status\.json: a state is an object, this is a list"),
    ("status.json", b'{"a": "\xff"}', r"status\.json: not valid JSON"),
    ("status.json", '{"timestamp": "yesterday"}', "timestamp 'yesterday' is not an ISO 8601 time"),
    ("logs/controller.log", "no time\n", r"controller\.log, line 1: expected '\[HH:MM:SS\]"),
    ("logs/controller.log", "\n[12:00:00] a\n[12:61:00] b\n", r"line 3: \[12:61:00\] is not a"),
    ("camera/frame_0000.png", b"\x89PNG\r\n\x1a\n but then not", r"frame_0000\.png is not a"),
    ("camera/frame_0000.png", b"", r"frame_0000\.png is not a usable PNG"),
    ("commands.json", '[{"action": "a"}, 3]', r"commands\.json: a command is an object"),
    ("commands.json", "{", r"commands\.json, line 1, column 2"),
    (
        "status.json",
        '{"x": ' + "9" * 100_000 + "}",
        r"not valid JSON: Exceeds the limit",
    ),
    ("status.json", '{"x": ' + "[" * 900 + "]" * 900 + "}", "nested over 100 levels, at 'x'"),
    ("status.json", '{"x": ' + "[" * 90_000, r"status\.json: not valid JSON"),
    ("status.json", '{"x": "' + "y" * 16_000_000 + '"}', "16,000,000 is the limit"),
    ("status.json", '{"timestamp": "' + "9" * 9000 + '"}', r"timestamp '9{50,99} is not an ISO"),
    ("commands.json", '{"action": {"a": ' + "[" * 900 + "]" * 900 + "}}", "nested over 100"),
    (
        "logs/controller.log",
        b"[00:00:01]\n[00:00:00]\n" * 800_000,
        "its clock goes back 800,000 times",
    ),
]


@pytest.mark.parametrize(("name", "content", "message"), BAD)
def test_a_bad_file_is_named_and_nothing_is_imported(
    peer: Peer,
    database: sqlite3.Connection,
    data_dir: Path,
    name: str,
    content: str | bytes,
    message: str,
) -> None:
    peer.everything()
    peer.write(name, content)
    with pytest.raises(InvalidInputError, match=message):
        import_folder(database, peer.folder, data_dir)
    assert set(counts(database).values()) == {0}
    assert not list(data_dir.rglob("*.png"))


@pytest.mark.skipif(sys.platform == "win32", reason="pipes and devices of POSIX")
@pytest.mark.parametrize("name", ["status.json", "camera/frame_0000.png"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_may_never_end_is_not_read(
    peer: Peer, database: sqlite3.Connection, data_dir: Path, name: str, kind: str
) -> None:
    peer.everything()
    file = peer.folder / name
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    else:
        file.mkdir()
    with pytest.raises(InvalidInputError, match=f"{file.name} is not a regular file"):
        import_folder(database, peer.folder, data_dir)
    assert set(counts(database).values()) == {0}


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text exist on Linux only")
def test_a_picture_whose_name_is_no_text_is_refused(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    picture = peer.picture("camera/frame.png")
    picture.rename(os.fsdecode(os.fsencode(picture.with_name("frame")) + b"\xff.png"))
    with pytest.raises(InvalidInputError, match="is not valid text: rename the file"):
        import_folder(database, peer.folder, data_dir)


def test_a_failure_half_way_takes_everything_back(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.everything()
    peer.write("logs/controller.log", "[12:00:00] line\n" * 2000)

    def fail(done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_folder(database, peer.folder, data_dir, progress=fail)
    assert set(counts(database).values()) == {0}
    assert not list(data_dir.rglob("*.png"))
    assert import_folder(database, peer.folder, data_dir).lines == 2000


def test_a_robots_own_recording_is_not_mixed_with_an_import(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.everything()
    import_folder(database, peer.folder, data_dir, "rover")
    peer.write("logs/controller.log", "[12:00:00] another\n")
    with pytest.raises(InvalidInputError, match="choose another name"):
        import_folder(database, peer.folder, data_dir, "rover")


@pytest.mark.parametrize("name", ["", "  ", "rover\udcff"])
def test_a_robot_needs_a_name(
    peer: Peer, database: sqlite3.Connection, data_dir: Path, name: str
) -> None:
    peer.everything()
    with pytest.raises(InvalidInputError, match="needs a name"):
        import_folder(database, peer.folder, data_dir, name)


def test_a_folder_without_anything_to_import_says_what_was_looked_for(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.folder.mkdir()
    with pytest.raises(InvalidInputError, match=r"no status\.json, no logs/controller\.log"):
        import_folder(database, peer.folder, data_dir)
