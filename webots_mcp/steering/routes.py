"""Routes to steer the simulation, tried in turn: controller, observer, WebSocket, key presses.

An answer names the route that worked and the evidence for it, or why each route failed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import anyio
from anyio import to_thread

from webots_mcp.console.ownership import belongs
from webots_mcp.contract import HEARTBEAT_LATE_S, UNMOVED
from webots_mcp.errors import (
    AmbiguousRobotError,
    CommandRefusedError,
    NoDatabaseError,
    NothingRecordedError,
)
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.steering.request import CLAIMING_S, LEAST_S, UNCLAIMED, Request
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.recording import Recording, View, look
from webots_mcp.store.robots import list_robots, live_observer
from webots_mcp.store.sessions import Session
from webots_mcp.store.status import find_holder
from webots_mcp.webots import Instance, instance_at, instances
from webots_mcp.webots.orders import (
    ANSWER_S,
    KEYS,
    RESTARTING,
    Order,
    OrderReply,
    WebotsAddress,
    address_of,
    give_order,
    press,
    why_not_obeyed,
)

_POLL_S: Final = 0.05
_EVIDENCE_S: Final = 3.0  # a heartbeat shows within half a second that simulation time advances
_RESTART_S: Final = 5.0  # until a controller that Webots restarts has recorded
_NOTHING_SEEN: Final = (
    "the recording does not show it yet: simulation time also stands still while a controller "
    "hangs, or while an extern one has not been started"
)
_NONE_LIVES: Final = "none of the recorded robots has a live controller"
_NO_FORCE: Final = "not tried: it presses keys in Webots' window, which needs force=true"


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
        situation = await self._assess()
        if situation.silent is None:
            answer = await self._by_bridge(situation, CLAIMING_S)
            if answer.outcome not in UNCLAIMED:
                return answer
            situation = await self._assess()
        if situation.silent is None:
            return await self._by_bridge(situation)
        self.failed_routes["bridge"] = situation.silent
        for route in (self._by_observer, self._by_websocket, self._by_keyboard):
            answer = await route(situation)
            if answer is not None:
                return answer
        if not situation.can_command:
            raise CommandRefusedError(_no_route(self.order, self._failed_routes()))
        return await self._by_bridge(situation)

    async def _assess(self) -> Situation:
        found = await to_thread.run_sync(assess, self.recording, self.robot, self.order)
        named = None if self.port is None else WebotsAddress("127.0.0.1", self.port)
        if named is None or (found.is_there and found.address == named):
            return found
        why = f"no live controller records from the Webots at port {self.port}"
        return Situation(None, False, why, named, Moment(None, None), is_there=True)

    async def _by_bridge(self, situation: Situation, claiming_s: float = math.inf) -> CommandAnswer:
        """Send a command to the controller, and wait for it as long as there is time.

        Args:
            situation: What is known of the robot.
            claiming_s: How long to wait for its loop to claim the command, in wall seconds.
        """
        answer = await self._sent(self.robot, self.order, self.params, claiming_s)
        if situation.robot is not None and situation.robot == situation.observer:
            return await self._done_by_observer(situation, answer)
        answer.route = "bridge" if answer.outcome == "done" else None
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
        return answer

    async def _by_websocket(self, situation: Situation) -> CommandAnswer | None:
        try:
            address = await to_thread.run_sync(find_webots, self.recording, situation)
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
            pid = await to_thread.run_sync(_window_owner, self.recording, situation)
            await to_thread.run_sync(press, self.order, pid)
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


def assess(recording: Recording, robot: str | None, action: str) -> Situation:
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
                view = look(connection, robot)
                _require_not_held_elsewhere(view, error)
                return _situation(view, can_command=False, silent=str(error))
            return _situation(view, can_command=True, silent=_why_silent(view))
    except (NoDatabaseError, NothingRecordedError) as error:  # their texts say how to record
        return Situation(None, False, str(error).rstrip("."), None, Moment(None, None))


def _require_not_held_elsewhere(view: View, error: CommandRefusedError) -> None:
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


def _situation(view: View, *, can_command: bool, silent: str | None) -> Situation:
    moment = Moment(view.run.id if view.run else None, view.header()["sim_time_s"])
    address = address_of(view.session.instance) if view.session else None
    observer = live_observer(view.connection, view.session, view.now_s)
    name = observer.name if observer else None
    is_there = view.robot.live
    return Situation(view.robot.name, can_command, silent, address, moment, name, is_there)


def _why_silent(view: View) -> str | None:
    """Why a command would not be claimed soon; None where it would, or this is unknown."""
    session = view.session
    if session is None or not session.is_alive(view.now_s):
        return None  # it is being reloaded
    if not session.heartbeat_is_fresh(view.now_s):
        return view.status.why or "the controller's loop is silent"
    if _never_asks(session, view.now_s):
        return "the controller's loop does not call bridge.get_command()"
    return None


def _never_asks(session: Session, now_s: float) -> bool:
    """Whether the loop has run for two heartbeats without calling `get_command()`."""
    since_s = session.last_poll_wall_time_s or session.started_wall_time_s
    return session.age_s(since_s, now_s) > 2 * HEARTBEAT_LATE_S


def _begun(before: Moment, view: View) -> str | None:
    if view.run is None or view.run.id == before.run_id:
        return None
    return f"run {view.run.id} began"


def _moved(before: Moment, view: View) -> str | None:
    now_s = view.header()["sim_time_s"]
    if now_s is None or (before.sim_time_s is not None and now_s <= before.sim_time_s):
        return _begun(before, view)
    return f"simulation time advanced to {now_s} s"


def _standing(before: Moment, view: View) -> str | None:
    unknown = view.status.is_moving or view.status.why == UNMOVED
    return None if unknown else f"status: {view.status.text}"


_SIGNS: Final[dict[Order, Callable[[Moment, View], str | None]]] = {
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


def find_webots(recording: Recording, situation: Situation) -> WebotsAddress:
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


def _window_owner(recording: Recording, situation: Situation) -> int:
    """The id of the process whose window receives the keys."""
    address = find_webots(recording, situation)
    found = instance_at(address.port)
    if found is not None and found.address == address:  # another machine may use the same port
        return found.pid
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
