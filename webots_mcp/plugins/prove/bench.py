"""A Webots that checks are made on: started on a world of ours, asked, looked at, ended."""

from __future__ import annotations

import json
import shutil
import sqlite3
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.cli.asking import ask
from webots_mcp.cli.options import Where
from webots_mcp.contract import DATA_DIR_VARIABLE, OBSERVER_NAME, PROJECT_DATA_FOLDER
from webots_mcp.errors import WebotsMCPError
from webots_mcp.launch import Launch
from webots_mcp.questions.control_simulation import webots_simulation_control
from webots_mcp.questions.declaring import Question
from webots_mcp.setup.project_edits import controller_change, python_change, with_observer
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.webots.orders import WebotsAddress, WebotsLine
from webots_mcp.webots.starting import LaunchedWebots, Mode, Start, free_port

T = TypeVar("T")
ROVER: Final = "rover"
SPEAKER: Final = "speaker"
ROBOTS: Final = (ROVER, SPEAKER, OBSERVER_NAME)
PATIENCE_S: Final = 60.0  # Webots may compile shaders, and fill its cache, when it starts first
SOON_S: Final = 10.0
_LOOK_EVERY_S: Final = 0.03
_STANDS_S: Final = 0.5
_PROJECT: Final = Path(__file__).parent / "project"
_HEADER: Final = "#VRML_SIM R2023b utf8\n"
_SIGN: Final = 'EXTERNPROTO "../protos/Sign.proto"\n'
_MORE_NODES: Final = """
Robot {
  translation 1.5 -1.5 0.1
  name "speaker"
  controller "speaker"
}
DEF SIGN Sign {
  translation 1.5 1.5 0.2
}
"""
_NEWEST: Final = (
    "SELECT s.id, s.pid, run.id, run.world, run.start_reason, state.sim_time_s, state.data "
    "FROM state JOIN run ON run.id = state.run_id JOIN session s ON s.id = run.session_id "
    "JOIN robot ON robot.id = s.robot_id WHERE robot.name = ? ORDER BY state.id DESC LIMIT 1"
)


class OtherwiseError(Exception):
    """Webots did not do what its sources say; the text is what was seen."""


class NotTriedError(Exception):
    """Nothing can be said of it here; the text is why."""


class Moment(NamedTuple):
    """The newest row of a robot, with the run and the process that it is of."""

    session_id: int
    pid: int
    run_id: int
    world: str
    start_reason: str
    sim_time_s: float
    state: dict[str, Any]


