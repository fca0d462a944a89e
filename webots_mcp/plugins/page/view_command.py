"""The command that shows a recording as a page in the browser."""

from __future__ import annotations

import argparse

from webots_mcp.cli.command import DATA_DIR, DATABASE, argument, command, count
from webots_mcp.cli.ending import ending_in_time
from webots_mcp.errors import InvalidInputError

_LAST_PORT = 65535


@command(
    "view",
    DATA_DIR,
    DATABASE,
    count("--port", "of 127.0.0.1; 0 for any that is free", default=5006, least=0, dest="port"),
    argument("--no-browser", action="store_true", help="only say the address of the page"),
    argument(
        "--read-only", action="store_true", help="without buttons and inputs that steer the robot"
    ),
)
def view(arguments: argparse.Namespace) -> None:
    """Show a recording as a page in the browser, live: signals, the way, pictures, the log.

    The page is for this computer only (127.0.0.1) and needs no network. Its buttons pause, resume,
    step and reset the simulation and set parameters, as the commands of the same names do. Ctrl-C
    ends it, and the robots do not notice.
    """
    import webbrowser
    from contextlib import suppress

    from webots_mcp.contract import resolve_database
    from webots_mcp.errors import NoDatabaseError
    from webots_mcp.plugins.page.server import create_page_server
    from webots_mcp.store.recording import Recording

    if arguments.port > _LAST_PORT:
        raise InvalidInputError(f"--port {arguments.port}: the last port is {_LAST_PORT}")
    where = resolve_database(arguments.database, arguments.data_dir)
    recording = Recording(*where, read_only=True, asker="page")
    with suppress(NoDatabaseError), recording.reader():  # one that is refused will not be shown
        pass
    server = create_page_server(recording, arguments.port, read_only=arguments.read_only)

    def ready(url: str) -> None:
        print(f"webots-mcp: the page is at {url} (Ctrl-C ends it)", flush=True)
        if not arguments.no_browser:
            webbrowser.open(url)

    with ending_in_time():
        server.run(ready)
