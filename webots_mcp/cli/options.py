"""Define the options that commands share: values, recording, range, limits of retention."""

from __future__ import annotations

import functools
import json
import math
import re
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, ParamSpec, TypeAlias

import cyclopts
from cyclopts import Token
from cyclopts.validators import Number

from webots_mcp.errors import InvalidInputError, MalformedRowError, WebotsMCPError
from webots_mcp.store.retention_limits import (
    DEFAULT,
    NO_LIMIT,
    Asked,
    Limit,
    limit_text,
    option_of,
    parse_limit,
)

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.store.reading.ranges import Scope, TimeRange
    from webots_mcp.store.recording import RecordingAccess

if TYPE_CHECKING or hasattr(cyclopts.Parameter(), "metavar"):
    Parameter = cyclopts.Parameter
else:  # cyclopts 4, the last version for Python 3.10, has no words for the values of options

    def Parameter(*names: str, metavar: str | None = None, **given: Any) -> cyclopts.Parameter:  # noqa: N802
        """Return a parameter by its spelling, without the word for its value."""
        return cyclopts.Parameter(*names, **given)


_TOO_LARGE: Final = 2**63  # limit of SQLite, above all assigned ids
_NO_KINDS: Final[Mapping[str, str]] = MappingProxyType({})
_RUNS: Final = "outlive"


def whole_number(_kind: Any, tokens: Sequence[Token]) -> int:
    """Return the typed whole number; cyclopts by itself would round 1.5.

    Raises:
        ValueError: It is no whole number, or exceeds the range of SQLite.
    """
    text = tokens[0].value
    if not re.fullmatch(r"[+-]?[0-9]+", text):
        raise ValueError(f"{text!r} is not a whole number")
    if abs(int(text)) >= _TOO_LARGE:
        raise ValueError(f"{text} is too large")
    return int(text)


def refuse_options(_kind: Any, value: Any) -> None:
    """Refuse unknown options, but accept a lone hyphen and conditions such as '-x > 3' as values.

    Raises:
        ValueError: It is an unknown option.
    """
    if isinstance(value, (str, Path)) and re.match(r"--?\w[\w-]*(=|$)", str(value)):
        raise ValueError(f"unknown option {value}")


def _row_id(_kind: Any, tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    if (
        text.isascii() and text.isdecimal() and int(text) < _TOO_LARGE
    ):  # an id that SQLite could have assigned
        return int(text)
    raise ValueError(f"{text!r} is not an id. An id is a number from an answer")


Id: TypeAlias = Annotated[int, Parameter(converter=_row_id)]
Count: TypeAlias = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1))]


