"""Which recording a command is about, and how it is opened."""

from __future__ import annotations

import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

from cyclopts import Parameter

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.store.recording import Recording

_SUM_UP_S: Final = 300.0  # a million rows of 40 values take 100 s
Json: TypeAlias = Annotated[bool, Parameter("--json", help="Print JSON.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """The recording of a command."""

    data_dir: Annotated[
        str | None,
        Parameter(
            "--data-dir",
            help="The folder of the database and the pictures; by default mcp_data/ in the nearest "
            "Webots project, else ~/.webots-mcp/data; also WEBOTS_MCP_DATA_DIR.",
        ),
    ] = None
    database: Annotated[str | None, Parameter("--database", help="The database file itself.")] = (
        None
    )

    def recording(self, *, read_only: bool = True) -> Recording:
        """The recording; read-only it is never migrated."""
        from webots_mcp.contract import resolve_database
        from webots_mcp.store.recording import Recording

        where = resolve_database(self.database, self.data_dir)
        return Recording(*where, read_only=read_only, asker="cli")

    @contextmanager
    def reader(self) -> Generator[sqlite3.Connection]:
        """A connection that reads; how the file is read is said on stderr where that matters."""
        from webots_mcp.store.recording import storage

        with self.recording().reader() as connection:
            for said in storage(connection).values():
                print(f"webots-mcp: {said}", file=sys.stderr)
            yield connection

    @contextmanager
    def writer(self, *, create: bool = False) -> Generator[tuple[Recording, sqlite3.Connection]]:
        """The recording, migrated where it has to be, and a connection that may write to it."""
        recording = self.recording(read_only=False)
        if create:
            recording.create()
        with recording.writer() as connection:
            yield recording, connection


def sum_up_first(recording: Recording) -> None:
    """Roll up what no server has rolled up, so that a question of any length is answered."""
    from webots_mcp.cli.progress import shown_progress
    from webots_mcp.store.summing_up import sum_up

    with shown_progress("summing up what was recorded") as progress:
        left = sum_up(recording, progress, limit_s=_SUM_UP_S)
    if left:
        print(f"webots-mcp: {left}", file=sys.stderr)
