"""The command that starts Webots."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.command import argument, command

if TYPE_CHECKING:
    from pathlib import Path

    from webots_mcp.launch import Launch, SessionStart
    from webots_mcp.store.recording import Recording
    from webots_mcp.webots.stream import WebotsLine

_LOOK_EVERY_S: Final = 0.2
_PORTS: Final = range(1, 1 << 16)


def _port(text: str) -> int:
    if text.isascii() and text.isdecimal() and int(text) in _PORTS:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no port: it is from 1 to {_PORTS[-1]}")


@command(
    "launch",
    argument("world", metavar="WORLD", help="a .wbt file in a Webots project"),
    argument("--headless", action="store_true", help="without its window and its 3D view"),
    argument("--mode", choices=["fast", "realtime", "pause"],
             help="the mode that it begins with (default: that of Webots' preferences)"),
    argument("--stream", action="store_true",
             help="let it be steered from outside without a controller of ours; at its port the "
             "project's files can then be read, from the network too"),
    argument("--port", type=_port, metavar="N", help="(default: the first free one from 1234 on)"),
    argument("--data-dir", metavar="DIR",
             help="where controllers record (default: mcp_data/ of the world's project)"),
    argument("--patience", type=float, default=30.0, metavar="S", dest="patience_s",
             help="say after S seconds why nobody has recorded yet (30)"),
)  # fmt: skip
def launch(arguments: argparse.Namespace) -> int:
    """Start Webots on a world, show and record its console, say when the first controller records.

    Webots opens no dialogs and ends with this command, however that ends: by Ctrl-C, by SIGTERM,
    killed. If it ends by itself, the exit code is its own. Where there is no display, xvfb-run
    gives it one.

        webots-mcp launch worlds/arena.wbt --headless --mode fast
    """
    from webots_mcp.contract import DATA_DIR_VARIABLE
    from webots_mcp.launch import Launch, require_world
    from webots_mcp.webots.starting import Start, free_port

    world, project = require_world(arguments.world)
    recording = _recording(arguments, project)
    port = arguments.port or free_port()
    start = Start(world, arguments.mode, arguments.headless, arguments.stream, port)
    environment = {DATA_DIR_VARIABLE: str(recording.data_dir)}
    console = _Console()
    launched = Launch(recording, start, environment, console.show)
    with _Recorder(launched, recording) as recorder:
        try:
            return _follow(launched, arguments.patience_s, console, recorder)
        finally:
            if not launched.webots.is_over:
                _say("ending Webots")
            launched.webots.end()


def _recording(arguments: argparse.Namespace, project: Path) -> Recording:
    """Where the controllers of the project record, whatever folder this one is started in."""
    from webots_mcp.contract import DATA_DIR_VARIABLE, PROJECT_DATA_FOLDER, resolve_database
    from webots_mcp.store.recording import Recording

    named = arguments.data_dir or os.environ.get(DATA_DIR_VARIABLE)
    return Recording(*resolve_database(None, named or project / PROJECT_DATA_FOLDER), asker="cli")


def _follow(launched: Launch, patience_s: float, console: _Console, recorder: _Recorder) -> int:
    """Until Webots has ended; its exit code."""
    webots, first = launched.webots, None
    until_s = time.monotonic() + patience_s
    while (code := webots.exit_code) is None:
        first = first or _told(launched)
        if first is None and time.monotonic() > until_s:
            until_s = math.inf
            _say(f"no controller has recorded within {patience_s:g} s: {launched.silence()}")
        console.require_reader()
        recorder.begin()
        time.sleep(_LOOK_EVERY_S)
    webots.wait_for_output()
    if first is None and _told(launched) is None:
        launched.record_last_words()
        _say(launched.silence())
    return code


def _told(launched: Launch) -> SessionStart | None:
    """The first controller that records, once there is one."""
    first = launched.first_record()
    if first is not None:
        address = launched.webots.address_now()
        where = f", Webots listens at port {address.port}" if address else ""
        _say(f"{first.robot} records: run {first.run_id}{where}")
    return first


class _Console:
    """Shows Webots' console on this one."""

    def __init__(self) -> None:
        self._broken: OSError | None = None

    def show(self, line: WebotsLine) -> None:
        """In a thread of its own."""
        try:
            print(line.text, file=getattr(sys, line.stream), flush=True)
        except OSError as error:
            self._broken = error

    def require_reader(self) -> None:
        """Raise what was raised where nobody reads it any more."""
        if self._broken is not None:
            raise self._broken


class _Recorder(ExitStack):
    """Records Webots' console, from when it listens."""

    def __init__(self, launched: Launch, recording: Recording) -> None:
        super().__init__()
        self._launched = launched
        self._recording = recording
        self._begun = False

    def begin(self) -> None:
        """Unless it has begun, or Webots does not listen yet."""
        from webots_mcp.console.console_follower import follow_console

        instance = None if self._begun else self._launched.webots.instance
        if instance is not None:
            self._begun = True
            self.enter_context(follow_console(instance, self._recording))


def _say(text: str) -> None:
    print(f"webots-mcp: {text}", file=sys.stderr, flush=True)
