"""What this Python brings along."""

from __future__ import annotations

import platform
import sqlite3
import sys
from typing import Final

from webots_mcp.connection import OLDEST_SQLITE
from webots_mcp.diagnosis.finding import Finding, Subject
from webots_mcp.requirements import install_line, missing_requirements, package_of

_OLDEST_PYTHON: Final = (3, 10)
_NEWEST_PYTHON: Final = (3, 13)  # that it was tried with
# Two connections that write or checkpoint at once could damage a file before these versions
# (sqlite.org/wal.html, "The WAL-reset bug"); the two older branches were mended as well.
_WAL_RESET_MENDED: Final = (3, 51, 3)
_WAL_RESET_MENDED_IN_BRANCH: Final = {(3, 44): 6, (3, 50): 7}


def python(_: Subject) -> Finding:
    """The Python that runs this; that of the controllers is said by `Recording now`."""
    seen = f"{platform.python_version()} at {sys.executable}"
    if sys.version_info[:2] < _OLDEST_PYTHON:
        return Finding("wrong", seen, "use Python 3.10 or newer")
    if sys.version_info[:2] > _NEWEST_PYTHON:
        return Finding("warning", f"{seen}: newer than what this was tried with", "use Python 3.13")
    return Finding("ok", seen)


def packages(_: Subject) -> Finding:
    """What the server and most commands need; a bridge does without."""
    missing = missing_requirements()
    if not missing:
        return Finding("ok", "all that the server needs are installed")
    seen = f"missing: {', '.join(map(package_of, missing))} (a bridge does without)"
    return Finding("wrong", seen, f"run {install_line(missing)}")


def sqlite(_: Subject) -> Finding:
    """The SQLite of this Python."""
    return judge_sqlite(sqlite3.sqlite_version_info)


def judge_sqlite(version: tuple[int, ...]) -> Finding:
    """Whether a version can be used."""
    seen = ".".join(map(str, version))
    if version < OLDEST_SQLITE:
        return Finding(
            "wrong",
            f"{seen} is too old: 3.38 is needed",
            "use a Python with a newer one (python.org, conda and Debian 12 have it)",
        )
    if has_wal_reset_bug(version):
        seen += (
            ", which has the WAL-reset bug: webots-mcp checkpoints so that it cannot strike; let "
            "no other program write to the file while a robot records"
        )
    return Finding("ok", seen)


def has_wal_reset_bug(version: tuple[int, ...]) -> bool:
    """Whether a checkpoint beside a commit can damage a file."""
    mended = _WAL_RESET_MENDED_IN_BRANCH.get((version[0], version[1]))
    return version < _WAL_RESET_MENDED and (mended is None or version[2] < mended)
