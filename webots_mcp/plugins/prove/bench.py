"""A Webots that checks are made on: started on a world of ours, asked, looked at, ended."""

from __future__ import annotations

import json
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.cli.asking import ask
from webots_mcp.cli.options import Where
from webots_mcp.contract import DATA_DIR_VARIABLE, OBSERVER_NAME, PROJECT_DATA_FOLDER
from webots_mcp.errors import NoDatabaseError, WebotsMCPError
from webots_mcp.launch import Launch
from webots_mcp.questions.control_simulation import webots_simulation_control
from webots_mcp.questions.declaring import Question
from webots_mcp.questions.send_command import webots_send_command
from webots_mcp.setup.project_edits import controller_change, python_change, with_observer
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.webots.orders import WebotsAddress
from webots_mcp.webots.starting import LaunchedWebots, Mode, Start, free_port

T = TypeVar("T")
ROVER: Final = "rover"
SPEAKER: Final = "speaker"
SOON_S: Final = 10.0
REAL_TIME: Final = 1  # of simulationGetMode
_LOOK_EVERY_S: Final = 0.03
_STANDS_S: Final = 0.5
_MOVES_S: Final = 2.0
_HEADER: Final = "#VRML_SIM R2023b utf8\n"
_SIGN: Final = 'EXTERNPROTO "../protos/Sign.proto"\n'
_NODES: Final = """
Robot { translation 1.5 -1.5 0.1 name "speaker" controller "speaker" }
DEF SIGN Sign { translation 1.5 1.5 0.2 }
"""
_NEWEST: Final = (
    "SELECT s.id, s.pid, run.id, run.world, state.sim_time_s, state.data "
    "FROM state JOIN run ON run.id = state.run_id JOIN session s ON s.id = run.session_id "
    "JOIN robot ON robot.id = s.robot_id WHERE robot.name = ? ORDER BY state.id DESC LIMIT 1"
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
        self._launch: Launch | None = None
        self._runs: tuple[bool, Mode] = False, "realtime"
        self._never = set[tuple[bool, Mode]]()
        self._at_start = dict[str, Moment | None]()

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
        runs: tuple[bool, Mode] = stream, mode
        if launch is None or launch.webots.is_over or self._runs != runs or port:
            self.end()
            if runs in self._never:
                raise NotTriedError("a Webots that was started so has not recorded")
            self._at_start = {name: self.newest(name) for name in (ROVER, SPEAKER, OBSERVER_NAME)}
            start = Start(self.world, mode, headless=True, streams=stream, port=port or free_port())
            environment = {DATA_DIR_VARIABLE: str(self.recording.data_dir)}
            self._runs = runs
            launch = self._launch = Launch(self.recording, start, environment, lambda line: None)
            if mode != "pause":
                self._wait_for_first_row(launch)
        return launch.webots

    def _wait_for_first_row(self, launch: Launch) -> None:
        def is_decided() -> bool:
            return self.newest(ROVER) != self._at_start[ROVER] or launch.webots.is_over

        try:
            self.until(is_decided, "", self.patience_s)
            require(self.newest(ROVER) != self._at_start[ROVER], "")
        except OtherwiseError as error:
            self._never.add(self._runs)
            why = launch.silence()
            self.end()
            raise OtherwiseError(f"the rover records nothing after the start: {why}") from error

    def running(self, *, stream: bool) -> None:
        """Webots whose time goes on in real time."""
        self.webots(stream=stream)
        if not self.moves(_MOVES_S) or self.rover().state["mode"] != REAL_TIME:
            self.control("resume")
            self.goes_on("it was told to resume")
        self.before = self.rover()

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

    def newest(self, robot: str) -> Moment | None:
        """The newest row of a robot; None where it has none."""
        found = self.rows(_NEWEST, robot)
        return Moment._make((*found[0][:-1], json.loads(found[0][-1]))) if found else None

    def rover(self) -> Moment:
        """The newest row of the rover."""
        return self.since_start(ROVER)

    def since_start(self, robot: str) -> Moment:
        """The newest row of a robot, as soon as it has one since Webots was started."""
        before = self._at_start.get(robot)

        def look() -> Moment | None:
            return found if (found := self.newest(robot)) != before else None

        found = self.until(look, f"{robot} records nothing")
        assert found is not None
        return found

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
        before, until_s = self.rover(), time.monotonic() + within_s
        while (now := self.rover())[2:5:2] == before[2:5:2] and time.monotonic() < until_s:
            time.sleep(_LOOK_EVERY_S)
        return now[2:5:2] != before[2:5:2]

    def goes_on(self, what: str) -> None:
        """Fail where simulation time stands still after something."""
        require(self.moves(SOON_S), f"{what}, and simulation time stands still")

    def stands(self, what: str) -> None:
        """Fail where simulation time goes on after something; what is under way may end first."""
        self.until(lambda: not self.moves(_STANDS_S), f"{what}, and simulation time goes on")

    def until(self, look: Callable[[], T], otherwise: str, within_s: float = SOON_S) -> T:
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
        usual = {"robot": ROVER, "timeout_wall_s": SOON_S}
        known = {each.name for each in question.parameters}
        given = {name: value for name, value in usual.items() if name in known} | given
        try:
            data, shown = ask(question, given, self.where)
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

    def send(self, action: str, waits_s: float = SOON_S, **params: Any) -> None:
        """Send the rover a command of its own; it may be under way afterwards."""
        self.ask(webots_send_command, action=action, params=params, timeout_wall_s=waits_s)


def _write_project(folder: Path) -> Path:
    """The world with an observer, twice, and the controllers with the Python that runs this."""
    shutil.copytree(Path(__file__).parent / "project", folder)
    world = folder / "worlds" / "proving.wbt"
    world.parent.mkdir()
    text = DEFAULT_WORLD.read_text("utf-8").replace(_HEADER, _HEADER + _SIGN, 1) + _NODES
    for file in (world, world.with_name("second.wbt")):
        file.write_bytes(with_observer(text.encode()))
    observer = controller_change(folder)
    files = [folder / "controllers" / name / f"{name}.py" for name in (ROVER, SPEAKER)]
    for change in (observer, *(python_change(f, sys.executable) for f in (*files, observer.file))):
        change.file.parent.mkdir(exist_ok=True)
        change.file.write_bytes(change.after)
    return world