class Bench:
    """Webots on a project of ours in a folder, and the recording that its controllers make.

    One check at a time uses it, in a thread of its own: `use` takes it from the one before, which
    may hang, and whose further calls raise.

    Args:
        folder: Is made.
        patience_s: How long a start of Webots may take until the first row.

    Attributes:
        world: The world file.
        recording: What its controllers record.
    """

    def __init__(self, folder: Path, patience_s: float = PATIENCE_S) -> None:
        self.world = _write_project(folder)
        self.patience_s = patience_s
        self.where = Where(data_dir=folder / PROJECT_DATA_FOLDER)
        self.recording = self.where.recording(read_only=False)
        self._launch: Launch | None = None
        self._runs: tuple[bool, Mode] | None = None
        self._never: set[tuple[bool, Mode] | None] = set()
        self._before: dict[str, Moment | None] = {}
        self._user: threading.Thread | None = None

    def use(self, user: threading.Thread) -> None:
        """From now on this thread uses it, and no other."""
        self._user = user

    # -- Webots --

    def webots(
        self, *, stream: bool = False, mode: Mode = "realtime", port: int | None = None
    ) -> LaunchedWebots:
        """The Webots that runs so already, or a new one, once the rover has recorded.

        Raises:
            OtherwiseError: It has not.
            NotTriedError: It has not before either.
        """
        self._require_user()
        launch = self._launch
        runs: tuple[bool, Mode] = stream, mode
        if launch is None or launch.webots.is_over or self._runs != runs or port:
            self.end()
            if runs in self._never:
                raise NotTriedError("a Webots that was started so before has not begun to record")
            self._before = {name: self.newest(name) for name in ROBOTS}
            start = Start(self.world, mode, headless=True, streams=stream, port=port or free_port())
            environment = {DATA_DIR_VARIABLE: str(self.recording.data_dir)}
            launch = self._launch = Launch(self.recording, start, environment, _ignore)
            self._runs = runs
            if mode != "pause":
                self._wait_for_first_row(launch)
        return launch.webots

    def _wait_for_first_row(self, launch: Launch) -> None:
        def is_decided() -> bool:
            return self.newest(ROVER) != self._before[ROVER] or launch.webots.is_over

        with suppress(OtherwiseError):
            self.until(is_decided, "", self.patience_s)
        if self.newest(ROVER) == self._before[ROVER]:
            why = launch.silence()
            self._never |= {self._runs}
            self.end()
            raise OtherwiseError(f"no row of the rover after the start: {why}")

    def since_start(self, robot: str) -> Moment:
        """The newest row of a robot, as soon as it has one since Webots was started."""
        wanted = self._before[robot]
        self.until(lambda: self.newest(robot) != wanted, f"{robot} records nothing")
        found = self.newest(robot)
        assert found is not None
        return found

    def running(self, *, stream: bool = False) -> Moment:
        """Webots whose time goes on in real time, and the newest row of the rover."""
        self.webots(stream=stream)
        now = self.rover()
        if not self.moves(2.0) or now.state["simulation_mode"] != "real_time":
            self.ask(webots_simulation_control, command="resume", robot=ROVER)
            self.goes_on("it was told to resume")
        return self.rover()

    def address(self) -> WebotsAddress:
        """Of the Webots that runs, as far as the system shows where it listens."""
        assert self._launch is not None
        return self._launch.webots.address_now() or WebotsAddress(
            "127.0.0.1", self._launch.start.port
        )

    def end(self) -> None:
        """End the Webots that runs."""
        launch, self._launch = self._launch, None
        if launch is not None:
            launch.webots.end()

    # -- what it records --

    def newest(self, robot: str) -> Moment | None:
        """The newest row of a robot; None where it has none."""
        for *values, data in self.rows(_NEWEST, robot):
            return Moment(*values, json.loads(data))
        return None

    def rover(self) -> Moment:
        """The newest row of the rover, which has recorded."""
        found = self.newest(ROVER)
        if found is None:
            raise OtherwiseError("the rover has recorded nothing")
        return found

    def rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        """Of the recording; none before there is one."""
        self._require_user()
        try:
            with self.recording.reader() as connection:
                return connection.execute(query, values).fetchall()
        except (WebotsMCPError, sqlite3.Error):
            return []

    def moves(self, within_s: float) -> bool:
        """Whether the rover's simulation time goes on."""
        before = self.rover()
        until_s = time.monotonic() + within_s
        while time.monotonic() < until_s:
            if _is_later(self.rover(), before):
                return True
            time.sleep(_LOOK_EVERY_S)
        return False

    def goes_on(self, what: str) -> None:
        """Fail where simulation time stands still after something."""
        if not self.moves(SOON_S):
            raise OtherwiseError(f"{what}, and simulation time stands still")

    def stands(self, what: str) -> None:
        """Fail where simulation time goes on after something; what is under way may end first."""
        self.until(lambda: not self.moves(_STANDS_S), f"{what}, and time went on")

    def until(self, look: Callable[[], T], otherwise: str, within_s: float = SOON_S) -> T:
        """What a look finds, as soon as it is something.

        Raises:
            OtherwiseError: It never was, in that time.
        """
        until_s = time.monotonic() + within_s
        while not (found := look()):
            if time.monotonic() > until_s:
                raise OtherwiseError(f"{otherwise} (waited {within_s:g} s)")
            time.sleep(_LOOK_EVERY_S)
        return found

    # -- asking --

    def ask(self, question: Question, *, may_be_under_way: bool = False, **given: Any) -> Any:
        """The answer to a question: its data, or captions with pictures.

        Raises:
            OtherwiseError: It was refused, or is not done.
        """
        self._require_user()
        if any(each.name == "timeout_wall_s" for each in question.parameters):
            given = {"timeout_wall_s": SOON_S} | given
        try:
            data, shown = ask(question, given, self.where)
        except WebotsMCPError as error:
            raise OtherwiseError(str(error)) from error
        if data is None:
            return shown
        outcome = data.get("outcome", "done")
        if outcome not in ("done", "claimed" if may_be_under_way else "done"):
            why = data.get("error") or data.get("hint") or data.get("why")
            raise OtherwiseError(f"{data.get('action')}: {outcome}, {why}")
        return data

    def _require_user(self) -> None:
        if self._user is not None and threading.current_thread() is not self._user:
            raise OtherwiseError("another check is made now")


def _is_later(now: Moment, before: Moment | None) -> bool:
    return before is None or (now.run_id, now.sim_time_s) > (before.run_id, before.sim_time_s)


def _write_project(folder: Path) -> Path:
    """The world with an observer, twice, and the controllers with the Python that runs this."""
    shutil.copytree(_PROJECT, folder)
    world = folder / "worlds" / "proving.wbt"
    world.parent.mkdir()
    text = DEFAULT_WORLD.read_text("utf-8").replace(_HEADER, _HEADER + _SIGN, 1) + _MORE_NODES
    for file in (world, world.with_name("second.wbt")):
        file.write_bytes(with_observer(text.encode()))
    observer = controller_change(folder)
    files = [folder / "controllers" / name / f"{name}.py" for name in (ROVER, SPEAKER)]
    for change in (observer, *(python_change(f, sys.executable) for f in (*files, observer.file))):
        change.file.parent.mkdir(exist_ok=True)
        change.file.write_bytes(change.after)
    return world


def _ignore(line: WebotsLine) -> None:
    """`LaunchedWebots` keeps the newest lines."""
