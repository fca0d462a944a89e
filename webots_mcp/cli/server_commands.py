"""Define the commands that run next to Webots (serve, token, observe) or start it (launch)."""

from __future__ import annotations

import gc
import math
import os
import shlex
import sys
import threading
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from cyclopts.validators import Number

from webots_mcp.cli.interrupts import ending_in_time
from webots_mcp.cli.options import (
    HERE,
    DataDir,
    Json,
    Parameter,
    RetentionOptions,
    Where,
    whole_number,
)
from webots_mcp.cli.terminal import print_json
from webots_mcp.contract import OBSERVER_NAME
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError
from webots_mcp.extras.plugin_registry import stand_in_simulator

if TYPE_CHECKING:
    from webots_mcp.database.location import Database
    from webots_mcp.server.endpoint import Endpoint
    from webots_mcp.simulator.launch import SessionStart, WebotsLaunch
    from webots_mcp.simulator.orders import WebotsLine
    from webots_mcp.store.recording import RecordingAccess
    from webots_mcp.store.retention_limits import Asked

_AS_BEFORE: Final = RetentionOptions()
_URL: Final = "WEBOTS_CONTROLLER_URL"
_LOOK_EVERY_S: Final = 0.2
MAX_PORT: Final = 65_535


def serve(
    *,
    read_only: Annotated[
        bool, Parameter("--read-only", help="Offer only tools that change nothing.")
    ] = False,
    tools: Annotated[
        Literal["core", "default", "all"],
        Parameter(
            "--tools",
            help="Tools to list: core (17 tools), default (34) or all. Tools that are not listed "
            "can still be called by name.",
        ),
    ] = "default",
    output_schemas: Annotated[
        bool,
        Parameter(
            "--output-schemas",
            help="Also list the schemas of the answers. This makes the list five times as long.",
        ),
    ] = False,
    http: Annotated[
        str | None,
        Parameter(
            "--http",
            metavar="[HOST:]PORT",
            help="Serve many clients over HTTP at this port, such as 8000. HOST is 127.0.0.1 by "
            "default. Clients need the token of 'webots-mcp token'.",
        ),
    ] = None,
    allow_host: Annotated[
        tuple[str, ...],
        Parameter(
            "--allow-host",
            metavar="NAME",
            help="With --http: host name that clients may use for this computer. Required, with "
            "the TLS files, if HOST can be reached from the network.",
        ),
    ] = (),
    tls_cert: Annotated[
        Path | None,
        Parameter(
            "--tls-cert",
            metavar="FILE",
            help="With --http: certificate with its chain, as a PEM file.",
        ),
    ] = None,
    tls_key: Annotated[
        Path | None,
        Parameter(
            "--tls-key", metavar="FILE", help="With --http: key of the certificate, as a PEM file."
        ),
    ] = None,
    notify: Annotated[
        bool,
        Parameter(
            "--notify",
            negative=(),
            help="Notify clients that support channels (Claude Code) when a breakpoint is hit, an "
            "expectation is violated, a controller crashes or trials finish. See 'webots-mcp help "
            "updates'.",
        ),
    ] = False,
    limits: RetentionOptions = _AS_BEFORE,
    recorded: Where = HERE,
) -> None:
    """Serve a recording to an MCP client over stdin and stdout, or to many clients over HTTP.

    'webots-mcp init' registers this server with clients. To register it by hand in Claude Code:

        claude mcp add webots -- webots-mcp serve --data-dir /path/to/project/mcp_data

    It starts even if nothing was recorded yet. With --http it runs until Ctrl-C; see 'webots-mcp
    help clients'.

    Unless --read-only is given, the server deletes the oldest rows beyond the limits. A LIMIT is a
    size (500MB), an age (30d), a number of rows (100000rows), several of these joined by commas, or
    'all' (no limit). Limits are stored in the database. Those set before by 'webots-mcp prune',
    'webots-mcp retention' or another running server stay in force, and a message says so.
    'webots-mcp prune --dry-run' with the same limits shows what would be deleted.
    """
    import logging

    from webots_mcp.database.location import resolve_database

    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    database, data_dir = resolve_database(recorded.database, recorded.data_dir)
    asked = limits.asked()
    place = _endpoint(http, allow_host, tls_cert, tls_key)
    if place is None and sys.stdin.isatty():
        print(
            f"webots-mcp: serving {database} to an MCP client on stdin and stdout; Ctrl-C ends it. "
            "MCP clients start this command themselves; 'webots-mcp init' registers it.",
            file=sys.stderr,
        )
    if asked and not read_only:
        _ask_for(asked, database, data_dir)
    with _keeping_what_is_made():
        from webots_mcp.server.mcp_server import create_server

        server = create_server(
            database,
            data_dir,
            read_only=read_only,
            tools=tools,
            output_schemas=output_schemas,
            limits=asked,
            notify=notify,
        )
    with ending_in_time(), _ending_with_the_client():
        if place is None:
            return server.run()
        from webots_mcp.server.http_server import serve_http

        serve_http(server, place, partial(_say_address, database))


