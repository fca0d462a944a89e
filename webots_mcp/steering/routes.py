"""Routes to steer the simulation, tried in turn: controller, observer, WebSocket, key presses.

An answer names the route that worked and the evidence for it, or why each route failed.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import anyio
from anyio import to_thread

from webots_mcp.answers.models import CommandAnswer
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, HEARTBEAT_LATE_S, UNMOVED
from webots_mcp.database.location import find_project
from webots_mcp.errors import (
    AmbiguousRobotError,
    CommandRefusedError,
    InvalidInputError,
    NoDatabaseError,
    NothingRecordedError,
)
from webots_mcp.simulator.console import belongs
from webots_mcp.simulator.instances import Instance, instance_at, instances
from webots_mcp.simulator.launch import Launch, SessionStart, newest_in, starts_since
from webots_mcp.simulator.orders import (
    ANSWER_S,
    KEYS,
    RESTARTING,
    Order,
    OrderReply,
    WebotsAddress,
    WebotsLine,
    address_of,
    give_order,
    load_world,
    press,
    why_not_obeyed,
)
from webots_mcp.simulator.starting import Start
from webots_mcp.steering.dispatch import (
    BLOCK_NOTICED_S,
    Dispatcher,
    find_target,
    is_withdrawn,
)
from webots_mcp.steering.trial_worker import TrialWorkers
from webots_mcp.store.policy import LAUNCH
from webots_mcp.store.recording import RecordingAccess, RobotView, view_robot
from webots_mcp.store.requests import permit
from webots_mcp.store.robots import SessionRecord, find_holder, list_robots, live_observer

CLAIMING_S: Final = HEARTBEAT_LATE_S + 0.5  # a loop that has just stopped is detected within it
UNCLAIMED: Final = ("cancelled", "expired")
LEAST_S: Final = 0.1  # that each route gets
_POLL_S: Final = 0.05
_EVIDENCE_S: Final = 3.0  # a heartbeat shows within half a second that simulation time advances
_RESTART_S: Final = 5.0  # until a controller that Webots restarts has recorded
_NOTHING_SEEN: Final = (
    "the recording does not show it yet: simulation time also stands still while a controller "
    "hangs, or while an extern one has not been started"
)
_NONE_LIVES: Final = "none of the recorded robots has a live controller"
_NO_FORCE: Final = "not tried: it presses keys in Webots' window, which needs force=true"
_WORLD_POLL_S: Final = 0.1
_GONE_S: Final = 5.0  # from the end of its controllers to that of Webots
_NONE_IS_OURS: Final = "no Webots that was started by this server runs"
_OURS_IS_ANOTHER: Final = (
    "this robot is not in the Webots that was started by this server (without robot it is ended)"
)
_NOT_RECORDED_YET: Final = (
    "no controller has recorded in it yet: its robots may have no bridge, or the simulation is "
    "paused; check webots_get_logs and webots_diagnose"
)


@dataclass
class Request:
    """One request, by all routes.

    Attributes:
        robot: The robot whose simulation to steer; None where there is only one.
        timeout_s: The wall time for all routes together, in seconds.
        failed_routes: Why each route did not work, by its name.
    """

    recording: RecordingAccess
    dispatcher: Dispatcher
    robot: str | None
    timeout_s: float
    failed_routes: dict[str, str] = field(default_factory=dict[str, str], init=False)
    started_s: float = field(default_factory=time.monotonic, init=False)

    async def _sent(
        self,
        robot: str | None,
        action: str,
        params: Mapping[str, Any],
        claiming_s: float,
        block_noticed_s: float = BLOCK_NOTICED_S,
    ) -> CommandAnswer:
        """The outcome of a command, which the controller must claim within `claiming_s`."""
        answer = await self.dispatcher.ask(
            robot,
            action,
            self._left_s,
            params,
            claiming_s=claiming_s,
            block_noticed_s=block_noticed_s,
        )
        answer.waited_s = self._waited_s
        return answer

    async def _permit(
        self, action: str, params: Mapping[str, Any], port: int | None = None
    ) -> None:
        """Before it is done without a command, by a Webots that may be of another project."""

        def ask() -> None:
            found = instance_at(port) if port else None
            world = found.world if found else None
            permit(self.recording, action, params, create=True, steered=world)

        await to_thread.run_sync(ask)

    def _header(self, robot: str) -> dict[str, Any]:
        with self.recording.view(robot) as view:
            return view.header()

    def _failed_routes(self) -> str:
        return "; ".join(f"{route}: {why}" for route, why in self.failed_routes.items())

    @property
    def _waited_s(self) -> float:
        return round(time.monotonic() - self.started_s, 3)

    @property
    def _left_s(self) -> float:
        return max(self.timeout_s - (time.monotonic() - self.started_s), LEAST_S)


class Moment(NamedTuple):
    """The newest moment of the recording before an order; later rows show its effect."""

    run_id: int | None
    sim_time_s: float | None


@dataclass
class Situation:
    """What is known before the first route is tried.

    Attributes:
        robot: The recorded name of the robot; None where none is recorded.
        can_command: Whether a command can be queued for its controller.
        silent: Why a command would wait now; None where the controller's loop runs.
        address: Webots' address as named by the caller or by the robot's session.
        before: The newest moment of its recording.
        observer: The name of the live observer of its simulation, if there is one.
        is_there: Whether the address is sure to be that of the wanted Webots: the caller has named
            it, or a live controller runs there. Else another Webots may listen at it by now.
    """

    robot: str | None
    can_command: bool
    silent: str | None
    address: WebotsAddress | None
    before: Moment
    observer: str | None = None
    is_there: bool = False


@dataclass
class Attempt(Request):
    """One request to steer.

    Attributes:
        port: The port of the wanted Webots; None for that of the robot.
    """

    order: Order
    params: Mapping[str, Any]
    force: bool = False
    port: int | None = None

    async def steer(self) -> CommandAnswer:
        """Steer by the first route that works.

        Raises:
            InvalidInputError: There is no such robot, or several are possible.
            CommandRefusedError: No route works; each is named with the reason.
        """
        situation, withdrawn = await self._assess(), None
        if situation.silent is None:
            answer = await self._by_bridge(situation, CLAIMING_S)
            if answer.outcome not in UNCLAIMED:
                return answer
            withdrawn = answer if is_withdrawn(answer) else None
            situation = await self._assess()
        silent = situation.silent or (withdrawn and withdrawn.error)
        if silent is None:
            return await self._by_bridge(situation)
        self.failed_routes["bridge"] = silent
        for route in (self._by_observer, self._by_websocket, self._by_keyboard):
            answer = await route(situation)
            if answer is not None:
                return answer
        if not situation.can_command:
            raise CommandRefusedError(_no_route(self.order, self._failed_routes()))
        if withdrawn is not None:  # its loop was blocked a moment ago: it is not asked again
            return self._with_failed_routes(withdrawn)
        noticed_s = max(BLOCK_NOTICED_S - self._waited_s, 0.0)
        return await self._by_bridge(situation, block_noticed_s=noticed_s)

    async def _assess(self) -> Situation:
        found = await to_thread.run_sync(assess, self.recording, self.robot, self.order)
        named = None if self.port is None else WebotsAddress("127.0.0.1", self.port)
        if named is None or (found.is_there and found.address == named):
            return found
        why = f"no live controller records from the Webots at port {self.port}"
        return Situation(None, False, why, named, Moment(None, None), is_there=True)

    async def _by_bridge(
        self,
        situation: Situation,
        claiming_s: float = math.inf,
        block_noticed_s: float = BLOCK_NOTICED_S,
    ) -> CommandAnswer:
        """Send a command to the controller, and wait for it as long as there is time.

        Args:
            situation: What is known of the robot.
            claiming_s: How long to wait for its loop to claim the command, in wall seconds.
            block_noticed_s: After which time it is asked whether its loop is blocked.
        """
        answer = await self._sent(self.robot, self.order, self.params, claiming_s, block_noticed_s)
        if situation.robot is not None and situation.robot == situation.observer:
            return await self._done_by_observer(situation, answer)
        answer.route = "bridge" if answer.outcome == "done" else None
        return self._with_failed_routes(answer)

    def _with_failed_routes(self, answer: CommandAnswer) -> CommandAnswer:
        others = {name: why for name, why in self.failed_routes.items() if name != "bridge"}
        if answer.outcome != "done" and others:
            answer.failed_routes = others
        return answer

    async def _by_observer(self, situation: Situation) -> CommandAnswer | None:
        """Ask the observer, whose loop also runs while simulation time stands still."""
        observer = situation.observer
        if observer is None or observer == situation.robot:
            return None
        try:
            answer = await self._sent(observer, self.order, self.params, CLAIMING_S)
        except CommandRefusedError as error:
            self.failed_routes["observer"] = str(error)
            return None
        if answer.outcome in UNCLAIMED:
            self.failed_routes["observer"] = (
                f"robot {observer!r} did not take the command: {answer.why}"
            )
            return None
        return await self._done_by_observer(situation, answer)

    async def _done_by_observer(self, situation: Situation, answer: CommandAnswer) -> CommandAnswer:
        """Add evidence from the recording: other controllers may prevent what Webots accepted."""
        if answer.outcome != "done":
            return answer
        answer.route = "observer"
        if self.order not in ("pause", "step"):
            answer.evidence = await self._shown(situation, _EVIDENCE_S)
            answer.hint = answer.hint if answer.evidence else _NOTHING_SEEN
            await self.dispatcher.name_mode_afterwards(answer)
        return answer

    async def _by_websocket(self, situation: Situation) -> CommandAnswer | None:
        try:
            address = await to_thread.run_sync(find_webots, self.recording, situation)
            await self._permit(self.order, self.params, address.port)
            reply, made = await self._give(address)
        except CommandRefusedError as error:
            self.failed_routes["websocket"] = str(error)
            return None
        if made:
            return await self._obeyed(situation, reply, made)
        seen = None
        if self.order in RESTARTING:  # Webots need not reply to these
            seen = await self._shown(situation, _RESTART_S)
        if seen is None:
            self.failed_routes["websocket"] = await to_thread.run_sync(why_no_reply, address, reply)
            return None
        return await self._answered(situation, "websocket", seen)

    async def _give(self, address: WebotsAddress) -> tuple[OrderReply, int]:
        """Give the order once per wanted step; returns the last reply and the number of replies."""
        reply, made = OrderReply(None, is_alive=False), 0
        while made < self._wanted and (made == 0 or self._left_s > LEAST_S):
            timeout_s = min(ANSWER_S, self._left_s)
            reply = await to_thread.run_sync(give_order, address, self.order, timeout_s)
            if reply.text is None:
                break
            made += 1
        return reply, made

    @property
    def _wanted(self) -> int:
        return int(self.params.get("steps", 1))

    async def _obeyed(self, situation: Situation, reply: OrderReply, made: int) -> CommandAnswer:
        """The answer after Webots' reply, with evidence from the recording where there is some."""
        replied = f"Webots replied {reply.text!r}" if reply.text else "Webots obeyed"
        if self._wanted > 1:
            replied = f"Webots made {made} of {self._wanted} basic time steps"
        wait_s = self._left_s if self.order in RESTARTING else _EVIDENCE_S
        seen = None if self.order == "pause" else await self._shown(situation, wait_s)
        evidence = f"{replied}; {seen}" if seen else replied
        answer = await self._answered(situation, "websocket", evidence)
        if made < self._wanted:
            answer.outcome = "failed"
        elif seen is None and self.order != "pause" and situation.robot is not None:
            answer.hint = _NOTHING_SEEN
        return answer

    async def _by_keyboard(self, situation: Situation) -> CommandAnswer | None:
        if not self.force:
            self.failed_routes["keyboard"] = _NO_FORCE
            return None
        try:
            found = await to_thread.run_sync(_window, self.recording, situation)
            await self._permit(self.order, self.params, found.port)
            await to_thread.run_sync(press, self.order, found.pid)
        except CommandRefusedError as error:
            self.failed_routes["keyboard"] = str(error)
            return None
        seen = await self._shown(situation, self.timeout_s)
        if seen is not None:
            return await self._answered(situation, "keyboard", seen)
        self.failed_routes["keyboard"] = (
            f"{KEYS[self.order].spoken} was pressed, but the recording does not show that Webots "
            "obeyed: check its window"
        )
        return None

    async def _shown(self, situation: Situation, wait_s: float) -> str | None:
        """The evidence in the recording, as soon as there is some; None after that time."""
        if situation.robot is None:
            return None
        until_s = time.monotonic() + min(wait_s, self._left_s)
        while True:
            sign = await to_thread.run_sync(self._sign, situation)
            if sign is not None or time.monotonic() > until_s:
                return sign
            await anyio.sleep(_POLL_S)

    def _sign(self, situation: Situation) -> str | None:
        with self.recording.view(situation.robot) as view:
            return _SIGNS[self.order](situation.before, view)

    async def _answered(self, situation: Situation, route: str, evidence: str) -> CommandAnswer:
        header: dict[str, Any] = {}
        if situation.robot is not None:
            header = await to_thread.run_sync(self._header, situation.robot)
        return CommandAnswer(
            **header,
            action=self.order,
            outcome="done",
            waited_s=self._waited_s,
            route=route,
            evidence=evidence,
        )


