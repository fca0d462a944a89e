"""A Webots for checks, which runs a world of this package and can be steered and read."""

from __future__ import annotations

import getpass
import json
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.cli.options import Where
from webots_mcp.cli.question_commands import ask
from webots_mcp.contract import DATA_DIR_VARIABLE, PROJECT_DATA_FOLDER, host_name
from webots_mcp.errors import NoDatabaseError, WebotsMCPError
from webots_mcp.questions.control_simulation import webots_simulation_control
from webots_mcp.questions.declaration import Question
from webots_mcp.questions.send_command import webots_send_command
from webots_mcp.setup.observer_edits import controller_change, python_change, with_observer
from webots_mcp.simulator.launch import WebotsLaunch
from webots_mcp.simulator.orders import WebotsAddress
from webots_mcp.simulator.starting import LaunchedWebots, Mode, Start, free_port
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.store.recording import OpenConnections

T = TypeVar("T")
ROVER: Final = "rover"
SPEAKER: Final = "speaker"
SOON_S: Final = 10.0
REAL_TIME: Final = 1  # Value of simulationGetMode.
_POLL_S: Final = 0.03
_LIMIT_S: Final = 300.0  # Of a check, in addition to the start of Webots.
_LONGEST: Final = 500  # Characters of a result.
_DEFAULTS: Final = {"robot": ROVER, "timeout_wall_s": SOON_S}
_FOLDER: Final = re.compile(
    r"""(?<![\w/\\])(?:[A-Za-z]:(?:[/\\][^/\\:*?"<>|\n]+)*|(?:~|[A-Z]{4,})?(?:/[^\s/:'"]+)+)[/\\]"""
)


class OtherwiseError(Exception):
    """Webots did not do what its sources say. The text is what was observed."""


class NotTriedError(Exception):
    """A check could not be made. The text is the reason."""


def require(holds: object, seen: str) -> None:
    """Check a condition.

    Raises:
        OtherwiseError: It does not hold. The text is `seen`.
    """
    if not holds:
        raise OtherwiseError(seen)


class RobotRow(NamedTuple):
    """The newest row of a robot, with its run and its process."""

    session_id: int
    pid: int
    run_id: int
    world: str
    sim_time_s: float
    state: dict[str, Any]


