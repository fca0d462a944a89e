"""The command that shows a recording as a page in the browser."""

from __future__ import annotations

import sys
from typing import Annotated, Final

from cyclopts.validators import Number

from webots_mcp.cli.interrupts import ending_in_time
from webots_mcp.cli.options import HERE, Json, Parameter, Where, whole_number
from webots_mcp.cli.server_commands import MAX_PORT
from webots_mcp.cli.terminal import print_json

_PORT: Final = 5006


def view(
    *,
    port: Annotated[
        int,
        Parameter(
            "--port",
            converter=whole_number,
            validator=Number(gte=0, lte=MAX_PORT),
            metavar="PORT",
            help=f"Port of the page; 0 for any free port. Default: {_PORT}.",
        ),
    ] = _PORT,
    no_browser: Annotated[
        bool, Parameter("--no-browser", help="Print the address of the page, and open no browser.")
    ] = False,
    read_only: Annotated[
        bool,
        Parameter("--read-only", help="Leave out the controls that steer the simulation."),
    ] = False,
    as_json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Show a recording live in the browser: signals, the path, pictures and the log.

    The page is served on this computer only (127.0.0.1). Its controls pause, resume, step and reset
    the simulation and set parameters, like the commands of these names. Ctrl-C stops the page, not
    the simulation. With --json the address is printed as {"url": ...}.
    """
    import webbrowser
    from contextlib import suppress
    from dataclasses import replace

    from webots_mcp.errors import NoDatabaseError
    from webots_mcp.plugins.page.page_server import create_page_server

    recording = replace(recorded.recording(), asker="page")
    with suppress(NoDatabaseError), recording.reader():  # one that is refused will not be shown
        pass
    server = create_page_server(recording, port, read_only=read_only)

    def ready(url: str) -> None:
        if as_json:
            print_json({"url": url})
        else:
            print(f"webots-mcp: the page is at {url} (Ctrl-C ends it)")
        sys.stdout.flush()
        if not no_browser:
            webbrowser.open(url)

    with ending_in_time():
        server.run(ready)