def assess(recording: RecordingAccess, robot: str | None, action: str) -> Situation:
    """Find out which controllers could run an action that steers the simulation.

    Raises:
        InvalidInputError: There is no such robot, or several are possible.
        CommandRefusedError: Another robot's bridge has paused the simulation.
    """
    try:
        with recording.reader() as connection:
            try:
                view = find_target(connection, robot, action)
            except AmbiguousRobotError:
                if any(each.live for each in list_robots(connection, time.time())):
                    raise
                return Situation(None, False, _NONE_LIVES, None, Moment(None, None))
            except CommandRefusedError as error:
                view = view_robot(connection, robot)
                _require_not_held_elsewhere(view, error)
                return _situation(view, can_command=False, silent=str(error))
            return _situation(view, can_command=True, silent=_why_silent(view))
    except (NoDatabaseError, NothingRecordedError) as error:  # their texts say how to record
        return Situation(None, False, str(error).rstrip("."), None, Moment(None, None))


def _require_not_held_elsewhere(view: RobotView, error: CommandRefusedError) -> None:
    """Refuse a simulation that another robot's bridge has paused: only that bridge resumes it."""
    session = view.session
    if session is None or not session.is_alive(view.now_s):
        return
    holder = find_holder(view.connection, session, view.now_s)
    if holder is None or holder.id == session.id:
        return
    observer = live_observer(view.connection, session, view.now_s)
    if observer is None or observer.id != holder.robot_id:
        raise error


