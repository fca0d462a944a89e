"""One run as a file to send: a ZIP archive with a small recording of its own and its pictures."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import zipfile
import zlib
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import Final

from webots_mcp.connection import FrozenConnection, connect
from webots_mcp.contract import DATABASE_NAME, PRIVATE_FILE
from webots_mcp.errors import InvalidInputError
from webots_mcp.schema import create_schema
from webots_mcp.store.export.export_rows import Progress
from webots_mcp.store.images import MAX_FILE_BYTES, PICTURES
from webots_mcp.store.merging import merge

_PIECE_BYTES: Final = 1_000_000
# Rows that are all alike become a fiftieth of their size; who unpacks to far more wants to harm.
_MOST_TIMES: Final = 100
_HARMLESS_BYTES: Final = 100_000_000
_LINK: Final = 0o120000  # of a file's type in Unix, as archives keep it
END_SESSIONS: Final = (  # with the last of their runs that is here
    "UPDATE session SET ended_wall_time_s = (SELECT max(ended_wall_time_s) FROM run "
    "WHERE session_id = session.id), end_reason = 'finished' WHERE ended_wall_time_s IS NULL"
)
_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)


def write_bundle(
    connection: sqlite3.Connection,
    database: Path,
    data_dir: Path,
    run_id: int,
    file: Path,
    progress: Progress | None = None,
) -> None:
    """Write a run that is over: everything of it that `merge` takes in, and its pictures.

    Where its session still records, the session in the bundle ends with the run.

    Args:
        connection: A reader of the recording.
        database: The recording.
        data_dir: The folder of its pictures.
        run_id: The run.
        file: To write to, in a folder with room for the rows that are not compressed.
        progress: Called now and then with the bytes that are packed and that there are.

    Raises:
        InvalidInputError: The run goes on, or has no UUID.
    """
    with tempfile.TemporaryDirectory(prefix=".bundle-", dir=file.parent) as name:
        folder = Path(name)
        with small_recording(folder) as writer:
            frozen = "&immutable=1" if isinstance(connection, FrozenConnection) else ""
            address = f"{database.absolute().as_uri()}?mode=ro{frozen}"
            merge(writer, folder, database, run_id=run_id, address=address, pictures=data_dir)
            writer.execute(END_SESSIONS)
        pack(folder, file, progress)


@contextmanager
def small_recording(folder: Path) -> Generator[sqlite3.Connection]:
    """A new recording to write in that folder, in one file, and not to keep."""
    with closing(connect(folder / DATABASE_NAME, "writer", create=True)) as writer:
        create_schema(writer)
        writer.execute("PRAGMA journal_mode=DELETE")  # all of it in the one file, written once
        writer.execute("PRAGMA synchronous=OFF")  # a killed process leaves nothing worth keeping
        yield writer


def pack(folder: Path, file: Path, progress: Progress | None = None) -> None:
    """Write only the database of a folder, which no process has open, and its pictures.

    Args:
        folder: Of the recording.
        file: To write to.
        progress: As in `write_bundle`.
    """
    found = [each for each in sorted(folder.rglob("*.*")) if _is_packed(each.relative_to(folder))]
    packed, of = 0, sum(each.stat().st_size for each in found)
    with zipfile.ZipFile(file, "w") as archive:
        for each in found:
            entry = zipfile.ZipInfo.from_file(each, each.relative_to(folder).as_posix())
            is_picture = each.suffix.lower() in PICTURES  # is compressed already
            entry.compress_type = zipfile.ZIP_STORED if is_picture else zipfile.ZIP_DEFLATED
            with each.open("rb") as source, archive.open(entry, "w") as target:
                while piece := source.read(_PIECE_BYTES):
                    target.write(piece)
                    packed += len(piece)
                    if progress is not None:
                        progress(packed, of)


def _is_packed(path: Path) -> bool:
    return str(path) == DATABASE_NAME or (len(path.parts) > 1 and path.suffix.lower() in PICTURES)


def is_bundle(file: Path) -> bool:
    """Whether a file is one, or says that it is: a damaged one is reported as such."""
    return file.suffix.lower() == ".zip" or zipfile.is_zipfile(file)


@contextmanager
def unpacked(file: Path) -> Generator[Path]:
    """The database of a bundle with its pictures next to it, for the duration of the block.

    Nothing is trusted: what is no database of ours and no picture, leads out of the folder, is a
    link or unpacks to far more than it holds is refused before anything is written.

    Raises:
        InvalidInputError: It is damaged or no bundle, or there is no room to unpack it.
    """
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as name:
        unpack(file, Path(name))
        yield Path(name) / DATABASE_NAME


def unpack(file: Path, folder: Path) -> None:
    """Unpack a bundle as `unpacked` does; a process killed meanwhile leaves no database there.

    Raises:
        InvalidInputError: As there.
    """
    aside = folder / f"{DATABASE_NAME}.part"
    try:
        with zipfile.ZipFile(file) as archive:
            _require_ours(file, archive)
            for entry in archive.infolist():
                is_database = entry.filename == DATABASE_NAME
                target = aside if is_database else folder / entry.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, target.open("wb") as sink:
                    target.chmod(PRIVATE_FILE)
                    shutil.copyfileobj(source, sink, _PIECE_BYTES)
        aside.replace(folder / DATABASE_NAME)
    except _DAMAGED as error:
        raise InvalidInputError(f"{file} is damaged, or no ZIP archive: {error}") from error
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be unpacked in {folder}: {error}") from error


def _require_ours(file: Path, archive: zipfile.ZipFile) -> None:
    entries = archive.infolist()
    names = [entry.filename for entry in entries]
    if DATABASE_NAME not in names:
        raise InvalidInputError(
            f"{file} holds no {DATABASE_NAME}: it is not a bundle of 'webots-mcp export -o RUN.zip'"
        )
    for entry in entries:
        if not _is_ours(entry):
            raise InvalidInputError(
                f"{file} holds {entry.filename!r}, which no bundle does: it is not unpacked"
            )
    if len(set(names)) < len(names):
        raise InvalidInputError(f"{file} holds a name twice, which no bundle does")
    size = sum(entry.file_size for entry in entries)
    if size > max(_HARMLESS_BYTES, _MOST_TIMES * file.stat().st_size):
        raise InvalidInputError(
            f"{file} would unpack to {size:,} bytes, which no bundle of its size does"
        )


def _is_ours(entry: zipfile.ZipInfo) -> bool:
    path = PurePosixPath(entry.filename)
    if entry.filename == DATABASE_NAME:
        return not _is_link(entry)
    plain = not path.is_absolute() and ".." not in path.parts and len(path.parts) > 1
    named = plain and not any(sign in entry.filename for sign in "\\:\0")
    fits = path.suffix.lower() in PICTURES and entry.file_size <= MAX_FILE_BYTES
    return named and fits and not _is_link(entry)


def _is_link(entry: zipfile.ZipInfo) -> bool:
    return entry.external_attr >> 16 & 0o170000 == _LINK
