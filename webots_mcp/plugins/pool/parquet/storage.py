"""Objects below the root of a pool, on a filesystem of fsspec: placed as a whole or not at all.

In a folder an object is written beside and moved to its place; object stores do as much with a
single put. Other filesystems are as atomic as their rename is.
"""

from __future__ import annotations

import errno
import os
import posixpath
import re
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, Final
from uuid import uuid4

from webots_mcp.contract import PRIVATE_FOLDER, make_folder
from webots_mcp.errors import InvalidInputError, PoolError, PoolUnavailableError, WebotsMCPError
from webots_mcp.plugins.pool.parquet.packages import package
from webots_mcp.plugins.pool.target import redacted

_PUT_WHOLE: Final = frozenset(
    {"memory", "s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oci", "oss", "hf"}
)
_INCOMING: Final = "_incoming"  # what is written, before it is moved to its place
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSED: Final = (errno.EACCES, errno.EPERM, errno.EROFS)
_OTHERS: Final = (0o070, 0o007)  # the group, and everybody
_WRITING: Final = 0o022
_SEARCH: Final = 0o111
_INHERITED: Final = 0o7000  # the group's sign, which a folder hands on
_NOT_A_FOLDER: Final = (errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)


class Storage:
    """What is below the root; paths are relative to it and have `/`.

    Each method raises PoolUnavailableError where the filesystem does not answer or has no room,
    and PoolError where it refuses.

    Attributes:
        address: The root without secrets.
        files: The filesystem, as other libraries take it.
        root: The root as that filesystem names it.
        is_local: Whether it is a folder of this machine.
    """

    def __init__(self, url: str) -> None:
        self.files, self.root = _filesystem(url)
        self.is_local = bool({"file", "local"} & _protocols(self.files))
        self.address = self.root if self.is_local else redacted(url)
        self._puts_whole = bool(_PUT_WHOLE & _protocols(self.files))

    def full(self, path: str, root: str | None = None) -> str:
        """A path as the filesystem names it."""
        return f"{(root or self.root).rstrip('/')}/{path}" if path else self.root

    def url_of(self, path: str) -> str:
        """An object as other libraries name it."""
        full = self.full(path)
        return full if self.is_local else str(self.files.unstrip_protocol(full))

    def read(self, path: str) -> bytes | None:
        """The content of an object; None where there is none."""
        with self._answering(path):
            try:
                return self.files.cat_file(self.full(path))
            except FileNotFoundError:
                return None

    def place(self, path: str, content: bytes) -> None:
        """Put an object, in the place of another of that path."""
        with self._answering(path):
            full = self.full(path)
            if self.is_local:
                with self._written(content) as written:
                    self._make_folder(Path(full).parent)
                    written.replace(full)
            elif self._puts_whole:
                self.files.pipe_file(full, content)
            else:
                beside = self.full(f"{_INCOMING}/{uuid4().hex}")
                self.files.makedirs(posixpath.dirname(beside), exist_ok=True)
                self.files.makedirs(posixpath.dirname(full), exist_ok=True)
                self.files.pipe_file(beside, content)
                self.files.mv(beside, full)

    def create(self, path: str, content: bytes) -> bool:
        """Put an object where there is none; whether there was none.

        Of two that do so at once in a folder one is told so; elsewhere, as a rule.
        """
        if not self.is_local:
            if self.read(path) is not None:
                return False
            self.place(path, content)
            return self.read(path) == content
        with self._answering(path), self._written(content) as written:
            full = Path(self.full(path))
            self._make_folder(full.parent)
            return _linked(written, full, content)

    def remove(self, path: str) -> None:
        """Remove an object, which may be gone already."""
        with self._answering(path), suppress(FileNotFoundError):
            self.files.rm_file(self.full(path))

    def find(self, pattern: str) -> list[str]:
        """The paths that match, `*` being any part of one name, in their order."""
        with self._answering(pattern):
            found = self.files.glob(self.full(pattern, _escaped(self.root)))
        return sorted(self._relative(each) for each in found)

    def sizes(self, pattern: str) -> dict[str, int]:
        """The objects that match, with their bytes."""
        with self._answering(pattern):
            found = self.files.glob(self.full(pattern, _escaped(self.root)), detail=True)
        return {self._relative(path): int(about["size"] or 0) for path, about in found.items()}

    @contextmanager
    def opened(self, path: str) -> Generator[Any]:
        """An object as a file to read here and there."""
        with self._answering(path), self.files.open(self.full(path), "rb") as file:
            yield file

    def is_empty(self) -> bool:
        """Whether nothing is below the root."""
        with self._answering(""):
            try:
                beside = [self._relative(each) for each in self.files.ls(self.root, detail=False)]
            except FileNotFoundError:
                return True
        return not [each for each in beside if each not in ("", ".", _INCOMING)]

    def clear(self, older_than_s: float) -> None:
        """Remove what killed processes left half written."""
        if not self.is_local:
            return
        for file in Path(self.full(_INCOMING)).glob("*"):
            with suppress(OSError):
                if file.stat().st_mtime < older_than_s:
                    file.unlink()

    def _relative(self, full: str) -> str:
        root = str(self.root).strip("/")
        return str(PurePosixPath(full.strip("/").removeprefix(root).lstrip("/")))

    @property
    def _rights(self) -> int:
        """Of folders: the owner's alone, and whose the folder of the pool lets write into it."""
        root = Path(self.root).stat().st_mode
        return PRIVATE_FOLDER | sum(who for who in _OTHERS if root & who & _WRITING)

    def _make_folder(self, folder: Path) -> None:
        if folder.is_dir():
            return
        if folder == Path(self.root):
            make_folder(folder)
            return
        self._make_folder(folder.parent)
        with suppress(FileExistsError):  # another shipper was first
            folder.mkdir(PRIVATE_FOLDER)
            folder.chmod(folder.stat().st_mode & _INHERITED | self._rights)

    @contextmanager
    def _written(self, content: bytes) -> Generator[Path]:
        """The content in a file beside the others, which is gone afterwards."""
        file = Path(self.full(f"{_INCOMING}/{uuid4().hex}"))
        self._make_folder(file.parent)
        try:
            with file.open("xb") as sink:
                file.chmod(self._rights & ~_SEARCH)
                sink.write(content)
                sink.flush()
                os.fsync(sink.fileno())
            yield file
        finally:
            file.unlink(missing_ok=True)

    @contextmanager
    def _answering(self, path: str) -> Generator[None]:
        try:
            yield
        except WebotsMCPError:  # from inside the block
            raise
        except OSError as error:
            raise self._explained(error, path) from error
        except Exception as error:  # each client of an object store has its own
            raise PoolUnavailableError(
                f"{self.address} does not answer ({path}): {error}"
            ) from error

    def _explained(self, error: OSError, path: str) -> PoolError:
        what = error.strerror or str(error) or type(error).__name__
        where = f"{self.address} ({path})" if path else self.address
        if error.errno in _NO_ROOM:
            return PoolUnavailableError(f"there is no room in {where}: {what}")
        if error.errno in _REFUSED or isinstance(error, PermissionError):
            return PoolError(f"{where} cannot be used by this user: {what}")
        if error.errno in _NOT_A_FOLDER or isinstance(error, NotADirectoryError):
            return PoolError(f"{where} cannot be a pool: {what}")
        return PoolUnavailableError(f"{where} does not answer: {what}")