def _situation(view: RobotView, *, can_command: bool, silent: str | None) -> Situation:
    moment = Moment(view.run.id if view.run else None, view.header()["sim_time_s"])
    address = address_of(view.session.instance) if view.session else None
    observer = live_observer(view.connection, view.session, view.now_s)
    name = observer.name if observer else None
    is_there = view.robot.live
    return Situation(view.robot.name, can_command, silent, address, moment, name, is_there)


def _why_silent(view: RobotView) -> str | None:
    """Why a command would not be claimed soon; None where it would, or this is unknown."""
    session = view.session
    if session is None or not session.is_alive(view.now_s):
        return None  # it is being reloaded
    if not session.heartbeat_is_fresh(view.now_s):
        return view.status.why or "the controller's loop is silent"
    if _never_asks(session, view.now_s):
        return "the controller's loop does not call bridge.get_command()"
    return None


def _never_asks(session: SessionRecord, now_s: float) -> bool:
    """Whether the loop has run for two heartbeats without calling `get_command()`."""
    since_s = session.last_poll_wall_time_s or session.started_wall_time_s
    return session.age_s(since_s, now_s) > 2 * HEARTBEAT_LATE_S


def _begun(before: Moment, view: RobotView) -> str | None:
    if view.run is None or view.run.id == before.run_id:
        return None
    return f"run {view.run.id} began"


