"""Creates private files and folders, and replaces files as a whole.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from webots_mcp.errors import InvalidInputError

PRIVATE_FOLDER: Final = 0o700  # recordings hold pictures and logs: they are their owner's alone
PRIVATE_FILE: Final = 0o600


def make_folder(folder: Path) -> None:
    """Create a folder that only its owner can read; an existing folder keeps its mode.

    Raises:
        OSError: If it cannot be created.
    """
    folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)


@contextmanager
def whole_file(file: Path) -> Generator[Path]:
    """Open a private temporary file next to a file, and replace that file once it is complete.

    Raises:
        OSError: If it cannot be written; no part of it is left.
    """
    aside = file.with_name(f"{file.name}.part")
    aside.touch(PRIVATE_FILE)
    try:
        aside.chmod(PRIVATE_FILE)  # also of one that a killed process has left
        yield aside
        os.replace(aside, file)  # noqa: PTH105
    finally:
        aside.unlink(missing_ok=True)


@contextmanager
def placed(file: Path) -> Generator[Path]:
    """Open a temporary file like `whole_file`, for a file that a user has named.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    try:
        with whole_file(file) as aside:
            yield aside
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error


def full_path(path: str | os.PathLike[str]) -> Path:
    """Return the path with `~` and links followed.

    Raises:
        OSError: If `~` is not a user's home, links form a circle, or the name is not valid.
    """
    try:
        return Path(path).expanduser().resolve()
    except (RuntimeError, ValueError) as error:
        raise OSError(f"{str(path)!r} cannot be followed: {error}; give the full path") from error
