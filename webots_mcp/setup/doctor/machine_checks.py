"""Checks of this machine: Python, packages, SQLite, and the disk on which a recording lies.

None of them needs a recording.
"""

from __future__ import annotations

import os
import platform
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from webots_mcp.contract import DATA_DIR_VARIABLE
from webots_mcp.database.connection import OLDEST_SQLITE
from webots_mcp.extras.requirements import install_line, missing_requirements, package_of
from webots_mcp.setup.doctor import (
    Diagnosis,
    Examined,
    check,
    ok,
    unclear,
    warning,
    wrong,
)
from webots_mcp.setup.wsl import WAY_OUT, is_wsl

_WAL_RESET_FIXED_IN_BRANCH: Final = {(3, 44): 6, (3, 50): 7}
# Names of file systems as the operating systems have them; in none does SQLite share memory.
_NETWORK: Final = (
    "nfs", "nfs4", "cifs", "smb2", "smb3", "smbfs", "afpfs", "webdav", "ncpfs", "afs", "ceph",
    "glusterfs", "lustre", "beegfs", "fuse.sshfs", "fuse.glusterfs", "fuse.s3fs", "fuse.rclone",
)  # fmt: skip
_WINDOWS_FROM_WSL: Final = ("9p", "drvfs")
_IN_MEMORY: Final = "the recording is in memory"
_LOCAL: Final = (
    f"record in a folder of this machine's own disk: {DATA_DIR_VARIABLE}, --data-dir, or "
    "MCPBridge(robot, data_dir=...), the same for controllers and server"
)


@dataclass(frozen=True)
class MachineLimits:
    """What a machine must have.

    Attributes:
        oldest_python: Oldest Python.
        newest_python: Newest Python with which this was tried.
        wal_reset_fixed: SQLite without the WAL-reset bug (sqlite.org/wal.html): before it, two
            connections that write or checkpoint at once could damage a file.
        full_bytes: Free space below which a disk counts as full.
        low_bytes: Free space below which there is a warning.
    """

    oldest_python: tuple[int, int] = (3, 10)
    newest_python: tuple[int, int] = (3, 13)
    wal_reset_fixed: tuple[int, int, int] = (3, 51, 3)
    full_bytes: int = 50_000_000
    low_bytes: int = 1_000_000_000


_LIMITS: Final = MachineLimits()


@check("Python")
def python(_: Examined) -> Iterator[Diagnosis]:
    """Report the Python that runs this; `Recording now` has that of the controllers."""
    seen = f"{platform.python_version()} at {sys.executable}"
    if sys.version_info[:2] < _LIMITS.oldest_python:
        yield wrong(seen, "use Python 3.10 or newer")
    elif sys.version_info[:2] > _LIMITS.newest_python:
        yield warning(f"{seen}: newer than what this was tried with", "use Python 3.13")
    else:
        yield ok(seen)


@check("Packages", well="all that the server needs are installed")
def packages(_: Examined) -> Iterator[Diagnosis]:
    """Report what the server and most commands need; a bridge does without."""
    if missing := missing_requirements():
        seen = f"missing: {', '.join(map(package_of, missing))} (a bridge does without)"
        yield wrong(seen, f"run {install_line(missing)}")


@check("SQLite")
def sqlite(_: Examined) -> Iterator[Diagnosis]:
    """Report the SQLite of this Python."""
    yield judge_sqlite(sqlite3.sqlite_version_info)


def judge_sqlite(version: tuple[int, ...]) -> Diagnosis:
    """Return whether a version can be used."""
    seen = ".".join(map(str, version))
    if version < OLDEST_SQLITE:
        fix = "use a Python with a newer one (python.org, conda and Debian 12 have it)"
        return wrong(f"{seen} is too old: 3.38 is needed", fix)
    mended = _WAL_RESET_FIXED_IN_BRANCH.get((version[0], version[1]))
    if version < _LIMITS.wal_reset_fixed and (mended is None or version[2] < mended):
        seen += (
            ", which has the WAL-reset bug: webots-mcp checkpoints so that it cannot strike; let "
            "no other program write to the file while a robot records"
        )
    return ok(seen)