def _moved(before: Moment, view: RobotView) -> str | None:
    now_s = view.header()["sim_time_s"]
    if now_s is None or (before.sim_time_s is not None and now_s <= before.sim_time_s):
        return _begun(before, view)
    return f"simulation time advanced to {now_s} s"


def _standing(before: Moment, view: RobotView) -> str | None:
    unknown = view.status.is_moving or view.status.why == UNMOVED
    return None if unknown else f"status: {view.status.text}"


_SIGNS: Final[dict[Order, Callable[[Moment, RobotView], str | None]]] = {
    "pause": _standing,
    "resume": _moved,
    "fast": _moved,
    "step": _moved,
    "reset": _begun,
    "reload": _begun,
}


def why_no_reply(address: WebotsAddress, reply: OrderReply) -> str:
    """Why Webots did not reply to an order, judged by its command line where it runs here."""
    found = instance_at(address.port)
    if reply.is_alive and found is not None and found.address == address and found.streams:
        return (
            f"Webots at {address} was started with --stream and received the order; it may have "
            "obeyed, but neither its reply nor the recording shows it; check webots_get_logs"
        )
    return why_not_obeyed(address, reply)


def find_webots(recording: RecordingAccess, situation: Situation) -> WebotsAddress:
    """The address of the wanted Webots; where that is not known, of the only one of this project.

    Raises:
        CommandRefusedError: There is none, or several, or only those of others.
    """
    address = situation.address
    if address is not None and situation.is_there:
        return address
    running = instances()
    if address is not None and not running:  # the system may not list its processes
        return address
    ours = [each for each in running if belongs(each, recording)]
    same = [each for each in ours if each.address == address]
    return _only(same or ours, running).address


