"""Commands that run something: the server, a migration."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from webots_mcp.cli.command import DATA_DIR, DATABASE, argument, command
from webots_mcp.cli.ending import ending_in_time
from webots_mcp.cli.limits import LIMITS, limits_of
from webots_mcp.errors import InvalidInputError, WebotsMCPError

if TYPE_CHECKING:
    from webots_mcp.contract import Database
    from webots_mcp.store.retention.limits import Asked


@command(
    "serve",
    DATA_DIR,
    DATABASE,
    argument(
        "--read-only", action="store_true", help="leave out the tools that change the simulation"
    ),
    argument(
        "--tools",
        choices=("all", "core"),
        default="all",
        help="which tools to list: core are the 17 that answer most questions; the others are "
        "there when they are called by name",
    ),
    argument(
        "--output-schemas",
        action="store_true",
        help="list the schemas of the answers too, which need four times as much room as all else",
    ),
    *LIMITS,
)
def serve(arguments: argparse.Namespace) -> None:
    """Serve a recording to an MCP client over stdin and stdout.

    Starts whether or not anything was recorded yet. 'webots-mcp init' tells clients of it; by
    hand, Claude Code is told with:

        claude mcp add webots -- webots-mcp serve --data-dir /path/to/project/mcp_data

    While it runs, and unless it is --read-only, the oldest of what is beyond the limits is deleted.
    Limits belong to the database: what 'webots-mcp prune' or 'retain' has set,
    or another server that runs, holds on, and is said.
    A LIMIT is a size (500MB), an age (30d), a number of rows (100000rows), several of them with
    commas between, or all, which keeps everything. 'webots-mcp prune --dry-run' with the same
    limits tells what would go.
    """
    import logging

    from webots_mcp.contract import resolve_database

    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    database, data_dir = resolve_database(arguments.database, arguments.data_dir)
    limits = limits_of(arguments)
    if sys.stdin.isatty():
        print(
            f"webots-mcp: serving {database} to an MCP client on stdin and stdout; Ctrl-C ends it. "
            "Clients start this command themselves, see 'webots-mcp serve --help'.",
            file=sys.stderr,
        )
    if limits and not arguments.read_only:
        _ask_for(limits, database, data_dir)
    with _keeping_what_is_made():
        from webots_mcp.server import create_server

        server = create_server(
            database,
            data_dir,
            read_only=arguments.read_only,
            core=arguments.tools == "core",
            output_schemas=arguments.output_schemas,
            limits=limits,
        )
    with ending_in_time(), _ending_with_the_client():
        server.run()


@contextmanager
def _ending_with_the_client() -> Generator[None]:
    """A client that has gone does not read the last answer: that is an end and no defect."""
    try:
        yield
    except Exception as error:
        if not _is_broken_pipe(error):
            raise
        raise BrokenPipeError from error


def _is_broken_pipe(error: object) -> bool:
    """Whether it is nothing else, also where the server's tasks have grouped it."""
    parts: tuple[object, ...] = getattr(error, "exceptions", ())
    return all(map(_is_broken_pipe, parts)) if parts else isinstance(error, BrokenPipeError)


@contextmanager
def _keeping_what_is_made() -> Generator[None]:
    """What is imported stays for good: to look for garbage in it takes a tenth of the start."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _ask_for(limits: Asked, database: Database, data_dir: Path) -> None:
    """Set the limits where that is this server's to do; say which others hold."""
    from webots_mcp.errors import NoDatabaseError
    from webots_mcp.store.recording import Recording
    from webots_mcp.store.retention.limits import ask_at_start

    try:
        with Recording(database, data_dir).writer() as connection:
            notes = ask_at_start(connection, limits)
    except NoDatabaseError:
        return  # they are set when there is one
    except WebotsMCPError as error:  # which the tools tell, in an answer
        notes = [f"the limits were not set: {error}"]
    for note in notes:
        print(f"webots-mcp: {note}", file=sys.stderr)


@command(
    "migrate",
    DATA_DIR,
    DATABASE,
    argument("--revision", default="head", help="an Alembic revision (default: the newest)"),
)
def migrate(arguments: argparse.Namespace) -> None:
    """Bring a database to the schema of this version; its data is kept."""
    from alembic.util import CommandError

    from webots_mcp.connection import is_there
    from webots_mcp.contract import MemoryDatabase, resolve_database
    from webots_mcp.store.recording import Recording

    database, data_dir = resolve_database(arguments.database, arguments.data_dir)
    if isinstance(database, MemoryDatabase) or not is_there(database):
        raise InvalidInputError(f"no database at {database}: give --data-dir or --database")
    try:
        before, after = Recording(database, data_dir).migrate(arguments.revision)
    except CommandError as error:
        raise InvalidInputError(f"--revision {arguments.revision}: {error}") from error
    print(f"{database}: schema {before}, now {after}" if before != after else f"schema {after}")
