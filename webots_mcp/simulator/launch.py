"""Start the user's Webots on a world of a project, and wait until the first controller records."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import OBSERVER_NAME, WORLD_ENDING, host_name
from webots_mcp.database.files import full_path
from webots_mcp.database.location import find_project, require_world_of
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import InvalidInputError, NoDatabaseError
from webots_mcp.simulator.console_lines import as_row
from webots_mcp.simulator.orders import WebotsAddress, WebotsLine, address_of
from webots_mcp.simulator.project import controllers_in, has_bridge
from webots_mcp.simulator.starting import LaunchedWebots, Show, Start
from webots_mcp.store.logs import ConsoleRows
from webots_mcp.store.recording import RecordingAccess

_EXTERN: Final = "<extern>"
_NOBODYS: Final = (_EXTERN, "<none>", "<generic>", "void")


def require_world(path: str | Path, project: Path | None = None) -> tuple[Path, Path]:
    """Return the file of a world, and the project that it lies in.

    Args:
        path: An absolute path, or one relative to the current folder or the project; a bare name
            may also be that of one of the project's worlds.
        project: The project that must contain it; None for any, in which case a bare name belongs
            to the project around the current folder.

    Raises:
        InvalidInputError: The world does not exist, or lies in no project or in another one.
    """
    try:
        world = _found(Path(path), project)
    except OSError as error:  # the name is too long, has a NUL, or links form a circle
        why = error.strerror or str(error)
        raise InvalidInputError(
            f"{str(path)[:100]!r} is not the name of a world: {why}."
        ) from error
    return world, require_world_of(project, world)


def _found(path: Path, project: Path | None) -> Path:
    """Return the file of a world: in a project, a name alone is that of one of its worlds."""
    around = project or find_project(Path.cwd())
    folders = [project or Path(), *([] if around is None else [around / "worlds"])]
    places = [full_path(folder / path) for folder in folders]
    for place in places:
        if place.is_file():
            return place
    folder = next((each.parent for each in reversed(places) if each.parent.is_dir()), Path())
    there = [world.name for world in sorted(folder.glob(f"*{WORLD_ENDING}"))]
    others = f"; in {folder} there is {', '.join(there[:20])}" if there else ""
    raise InvalidInputError(f"there is no world {places[0]}{others}")


class SessionStart(NamedTuple):
    """A controller that began to record.

    Attributes:
        robot: Its robot.
        pid: Its process.
        instance: The Webots that it belongs to, as its bridge knows it.
        run_id: Its first run with a state; None before there is one.
        world: The world of its first run.
    """

    robot: str
    pid: int
    instance: str
    run_id: int | None
    world: str | None


class WebotsLaunch:
    """A Webots that this process has started, and what is recorded in it.

    Args:
        recording: The recording into which its controllers write.
        start: How it is started.
        environment: Variables for its controllers, in addition to those of this process.
        show: Called with each line of its console, in a thread of its own.

    Attributes:
        world: The world that it runs, as far as that is known.
        webots: Its processes.

    Raises:
        CommandRefusedError: There is no Webots, or no display.
        DatabaseError: Nothing can be recorded there.
    """

    def __init__(
        self, recording: RecordingAccess, start: Start, environment: Mapping[str, str], show: Show
    ) -> None:
        self.start = start
        self.world = start.world
        self._recording = recording
        self._began_s = time.time()
        self.webots = LaunchedWebots(start, environment, show)
        try:
            # the database must exist before any controller starts, because the console is recorded
            # too
            recording.create()
            self._before = newest_in(recording)
            self.webots.start()
        except BaseException:
            self.webots.end()
            raise

    def first_record(self) -> SessionStart | None:
        """Return the first of its controllers that has recorded a state."""
        return next((each for each in self._begun() if each.run_id is not None), None)

    def silence(self) -> str:
        """Return why no controller has recorded yet, as far as that is known."""
        reasons = [*self._of_webots(), *why_silent(self._begun(), self.world)]
        return "; ".join(reasons) or "no controller has recorded yet"

    def record_unfollowed_output(self) -> None:
        """Record the output of a Webots that ended before its console was followed.

        Raises:
            DatabaseError: It cannot be recorded.
        """
        port = self.webots.address.port if self.webots.address else self.start.port
        rows = ConsoleRows(f"{host_name()}:{port}", self._began_s)
        with self._recording.writer() as connection, transaction(connection):
            if not rows.is_recorded(connection):
                rows.write(connection, [as_row(line) for line in self.webots.lines])

    def _begun(self) -> list[SessionStart]:
        asked = WebotsAddress("127.0.0.1", self.start.port)
        address, pids = self.webots.address or asked, self.webots.pids
        found = starts_since(self._recording, self._before)
        return [each for each in found if each.pid in pids or address_of(each.instance) == address]

    def _of_webots(self) -> list[str]:
        printed = [line.text for line in self.webots.lines if _is_problem(line)]
        reasons = list[str]()
        if self.webots.is_over:
            reasons.append(f"Webots ended with exit code {self.webots.exit_code}")
        elif self.webots.address is None:
            reasons.append(f"Webots does not listen at port {self.start.port} yet: it is starting")
        elif self.start.mode == "pause":
            reasons.append("it begins paused: controllers are started when it is played")
        if printed:
            reasons.append(f"its console has: {' | '.join(printed[-3:])}")
        return reasons


def _is_problem(line: WebotsLine) -> bool:
    """Return whether a line reports a problem; `xvfb-run` may mix stdout and stderr."""
    if line.stream == "stderr":
        return bool(line.text.strip()) and not line.text.startswith(("INFO:", "DEBUG:"))
    return bool(re.search(r"^(WARNING|ERROR):|\b\w*(Error|Exception)\b", line.text))


def why_silent(
    begun: Sequence[SessionStart], world: Path, extern: str = "start it with webots-controller"
) -> list[str]:
    """Say why no controller of a world has recorded yet, by its sessions or its files.

    Args:
        begun: The sessions of its controllers.
        world: The file.
        extern: The advice for an extern controller.
    """
    if begun:
        names = ", ".join(each.robot for each in begun)
        return [f"{names} has a bridge and has published nothing yet"]
    folder = (find_project(world.parent) or world.parent.parent) / "controllers"
    names = controllers_in(world)
    own = [name for name in names if name not in _NOBODYS and (folder / name).is_dir()]
    missing = [name for name in names if name not in (*_NOBODYS, *own)]
    without = [name for name in own if name != OBSERVER_NAME and not has_bridge(folder / name)]
    reasons = list[str]()
    if _EXTERN in names:
        reasons.append(f"a robot has the controller <extern>: {extern}")
    if missing:
        reasons.append(f"not in {folder}: {', '.join(missing)}")
    if without:
        file = folder / without[0] / f"{without[0]}.py"
        reasons.append(
            f"without a bridge: {', '.join(without)} (attach one: webots-mcp init --patch {file})"
        )
    if not own and not reasons:
        reasons.append(f"{world.name} names no controller (robots of PROTOs may have one)")
    return reasons


def newest_in(recording: RecordingAccess) -> int:
    """Return the id of the newest session of a recording; 0 without sessions."""
    return next(
        (newest for (newest,) in _read(recording, "SELECT coalesce(max(id), 0) FROM session")), 0
    )


def starts_since(recording: RecordingAccess, session: int) -> list[SessionStart]:
    """Return the sessions of a recording after that one; those that have recorded first."""
    statement = (
        "SELECT robot.name, s.pid, s.instance, "
        "(SELECT min(id) FROM run WHERE session_id = s.id "
        "AND EXISTS (SELECT 1 FROM state WHERE run_id = run.id)) AS run_id, "
        "(SELECT world FROM run WHERE session_id = s.id ORDER BY id LIMIT 1) "
        "FROM session s JOIN robot ON robot.id = s.robot_id WHERE s.id > ? "
        "ORDER BY run_id IS NULL, s.id"
    )
    return [SessionStart(*row) for row in _read(recording, statement, session)]


def _read(recording: RecordingAccess, query: str, *values: object) -> list[tuple[Any, ...]]:
    """Return the rows of a query; nothing if there is no recording yet."""
    try:
        with recording.reader() as connection:
            return connection.execute(query, values).fetchall()
    except NoDatabaseError:
        return []