def _window(recording: RecordingAccess, situation: Situation) -> Instance:
    """The Webots whose window receives the keys."""
    address = find_webots(recording, situation)
    found = instance_at(address.port)
    if found is not None and found.address == address:  # another machine may use the same port
        return found
    raise CommandRefusedError(f"no Webots of this machine listens at {address}")


def _only(ours: list[Instance], running: list[Instance]) -> Instance:
    if len(ours) == 1:
        return ours[0]
    if not running:
        raise CommandRefusedError("no Webots runs on this machine")
    worlds = ", ".join(f"{each.world or 'a world'} at port {each.port}" for each in running)
    if ours:
        raise CommandRefusedError(
            f"{len(ours)} Webots run ({worlds}), and no live session shows which one to steer: "
            "give its port"
        )
    raise CommandRefusedError(
        f"the Webots that runs here is not of this recording's project ({worlds}): give its port "
        "to steer it nevertheless"
    )


def _no_route(order: Order, failed_routes: str) -> str:
    return (
        f"no route to {order} the simulation works. {failed_routes}. Press {KEYS[order].spoken} in "
        "Webots, start Webots with --stream, or open the world with an observer in it (made by "
        "'webots-mcp init --observer WORLD'): both let it be steered without a controller"
    )


# -- the Webots that a server has started: at most one, which ends with the server --


class Launcher:
    """Starts Webots for a recording.

    Attributes:
        launched: The Webots that was started last.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        self.launched: Launch | None = None
        self._recording = recording
        self._lock = threading.Lock()

    @property
    def running(self) -> Launch | None:
        """The Webots that is still running, or None."""
        launched = self.launched
        return launched if launched is not None and not launched.webots.is_over else None

    def begin(self, start: Start) -> Launch:
        """Start Webots.

        Raises:
            NotAllowedError: A rule of the project forbids it.
            CommandRefusedError: It already runs, it is not installed, or there is no display.
            DatabaseError: The database cannot be used.
        """
        with self._lock:
            if self.running is not None:
                raise CommandRefusedError(
                    f"the Webots that this server started is still running with "
                    f"{self.running.world.name}: action=load opens another world in it, "
                    "action=quit ends it"
                )
            permit(self._recording, LAUNCH, {"world": str(start.world)}, create=True)
            self.launched = Launch(self._recording, start, self._environment(), _ignore)
            return self.launched

    def stop(self) -> None:
        """End it."""
        with self._lock:
            if self.launched is not None:
                self.launched.webots.end()

    def _environment(self) -> dict[str, str]:
        """The environment with which its controllers record where this server reads."""
        recording = self._recording
        if recording.database != recording.data_dir / DATABASE_NAME:
            return {}
        return {DATA_DIR_VARIABLE: str(recording.data_dir)}


@dataclass(frozen=True)
class Companions:
    """What runs in the background of a server, until the server ends."""

    trials: TrialWorkers
    webots: Launcher

    def stop(self) -> None:
        """End all of them."""
        self.trials.stop()
        self.webots.stop()


def project_of(recording: RecordingAccess) -> Path:
    """The Webots project of a server: that of its data folder, else of its current folder.

    Raises:
        InvalidInputError: Neither folder is in a project.
    """
    project = find_project(recording.data_dir) or find_project(Path.cwd())
    if project is None:
        raise InvalidInputError(
            f"this server has no Webots project: neither its data folder {recording.data_dir} nor "
            "its current folder is in one; start it with --data-dir PROJECT/mcp_data"
        )
    return project.resolve()


def _ignore(line: WebotsLine) -> None:
    """Ignore a line of Webots' output: `LaunchedWebots` keeps the newest ones."""