def _endpoint(
    http: str | None, allow_host: Sequence[str], tls_cert: Path | None, tls_key: Path | None
) -> Endpoint | None:
    """Return the HTTP endpoint to serve at; None for stdin and stdout.

    Raises:
        InvalidInputError: The endpoint is not safe, or options of HTTP are given without it.
    """
    if http is not None:
        from webots_mcp.server.endpoint import endpoint_of

        return endpoint_of(http, allow_host, tls_cert, tls_key)
    if allow_host or tls_cert or tls_key:
        raise InvalidInputError(
            "--allow-host, --tls-cert and --tls-key apply only to --http. Add --http PORT, or "
            "leave them out."
        )
    return None


def _say_address(database: Database, url: str) -> None:
    print(
        f"webots-mcp: serving {database} at {url} to clients that give the token, which "
        "'webots-mcp token' shows; Ctrl-C ends it",
        flush=True,
    )


def token(
    *,
    new: Annotated[
        bool,
        Parameter("--new", help="Replace the token first. Clients with the old token are refused."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Show the token that clients of 'webots-mcp serve --http' need.

    All your projects use the same token. It is stored in a file that only you can read. The address
    of the page of 'webots-mcp view' is derived from it.
    """
    from webots_mcp.server.access_token import access_token, new_token, token_file

    shown = new_token() if new else access_token()
    if as_json:
        return print_json({"token": shown, "file": str(token_file())})
    print(shown)


@contextmanager
def _ending_with_the_client() -> Generator[None]:
    """End normally when the client has gone and cannot read the last answer."""
    try:
        yield
    except Exception as error:
        if not _is_broken_pipe(error):
            raise
        raise BrokenPipeError from error


def _is_broken_pipe(error: object) -> bool:
    """Return whether an error is only a broken pipe, even inside a group of errors."""
    parts: tuple[object, ...] = getattr(error, "exceptions", ())
    return all(map(_is_broken_pipe, parts)) if parts else isinstance(error, BrokenPipeError)


@contextmanager
def _keeping_what_is_made() -> Generator[None]:
    """Exempt imported objects from garbage collection, which would take a tenth of the start."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _ask_for(limits: Asked, database: Database, data_dir: Path) -> None:
    """Set the limits that this server may set, and report which others apply."""
    from webots_mcp.errors import NoDatabaseError
    from webots_mcp.store.recording import RecordingAccess
    from webots_mcp.store.retention_limits import ask

    try:
        with RecordingAccess(database, data_dir).writer() as connection:
            notes = ask(connection, limits)
    except NoDatabaseError:
        return  # set once the database exists
    except WebotsMCPError as error:  # reported by the tools in an answer
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
            help=f"Robot node to run as, which has supervisor TRUE. Default: {OBSERVER_NAME}.",
        ),
    ] = OBSERVER_NAME,
    url: Annotated[
        str | None,
        Parameter(
            "--url",
            metavar="URL",
            help="Address of Webots, such as tcp://192.168.1.5:1234. Default: ipc://1234.",
        ),
    ] = None,
    period_ms: Annotated[
        int | None,
        Parameter(
            "--period-ms",
            metavar="N",
            converter=whole_number,
            help="Simulated milliseconds between two rows. Default: 100.",
        ),
    ] = None,
    data_dir: DataDir = None,
    as_json: Json = False,
) -> None:
    """Record the positions of all robots in a running world, as an extern controller.

        webots-mcp observe --url ipc://1234

    The world needs an observer robot, which 'webots-mcp init --observer WORLD --extern' adds.
    Without --extern, Webots starts the observer itself and this command is not needed. It stops
    when Webots reloads the world or quits; with --json it then reports where it recorded.
    """
    from webots_mcp.database.location import resolve_data_dir
    from webots_mcp.simulator import observer

    period_ms = observer.checked_period(observer.PERIOD_MS if period_ms is None else period_ms)
    address = _connect_to(url, robot)
    from controller import Supervisor  # type: ignore[import-not-found]

    observer.observe(Supervisor(), period_ms, data_dir=data_dir)
    if as_json:
        print_json({"url": address, "data_dir": str(resolve_data_dir(data_dir))})


