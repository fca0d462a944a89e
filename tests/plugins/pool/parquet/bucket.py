"""A filesystem as an object store is: puts are whole, nothing is renamed, and it can fail."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

fsspec: Any = import_module("fsspec")  # it has no types
MemoryFileSystem: Any = import_module("fsspec.implementations.memory").MemoryFileSystem


class KilledError(BaseException):
    """Nothing catches it: the process is gone."""


class Bucket(MemoryFileSystem):
    """As MemoryFileSystem, with what an object store has not left out."""

    protocol = ("bucket", "s3")
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    cachable = False
    puts_left: ClassVar[int | None] = None
    failure: ClassVar[BaseException] = KilledError()
    puts: ClassVar[int] = 0

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return super()._strip_protocol(path.replace("bucket://", "memory://"))

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **options: Any) -> None:
        self._count()
        super().pipe_file(path, value, mode=mode, **options)

    def rm_file(self, path: str) -> None:
        self._count()
        super().rm_file(path)

    def mv(self, *_: Any, **__: Any) -> None:
        raise OSError("object stores rename nothing")

    def _count(self) -> None:
        Bucket.puts += 1
        if Bucket.puts_left is not None:
            if Bucket.puts_left == 0:
                raise Bucket.failure
            Bucket.puts_left -= 1


fsspec.register_implementation("bucket", Bucket, clobber=True)


def empty() -> str:
    """The URL of a new bucket, which never fails."""
    Bucket.store.clear()
    Bucket.pseudo_dirs[:] = [""]
    Bucket.puts, Bucket.puts_left = 0, None
    return "bucket://pool/robots"


def copy_to(folder: Path) -> None:
    """What is in the pool, as files."""
    for path, content in Bucket.store.items():
        file = folder / path.removeprefix("/pool/robots/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.getvalue())


@contextmanager
def failing(after: int, error: BaseException) -> Generator[None]:
    """From the put after so many on, each fails so."""
    Bucket.puts_left, Bucket.failure = after, error
    try:
        yield
    finally:
        Bucket.puts_left = None
