"""One SQL statement in a process of its own, which its deadline ends whatever the engine is doing.

SQLite looks at its deadline between the steps of its virtual machine, and one call of `replace` on
long texts is one step of half a minute; DuckDB is no quicker. A process can be ended inside it, and
takes its memory along. It gets one request as JSON on stdin and gives one answer as JSON on stdout.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import sys
import tempfile
import threading
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import webots_mcp
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME, Database
from webots_mcp.errors import InvalidInputError, WebotsMCPError
from webots_mcp.store.questions.sql import TOO_LARGE, Cell, Result, query_sql, too_slow

LINE: Final = (sys.executable, "-m", __name__)
# Modules are looked for here first, so that no file of the user's folder is taken for one.
FOLDER: Final = Path(webots_mcp.__file__).parent.parent

_MAX_HEAP_BYTES: Final = 400_000_000
_TIMED_OUT: Final = 124  # the exit code of timeout(1): no other end of the process has it
_GRACE_S: Final = 0.3  # SQLite's own deadline comes first: it keeps the rows that were found


@dataclass(frozen=True)
class Statement:
    """What is asked; see `query_sql`. The database is a file, or the URL of a pool."""

    database: str
    sql: str
    max_rows: int
    max_bytes: int
    deadline_s: float

    def encoded(self) -> bytes:
        """The request as the process takes it."""
        return json.dumps(asdict(self), ensure_ascii=False).encode()  # what is no text fails here


def decode(answer: bytes, exit_code: int, asked: Statement, slow: str | None = None) -> Result:
    """What the process answered; one that ended itself before it could answer took too long.

    Args:
        answer: What it wrote to stdout.
        exit_code: Its own.
        asked: What it was asked.
        slow: What to do about a statement that takes too long, where it is not asked of SQLite.

    Raises:
        InvalidInputError: As `query_sql`.
        WebotsMCPError: The process ended for another reason, not because of the statement.
    """
    if exit_code == _TIMED_OUT:
        raise InvalidInputError(slow or too_slow(asked.deadline_s))
    if exit_code < 0:
        raise InvalidInputError(f"signal {-exit_code} ended the statement; perhaps {TOO_LARGE}")
    if exit_code != 0:
        raise WebotsMCPError(
            f"the process that runs the statement ended without an answer (exit code {exit_code}); "
            "the server's stderr may tell why. Was webots-mcp updated or moved since the server "
            "started? Then start the server again"
        )
    found = json.loads(answer)
    if "error" in found:
        raise InvalidInputError(found["error"])
    rows: tuple[tuple[Cell, ...], ...] = tuple(tuple(row) for row in found["rows"])
    return Result(tuple(found["columns"]), rows, found["truncated"], found["shortened"])


@contextlib.contextmanager
def as_file(database: Database) -> Generator[Path]:
    """The database as a file that another process can open; one in memory is copied to a file."""
    if isinstance(database, Path):
        yield database
        return
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as folder:
        file = Path(folder) / DATABASE_NAME
        with closing(connect(database, "reader")) as memory, closing(sqlite3.connect(file)) as copy:
            memory.backup(copy)
        yield file


def main(ask: Callable[[Statement], Result]) -> None:
    """Answer the request on stdin."""
    asked = Statement(**json.load(sys.stdin))
    end = threading.Timer(asked.deadline_s + _GRACE_S, os._exit, [_TIMED_OUT])
    end.daemon = True
    end.start()
    try:
        answer = asdict(ask(asked))
    except (WebotsMCPError, sqlite3.Error) as error:
        answer = {"error": str(error)}
    except MemoryError:
        answer = {"error": TOO_LARGE}
    sys.stdout.write(json.dumps(answer))


def _ask(asked: Statement) -> Result:
    with closing(connect(Path(asked.database), "reader")) as connection:
        connection.execute(f"PRAGMA hard_heap_limit={_MAX_HEAP_BYTES}")
        return query_sql(
            connection, asked.sql, max_rows=asked.max_rows, max_bytes=asked.max_bytes,
            deadline_s=asked.deadline_s,
        )  # fmt: skip


if __name__ == "__main__":
    main(_ask)
