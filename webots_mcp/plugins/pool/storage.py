"""Objects in a folder or on any filesystem that fsspec knows, each placed as a whole."""

from __future__ import annotations

import errno
import os
import posixpath
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from glob import escape
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, Final
from uuid import uuid4

from webots_mcp.database.files import make_folder
from webots_mcp.errors import (
    InvalidInputError,
    PoolError,
    PoolUnavailableError,
    WebotsMCPError,
)
from webots_mcp.extras.requirements import explain_extra, install_line
from webots_mcp.plugins.pool.pool_interface import redacted

_AT_ONCE: Final = 16  # Parallel reads.
# Filesystems whose single put is atomic.
_PUT_WHOLE: Final = frozenset(
    {"memory", "s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oci", "oss", "hf"}
)
_INCOMING: Final = "_incoming"  # Folder of files that are written, before they are moved.
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSED: Final = (errno.EACCES, errno.EPERM, errno.EROFS)
_NOT_A_FOLDER: Final = (errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)


def package(name: str) -> Any:
    """Import a module of the extra `parquet` or of DuckDB; they have no types.

    Raises:
        PoolError: It is not installed. The text says what to install.
    """
    try:
        return import_module(name)
    except ImportError as error:
        whose = name.partition(".")[0]
        if whose in ("pyarrow", "fsspec"):
            raise PoolError(explain_extra("a pool of Parquet files", "parquet")) from error
        asked = f"a SELECT over a pool of Parquet files needs {whose}"
        raise PoolError(f"{asked}: {install_line([whose])}") from error


