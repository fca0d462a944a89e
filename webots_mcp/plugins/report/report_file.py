"""A report as a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from webots_mcp.contract import make_folder, whole_file
from webots_mcp.errors import InvalidInputError


def file_name(run_ids: Sequence[int]) -> str:
    """How the file is called if nobody says: run-3.html, run-3-5.html."""
    return f"run-{'-'.join(map(str, run_ids))}.html"


def require_free(file: Path, *, overwrite: bool) -> None:
    """See that the file may be written, before the work is done.

    Raises:
        InvalidInputError: Something is there already, or it is no page's name.
    """
    try:
        is_folder, is_there = file.is_dir(), file.exists()
    except OSError as error:  # too long a name
        raise InvalidInputError(f"{str(file)[:200]} cannot be written: {error.strerror}") from error
    if is_folder:
        raise InvalidInputError(f"{file} is a folder: name a file in it")
    if file.suffix.lower() not in (".html", ".htm"):
        raise InvalidInputError(f"{file.name!r} is no page's name: end it in .html")
    if is_there and not overwrite:
        raise InvalidInputError(
            f"{file} is there already: name another one, or give overwrite (--overwrite)"
        )


def require_folder(file: Path) -> None:
    """See that there is a folder to write into.

    Raises:
        InvalidInputError: There is none.
    """
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent}: make it, or name another file")


def write_report(file: Path, html: bytes, *, overwrite: bool = False) -> None:
    """Write it as a file of its owner alone that appears only when it is complete.

    A folder that is not there is made.

    Raises:
        InvalidInputError: It cannot be written, or something is there already.
    """
    require_free(file, overwrite=overwrite)
    try:
        make_folder(file.parent)
        with whole_file(file) as aside:
            aside.write_bytes(html)
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error
