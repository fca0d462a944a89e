"""A Webots that checks are made on: started on a world of ours, asked, looked at, ended."""

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
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.cli.asking import ask
from webots_mcp.cli.options import Where
from webots_mcp.contract import DATA_DIR_VARIABLE, PROJECT_DATA_FOLDER, host_name
from webots_mcp.errors import NoDatabaseError, WebotsMCPError
from webots_mcp.questions.control_simulation import webots_simulation_control
from webots_mcp.questions.declaring import Question
from webots_mcp.questions.send_command import webots_send_command
from webots_mcp.setup.observer_edits import controller_change, python_change, with_observer
from webots_mcp.simulator.launch import WebotsLaunch
from webots_mcp.simulator.orders import WebotsAddress
from webots_mcp.simulator.starting import LaunchedWebots, Mode, Start, free_port
from webots_mcp.standin.in_process import DEFAULT_WORLD

T = TypeVar("T")
ROVER: Final = "rover"
SPEAKER: Final = "speaker"
SOON_S: Final = 10.0
REAL_TIME: Final = 1  # of simulationGetMode
_LOOK_EVERY_S: Final = 0.03
_LIMIT_S: Final = 300.0  # of a check, beside a start
_LONGEST: Final = 500
_USUAL: Final = {"robot": ROVER, "timeout_wall_s": SOON_S}
_FOLDER: Final = re.compile(
    r"""(?<![\w/\\])(?:[A-Za-z]:(?:[/\\][^/\\:*?"<>|\n]+)*|(?:~|[A-Z]{4,})?(?:/[^\s/:'"]+)+)[/\\]"""
)
_LAST_ROW: Final = "SELECT coalesce(max(id), 0) FROM state"
_NEWEST: Final = (
    "SELECT s.id, s.pid, run.id, run.world, state.sim_time_s, state.data "
    "FROM state JOIN run ON run.id = state.run_id JOIN session s ON s.id = run.session_id "
    "JOIN robot ON robot.id = s.robot_id WHERE robot.name = ? AND state.id > ? "
    "ORDER BY state.id DESC LIMIT 1"
)


class OtherwiseError(Exception):
    """Webots did not do what its sources say; the text is what was seen."""


class NotTriedError(Exception):
    """Nothing can be said of it here; the text is why."""


def require(holds: object, seen: str) -> None:
    """Fail with what was seen where something does not hold.

    Raises:
        OtherwiseError: It does not.
    """
    if not holds:
        raise OtherwiseError(seen)


class Moment(NamedTuple):
    """The newest row of a robot, with the run and the process that it is of."""

    session_id: int
    pid: int
    run_id: int
    world: str
    sim_time_s: float
    state: dict[str, Any]


