"""Where a recording lives: its database, its folder, and the Webots project that it belongs to.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    import tempfile
from webots_mcp.contract import (
    CONTROLLER_FOLDER,
    DATA_DIR_VARIABLE,
    DATABASE_NAME,
    PROJECT_DATA_FOLDER,
    PROJECT_IS,
    WORLD_ENDING,
    WORLD_FOLDER,
)
from webots_mcp.database.files import full_path


class MemoryDatabase:
    """A database in memory that a bridge and a server in one process share.

    Every connection to `uri` sees the same data; the data lives until `close` (or the end of
    the process). Pictures need files, so `data_dir` is a temporary folder, made when first asked
    for and removed with the database.
    """

    def __init__(self) -> None:
        self.uri: Final = f"file:/webots-mcp-{os.urandom(8).hex()}?vfs=memdb"
        self._keeper = sqlite3.connect(self.uri, uri=True, check_same_thread=False)
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    @property
    def data_dir(self) -> Path:
        """A temporary folder for the pictures of this database."""
        if self._folder is None:
            import tempfile  # only where needed: it is half of this module's import time

            self._folder = tempfile.TemporaryDirectory(prefix="webots-mcp-")
        return Path(self._folder.name)

    def close(self) -> None:
        """Forget the data, once the last other connection is closed as well."""
        self._keeper.close()
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def __repr__(self) -> str:
        return f"MemoryDatabase({self.uri!r})"


Database = Path | MemoryDatabase


class DataFolder(NamedTuple):
    """Where the database and the pictures live, and the rule that chose it."""

    path: Path
    chosen_by: str


def resolve_data_dir(data_dir: str | os.PathLike[str] | None = None) -> Path:
    """Return the folder of the database and the pictures; the same for bridge and server.

    In rising order of precedence: `~/.webots-mcp/data`; `mcp_data/` in the nearest folder at or
    above the current one that is a Webots project (see `find_project`); the environment variable
    `WEBOTS_MCP_DATA_DIR`; the argument.
    """
    return choose_data_dir(data_dir).path


def choose_data_dir(data_dir: str | os.PathLike[str] | None = None) -> DataFolder:
    """Return the same folder as `resolve_data_dir`, and the rule that chose it."""
    if data_dir is not None:
        return DataFolder(full_path(data_dir), "it was named")
    if named := os.environ.get(DATA_DIR_VARIABLE):
        return DataFolder(full_path(named), f"the environment variable {DATA_DIR_VARIABLE}")
    if project := find_project(Path.cwd()):
        return DataFolder(project / PROJECT_DATA_FOLDER, f"the Webots project {project}")
    default = Path.home() / ".webots-mcp" / "data"
    return DataFolder(default, f"the default, as {Path.cwd()} is in no Webots project")


def find_project(folder: Path) -> Path | None:
    """Return the nearest folder, at or above this one, that is a Webots project.

    It holds `worlds/`, and there a world or next to it `controllers/`. ROS 2 packages and projects
    of extern controllers have worlds alone: Webots needs no more.
    """
    return next((each for each in (folder, *folder.parents) if _is_project(each)), None)


def _is_project(folder: Path) -> bool:
    worlds = folder / WORLD_FOLDER
    try:
        if not worlds.is_dir():
            return False
        return (folder / CONTROLLER_FOLDER).is_dir() or any(
            name.endswith(WORLD_ENDING)
            for name in os.listdir(worlds)  # noqa: PTH208
        )
    except OSError:  # a folder that this user may not list is no project of theirs
        return False


def require_world_of(project: Path | None, world: Path) -> Path:
    """Return the project of a world; refuse one of another project, whose controllers it starts.

    Args:
        project: The project that it must lie in; None for any.
        world: The world file, with links followed.

    Raises:
        InvalidInputError: If it is not a world, or lies in no project, or in another one.
    """
    if world.suffix != WORLD_ENDING:
        raise InvalidInputError(f"{world} is no world: its name does not end with {WORLD_ENDING}")
    if project is not None and not world.is_relative_to(project):
        raise InvalidInputError(f"{world} lies outside of the project {project}")
    own = find_project(world.parent)
    if own is None:
        raise InvalidInputError(
            f"{world} lies in no Webots project: that is {PROJECT_IS}; move it into one"
        )
    return project or own


def resolve_database(
    database: str | os.PathLike[str] | MemoryDatabase | None = None,
    data_dir: str | os.PathLike[str] | None = None,
) -> tuple[Database, Path]:
    """Return the database and the folder of its pictures, from what a user gave.

    Args:
        database: A file, `":memory:"` for a new one in memory, an open `MemoryDatabase`, or None
            for `webots.db` in the data folder.
        data_dir: The data folder; None for the database's own folder, else `resolve_data_dir`.

    Raises:
        TypeError: If `database` is of another type.
        OSError: If a path cannot be followed.
    """
    if isinstance(database, str) and database == ":memory:":
        database = MemoryDatabase()
    if isinstance(database, MemoryDatabase):
        return database, database.data_dir if data_dir is None else resolve_data_dir(data_dir)
    if database is None:
        folder = resolve_data_dir(data_dir)
        return folder / DATABASE_NAME, folder
    if not isinstance(database, (str, os.PathLike)):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(
            f"database={database!r} is a {type(database).__name__}; give a path, ':memory:' or a "
            "webots_mcp.MemoryDatabase (shared by bridge and server in one process)"
        )
    file = full_path(database)
    return file, file.parent if data_dir is None else resolve_data_dir(data_dir)
