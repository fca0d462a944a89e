"""Commands that run beside Webots: the server and the observer."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from webots_mcp.cli.ending import ending_in_time
from webots_mcp.cli.limits import Limits
from webots_mcp.cli.recordings import HERE, DataDir, Json, Where
from webots_mcp.cli.rendering import print_json
from webots_mcp.cli.values import Parameter, whole_number
from webots_mcp.contract import OBSERVER_NAME
from webots_mcp.errors import CommandRefusedError, WebotsMCPError

if TYPE_CHECKING:
    from webots_mcp.contract import Database
    from webots_mcp.store.retention.limits import Asked


_AS_BEFORE: Final = Limits()
_URL: Final = "WEBOTS_CONTROLLER_URL"


def serve(
    *,
    read_only: Annotated[
        bool,
        Parameter("--read-only", help="Leave out the tools that change the simulation."),
    ] = False,
    tools: Annotated[
        Literal["all", "core"],
        Parameter(
            "--tools",
            help="Which tools to list: core are the 17 that answer most questions; the others are "
            "there when they are called by name.",
        ),
    ] = "all",
    output_schemas: Annotated[
        bool,
        Parameter(
            "--output-schemas",
            help="List the schemas of the answers too, which need four times as much room as all "
            "else.",
        ),
    ] = False,
    limits: Limits = _AS_BEFORE,
    recorded: Where = HERE,
) -> None:
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
    database, data_dir = resolve_database(recorded.database, recorded.data_dir)
    asked = limits.asked()
    if sys.stdin.isatty():
        print(
            f"webots-mcp: serving {database} to an MCP client on stdin and stdout; Ctrl-C ends it. "
            "Clients start this command themselves, see 'webots-mcp serve --help'.",
            file=sys.stderr,
        )
    if asked and not read_only:
        _ask_for(asked, database, data_dir)
    with _keeping_what_is_made():
        from webots_mcp.server import create_server

        server = create_server(
            database,
            data_dir,
            read_only=read_only,
            core=tools == "core",
            output_schemas=output_schemas,
            limits=asked,
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


def observe(
    *,
    robot: Annotated[
        str,
        Parameter(
            "--robot",
            metavar="NAME",
            help=f"The Robot node to be, with supervisor TRUE ({OBSERVER_NAME}).",
        ),
    ] = OBSERVER_NAME,
    url: Annotated[
        str | None,
        Parameter(
            "--url",
            metavar="URL",
            help="Where Webots is: ipc://1234, tcp://192.168.1.5:1234; else here, at port 1234.",
        ),
    ] = None,
    period_ms: Annotated[
        int | None,
        Parameter(
            "--period-ms",
            metavar="N",
            converter=whole_number,
            help="Milliseconds of simulation time between two rows (100).",
        ),
    ] = None,
    data_dir: DataDir = None,
    as_json: Json = False,
) -> None:
    """Record where all robots of a running world are, as an extern controller of it.

    The world needs a robot for it, which 'webots-mcp init --observer WORLD --extern' adds; without
    --extern Webots starts the observer itself, and this command is not needed. It ends when Webots
    reloads the world or ends; with --json it says then where it has recorded.
    """
    from webots_mcp import observer
    from webots_mcp.contract import resolve_data_dir

    period_ms = observer.checked_period(observer.PERIOD_MS if period_ms is None else period_ms)
    address = _connect_to(url, robot)
    from controller import Supervisor  # type: ignore[import-not-found]

    observer.observe(Supervisor(), period_ms, data_dir=data_dir)
    if as_json:
        print_json({"url": address, "data_dir": str(resolve_data_dir(data_dir))})


def _connect_to(url: str | None, robot: str) -> str:
    """Set what Webots' library needs to find its simulator; returns the address of the robot.

    Raises:
        CommandRefusedError: There is no such library.
    """
    from webots_mcp.webots import DEFAULT_PORT, HOME_VARIABLE, installations

    url = url or os.environ.get(_URL) or f"ipc://{DEFAULT_PORT}"
    os.environ[_URL] = f"{url.rstrip('/')}/{robot}" if url.count("/") == 2 else url
    found = next((each for each in installations() if each.python_api), None)
    if found is not None and found.python_api is not None:
        os.environ.setdefault(HOME_VARIABLE, str(found.home))
        sys.path.append(str(found.python_api))
    try:
        import controller  # type: ignore[import-not-found]  # noqa: F401
    except (ImportError, KeyError, OSError) as error:
        raise CommandRefusedError(
            f"Webots' Python package 'controller' cannot be used ({error}): set {HOME_VARIABLE} "
            "to the folder of Webots"
        ) from error
    return os.environ[_URL]
