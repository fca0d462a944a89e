"""Which files a forked process must not open with SQLite.

SQLite remembers in the process' own memory which files it has open and locked. A fork copies that
memory, but not the locks: a connection that the child opens to the same file believes to hold
locks that it does not have, and destroys the database under its parent.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

_MOST_DESCRIPTORS: Final = 1024

# Device and inode; None where this process was forked and has not looked yet.
_inherited: set[tuple[int, int]] | None = set()


def is_inherited(file: Path) -> bool:
    """Whether a process that this one was forked from had the file open at that moment."""
    global _inherited
    if _inherited is None:
        _inherited = _open_files()
    if not _inherited:
        return False
    try:
        status = file.stat()
    except OSError:
        return False
    return (status.st_dev, status.st_ino) in _inherited


def _open_files() -> set[tuple[int, int]]:
    files: set[tuple[int, int]] = set()
    for descriptor in range(_MOST_DESCRIPTORS):
        try:
            status = os.fstat(descriptor)
        except OSError:
            continue
        files.add((status.st_dev, status.st_ino))
    return files


def _forget() -> None:
    global _inherited
    _inherited = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