# -- opening another world in a Webots that runs, and ending it --


@dataclass
class WorldRequest(Request):
    """A request about the world as a whole, in the Webots that a recording knows."""

    launcher: Launcher

    async def load(self, world: Path) -> CommandAnswer:
        """Open another world.

        Raises:
            InvalidInputError: There is no such robot, or several are possible.
            CommandRefusedError: No route works; each is named with the reason.
        """
        situation = await self._assess("load_world")
        before = await to_thread.run_sync(newest_in, self.recording)
        answer = await self._by_controller(situation, "load_world", {"world": str(world)})
        if answer is not None and answer.outcome != "done":
            return answer
        evidence = "its controller has ended"
        if answer is None:
            evidence = await self._by_websocket(situation, world)
        answer = answer or CommandAnswer(action="load_world", outcome="done", route="websocket")
        return await self._proven(answer, situation, evidence, world, before)

    async def quit(self) -> CommandAnswer:
        """End Webots.

        Raises:
            InvalidInputError: There is no such robot, or several are possible.
            CommandRefusedError: This server has not started it, and no controller can be asked.
        """
        ours = self.launcher.running
        if ours is not None and await self._is_meant(ours):
            await self._permit(LAUNCH, {"world": str(ours.world)})  # so ended by who may start it
            await to_thread.run_sync(self.launcher.stop)
            evidence = f"its processes have ended, exit code {ours.webots.exit_code}"
            return self._answer("quit", "process", evidence)
        situation = await self._assess("quit")
        answer = await self._by_controller(situation, "quit", {})
        if answer is None:
            raise CommandRefusedError(
                f"{_OURS_IS_ANOTHER if ours else _NONE_IS_OURS}, and no controller can be asked to "
                f"end another. {self._failed_routes()}. Close its window (Ctrl+Q)"
            )
        if answer.outcome == "done":
            answer.evidence = await self._gone(situation.address)
        return answer

    async def _is_meant(self, ours: Launch) -> bool:
        """Whether the Webots of this server is that of the robot, where a robot is named."""
        if self.robot is None:
            return True
        situation = await self._assess("quit")
        address = await to_thread.run_sync(ours.webots.address_now)
        return situation.is_there and situation.address == address

    async def _assess(self, action: str) -> Situation:
        return await to_thread.run_sync(assess, self.recording, self.robot, action)

    async def _by_controller(
        self, situation: Situation, action: str, params: dict[str, Any]
    ) -> CommandAnswer | None:
        """The answer of the robot's controller or the observer; None where neither claimed it."""
        if situation.silent is None:
            answer = await self._taken("bridge", self.robot, action, params)
            if answer is not None:
                return answer
        else:
            self.failed_routes["bridge"] = situation.silent
        if situation.observer in (None, situation.robot):
            return None
        return await self._taken("observer", situation.observer, action, params)

    async def _taken(
        self, route: str, robot: str | None, action: str, params: dict[str, Any]
    ) -> CommandAnswer | None:
        answer = await self._sent(robot, action, params, CLAIMING_S)
        if answer.outcome in UNCLAIMED:
            self.failed_routes[route] = answer.hint or answer.error or "it did not take the command"
            return None
        answer.route = route if answer.outcome == "done" else None
        return answer

    async def _by_websocket(self, situation: Situation, world: Path) -> str:
        """Ask Webots over its WebSocket; returns its reply.

        Raises:
            CommandRefusedError: It cannot be asked this way, or does not obey.
        """
        try:
            address = await to_thread.run_sync(self._address, situation)
            await to_thread.run_sync(self._require_same_folder, situation, address, world)
            await self._permit("load_world", {"world": str(world)})
            reply = await to_thread.run_sync(load_world, address, world.name, ANSWER_S)
            if reply.text is None:
                raise CommandRefusedError(await to_thread.run_sync(why_no_reply, address, reply))
        except CommandRefusedError as error:
            self.failed_routes["websocket"] = str(error)
            raise CommandRefusedError(
                f"no route to open {world.name} works. {self._failed_routes()}. Open it in Webots "
                "(File, Open World), or end Webots and start it with that world "
                "(webots_launch_world can quit it, and launch one with stream=true)"
            ) from error
        return f"Webots replied {reply.text!r}"

    def _require_same_folder(
        self, situation: Situation, address: WebotsAddress, world: Path
    ) -> None:
        """Refuse a world of another folder: Webots looks for it next to the current world only."""
        current = self._current_world(situation, address)
        if current is None:
            raise CommandRefusedError(
                "Webots opens only worlds in the folder of the current one, which is not known"
            )
        if current.parent != world.parent:
            raise CommandRefusedError(
                f"Webots opens only worlds in the folder of the current one, {current.parent}"
            )

    def _current_world(self, situation: Situation, address: WebotsAddress) -> Path | None:
        if situation.robot is not None:
            with self.recording.view(situation.robot) as view:
                known = view.run.world if view.run else None
        elif self.launcher.running:
            known = self.launcher.running.world
        else:
            found = instance_at(address.port)
            known = found.world if found is not None and found.address == address else None
        return Path(known).resolve() if known else None

    def _address(self, situation: Situation) -> WebotsAddress:
        """The address of the robot's Webots, else of this server's, else of the only one.

        Raises:
            CommandRefusedError: There are several, or the only one is not of this project.
        """
        ours = self.launcher.running
        started = ours.webots.address if ours and not situation.is_there else None
        return started or find_webots(self.recording, situation)

    async def _proven(
        self, answer: CommandAnswer, situation: Situation, evidence: str, world: Path, before: int
    ) -> CommandAnswer:
        """The answer with the run that began in the world, or with a hint why none has."""
        begun = await self._wait(lambda: self._begun_in(situation, world, before))
        if begun is None:
            answer.evidence, answer.hint = evidence, _NOT_RECORDED_YET
        else:
            answer = answer.model_copy(update=await to_thread.run_sync(self._header, begun.robot))
            answer.evidence = (
                f"{evidence}; run {begun.run_id} of {begun.robot} began in {world.name}"
            )
        if self.launcher.running is not None:
            self.launcher.running.world = world
        answer.waited_s = self._waited_s
        return answer

    def _begun_in(self, situation: Situation, world: Path, before: int) -> SessionStart | None:
        for each in starts_since(self.recording, before):
            here = situation.address in (None, address_of(each.instance))
            if here and each.run_id and each.world and Path(each.world).resolve() == world:
                return each
        return None

    async def _wait(self, look: Callable[[], SessionStart | None]) -> SessionStart | None:
        while True:
            found = await to_thread.run_sync(look)
            if found is not None or self._left_s <= LEAST_S:
                return found
            await anyio.sleep(_WORLD_POLL_S)

    async def _gone(self, address: WebotsAddress | None) -> str:
        """The evidence that Webots has ended."""
        if address is None:
            return "its controller has ended"
        until_s = time.monotonic() + _GONE_S
        while await to_thread.run_sync(instance_at, address.port) is not None:
            if time.monotonic() > until_s:
                return f"its controller has ended; Webots still listens at port {address.port}"
            await anyio.sleep(_WORLD_POLL_S)
        return f"no Webots listens at port {address.port} any more"

    def _answer(self, action: str, route: str, evidence: str) -> CommandAnswer:
        waited_s = self._waited_s
        return CommandAnswer(
            action=action, outcome="done", waited_s=waited_s, route=route, evidence=evidence
        )
