"""What a console command is: a function, its arguments, and how it gets at a recording."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from webots_mcp.cli.recordings import past_invalid_rows as past_invalid_rows
from webots_mcp.cli.recordings import past_wrong_values as past_wrong_values
from webots_mcp.cli.values import settings_of as settings_of
from webots_mcp.cli.values import value_of as value_of

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.store.recording import Recording


class Argument(NamedTuple):
    """What `add_argument` takes."""

    flags: tuple[str, ...]
    options: dict[str, Any]

    @property
    def name(self) -> str:
        """What the value is called in the code, and in the questions that it is passed to."""
        return self.options.get("dest") or self.flags[-1].lstrip("-").replace("-", "_")

    @property
    def typed(self) -> str:
        """What a person types or reads in the help."""
        return self.flags[-1] if self.flags[-1].startswith("-") else self.value_name

    @property
    def value_name(self) -> str:
        """How the help calls the value."""
        return self.options.get("metavar") or self.name.upper()


class Command(NamedTuple):
    """A subcommand: its name, its function (whose docstring is its help), its arguments.

    What the function returns is the exit code; None is 0.
    """

    name: str
    run: Callable[[argparse.Namespace], int | None]
    arguments: tuple[Argument, ...]


_Run = TypeVar("_Run", bound=Callable[[argparse.Namespace], int | None])
COMMANDS: Final[list[Command]] = []
_SUM_UP_S: Final = 300.0  # a million rows of 40 values take 100 s


def argument(*flags: str, **options: Any) -> Argument:
    """An argument of a command, as `argparse` takes it."""
    return Argument(flags, options)


def count(
    flag: str,
    what: str,
    *,
    default: int | None,
    least: int = 1,
    dest: str = "limit",
    metavar: str = "N",
) -> Argument:
    """An argument that says how many; `what` is its help, to which a default is added."""

    def parse(text: str) -> int:
        if text.isascii() and text.isdecimal() and int(text) >= least:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number, {least} or more")

    told = what if default is None else f"{what} ({default})"
    return argument(flag, type=parse, default=default, dest=dest, metavar=metavar, help=told)


def row_id(text: str) -> int:
    """The id of a run, a command or another row, as `argparse` takes types.

    Raises:
        argparse.ArgumentTypeError: It is none that SQLite could have given.
    """
    if text.isascii() and text.isdecimal() and int(text) < 2**63:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no id: it is a number that an answer has told")


def command(name: str, *arguments: Argument) -> Callable[[_Run], _Run]:
    """Make a function a subcommand."""

    def register(run: _Run) -> _Run:
        COMMANDS.append(Command(name, run, arguments))
        return run

    return register


def question(
    name: str, *arguments: Argument
) -> Callable[[Callable[[argparse.Namespace], None]], Callable[[argparse.Namespace], None]]:
    """Make a function that only reads a subcommand.

    One that fails over a value that no bridge has written is asked again past such rows, which are
    named on stderr.
    """

    def register(run: Callable[[argparse.Namespace], None]) -> Callable[..., None]:
        @functools.wraps(run)
        def ask(arguments: argparse.Namespace) -> None:
            past_wrong_values(functools.partial(run, arguments))

        return command(name, *arguments)(ask)

    return register


DATA_DIR: Final = argument(
    "--data-dir",
    metavar="DIR",
    help="folder of the database and the pictures (default: mcp_data/ in the nearest Webots "
    "project, else ~/.webots-mcp/data; also WEBOTS_MCP_DATA_DIR)",
)
DATABASE: Final = argument("--database", metavar="FILE", help="the database file itself")
ROBOT: Final = argument("--robot", metavar="NAME", help="only this robot")
JSON: Final = argument("--json", action="store_true", help="print it as JSON")


@contextmanager
def reading(arguments: argparse.Namespace) -> Generator[sqlite3.Connection]:
    """A connection to the recording; how it is read is said on stderr where that matters."""
    from webots_mcp.store.recording import storage

    with open_recording(arguments).reader() as connection:
        for said in storage(connection).values():
            print(f"webots-mcp: {said}", file=sys.stderr)
        yield connection


@contextmanager
def reading_long(arguments: argparse.Namespace) -> Generator[sqlite3.Connection]:
    """As `reading`, of any length of a run: what no server has rolled up is rolled up first."""
    from webots_mcp.cli.progress import shown_progress
    from webots_mcp.store.summing_up import sum_up

    with shown_progress("summing up what was recorded") as progress:
        left = sum_up(open_recording(arguments), progress, limit_s=_SUM_UP_S)
    if left:
        print(f"webots-mcp: {left}", file=sys.stderr)
    with reading(arguments) as connection:
        yield connection


def open_recording(arguments: argparse.Namespace) -> Recording:
    """The recording that a command reads; commands that only look never migrate it."""
    from webots_mcp.contract import resolve_database
    from webots_mcp.store.recording import Recording

    return Recording(*resolve_database(arguments.database, arguments.data_dir), read_only=True)


@contextmanager
def writing(
    arguments: argparse.Namespace, *, create: bool = False
) -> Generator[tuple[Recording, sqlite3.Connection]]:
    """The recording, migrated where it has to be, and a connection that may write to it."""
    from webots_mcp.contract import resolve_database
    from webots_mcp.store.recording import Recording

    recording = Recording(*resolve_database(arguments.database, arguments.data_dir))
    if create:
        recording.create()
    with recording.writer() as connection:
        yield recording, connection
