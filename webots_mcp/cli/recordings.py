"""Which recording a command is about, which part of it, and how it is opened."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, ParamSpec, TypeAlias

from webots_mcp.cli.values import Id, Parameter, whole_number
from webots_mcp.errors import MalformedRowError, WebotsMCPError

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.store.reading.ranges import Scope, TimeRange
    from webots_mcp.store.recording import Recording

_Given = ParamSpec("_Given")
# Not owed to a value in a row: reading past invalid rows would not help.
_OF_NO_VALUE: Final = (WebotsMCPError, OSError, ImportError)

_MAKING_CHUNKS_S: Final = 300.0  # a million rows of 40 values take 100 s
Json: TypeAlias = Annotated[bool, Parameter("--json", negative=(), help="Print JSON.")]
Robot: TypeAlias = Annotated[
    str | None, Parameter("--robot", metavar="NAME", help="Only this robot.")
]
# Of a `Path` the shell completes the names of files.
DataDir: TypeAlias = Annotated[
    Path | None,
    Parameter(
        "--data-dir",
        metavar="DIR",
        help="The folder of the database and the pictures; by default mcp_data/ in the nearest "
        "Webots project, else ~/.webots-mcp/data; also WEBOTS_MCP_DATA_DIR.",
    ),
]
RunId: TypeAlias = Annotated[
    Id | None, Parameter("--run", metavar="ID", help="That run, not the newest one.")
]


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """The recording of a command."""

    data_dir: DataDir = None
    database: Annotated[
        Path | None, Parameter("--database", metavar="FILE", help="The database file itself.")
    ] = None

    def recording(self, *, read_only: bool = True) -> Recording:
        """The recording."""
        from webots_mcp.contract import resolve_database
        from webots_mcp.store.recording import Recording

        where = resolve_database(self.database, self.data_dir)
        return Recording(*where, read_only=read_only, asker="cli")

    def typed(self) -> list[str]:
        """The options that name it in another command line."""
        given = (("--data-dir", self.data_dir), ("--database", self.database))
        return [text for option, value in given if value for text in (option, str(value))]

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
        """The recording, and a connection that may write to it."""
        recording = self.recording(read_only=False)
        if create:
            recording.create()
        with recording.writer() as connection:
            yield recording, connection


HERE: Final = Where()


@Parameter(name="*")
@dataclass(frozen=True)
class ToRobot(Where):
    """Whom a command asks."""

    robot: Robot = None


@Parameter(name="*")
@dataclass(frozen=True)
class Waiting(ToRobot):
    """Whom a command asks, and how long it waits for the answer."""

    timeout_wall_s: Annotated[
        float | None,
        Parameter("--timeout", metavar="S", help="Wait up to so many wall seconds (600)."),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class ToWebots(Waiting):
    """The same, where Webots itself can be asked as well."""

    force: Annotated[
        bool, Parameter("--force", help="Press Webots' keys where nothing else works.")
    ] = False
    port: Annotated[
        int | None,
        Parameter(
            "--port", metavar="PORT", converter=whole_number, help="Of a Webots of another project."
        ),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class Range:
    """Which run of which robot, and which stretch of it: the options that commands share."""

    robot: Robot = None
    run_id: RunId = None
    last_s: Annotated[
        float | None,
        Parameter("--last", metavar="S", help="The last so many seconds of simulation time."),
    ] = None
    start_s: Annotated[
        float | None, Parameter("--start", metavar="S", help="From this simulation time on.")
    ] = None
    end_s: Annotated[
        float | None,
        Parameter("--end", metavar="S", help="Up to, not including, this simulation time."),
    ] = None
    since_wall_time: Annotated[
        str | None,
        Parameter(
            "--since", metavar="TIME", help="From this wall time on (ISO 8601 or Unix seconds)."
        ),
    ] = None
    until_wall_time: Annotated[
        str | None,
        Parameter("--until", metavar="TIME", help="Up to, not including, this wall time."),
    ] = None

    def scope(self) -> Scope:
        """What is asked for."""
        from webots_mcp.store.reading.ranges import Scope

        return Scope(**vars(self))

    def in_recording(self, connection: sqlite3.Connection) -> TimeRange:
        """What the options mean in a recording."""
        from webots_mcp.store.reading.ranges import find_range

        return find_range(connection, self.scope())


def only_reading(command: Callable[_Given, None]) -> Callable[_Given, None]:
    """A command that fails over a value that no bridge has written reads again past such rows."""

    @functools.wraps(command)
    def read(*arguments: _Given.args, **options: _Given.kwargs) -> None:
        past_wrong_values(functools.partial(command, *arguments, **options))

    return read


def past_wrong_values(run: Callable[[], None]) -> None:
    """Run what only reads; where it fails over a value, again past invalid rows."""
    try:
        return run()
    except Exception as error:
        if isinstance(error, _OF_NO_VALUE) and not isinstance(error, MalformedRowError):
            raise
    past_invalid_rows(run)


def past_invalid_rows(run: Callable[[], None]) -> None:
    """Run what only reads past invalid rows, which are named on stderr."""
    from webots_mcp.store import recording as invalid_rows

    with invalid_rows.past_invalid_rows() as invalid:
        run()
    for said in invalid.described():
        print(f"webots-mcp: left out: {said}", file=sys.stderr)


def make_chunks_first(recording: Recording) -> None:
    """Put into chunks what no server has, so that a question of any length is answered."""
    from webots_mcp.cli.terminal import shown_progress
    from webots_mcp.store.chunk_making import make_missing_chunks

    with shown_progress("making chunks of what was recorded") as progress:
        left = make_missing_chunks(recording, progress, limit_s=_MAKING_CHUNKS_S)
    if left:
        print(f"webots-mcp: {left}", file=sys.stderr)
