"""Ways to steer the simulation, tried in turn: controller, observer, Webots' WebSocket, its keys.

An answer names the way that worked and what shows that it did; where none does, each says why.
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
from webots_mcp.steering.target import find_target
from webots_mcp.store.recording import Recording, View, look
from webots_mcp.store.robots import list_robots, live_observer
from webots_mcp.store.sessions import Session
from webots_mcp.store.status import find_holder
from webots_mcp.webots.instances import Instance, instance_at, instances
from webots_mcp.webots.key_presses import KEYS, press
from webots_mcp.webots.stream import (
    ANSWER_S,
    RESTARTING,
    Order,
    OrderReply,
    WebotsAddress,
    address_of,
    give_order,
    why_not_obeyed,
)

_POLL_S: Final = 0.05
_PROOF_S: Final = 3.0  # a heartbeat tells within half a second that time goes on
_RESTART_S: Final = 5.0  # until a controller that Webots starts again has recorded
_NOTHING_SEEN: Final = (
    "the recording does not show it yet: a controller that hangs, or an extern one that is "
    "missing, stops the time of a simulation that runs"
)
_NONE_LIVES: Final = "none of the recorded robots has a live controller"
_NO_FORCE: Final = "force=true would press Webots' own keys"


class Moment(NamedTuple):
    """Where the recording is: what comes after it shows what an order did."""

    run_id: int | None
    sim_time_s: float | None


@dataclass
class Situation:
    """What is known before the first way is tried.

    Attributes:
        robot: The robot as it is recorded; None where none was.
        can_command: Whether its controller can be sent a command, if only to wait for it.
        silent: Why a command would wait now; None where the controller's loop turns.
        address: Where its session says that Webots listens, or the caller.
        before: Where its recording was.
        observer: The name of the observer of its simulation, if one lives.
        is_there: Whether the address is that of the Webots that is meant: who called has named it,
            or a controller lives there. Another one may listen where one was.
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
        port: Of the Webots that is meant; None for that of the robot.
    """

    order: Order
    params: Mapping[str, Any]
    force: bool = False
    port: int | None = None

    async def steer(self) -> CommandAnswer:
        """Go the first way that works.

        Raises:
            InvalidInputError: There is no such robot, or several are possible.
            CommandRefusedError: No way works; each is named with the reason.
        """
        situation = await self._look_around()
        if situation.silent is None:
            answer = await self._by_bridge(situation, CLAIMING_S)
            if answer.outcome not in UNCLAIMED:
                return answer
            situation = await self._look_around()
        if situation.silent is None:
            return await self._by_bridge(situation)
        self.tried["bridge"] = situation.silent
        for way in (self._by_observer, self._by_websocket, self._by_keyboard):
            answer = await way(situation)
            if answer is not None:
                return answer
        if not situation.can_command:
            raise CommandRefusedError(_no_way(self.order, self._told()))
        return await self._by_bridge(situation)

    async def _look_around(self) -> Situation:
        found = await to_thread.run_sync(look_around, self.recording, self.robot, self.order)
        named = None if self.port is None else WebotsAddress("127.0.0.1", self.port)
        if named is None or (found.is_there and found.address == named):
            return found
        why = f"no live controller records from the Webots at port {self.port}"
        return Situation(None, False, why, named, Moment(None, None), is_there=True)

    async def _by_bridge(self, situation: Situation, claiming_s: float = math.inf) -> CommandAnswer:
        """Send a command to the controller, and wait for it as long as there is time.

        Args:
            situation: As it was looked at.
            claiming_s: Nobody waits for longer until its loop takes the command.
        """
        answer = await self._sent(self.robot, self.order, self.params, claiming_s)
        if situation.robot is not None and situation.robot == situation.observer:
            return await self._done_by_observer(situation, answer)
        answer.route = "bridge" if answer.outcome == "done" else None
        others = {name: why for name, why in self.tried.items() if name != "bridge"}
        if answer.outcome != "done" and others:
            answer.tried = others
        return answer

    async def _by_observer(self, situation: Situation) -> CommandAnswer | None:
        """Its loop turns also where time stands still, so it is asked without a long wait."""
        observer = situation.observer
        if observer is None or observer == situation.robot:
            return None
        try:
            answer = await self._sent(observer, self.order, self.params, CLAIMING_S)
        except CommandRefusedError as error:
            self.tried["observer"] = str(error)
            return None
        if answer.outcome in UNCLAIMED:
            self.tried["observer"] = f"robot {observer!r} did not take the command: {answer.why}"
            return None
        return await self._done_by_observer(situation, answer)

    async def _done_by_observer(self, situation: Situation, answer: CommandAnswer) -> CommandAnswer:
        """It asks Webots for something that others may prevent: the recording shows it, or not."""
        if answer.outcome != "done":
            return answer
        answer.route = "observer"
        if self.order not in ("pause", "step"):
            answer.proof = await self._shown(situation, _PROOF_S)
            answer.hint = answer.hint if answer.proof else _NOTHING_SEEN
        return answer

    async def _by_websocket(self, situation: Situation) -> CommandAnswer | None:
        try:
            address = await to_thread.run_sync(webots_meant, self.recording, situation)
            reply, made = await self._give(address)
        except CommandRefusedError as error:
            self.tried["websocket"] = str(error)
            return None
        if made:
            return await self._obeyed(situation, reply, made)
        seen = None
        if self.order in RESTARTING:  # of which Webots need not say anything
            seen = await self._shown(situation, _RESTART_S)
        if seen is None:
            self.tried["websocket"] = await to_thread.run_sync(why_no_word, address, reply)
            return None
        return await self._answered(situation, "websocket", seen)

    async def _give(self, address: WebotsAddress) -> tuple[OrderReply, int]:
        """Once, or as many steps as are asked for; the last reply, and how many were heard."""
        reply, made = OrderReply(None, is_alive=False), 0
        while made < self._wanted and (made == 0 or self._left_s > LEAST_S):
            timeout_s = min(ANSWER_S, self._left_s)
            reply = await to_thread.run_sync(give_order, address, self.order, timeout_s)
            if reply.heard is None:
                break
            made += 1
        return reply, made

    @property
    def _wanted(self) -> int:
        return int(self.params.get("steps", 1))

    async def _obeyed(self, situation: Situation, reply: OrderReply, made: int) -> CommandAnswer:
        """Webots has said so; the recording soon shows it as well, where controllers record."""
        said = f"Webots said {reply.heard!r}" if reply.heard else "Webots obeyed"
        if self._wanted > 1:
            said = f"Webots made {made} of {self._wanted} basic time steps"
        wait_s = self._left_s if self.order in RESTARTING else _PROOF_S
        seen = None if self.order == "pause" else await self._shown(situation, wait_s)
        proof = f"{said}; {seen}" if seen else said
        answer = await self._answered(situation, "websocket", proof)
        if made < self._wanted:
            answer.outcome = "failed"
        elif seen is None and self.order != "pause" and situation.robot is not None:
            answer.hint = _NOTHING_SEEN
        return answer

    async def _by_keyboard(self, situation: Situation) -> CommandAnswer | None:
        if not self.force:
            self.tried["keyboard"] = _NO_FORCE
            return None
        try:
            pid = await to_thread.run_sync(_window_owner, self.recording, situation)
            await to_thread.run_sync(press, self.order, pid)
        except CommandRefusedError as error:
            self.tried["keyboard"] = str(error)
            return None
        seen = await self._shown(situation, self.timeout_s)
        if seen is not None:
            return await self._answered(situation, "keyboard", seen)
        self.tried["keyboard"] = (
            f"{KEYS[self.order].spoken} was sent, and nothing in the recording shows that "
            "Webots obeyed: look at its window"
        )
        return None

    async def _shown(self, situation: Situation, wait_s: float) -> str | None:
        """What the recording shows of it, as soon as it does; None if nothing in that time."""
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

    async def _answered(self, situation: Situation, route: str, proof: str) -> CommandAnswer:
        header: dict[str, Any] = {}
        if situation.robot is not None:
            header = await to_thread.run_sync(self._header, situation.robot)
        return CommandAnswer(
            **header,
            action=self.order,
            outcome="done",
            waited_s=self._waited_s,
            route=route,
            proof=proof,
        )


def look_around(recording: Recording, robot: str | None, action: str) -> Situation:
    """Who could be asked for an action of the bridge that steers the simulation.

    Raises:
        InvalidInputError: There is no such robot, or several are possible.
        CommandRefusedError: Another robot's bridge holds the simulation.
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
    except (NoDatabaseError, NothingRecordedError) as error:  # which say how to record
        return Situation(None, False, str(error).rstrip("."), None, Moment(None, None))


