"""Camera frames and screenshots: rows here, files in the data folder."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.store.rows import columns_of


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
    bytes: int

    def file(self, data_dir: Path) -> Path:
        """The file itself; see `inside` for the errors."""
        return inside(data_dir, self.path)


_COLUMNS: Final = columns_of(StoredImage)
_NEWEST: Final = (
    f"SELECT {_COLUMNS} FROM image WHERE run_id = :run_id AND kind = :kind "
    "AND (:device IS NULL OR device = :device) ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_DEVICES: Final = (
    "SELECT DISTINCT device FROM image WHERE run_id = ? AND kind = 'camera' AND device IS NOT NULL"
)


def inside(data_dir: Path, path: str) -> Path:
    """The file at a recorded path.

    Raises:
        InvalidInputError: The path leads out of the data folder.
        NothingRecordedError: The file is gone.
    """
    file = (data_dir / path).resolve()
    if not file.is_relative_to(data_dir.resolve()):
        raise InvalidInputError(f"{path!r} lies outside the data folder and is not opened")
    if not file.is_file():
        raise NothingRecordedError(
            f"{file} was recorded, but the file is gone: only the newest pictures are kept; or "
            "this is not the data folder that the controller records into"
        )
    return file


def newest_camera_image(
    connection: sqlite3.Connection, run_id: int, device: str | None = None
) -> StoredImage | None:
    """The latest camera frame of a run, of one camera or of any."""
    values = {"run_id": run_id, "kind": "camera", "device": device}
    row = connection.execute(_NEWEST, values).fetchone()
    return StoredImage(*row) if row else None


def camera_names(connection: sqlite3.Connection, run_id: int) -> list[str]:
    """The cameras whose frames the run recorded."""
    return [row[0] for row in connection.execute(_DEVICES, (run_id,)).fetchall()]