class Bench:
    """Webots with the project of this package, and the recording that its controllers make.

    One check at a time uses it, in the thread `user`. Calls from the thread of a check that hung
    fail.

    Args:
        folder: Folder in which the project is written.
        patience_s: Maximum time from a start of Webots to the first row.

    Attributes:
        world: The world file.
        before: The newest row of the rover at the start of the check.
    """

    before: RobotRow
    user: threading.Thread

    def __init__(self, folder: Path, patience_s: float) -> None:
        self.world = _write_project(folder)
        self.patience_s = patience_s
        self.where = Where(data_dir=folder / PROJECT_DATA_FOLDER)
        self._connections = OpenConnections()  # It asks up to 30 times a second.
        self.recording = replace(
            self.where.recording(read_only=False), connections=self._connections
        )
        self._launch: WebotsLaunch | None = None
        self._never = set[tuple[bool, Mode | None]]()
        self._last_row = 0  # The newest row before the start of Webots.

    # -- Webots --

    def webots(
        self, *, stream: bool = False, mode: Mode = "realtime", port: int | None = None
    ) -> LaunchedWebots:
        """Return a Webots that runs like this, started if needed, once the rover has recorded.

        Raises:
            OtherwiseError: The rover does not record.
            NotTriedError: It did not record after an earlier start like this.
        """
        launch = self._launch
        runs: tuple[bool, Mode | None] = stream, mode
        is_there = launch and not launch.webots.is_over and not port
        if launch and is_there and (launch.start.streams, launch.start.mode) == runs:
            return launch.webots
        self.end()
        if runs in self._never:
            raise NotTriedError("a Webots that was started so has not recorded")
        ((self._last_row,),) = self.rows("SELECT coalesce(max(id), 0) FROM state") or [(0,)]
        start = Start(self.world, mode, headless=True, streams=stream, port=port or free_port())
        environment = {DATA_DIR_VARIABLE: str(self.recording.data_dir)}
        launch = self._launch = WebotsLaunch(self.recording, start, environment, lambda line: None)
        until_s = time.monotonic() + self.patience_s
        while mode != "pause" and not self.newest():
            if launch.webots.is_over or time.monotonic() > until_s:
                self._never.add(runs)
                why = launch.silence()
                self.end()
                raise OtherwiseError(f"the rover records nothing after the start: {why}")
            time.sleep(_POLL_S)
        return launch.webots

    def running(self, *, stream: bool) -> None:
        """Make sure that Webots runs in real time."""
        self.webots(stream=stream)
        if not self.moves(2.0) or self.row().state["mode"] != REAL_TIME:
            self.control("resume")
            self.goes_on("it was told to resume")
        self.before = self.row()

    def address(self) -> WebotsAddress:
        """Return the address where it listens, as far as the system shows it."""
        assert self._launch is not None
        asked = WebotsAddress("127.0.0.1", self._launch.start.port)
        return self._launch.webots.address_now() or asked

    def close(self) -> None:
        """End the Webots that runs, and close the recording."""
        self.end()
        self._connections.close()

    def end(self) -> None:
        """End the Webots that runs."""
        launch, self._launch = self._launch, None
        if launch is not None:
            launch.webots.end()

    # -- reading its recording --

    def newest(self, robot: str = ROVER) -> RobotRow | None:
        """Return the newest row of a robot since Webots was started; None if there is none."""
        found = self.rows(
            "SELECT s.id, s.pid, run.id, run.world, state.sim_time_s, state.data FROM state "
            "JOIN run ON run.id = state.run_id JOIN session s ON s.id = run.session_id "
            "JOIN robot ON robot.id = s.robot_id WHERE robot.name = ? AND state.id > ? "
            "ORDER BY state.id DESC LIMIT 1",
            robot,
            self._last_row,
        )
        return RobotRow._make((*found[0][:-1], json.loads(found[0][-1]))) if found else None

    def row(self, robot: str = ROVER) -> RobotRow:
        """Wait for a row of a robot since Webots was started; return the newest."""
        return self.until(lambda: self.newest(robot), f"{robot} records nothing")

    def rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        """Return rows of the recording; none before it exists."""
        require(threading.current_thread() is self.user, "another check is made now")
        try:
            with self.recording.reader() as connection:
                return connection.execute(query, values).fetchall()
        except NoDatabaseError:
            return []

    def moves(self, within_s: float) -> bool:
        """Return whether the rover's simulation time advances within some wall time."""
        before = self.row()
        with suppress(OtherwiseError):
            self.until(lambda: self.row()[2:5:2] != before[2:5:2], "", within_s)  # run and time
            return True
        return False

    def goes_on(self, what: str) -> None:
        """Require that simulation time advances after something."""
        require(self.moves(SOON_S), f"{what}, and simulation time stands still")

    def stands(self, what: str) -> None:
        """Require that simulation time stops after something; a step under way may end first."""
        self.until(lambda: not self.moves(0.5), f"{what}, and simulation time goes on")

    def until(self, find: Callable[[], T | None], otherwise: str, within_s: float = SOON_S) -> T:
        """Wait until `find` returns something, and return that.

        Raises:
            OtherwiseError: It found nothing in time. The text is `otherwise`.
        """
        until_s = time.monotonic() + within_s
        while not (found := find()):
            require(time.monotonic() < until_s, f"{otherwise} (waited {within_s:g} s)")
            time.sleep(_POLL_S)
        return found

    # -- asking --

    def ask(self, question: Question, **given: Any) -> Any:
        """Return the answer to a question about the rover: its data, or captions with pictures.

        Raises:
            OtherwiseError: The question was refused, or failed.
        """
        require(threading.current_thread() is self.user, "another check is made now")
        names = {each.name for each in question.parameters}
        defaults = {name: value for name, value in _DEFAULTS.items() if name in names}
        try:
            data, shown = ask(question, defaults | given, self.where)
        except WebotsMCPError as error:
            raise OtherwiseError(str(error)) from error
        if data is None:
            return shown
        why = data.get("error") or data.get("hint") or str(data)
        require(data.get("outcome", "done") in ("done", "claimed"), why)
        return data

    def control(self, command: str, **given: Any) -> None:
        """Steer the simulation, and require that it is done."""
        answer = self.ask(webots_simulation_control, command=command, **given)
        require(answer["outcome"] == "done", f"{command} is {answer['outcome']}")

    def refuses(self, question: Question, **given: Any) -> bool:
        """Return whether a question is refused, or fails."""
        with suppress(OtherwiseError):
            self.ask(question, **given)
            return False
        return True

    def send(self, action: str, waits_s: float = SOON_S, **params: Any) -> None:
        """Send the rover a registered command, which may still be running afterwards."""
        self.ask(webots_send_command, action=action, params=params, timeout_wall_s=waits_s)