def settings_of(texts: Sequence[str], kinds: Mapping[str, str] = _NO_KINDS) -> dict[str, Any]:
    """Return values by name from texts NAME=VALUE; a value that is no JSON is a text.

    Args:
        texts: The texts as typed.
        kinds: Kinds of parameters by name: a value of kind `str` is a text even if it looks like a
            number.

    Raises:
        InvalidInputError: A text has no `=`.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InvalidInputError(f"{text!r} has no value. Write {name}=VALUE.")
        values[name] = value if kinds.get(name) == "str" else value_of(value)
    return values


def value_of(text: str) -> Any:
    """Return a typed value parsed as JSON, or else as text."""
    try:
        return json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        return text


def _no_constant(name: str) -> float:
    """Refuse NaN and the infinities, which Python accepts but JSON does not."""
    raise ValueError(name)


# -- which recording, which part of it, and how it is opened ---------------------------------------

_Given = ParamSpec("_Given")
Json: TypeAlias = Annotated[
    bool, Parameter("--json", negative=(), help="Print the answer as JSON.")
]
Robot: TypeAlias = Annotated[
    str | None,
    Parameter(
        "--robot", metavar="NAME", help="Name of the robot. Needed only if several robots are live."
    ),
]
# Shells complete file names for arguments of type `Path`.
DataDir: TypeAlias = Annotated[
    Path | None,
    Parameter(
        "--data-dir",
        metavar="DIR",
        help="Folder of the database and the pictures. Default: WEBOTS_MCP_DATA_DIR, else "
        "mcp_data/ "
        "in the nearest Webots project, else ~/.webots-mcp/data.",
    ),
]
RunId: TypeAlias = Annotated[
    Id | None,
    Parameter(
        "--run", metavar="ID", help="Run number, from 'webots-mcp runs'. Default: the newest."
    ),
]


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """The recording of a command."""

    data_dir: DataDir = None
    database: Annotated[
        Path | None,
        Parameter("--database", metavar="FILE", help="Database file, if it is not in that folder."),
    ] = None

    def recording(self, *, read_only: bool = True) -> RecordingAccess:
        """Return the recording."""
        from webots_mcp.cli.terminal import note_recording
        from webots_mcp.database.location import resolve_database
        from webots_mcp.store.recording import RecordingAccess

        where = resolve_database(self.database, self.data_dir)
        note_recording(where[0])
        return RecordingAccess(*where, read_only=read_only, asker="cli")

    def typed(self) -> list[str]:
        """Return the options that name the recording in another command line."""
        given = (("--data-dir", self.data_dir), ("--database", self.database))
        return [text for option, value in given if value for text in (option, str(value))]

    @contextmanager
    def reader(self) -> Generator[sqlite3.Connection]:
        """Open a reading connection; unusual ways of reading the file are reported on stderr."""
        from webots_mcp.store.recording import storage

        with self.recording().reader() as connection:
            for said in storage(connection).values():
                print(f"webots-mcp: {said}", file=sys.stderr)
            yield connection

    def may_change(self) -> bool:
        """Return whether rows may still be added; never if the file cannot be written."""
        from webots_mcp.database.connection import FrozenConnection

        with self.recording().reader() as connection:
            return not isinstance(connection, FrozenConnection)

    @contextmanager
    def writer(
        self, command: str, arguments: Mapping[str, Any] = _NO_KINDS, *, create: bool = False
    ) -> Generator[tuple[RecordingAccess, sqlite3.Connection]]:
        """Open the recording and a writing connection for a command with such arguments.

        Raises:
            NotAllowedError: The project's file does not allow the command.
        """
        from webots_mcp.store.requests import BY_COMMAND_LINE, OpenRequest

        recording = self.recording(read_only=False)
        if create:
            recording.create()
        asked = OpenRequest(recording, BY_COMMAND_LINE, [command], arguments)
        with asked, recording.writer() as connection:
            yield recording, connection


HERE: Final = Where()


@Parameter(name="*")
@dataclass(frozen=True)
class ToRobot(Where):
    """The robot that a command addresses."""

    robot: Robot = None


@Parameter(name="*")
@dataclass(frozen=True)
class Waiting(ToRobot):
    """The robot that a command addresses, and how long it waits for the answer."""

    timeout_wall_s: Annotated[
        float | None,
        Parameter(
            "--timeout", metavar="S", help="Maximum wall-clock seconds to wait. Default: 600."
        ),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class ToWebots(Waiting):
    """The robot that a command addresses, if Webots itself can do it as well."""

    force: Annotated[
        bool, Parameter("--force", help="Press keys in the window of Webots if nothing else works.")
    ] = False
    port: Annotated[
        int | None,
        Parameter(
            "--port",
            metavar="PORT",
            converter=whole_number,
            help="Port of a Webots that runs another project, such as 1235.",
        ),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class TimeRangeOptions:
    """The options for a run of a robot and a range of it."""

    robot: Robot = None
    run_id: RunId = None
    last_s: Annotated[
        float | None,
        Parameter("--last", metavar="S", help="Only the last S seconds of simulated time."),
    ] = None
    start_s: Annotated[
        float | None,
        Parameter("--start", metavar="S", help="Start of the range in simulated seconds."),
    ] = None
    end_s: Annotated[
        float | None,
        Parameter(
            "--end", metavar="S", help="End of the range in simulated seconds, not included."
        ),
    ] = None
    since_wall_time: Annotated[
        str | None,
        Parameter(
            "--since",
            metavar="TIME",
            help="Start of the range as a wall-clock time: 2026-05-01T03:00:00Z, or Unix seconds.",
        ),
    ] = None
    until_wall_time: Annotated[
        str | None,
        Parameter(
            "--until", metavar="TIME", help="End of the range as a wall-clock time, not included."
        ),
    ] = None

    def scope(self) -> Scope:
        """Return the scope that the options mean."""
        from webots_mcp.store.reading.ranges import Scope

        return Scope(**vars(self))

    def in_recording(self, connection: sqlite3.Connection) -> TimeRange:
        """Return what the options mean in a recording."""
        from webots_mcp.store.reading.ranges import find_range

        return find_range(connection, self.scope())


def only_reading(command: Callable[_Given, None]) -> Callable[_Given, None]:
    """Decorate a command that only reads, so that it reads again past invalid rows if needed."""

    @functools.wraps(command)
    def read(*arguments: _Given.args, **options: _Given.kwargs) -> None:
        past_wrong_values(functools.partial(command, *arguments, **options))

    return read


def past_wrong_values(run: Callable[[], None]) -> None:
    """Run a reading function; if it fails because of a value, run it again past invalid rows."""
    try:
        return run()
    except Exception as error:
        # Other errors are due to a value in a row: reading past invalid rows helps only there.
        is_other = isinstance(error, (WebotsMCPError, OSError, ImportError))
        if is_other and not isinstance(error, MalformedRowError):
            raise
    past_invalid_rows(run)


def past_invalid_rows(run: Callable[[], None]) -> None:
    """Run a reading function past invalid rows, which are named on stderr."""
    from webots_mcp.store import invalid_rows

    with invalid_rows.past_invalid_rows() as invalid:
        run()
    for said in invalid.described():
        print(f"webots-mcp: left out: {said}", file=sys.stderr)


def make_chunks_first(recording: RecordingAccess) -> None:
    """Put rows into chunks that no server has handled, so that any question can be answered."""
    from webots_mcp.cli.streams import shown_progress
    from webots_mcp.store.chunk_making import make_missing_chunks

    with shown_progress("preparing statistics") as progress:
        # A million rows of 40 values take 100 s.
        left = make_missing_chunks(recording, progress, limit_s=300.0)
    if left:
        print(f"webots-mcp: {left}", file=sys.stderr)


# -- how much is kept --


def _option(name: str, text: str) -> Parameter:
    """Return the option of a limit, with the default."""
    value = getattr(DEFAULT, name)
    text += f" Default: {value:g}." if name == _RUNS else f" Default: {limit_text(value)}."
    if isinstance(value, Limit) and value.limits:
        text += f" A limit by age always keeps the newest {value.spared_rows:,} rows."
    return Parameter(_name_of(name), metavar="TIMES" if name == _RUNS else "LIMIT", help=text)


def _name_of(name: str) -> str:
    return option_of("run" if name == _RUNS else name)


@Parameter(name="*")
@dataclass(frozen=True)
class RetentionOptions:
    """How much of each kind is kept, as typed; by the names of `Retention`."""

    state: Annotated[str | None, _option("state", "Limit for recorded states.")] = None
    kept_state: Annotated[
        str | None,
        _option("kept_state", "Limit for full-rate segments."),
    ] = None
    chunk: Annotated[
        str | None,
        _option("chunk", "Limit for the values in chunks, which outlive states."),
    ] = None
    log: Annotated[str | None, _option("log", "Limit for log lines.")] = None
    event: Annotated[
        str | None,
        _option("event", "Limit for events. Its age also applies to commands."),
    ] = None
    image: Annotated[str | None, _option("image", "Limit for pictures with their files.")] = None
    outlive: Annotated[
        str | None,
        _option(
            _RUNS,
            "How many times longer than its states the rest of a run is kept, or 'all' to keep it "
            "forever.",
        ),
    ] = None

    def asked(self) -> Asked:
        """Return the given limits; None resets a limit to the default.

        Raises:
            InvalidInputError: A text is not a limit, or a number is below 1.
        """
        given = {name: text for name, text in vars(self).items() if text is not None}
        return {name: _value(name, text) for name, text in given.items()}


def _value(name: str, text: str) -> Limit | float | None:
    if text == "default":
        return None
    try:
        if name == _RUNS:
            return _times_of(text)
        return parse_limit(text, getattr(DEFAULT, name))
    except InvalidInputError as error:
        raise InvalidInputError(f"{_name_of(name)}: {error}") from error


def _times_of(text: str) -> float:
    """Return a number of times; 0 means for ever, which is typed as all."""
    if text == NO_LIMIT:
        return 0.0
    try:
        times = float(text)
    except ValueError:
        times = math.nan
    if not 1 <= times < math.inf:
        raise InvalidInputError(
            f"{text!r} is not a number of times. Give a number from 1, or {NO_LIMIT}."
        )
    return times