class Bench:
    """Webots on a project of ours, and the recording that its controllers make.

    One check at a time uses it, in the thread `user`. Another, of a check that hung, may go on: its
    calls fail.

    Args:
        folder: Of the project, which is written.
        patience_s: How long a start of Webots may take until the first row.

    Attributes:
        world: The world file.
        before: The newest row of the rover when the check began.
    """

    before: Moment
    user: threading.Thread

    def __init__(self, folder: Path, patience_s: float) -> None:
        self.world = _write_project(folder)
        self.patience_s = patience_s
        self.where = Where(data_dir=folder / PROJECT_DATA_FOLDER)
        self.recording = self.where.recording(read_only=False)
        self._launch: WebotsLaunch | None = None
        self._never = set[tuple[bool, Mode | None]]()
        self._last_row = 0  # before Webots was started

    # -- Webots --

    def webots(
        self, *, stream: bool = False, mode: Mode = "realtime", port: int | None = None
    ) -> LaunchedWebots:
        """The Webots that runs so already, or a new one, once the rover has recorded.

        Raises:
            OtherwiseError: It has not.
            NotTriedError: It has not before either.
        """
        launch = self._launch
        runs: tuple[bool, Mode | None] = stream, mode
        is_there = launch and not launch.webots.is_over and not port
        if launch and is_there and (launch.start.streams, launch.start.mode) == runs:
            return launch.webots
        self.end()
        if runs in self._never:
            raise NotTriedError("a Webots that was started so has not recorded")
        ((self._last_row,),) = self.rows(_LAST_ROW) or [(0,)]
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
            time.sleep(_LOOK_EVERY_S)
        return launch.webots

    def running(self, *, stream: bool) -> None:
        """Webots whose time goes on in real time."""
        self.webots(stream=stream)
        if not self.moves(2.0) or self.row().state["mode"] != REAL_TIME:
            self.control("resume")
            self.goes_on("it was told to resume")
        self.before = self.row()

    def address(self) -> WebotsAddress:
        """Where it listens, as far as the system shows that."""
        assert self._launch is not None
        asked = WebotsAddress("127.0.0.1", self._launch.start.port)
        return self._launch.webots.address_now() or asked

    def end(self) -> None:
        """End the Webots that runs."""
        launch, self._launch = self._launch, None
        if launch is not None:
            launch.webots.end()

    # -- what it records --

    def newest(self, robot: str = ROVER) -> Moment | None:
        """The newest row of a robot since Webots was started; None where it has none."""
        found = self.rows(_NEWEST, robot, self._last_row)
        return Moment._make((*found[0][:-1], json.loads(found[0][-1]))) if found else None

    def row(self, robot: str = ROVER) -> Moment:
        """The newest row of a robot, as soon as it has one since Webots was started."""
        return self.until(lambda: self.newest(robot), f"{robot} records nothing")

    def rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        """Of the recording; none before there is one."""
        require(threading.current_thread() is self.user, "another check is made now")
        try:
            with self.recording.reader() as connection:
                return connection.execute(query, values).fetchall()
        except NoDatabaseError:
            return []

    def moves(self, within_s: float) -> bool:
        """Whether the rover's simulation time goes on within that wall time."""
        before = self.row()
        with suppress(OtherwiseError):
            self.until(lambda: self.row()[2:5:2] != before[2:5:2], "", within_s)  # run and time
            return True
        return False

    def goes_on(self, what: str) -> None:
        """Fail where simulation time stands still after something."""
        require(self.moves(SOON_S), f"{what}, and simulation time stands still")

    def stands(self, what: str) -> None:
        """Fail where simulation time goes on after something; what is under way may end first."""
        self.until(lambda: not self.moves(0.5), f"{what}, and simulation time goes on")

    def until(self, look: Callable[[], T | None], otherwise: str, within_s: float = SOON_S) -> T:
        """What a look finds, as soon as it is something.

        Raises:
            OtherwiseError: It never was, in that time.
        """
        until_s = time.monotonic() + within_s
        while not (found := look()):
            require(time.monotonic() < until_s, f"{otherwise} (waited {within_s:g} s)")
            time.sleep(_LOOK_EVERY_S)
        return found

    # -- asking --

    def ask(self, question: Question, **given: Any) -> Any:
        """The answer to a question of the rover: its data, or captions with pictures.

        Raises:
            OtherwiseError: It was refused, or failed.
        """
        require(threading.current_thread() is self.user, "another check is made now")
        names = {each.name for each in question.parameters}
        usual = {name: value for name, value in _USUAL.items() if name in names}
        try:
            data, shown = ask(question, usual | given, self.where)
        except WebotsMCPError as error:
            raise OtherwiseError(str(error)) from error
        if data is None:
            return shown
        why = data.get("error") or data.get("hint") or str(data)
        require(data.get("outcome", "done") in ("done", "claimed"), why)
        return data

    def control(self, command: str, **given: Any) -> None:
        """Steer, and require that it is done."""
        answer = self.ask(webots_simulation_control, command=command, **given)
        require(answer["outcome"] == "done", f"{command} is {answer['outcome']}")

    def refuses(self, question: Question, **given: Any) -> bool:
        """Whether a question is refused, or fails."""
        with suppress(OtherwiseError):
            self.ask(question, **given)
            return False
        return True

    def send(self, action: str, waits_s: float = SOON_S, **params: Any) -> None:
        """Send the rover a command of its own; it may be under way afterwards."""
        self.ask(webots_send_command, action=action, params=params, timeout_wall_s=waits_s)


def _write_project(folder: Path) -> Path:
    """The world with an observer, twice, and the controllers with the Python that runs this."""
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


def tried(
    check: Callable[[Bench], object], bench: Bench, limit_s: float = _LIMIT_S
) -> dict[str, Any]:
    """What came of a check: where it hangs, Webots is ended and its thread left alone.

    Args:
        check: One of `checks.CHECKS`.
        bench: Its Webots.
        limit_s: In so much time it is over, besides that of a start.
    """
    came = list[tuple[str, object]]()
    kind = check.__name__.partition("_")[0]

    def work() -> None:
        try:
            if kind != "check":
                bench.running(stream=kind == "streaming")
            came.append(("as expected", check(bench)))
        except Exception as error:  # noqa: BLE001 - what an unknown Webots answers can be anything
            is_tried = not isinstance(error, NotTriedError)
            came.append(("otherwise" if is_tried else "not tried", error or type(error).__name__))

    began_s = time.monotonic()
    bench.user = threading.Thread(target=work, daemon=True)
    bench.user.start()
    bench.user.join(limit_s + bench.patience_s)
    outcome, seen = (came or [("otherwise", f"it hung for {limit_s:g} s")])[0]
    if not came:
        bench.end()
    answer = {"outcome": outcome, "seen": None if seen is None else _anonymous(str(seen))}
    if outcome == "otherwise":
        expected, _, then = (check.__doc__ or "").rstrip(".").partition("; otherwise ")
        answer |= {"expected": expected, "works still": then}
    return answer | {"took_s": round(time.monotonic() - began_s, 1)}


def _anonymous(text: str) -> str:
    """Without the folder of any file, and the names of the user and the machine; cut if long."""
    names = {sys.prefix: "PYTHON", str(Path(__file__).parents[3]): "PACKAGE", host_name(): "HOST"}
    with suppress(OSError, KeyError, RuntimeError):  # a user without a name or a home
        names |= {str(Path.home()): "~", getpass.getuser(): "USER"}
    for name in sorted(names, key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", names[name], text)
    return _FOLDER.sub("", text)[:_LONGEST]
