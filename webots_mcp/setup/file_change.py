"""A change of one file of the user: shown as a diff, then written wholly or not at all."""

from __future__ import annotations

import contextlib
import difflib
import os
from pathlib import Path
from typing import NamedTuple

from webots_mcp.errors import CommandRefusedError


class FileChange(NamedTuple):
    """What a file is to hold.

    Attributes:
        file: As it was named; a symbolic link is followed when it is written.
        before: What it holds; None where there is no such file.
        after: What it is to hold.
    """

    file: Path
    before: bytes | None
    after: bytes

    @property
    def is_needed(self) -> bool:
        """Whether the file differs from what it is to hold."""
        return self.before != self.after

    @property
    def diff(self) -> str:
        """The lines that change, whatever the file's encoding."""
        before, after = (
            (content or b"").decode("utf-8", "replace").splitlines()
            for content in (self.before, self.after)
        )
        names = str(self.file), f"{self.file} (new)"
        return "\n".join(difflib.unified_diff(before, after, *names, lineterm="", n=2))


def read(file: Path) -> bytes | None:
    """Return what the file holds; None where there is none.

    Raises:
        OSError: It cannot be read, or is no file.
    """
    try:
        return file.read_bytes()
    except FileNotFoundError:
        for each in (file, file.parent):
            if each.is_symlink() and not each.exists():
                raise OSError(f"{each} is a symbolic link to nothing: remove or mend it") from None
        return None


def apply(change: FileChange) -> None:
    """Write the file, by a new one that takes its place; its permissions stay.

    Raises:
        CommandRefusedError: It may not be written, or has changed since it was read.
        OSError: It cannot be written.
    """
    target = change.file.resolve()
    if change.before is not None and not os.access(target, os.W_OK):
        raise CommandRefusedError(f"{change.file} is read-only: make it writable first")
    if read(change.file) != change.before:
        raise CommandRefusedError(f"{change.file} has changed meanwhile: try again")
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = target.with_name(f".{target.name}.{os.getpid()}.new")
    try:
        with aside.open("xb") as new:
            new.write(change.after)
            new.flush()
            os.fsync(new.fileno())
        if change.before is not None:
            aside.chmod(target.stat().st_mode & 0o7777)
        os.replace(aside, target)  # noqa: PTH105
    finally:
        with contextlib.suppress(FileNotFoundError):
            aside.unlink()