def _connect_to(url: str | None, robot: str) -> str:
    """Set what Webots' library needs to find its simulator. Return the address of the robot.

    Raises:
        CommandRefusedError: The library does not exist.
    """
    from webots_mcp.simulator.installations import HOME_VARIABLE, installations
    from webots_mcp.simulator.instances import DEFAULT_PORT

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


# -- starting Webots --


def launch(
    world: Annotated[
        Path, Parameter("WORLD", help="World to open: a .wbt file in a Webots project.")
    ],
    /,
    *,
    headless: Annotated[
        bool, Parameter("--headless", help="Start without window and 3D view.")
    ] = False,
    mode: Annotated[
        Literal["fast", "realtime", "pause"] | None,
        Parameter("--mode", help="Mode to start in. Default: as in the preferences of Webots."),
    ] = None,
    stream: Annotated[
        bool,
        Parameter(
            "--stream",
            help="Allow steering without a controller that records. Everyone who can reach the "
            "port can then read files of the project.",
        ),
    ] = False,
    port: Annotated[
        int | None,
        Parameter(
            "--port",
            metavar="PORT",
            validator=Number(gte=1, lte=MAX_PORT),
            help="Port of Webots. Default: the first free port from 1234.",
        ),
    ] = None,
    stand_in: Annotated[
        bool,
        Parameter(
            "--stand-in",
            help="Use the stand-in simulator of webots-mcp, which needs no Webots. It stops with "
            "its last controller, or with Ctrl-C.",
        ),
    ] = False,
    robot: Annotated[
        tuple[str, ...],
        Parameter(
            "--robot",
            metavar="NAME=FILE",
            help="With --stand-in: run FILE as the controller of the robot NAME, also if it is "
            "`<extern>`.",
        ),
    ] = (),
    tape: Annotated[
        bool,
        Parameter(
            "--tape",
            negative=(),
            help="Record each call of Webots' API by Python controllers, for 'webots-mcp rerun'.",
        ),
    ] = False,
    tape_images: Annotated[
        bool,
        Parameter(
            "--tape-images",
            negative=(),
            help="The same, with the images of cameras and lidars, which need much space.",
        ),
    ] = False,
    data_dir: Annotated[
        Path | None,
        Parameter(
            "--data-dir",
            metavar="DIR",
            help="Folder to record in. Default: mcp_data/ in the project.",
        ),
    ] = None,
    patience_s: Annotated[
        float,
        Parameter(
            "--patience",
            metavar="S",
            help="Seconds to wait for the first row before reporting why none came. Default: 30.",
        ),
    ] = 30.0,
) -> int:
    """Start Webots on a world, record its console, and report the first controller that records.

    Webots opens no dialogs. It is stopped whenever this command ends, even if it is killed. If
    Webots quits by itself, its exit code is returned. Without a display, xvfb-run provides one.

        webots-mcp launch worlds/arena.wbt --headless --mode fast
    """
    from webots_mcp.contract import DATA_DIR_VARIABLE
    from webots_mcp.database.tapes.tape_wanted import IMAGES, TAPE_VARIABLE
    from webots_mcp.simulator.launch import WebotsLaunch, require_world
    from webots_mcp.simulator.starting import Start, free_port
    from webots_mcp.store.policy import LAUNCH
    from webots_mcp.store.requests import BY_COMMAND_LINE, OpenRequest, permit

    file, project = require_world(world)
    recording = _recording(data_dir, project)
    names, asked = ["launch", "webots_launch_world"], {"world": str(file)}
    with OpenRequest(recording, BY_COMMAND_LINE, names, asked):
        permit(recording, LAUNCH, asked, create=True)
    taping = {TAPE_VARIABLE: IMAGES if tape_images else "1"} if tape or tape_images else {}
    if stand_in:
        if stream or port is not None:
            raise InvalidInputError(
                "--stream and --port apply only to Webots, not to --stand-in. Leave them out."
            )
        os.environ.update(taping)
        return _launch_stand_in(recording, file, mode or "realtime", robot, patience_s)
    if robot:
        raise InvalidInputError(
            "--robot applies only to --stand-in: Webots runs the controllers that the world names. "
            "Leave it out."
        )
    start = Start(file, mode, headless, stream, port or free_port())
    environment = {DATA_DIR_VARIABLE: str(recording.data_dir), **taping}
    console = _Console()
    launched = WebotsLaunch(recording, start, environment, console.show)
    with _Recorder(launched, recording) as recorder:
        try:
            return _follow(launched, patience_s, console, recorder)
        finally:
            if not launched.webots.is_over:
                _say("ending Webots")
            launched.webots.end()