def _write_project(folder: Path) -> Path:
    """Write two worlds with an observer, and controllers that use this Python."""
    shutil.copytree(Path(__file__).parent / "project", folder)
    world = folder / "worlds/proving.wbt"
    header, _, nodes = DEFAULT_WORLD.read_text("utf-8").partition("\n")
    text = f"{header}\n{world.read_text('utf-8')}".replace("NODES", nodes)
    for file in (world, world.with_name("second.wbt")):
        file.write_bytes(with_observer(text.encode()))
    observer = controller_change(folder)
    files = [folder / "controllers" / name / f"{name}.py" for name in (ROVER, SPEAKER)]
    for change in (observer, *(python_change(f, sys.executable) for f in (*files, observer.file))):
        change.file.parent.mkdir(exist_ok=True)
        change.file.write_bytes(change.after)
    return world


def run_check(
    check: Callable[[Bench], object], bench: Bench, limit_s: float = _LIMIT_S
) -> dict[str, Any]:
    """Run a check and return its outcome. If it hangs, end Webots and abandon its thread.

    Args:
        check: A function of `checks.CHECKS`.
        bench: Webots for the check.
        limit_s: Time limit, in addition to the start of Webots.
    """
    outcomes = list[tuple[str, object]]()
    kind = check.__name__.partition("_")[0]

    def work() -> None:
        try:
            if kind != "check":
                bench.running(stream=kind == "streaming")
            outcomes.append(("as expected", check(bench)))
        except Exception as error:  # noqa: BLE001 - An unknown Webots can answer anything.
            is_tried = not isinstance(error, NotTriedError)
            outcomes.append(
                ("otherwise" if is_tried else "not tried", error or type(error).__name__)
            )

    began_s = time.monotonic()
    bench.user = threading.Thread(target=work, daemon=True)
    bench.user.start()
    bench.user.join(limit_s + bench.patience_s)
    outcome, seen = (outcomes or [("otherwise", f"it hung for {limit_s:g} s")])[0]
    if not outcomes:
        bench.end()
    answer = {"outcome": outcome, "seen": None if seen is None else _anonymous(str(seen))}
    if outcome == "otherwise":
        expected, _, then = (check.__doc__ or "").rstrip(".").partition("; otherwise ")
        answer |= {"expected": expected, "works still": then}
    return answer | {"took_s": round(time.monotonic() - began_s, 1)}


def _anonymous(text: str) -> str:
    """Remove folders and the names of user and machine from a text, and cut it if it is long."""
    names = {sys.prefix: "PYTHON", str(Path(__file__).parents[3]): "PACKAGE", host_name(): "HOST"}
    with suppress(OSError, KeyError, RuntimeError):  # The user may have no name or home.
        names |= {str(Path.home()): "~", getpass.getuser(): "USER"}
    for name in sorted(names, key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", names[name], text)
    return _FOLDER.sub("", text)[:_LONGEST]
