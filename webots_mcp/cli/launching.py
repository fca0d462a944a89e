"""The command that starts Webots."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from cyclopts.validators import Number

from webots_mcp.cli.values import Parameter
from webots_mcp.errors import InvalidInputError, WebotsMCPError
from webots_mcp.plugins import stand_in_simulator

if TYPE_CHECKING:
    from webots_mcp.launch import Launch, SessionStart
    from webots_mcp.store.recording import Recording
    from webots_mcp.webots.stream import WebotsLine

_LOOK_EVERY_S: Final = 0.2
_EXTERN_HERE: Final = "--robot NAME=FILE runs one"
MAX_PORT: Final = 65_535


def launch(
    world: Annotated[Path, Parameter("WORLD", help="A .wbt file in a Webots project.")],
    /,
    *,
    headless: Annotated[
        bool, Parameter("--headless", help="Without its window and its 3D view.")
    ] = False,
    mode: Annotated[
        Literal["fast", "realtime", "pause"] | None,
        Parameter("--mode", help="The mode that it begins with; else that of its preferences."),
    ] = None,
    stream: Annotated[
        bool,
        Parameter(
            "--stream",
            help="Let it be steered from outside without a controller of ours; at its port the "
            "project's files can then be read, from the network too.",
        ),
    ] = False,
    port: Annotated[
        int | None,
        Parameter(
            "--port",
            validator=Number(gte=1, lte=MAX_PORT),
            help="Else the first free one from 1234 on.",
        ),
    ] = None,
    stand_in: Annotated[
        bool,
        Parameter(
            "--stand-in",
            help="Run the world on the stand-in simulator that comes with webots-mcp, where no "
            "Webots is installed; it ends with Ctrl-C.",
        ),
    ] = False,
    robot: Annotated[
        tuple[str, ...],
        Parameter(
            "--robot",
            help="With --stand-in: NAME=FILE runs this file as the controller of a robot, also of "
            "one that is <extern>.",
        ),
    ] = (),
    data_dir: Annotated[
        Path | None,
        Parameter("--data-dir", help="Where controllers record; else mcp_data/ of the project."),
    ] = None,
    patience_s: Annotated[
        float,
        Parameter("--patience", help="Say after so many seconds why nobody has recorded yet (30)."),
    ] = 30.0,
) -> int:
    """Start Webots on a world, show and record its console, say when the first controller records.

    Webots opens no dialogs and ends with this command, however that ends: by Ctrl-C, by SIGTERM,
    killed. If it ends by itself, the exit code is its own. Where there is no display, xvfb-run
    gives it one.

        webots-mcp launch worlds/arena.wbt --headless --mode fast
    """
    from webots_mcp.contract import DATA_DIR_VARIABLE
    from webots_mcp.launch import Launch, newest_in, require_world
    from webots_mcp.webots.starting import Start, free_port

    file, project = require_world(world)
    recording = _recording(data_dir, project)
    if stand_in:
        if stream or port is not None:
            raise InvalidInputError("--stream and --port are Webots' own: leave them out")
        os.environ[DATA_DIR_VARIABLE] = str(recording.data_dir)
        watched = recording, newest_in(recording), file, patience_s
        threading.Thread(target=_watch, args=watched, daemon=True).start()
        return stand_in_simulator()(file, mode or "realtime", None, _controllers(robot))
    if robot:
        raise InvalidInputError("--robot is for --stand-in: Webots runs what the world names")
    start = Start(file, mode, headless, stream, port or free_port())
    environment = {DATA_DIR_VARIABLE: str(recording.data_dir)}
    console = _Console()
    launched = Launch(recording, start, environment, console.show)
    with _Recorder(launched, recording) as recorder:
        try:
            return _follow(launched, patience_s, console, recorder)
        finally:
            if not launched.webots.is_over:
                _say("ending Webots")
            launched.webots.end()


def _controllers(robots: tuple[str, ...]) -> dict[str, str]:
    """Controller files by robot name, of NAME=FILE."""
    named: dict[str, str] = {}
    for text in robots:
        name, equals, file = text.partition("=")
        if not (name and equals and file):
            raise InvalidInputError(f"--robot {text!r} is not NAME=FILE")
        named[name] = file
    return named


def _watch(recording: Recording, before: int, world: Path, patience_s: float) -> None:
    """Say which controller records in the stand-in, after the session `before`; or why none."""
    from webots_mcp.launch import starts_since, why_silent

    until_s = time.monotonic() + patience_s
    while True:
        try:
            begun = starts_since(recording, before)
        except WebotsMCPError as error:
            return _say(str(error))
        if begun and begun[0].run_id is not None:  # those that have recorded come first
            return _say(f"{begun[0].robot} records: run {begun[0].run_id}")
        if time.monotonic() > until_s:
            until_s = math.inf
            reasons = why_silent(begun, world, extern=_EXTERN_HERE)
            why = "; ".join(reasons) or "no robot has published yet"
            _say(f"no controller has recorded within {patience_s:g} s: {why}")
        time.sleep(_LOOK_EVERY_S)


def _recording(data_dir: Path | None, project: Path) -> Recording:
    """Where the controllers of the project record, whatever folder this one is started in."""
    from webots_mcp.contract import DATA_DIR_VARIABLE, PROJECT_DATA_FOLDER, resolve_database
    from webots_mcp.store.recording import Recording

    named = data_dir or os.environ.get(DATA_DIR_VARIABLE)
    return Recording(*resolve_database(None, named or project / PROJECT_DATA_FOLDER), asker="cli")


def _follow(launched: Launch, patience_s: float, console: _Console, recorder: _Recorder) -> int:
    """Until Webots has ended; its exit code."""
    webots, first = launched.webots, None
    until_s = time.monotonic() + patience_s
    while (code := webots.exit_code) is None:
        first = first or _announce_first(launched)
        if first is None and time.monotonic() > until_s:
            until_s = math.inf
            _say(f"no controller has recorded within {patience_s:g} s: {launched.silence()}")
        console.require_reader()
        recorder.begin()
        time.sleep(_LOOK_EVERY_S)
    webots.wait_for_output()
    if first is None and _announce_first(launched) is None:
        launched.record_last_words()
        _say(launched.silence())
    return code


def _announce_first(launched: Launch) -> SessionStart | None:
    """Say which controller records first, once there is one."""
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