def _launch_stand_in(
    recording: RecordingAccess,
    world: Path,
    mode: Literal["fast", "realtime", "pause"],
    robots: Sequence[str],
    patience_s: float,
) -> int:
    """Run a world in the stand-in until it ends; return its exit code."""
    from webots_mcp.contract import DATA_DIR_VARIABLE
    from webots_mcp.simulator.console import StandInConsole
    from webots_mcp.simulator.launch import newest_in

    controllers = _controllers(robots)
    os.environ[DATA_DIR_VARIABLE] = str(recording.data_dir)
    watched = recording, newest_in(recording), world, patience_s
    threading.Thread(target=_watch, args=watched, daemon=True).start()
    with StandInConsole(recording) as recorder:
        status = stand_in_simulator()(world, mode, None, controllers, recorder)
    option = _data_dir_option(recording)
    if _has_recorded(*watched[:2]):
        _say(f"next: 'webots-mcp check{option}' judges what was recorded")
    else:
        _say(f"no controller has recorded; 'webots-mcp logs{option}' shows what they printed")
    return status


def _controllers(robots: Sequence[str]) -> dict[str, str]:
    """Return controller files by robot name, from texts NAME=FILE."""
    named: dict[str, str] = {}
    for text in robots:
        name, equals, file = text.partition("=")
        if not (name and equals and file):
            raise InvalidInputError(
                f"--robot {text!r} is not of the form NAME=FILE, such as rover=rover.py"
            )
        named[name] = file
    return named


def _has_recorded(recording: RecordingAccess, before: int) -> bool:
    """Return whether a session after `before` has a run."""
    from webots_mcp.simulator.launch import starts_since

    try:
        return any(each.run_id is not None for each in starts_since(recording, before))
    except WebotsMCPError as error:
        _say(str(error))
        return True


def _watch(recording: RecordingAccess, before: int, world: Path, patience_s: float) -> None:
    """Report the first controller that records in the stand-in after the session `before`."""
    from webots_mcp.simulator.launch import starts_since, why_silent

    until_s = time.monotonic() + patience_s
    while True:
        try:
            begun = starts_since(recording, before)
        except WebotsMCPError as error:
            return _say(str(error))
        if begun and begun[0].run_id is not None:  # robots that have recorded come first
            _say(f"{begun[0].robot} records: run {begun[0].run_id}")
            return _say(_next_step(recording))
        if time.monotonic() > until_s:
            until_s = math.inf
            reasons = why_silent(begun, world, extern="--robot NAME=FILE runs one")
            why = "; ".join(reasons) or "no robot has published yet"
            _say(f"no controller has recorded within {patience_s:g} s: {why}")
        time.sleep(_LOOK_EVERY_S)


