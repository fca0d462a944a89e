"""Camera frames and screenshots: rows here, files in the data folder."""

from __future__ import annotations

import contextlib
import sqlite3
import stat
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.store.run_rows import columns_of

if TYPE_CHECKING:
    from PIL.Image import Image

PICTURES: Final = (".png", ".jpg", ".jpeg")
MAX_FILE_BYTES: Final = 64_000_000
MAX_PIXELS: Final = 50_000_000  # 200 MB in memory


@dataclass(frozen=True)
class StoredImage:
    """A picture that was recorded; `path` is relative to the data folder."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    kind: str
    device: str | None
    path: str
    width: int
    height: int
    size_bytes: int

    def file(self, data_dir: Path) -> Path:
        """The file itself; see `inside` for the errors."""
        return inside(data_dir, self.path)


_SHOWN_PATH: Final = 100
_COLUMNS: Final = columns_of(StoredImage)
_OF_CAMERA: Final = f"kind IN ('camera', '{KEPT_FRAME}')"
_NEWEST_FIRST: Final = "sim_time_s DESC"
_NEAREST_FIRST: Final = "abs(sim_time_s - :at_s)"
_FRAMES: Final = (
    f"SELECT {_COLUMNS} FROM image WHERE run_id = :run_id AND {_OF_CAMERA} "
    "AND (:device IS NULL OR device = :device) AND (:kind IS NULL OR kind = :kind) "
    "ORDER BY {order}, id DESC LIMIT :count"
)
_NEWEST: Final = (
    f"SELECT {_COLUMNS} FROM image WHERE run_id = ? ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_KEPT_FRAMES: Final = (
    f"SELECT count(*) FROM image WHERE run_id = ? AND kind = '{KEPT_FRAME}' "
    "AND sim_time_s BETWEEN ? AND ?"
)
_CAMERAS: Final = (
    f"SELECT run_id, group_concat(DISTINCT device) FROM image WHERE {_OF_CAMERA} AND run_id IN "
    "(SELECT id FROM run WHERE robot_id = ?) GROUP BY run_id ORDER BY run_id DESC"
)


def inside(data_dir: Path, path: str) -> Path:
    """The file at a recorded path.

    Raises:
        InvalidInputError: The path leads out of the data folder, or to no regular file.
        NothingRecordedError: The file is gone.
    """
    try:
        file = (data_dir / path).resolve()
        if not file.is_relative_to(data_dir.resolve()):
            raise InvalidInputError(f"{path!r} lies outside the data folder and is not opened")
        mode = file.stat().st_mode
    except FileNotFoundError as error:
        raise NothingRecordedError(
            f"{data_dir / path} was recorded, but the file is gone: only the newest pictures are "
            "kept; or this is not the data folder that the controller records into"
        ) from error
    except (OSError, ValueError, RuntimeError) as error:  # too long, a NUL, a loop of links
        raise InvalidInputError(f"{path[:_SHOWN_PATH]!r} is not a usable path: {error}") from error
    if not stat.S_ISREG(mode):
        raise InvalidInputError(f"{file} is not a regular file and is not opened")
    return file


@contextlib.contextmanager
def opened(file: Path, formats: tuple[str, ...] = ("PNG", "JPEG")) -> Generator[Image]:
    """A picture, not decoded yet; errors of its user inside the block are reported alike.

    Pillow is imported here, at the first picture: it would add to the server's start.

    Args:
        file: A regular file.
        formats: Those that are allowed, as Pillow names them.

    Raises:
        InvalidInputError: It is not a complete picture of these formats, or is too large.
    """
    from PIL import Image as Pictures

    try:
        _require_at_most(MAX_FILE_BYTES, "bytes", file.stat().st_size)
        picture: Any = Pictures.open(file, formats=formats)
        with picture:
            _require_at_most(MAX_PIXELS, "pixels", picture.width * picture.height)
            yield picture
    except Exception as error:  # Pillow raises nearly anything about a file that is damaged
        usable = f"usable {' or '.join(formats)}"
        raise InvalidInputError(f"{file} is not a {usable}: {error}") from error


def _require_at_most(limit: int, of: str, found: int) -> None:
    if found > limit:
        raise ValueError(f"it has {found:,} {of}, {limit:,} is the limit")


def camera_frames(
    connection: sqlite3.Connection,
    run_id: int,
    device: str | None = None,
    *,
    at_s: float | None = None,
    count: int = 1,
) -> list[StoredImage]:
    """Frames of one camera in a run, those of kept stretches too, in order of time.

    Args:
        connection: Any.
        run_id: The run.
        device: Of this camera; None is the one that has the frame that is looked for.
        at_s: The frames nearest to this simulation time; None is the newest.
        count: The most to return, of one kind.
    """
    order = _NEWEST_FIRST if at_s is None else _NEAREST_FIRST
    values = {"run_id": run_id, "device": device, "kind": None, "at_s": at_s, "count": 1}
    query = _FRAMES.format(order=order)
    found = connection.execute(query, values).fetchall()
    if found and count > 1:
        of = {"device": found[0][5], "kind": found[0][4], "count": count}
        found = connection.execute(query, values | of).fetchall()
    return sorted((StoredImage(*row) for row in found), key=lambda each: each.sim_time_s)


def newest_image(connection: sqlite3.Connection, run_id: int) -> StoredImage | None:
    """The newest picture of a run, of whatever kind."""
    row = connection.execute(_NEWEST, (run_id,)).fetchone()
    return StoredImage(*row) if row else None


def count_kept_frames(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> int:
    """How many camera frames a kept stretch has, from its start to its end."""
    return int(connection.execute(_KEPT_FRAMES, (run_id, start_s, end_s)).fetchone()[0])


def cameras(connection: sqlite3.Connection, robot_id: int) -> dict[int, str]:
    """The cameras whose frames there are, by run of the robot, the newest run first."""
    return dict(connection.execute(_CAMERAS, (robot_id,)).fetchall())