class Storage:
    """Objects below a root, each written completely or not at all.

    Paths are relative to the root, with `/`. In a folder, an object is written to another place and
    moved; object stores need a single put. Other filesystems are as atomic as their rename.

    Each method raises PoolUnavailableError if the filesystem does not answer or is full, and
    PoolError if it refuses.

    Attributes:
        address: The root without secrets.
        files: The filesystem, for other libraries.
        root: The root as the filesystem names it.
        is_local: Whether it is a folder of this machine.
    """

    def __init__(self, url: str) -> None:
        self.files, self.root = _filesystem(url)
        named: str | tuple[str, ...] = self.files.protocol
        protocols = {named} if isinstance(named, str) else set(named)
        self.is_local = bool({"file", "local"} & protocols)
        self.address = self.root if self.is_local else redacted(url)
        self._puts_whole = bool(_PUT_WHOLE & protocols)

    def full(self, path: str) -> str:
        """Return a path as the filesystem names it."""
        return f"{self.root.rstrip('/')}/{path}" if path else self.root

    def url_of(self, path: str) -> str:
        """Return an object as other libraries name it."""
        full = self.full(path)
        return full if self.is_local else str(self.files.unstrip_protocol(full))

    def read(self, path: str) -> bytes | None:
        """Return the content of an object; None if it does not exist."""
        with self._answering(path):
            try:
                return self.files.cat_file(self.full(path))
            except FileNotFoundError:
                return None

    def read_all(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield the objects that exist.

        Several are read in parallel, since most time is waiting.
        """
        listed = [*paths]
        with ThreadPoolExecutor(_AT_ONCE) as workers:
            contents = map(self.read, listed) if self.is_local else workers.map(self.read, listed)
            for path, content in zip(listed, contents, strict=True):
                if content is not None:
                    yield path, content

    def place(self, path: str, content: bytes) -> None:
        """Write an object, which replaces another of its path."""
        with self._answering(path):
            full = self.full(path)
            if self.is_local:
                with self._written(content) as written:
                    self._make_folder(Path(full).parent)
                    written.replace(full)
            elif self._puts_whole:
                self.files.pipe_file(full, content)
            else:
                incoming = self.full(f"{_INCOMING}/{uuid4().hex}")
                self.files.makedirs(posixpath.dirname(incoming), exist_ok=True)
                self.files.makedirs(posixpath.dirname(full), exist_ok=True)
                self.files.pipe_file(incoming, content)
                self.files.mv(incoming, full)

    def create(self, path: str, content: bytes) -> bool:
        """Write an object if none exists; return whether none existed.

        If two processes do so at once in a folder, exactly one gets True; on other filesystems,
        usually.
        """
        if not self.is_local:
            if self.read(path) is not None:
                return False
            self.place(path, content)
            return self.read(path) == content
        with self._answering(path), self._written(content) as written:
            full = Path(self.full(path))
            self._make_folder(full.parent)
            try:
                full.hardlink_to(written)
            except FileExistsError:
                return False
            except OSError:  # The filesystem has no hard links.
                if full.exists():
                    return False
                written.rename(full)
        return True

    def remove(self, path: str) -> None:
        """Remove an object, if it exists."""
        with self._answering(path), suppress(FileNotFoundError):
            self.files.rm_file(self.full(path))

    def find(self, pattern: str) -> list[str]:
        """Return the paths that match, sorted; `*` is any part of one name."""
        with self._answering(pattern):
            if self.is_local:
                found = Path(self.root).glob(pattern)
                return sorted(each.relative_to(self.root).as_posix() for each in found)
            full = f"{escape(self.root.rstrip('/'))}/{pattern}"
            return sorted(map(self._relative, self.files.glob(full)))

    def names(self) -> list[str]:
        """Return the names directly below the root."""
        with self._answering(""), suppress(FileNotFoundError):
            found = [self._relative(each) for each in self.files.ls(self.root, detail=False)]
            return [each for each in found if each not in ("", ".", _INCOMING)]
        return []

    def clear(self, older_than_s: float) -> None:
        """Remove incomplete files of processes that were killed."""
        for file in Path(self.full(_INCOMING)).glob("*") if self.is_local else ():
            with suppress(OSError):
                if file.stat().st_mtime < older_than_s:
                    file.unlink()

    def _relative(self, full: str) -> str:
        root = str(self.root).strip("/")
        return str(PurePosixPath(full.strip("/").removeprefix(root).lstrip("/")))

    def _make_folder(self, folder: Path) -> None:
        """Make a folder. The folder of a new pool is private to its owner."""
        if not Path(self.root).is_dir():
            make_folder(Path(self.root))
        folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def _written(self, content: bytes) -> Generator[Path]:
        """Write the content to a temporary file, which is removed afterwards."""
        file = Path(self.full(f"{_INCOMING}/{uuid4().hex}"))
        self._make_folder(file.parent)
        try:
            with file.open("xb") as sink:
                sink.write(content)
                sink.flush()
                os.fsync(sink.fileno())
            yield file
        finally:
            file.unlink(missing_ok=True)

    @contextmanager
    def _answering(self, path: str) -> Generator[None]:
        where = f"{self.address} ({path})" if path else self.address
        try:
            yield
        except WebotsMCPError:  # Raised inside the block.
            raise
        except OSError as error:
            what = error.strerror or str(error) or type(error).__name__
            if error.errno in _NO_ROOM:
                raise PoolUnavailableError(f"there is no room in {where}: {what}") from error
            if error.errno in _REFUSED or isinstance(error, PermissionError):
                raise PoolError(f"{where} cannot be used by this user: {what}") from error
            if error.errno in _NOT_A_FOLDER or isinstance(error, NotADirectoryError):
                raise PoolError(f"{where} cannot be a pool: {what}") from error
            raise PoolUnavailableError(f"{where} does not answer: {what}") from error
        except Exception as error:  # Each client of an object store has its own errors.
            raise PoolUnavailableError(f"{where} does not answer: {error}") from error


def _filesystem(url: str) -> tuple[Any, str]:
    """Return the filesystem and the root of a URL or a folder.

    Raises:
        PoolError: A package is missing. The text names it.
        InvalidInputError: The filesystem is unknown.
    """
    core = package("fsspec.core")
    try:
        # No cached listings: other processes ship to the same pool.
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