def _recording(data_dir: Path | None, project: Path) -> RecordingAccess:
    """Return where the controllers of the project record, whatever the current folder is."""
    from webots_mcp.contract import DATA_DIR_VARIABLE, PROJECT_DATA_FOLDER
    from webots_mcp.database.location import resolve_database
    from webots_mcp.store.recording import RecordingAccess

    named = data_dir or os.environ.get(DATA_DIR_VARIABLE)
    return RecordingAccess(
        *resolve_database(None, named or project / PROJECT_DATA_FOLDER), asker="cli"
    )


def _follow(
    launched: WebotsLaunch, patience_s: float, console: _Console, recorder: _Recorder
) -> int:
    """Wait until Webots has ended. Return its exit code."""
    webots, first = launched.webots, None
    until_s = time.monotonic() + patience_s
    while (code := webots.exit_code) is None:
        first = first or _announce_first(launched, recorder.recording)
        if first is None and time.monotonic() > until_s:
            until_s = math.inf
            _say(f"no controller has recorded within {patience_s:g} s: {launched.silence()}")
        console.require_reader()
        recorder.begin()
        time.sleep(_LOOK_EVERY_S)
    webots.wait_for_output()
    if first is None and _announce_first(launched, recorder.recording) is None:
        launched.record_unfollowed_output()
        _say(launched.silence())
    return code


def _announce_first(launched: WebotsLaunch, recording: RecordingAccess) -> SessionStart | None:
    """Report the first controller that records."""
    first = launched.first_record()
    if first is not None:
        address = launched.webots.address_now()
        where = f", Webots listens at port {address.port}" if address else ""
        _say(f"{first.robot} records: run {first.run_id}{where}")
        _say(_next_step(recording))
    return first


class _Console:
    """Show Webots' console on the console of this command."""

    def __init__(self) -> None:
        self._broken: OSError | None = None

    def show(self, line: WebotsLine) -> None:
        """Print a line; called in a thread of its own."""
        try:
            print(line.text, file=getattr(sys, line.stream), flush=True)
        except OSError as error:
            self._broken = error

    def require_reader(self) -> None:
        """Raise the error of writing to a pipe that nobody reads any more."""
        if self._broken is not None:
            raise self._broken


class _Recorder(ExitStack):
    """Record Webots' console from the moment it listens."""

    def __init__(self, launched: WebotsLaunch, recording: RecordingAccess) -> None:
        super().__init__()
        self._launched = launched
        self.recording = recording
        self._begun = False

    def begin(self) -> None:
        """Begin to record, unless that has begun or Webots does not listen yet."""
        from webots_mcp.simulator.console import follow_console

        instance = None if self._begun else self._launched.webots.instance
        if instance is not None:
            self._begun = True
            self.enter_context(follow_console(instance, self.recording))


def _next_step(recording: RecordingAccess) -> str:
    """Return what to do once a robot is recorded."""
    return (
        'next: ask your assistant "What is the robot doing?", or run '
        f"'webots-mcp status{_data_dir_option(recording)}' in another terminal"
    )


def _data_dir_option(recording: RecordingAccess) -> str:
    """Return the option that names the recording; empty if the current folder implies it."""
    from webots_mcp.contract import PROJECT_DATA_FOLDER
    from webots_mcp.database.location import find_project

    project = find_project(Path.cwd())
    if project and project / PROJECT_DATA_FOLDER == recording.data_dir:
        return ""
    return f" --data-dir {shlex.quote(str(recording.data_dir))}"


def _say(text: str) -> None:
    print(f"webots-mcp: {text}", file=sys.stderr, flush=True)