def _filesystem(url: str) -> tuple[Any, str]:
    """Of a URL or a folder.

    Raises:
        PoolError: A package is missing; the text names it.
        InvalidInputError: No filesystem is known by that name.
    """
    core = package("fsspec.core")
    try:
        # What was listed before may have changed since: others ship to the same pool.
        files, root = core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise PoolError(f"{redacted(url)} needs another package: {error}") from error
    except ValueError as error:
        raise InvalidInputError(
            f"{redacted(url)} is on no filesystem that fsspec knows: {error}"
        ) from error
    except OSError as error:
        raise PoolUnavailableError(f"{redacted(url)} does not answer: {error}") from error
    return files, str(root)


def _protocols(files: Any) -> set[str]:
    named: str | tuple[str, ...] = files.protocol
    return {named} if isinstance(named, str) else set(named)


def _escaped(path: str) -> str:
    """As a pattern that matches this path only."""
    return re.sub(r"([*?\[])", r"[\1]", path)


def _linked(written: Path, full: Path, content: bytes) -> bool:
    """Whether the file is at its place now; not where another was there before it."""
    try:
        full.hardlink_to(written)
    except FileExistsError:
        return False
    except OSError:  # no hard links there
        try:
            with full.open("xb") as sink:
                sink.write(content)
        except FileExistsError:
            return False
    return True