def _require_not_held_elsewhere(view: View, error: CommandRefusedError) -> None:
    """What another robot's bridge holds, only that bridge can let go."""
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
    """Why a command would not be claimed soon; None where it would, or that is not known."""
    session = view.session
    if session is None or not session.is_alive(view.now_s):
        return None  # it is being reloaded
    if not session.heartbeat_is_fresh(view.now_s):
        return view.status.why or "the controller's loop is silent"
    if _never_asks(session, view.now_s):
        return "the controller's loop does not call bridge.get_command()"
    return None


def _never_asks(session: Session, now_s: float) -> bool:
    """Whether it turns for longer than a heartbeat may take without looking for commands."""
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
    return f"simulation time went on to {now_s} s"


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


def why_no_word(address: WebotsAddress, reply: OrderReply) -> str:
    """Why Webots said nothing to an order: how it was started shows it, where it runs here."""
    found = instance_at(address.port)
    if reply.is_alive and found is not None and found.address == address and found.streams:
        return (
            f"Webots at {address} was started with --stream and hears: it was asked, and may have "
            "obeyed, but neither its answer nor the recording shows it; webots_get_logs may"
        )
    return why_not_obeyed(address, reply)


def webots_meant(recording: Recording, situation: Situation) -> WebotsAddress:
    """Where the Webots listens that is meant; where that is not known, the only one of ours.

    Raises:
        CommandRefusedError: There is none, or several, or only those of others.
    """
    address = situation.address
    if address is not None and situation.is_there:
        return address
    running = instances()
    if address is not None and not running:  # the system may not show it
        return address
    ours = [each for each in running if belongs(each, recording)]
    same = [each for each in ours if each.address == address]
    return _only(same or ours, running).address


def _window_owner(recording: Recording, situation: Situation) -> int:
    """The process whose window gets the keys."""
    address = webots_meant(recording, situation)
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
            f"{len(ours)} Webots run ({worlds}), and no live session tells which is meant: name "
            "its port"
        )
    raise CommandRefusedError(
        f"the Webots that runs here is not of this recording's project ({worlds}): name its port "
        "if it is meant all the same"
    )


def _no_way(order: Order, told: str) -> str:
    return (
        f"no route to {order} the simulation works. {told}. Press {KEYS[order].spoken} in "
        "Webots, start Webots with --stream, or open the world with an observer in it (made by "
        "'webots-mcp init --observer WORLD'): both let it be steered without a controller"
    )