@check("Data folder", well=_IN_MEMORY)
def data_folder(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether it is there, and may be written."""
    if subject.file is None:
        return
    folder = subject.file.parent
    seen = f"{folder}, chosen by: {subject.chosen_by}"
    if not folder.exists():
        yield warning(
            f"{seen}; it is not there yet",
            "start a controller with an MCPBridge, which makes it; if it records elsewhere, name "
            "that folder with --data-dir",
        )
    elif not folder.is_dir():
        yield wrong(f"{seen}; it is a file", "name the folder with --data-dir")
    else:
        try:  # a read-only file system ignores the folder's rights
            with tempfile.TemporaryFile(dir=folder):
                yield ok(seen)
        except OSError as error:
            yield wrong(
                f"{seen}; it cannot be written: {error.strerror or error}",
                "give this user the right to write there, or name another with --data-dir; a "
                "recording that only has to be read can: webots-mcp serve --read-only",
            )


class Mount(NamedTuple):
    """A file system and its mount point, as psutil lists them."""

    point: str
    kind: str
    is_remote: bool = False


@check("File system", well=_IN_MEMORY)
def file_system(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether processes can share memory there, which WAL needs."""
    if subject.file is None:
        return
    import psutil

    mounts = [
        Mount(part.mountpoint, part.fstype, "remote" in part.opts.split(","))
        for part in psutil.disk_partitions(all=True)
    ]
    yield judge_file_system(str(subject.file.parent), mounts, in_wsl=is_wsl())


def judge_file_system(folder: str, mounts: Iterable[Mount], *, in_wsl: bool) -> Diagnosis:
    """Return whether a recording may lie in a folder, on a machine with these file systems."""
    path = folder.replace("\\", "/")
    if path.lower().startswith(("//wsl$/", "//wsl.localhost/")):
        return _across_the_border(folder, "a folder of WSL, seen from Windows")
    if path.startswith("//"):
        return _on_the_network(folder, "a network drive")
    above = [mount for mount in mounts if _is_in(path, mount.point.replace("\\", "/"))]
    if not above:
        return unclear(f"the system does not show on which drive {folder} is")
    mount = max(above, key=lambda mount: len(mount.point))
    kind = mount.kind.lower()
    if in_wsl and kind in _WINDOWS_FROM_WSL:
        return _across_the_border(folder, f"a drive of Windows, seen from WSL ({kind})")
    if mount.is_remote or kind in _NETWORK:
        return _on_the_network(folder, f"a network drive ({mount.kind} at {mount.point})")
    if kind in ("vboxsf", "prl_fs", "fuse.vmhgfs-fuse", "vmhgfs", *_WINDOWS_FROM_WSL):
        seen = f"{folder} is shared with a virtual machine's host ({mount.kind} at {mount.point})"
        return warning(f"{seen}: both at once would not see each other's locks", _LOCAL)
    return ok(f"{mount.kind or 'of an unnamed kind'} at {mount.point}")


def _across_the_border(folder: str, what: str) -> Diagnosis:
    seen = (
        f"{folder} is {what}: SQLite cannot share memory across that border, so that controllers "
        "and server lock each other out or damage the file"
    )
    return wrong(seen, WAY_OUT)


def _on_the_network(folder: str, what: str) -> Diagnosis:
    seen = (
        f"{folder} is on {what}: SQLite's log needs memory that processes share, which network "
        "file systems do not have"
    )
    return wrong(seen, _LOCAL)


def _is_in(path: str, point: str) -> bool:
    if os.name == "nt" or point[1:2] == ":":
        path, point = path.lower(), point.lower()
    return f"{path}/".startswith(f"{point.rstrip('/')}/")


@check("Free space", well=_IN_MEMORY)
def free_space(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether there is space for what will be recorded."""
    if subject.file is None:
        return
    folder = next(folder for folder in subject.file.parents if folder.exists())
    free = shutil.disk_usage(folder).free
    seen = f"{free / 1e9:.1f} GB free"
    fix = "make room: 'webots-mcp prune --dry-run' lists what could be deleted"
    if free < _LIMITS.full_bytes:
        yield wrong(f"{seen}: the disk is full", fix)
    else:
        yield warning(seen, fix) if free < _LIMITS.low_bytes else ok(seen)
