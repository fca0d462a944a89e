"""Routes to steer the simulation, tried in turn: controller, observer, WebSocket, key presses.

An answer names the route that worked and the evidence for it, or why each route failed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import anyio
from anyio import to_thread

from webots_mcp.answers.answer_models import CommandAnswer
from webots_mcp.contract import HEARTBEAT_LATE_S
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.instances import instance_at
from webots_mcp.simulator.key_presses import KEYS, press
from webots_mcp.simulator.orders import (
    ANSWER_S,
    RESTARTING,
    Order,
    OrderReply,
    WebotsAddress,
    give_order,
    why_not_obeyed,
)
from webots_mcp.steering.dispatch import BLOCK_NOTICED_S, Dispatcher, is_withdrawn
from webots_mcp.steering.situation import (
    Situation,
    assess,
    find_address,
    find_evidence,
    find_instance,
)
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import permit

CLAIMING_S: Final = HEARTBEAT_LATE_S + 0.5  # a loop that has just stopped is detected within it
UNCLAIMED: Final = ("cancelled", "expired")
MIN_ROUTE_S: Final = 0.1  # minimum time for a route, however little is left
_EVIDENCE_S: Final = 3.0  # a heartbeat shows within half a second that simulation time advances
_NOT_SHOWN: Final = (
    "the recording does not show it yet: simulation time also stands still while a controller "
    "hangs, or while an extern one has not been started"
)


@dataclass
class Request:
    """One request, by all routes.

    Attributes:
        recording: The recording of the robot.
        dispatcher: Sends commands to controllers.
        robot: The robot whose simulation to steer; None where there is only one.
        timeout_s: The wall time for all routes together, in seconds.
        failed_routes: Why each route did not work, by its name.
        started_s: When it began, on the monotonic clock.
    """

    recording: RecordingAccess
    dispatcher: Dispatcher
    robot: str | None
    timeout_s: float
    failed_routes: dict[str, str] = field(default_factory=dict[str, str], init=False)
    started_s: float = field(default_factory=time.monotonic, init=False)

    async def _send(
        self,
        robot: str | None,
        action: str,
        params: Mapping[str, Any],
        claiming_s: float,
        block_noticed_s: float = BLOCK_NOTICED_S,
    ) -> CommandAnswer:
        """Send a command, which the controller must claim within `claiming_s`."""
        answer = await self.dispatcher.ask(
            robot,
            action,
            self._left_s,
            params,
            claiming_s=claiming_s,
            block_noticed_s=block_noticed_s,
        )
        answer.waited_wall_s = self._waited_s
        return answer

    async def _permit(
        self, action: str, params: Mapping[str, Any], port: int | None = None
    ) -> None:
        """Ask for permission to do something without a command.

        The Webots at a port may be of another project, whose rules count then.
        """

        def ask() -> None:
            found = instance_at(port) if port else None
            world = found.world if found else None
            permit(self.recording, action, params, create=True, steered=world)

        await to_thread.run_sync(ask)

    def _header(self, robot: str) -> dict[str, Any]:
        with self.recording.view(robot) as view:
            return view.header()

    def _failed_routes_text(self) -> str:
        return "; ".join(f"{route}: {why}" for route, why in self.failed_routes.items())

    @property
    def _waited_s(self) -> float:
        return round(time.monotonic() - self.started_s, 3)

    @property
    def _left_s(self) -> float:
        return max(self.timeout_s - (time.monotonic() - self.started_s), MIN_ROUTE_S)


@dataclass
class Attempt(Request):
    """One request to steer.

    Attributes:
        order: What Webots is to do.
        params: The parameters of the order.
        force: Whether to press keys in Webots' window if nothing else works.
        port: The port of the wanted Webots; None for that of the robot.
    """

    order: Order
    params: Mapping[str, Any]
    force: bool = False
    port: int | None = None

    async def steer(self) -> CommandAnswer:
        """Carry out the order by the first route that works.

        Raises:
            InvalidInputError: There is no such robot, or several are possible.
            CommandRefusedError: No route works; each is named with the reason.
        """
        situation, withdrawn = await self._assess(), None
        if situation.why_silent is None:
            answer = await self._by_bridge(situation, CLAIMING_S)
            if answer.outcome not in UNCLAIMED:
                return answer
            withdrawn = answer if is_withdrawn(answer) else None
            situation = await self._assess()
        why_silent = situation.why_silent or (withdrawn and withdrawn.error)
        if why_silent is None:
            return await self._by_bridge(situation)
        self.failed_routes["bridge"] = why_silent
        for route in (self._by_observer, self._by_websocket, self._by_keyboard):
            answer = await route(situation)
            if answer is not None:
                return answer
        if not situation.can_command:
            raise CommandRefusedError(self._no_route_text())
        if withdrawn is not None:  # its loop was blocked a moment ago: it is not asked again
            return self._with_failed_routes(withdrawn)
        noticed_s = max(BLOCK_NOTICED_S - self._waited_s, 0.0)
        return await self._by_bridge(situation, block_noticed_s=noticed_s)

    async def _assess(self) -> Situation:
        found = await to_thread.run_sync(assess, self.recording, self.robot, self.order)
        named = None if self.port is None else WebotsAddress("127.0.0.1", self.port)
        if named is None or (found.is_address_sure and found.address == named):
            return found
        why = f"no live controller records from the Webots at port {self.port}"
        return Situation.without_controller(why, named, is_address_sure=True)

    # -- by a command: to the controller, or to the observer --------------------------------------

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
            block_noticed_s: Time after which to check whether its loop is blocked, in wall seconds.
        """
        answer = await self._send(self.robot, self.order, self.params, claiming_s, block_noticed_s)
        if situation.robot is not None and situation.robot == situation.observer:
            return await self._with_evidence(situation, answer)
        answer.route = "bridge" if answer.outcome == "done" else None
        return self._with_failed_routes(answer)

    async def _by_observer(self, situation: Situation) -> CommandAnswer | None:
        """Ask the observer, whose loop also runs while simulation time stands still."""
        observer = situation.observer
        if observer is None or observer == situation.robot:
            return None
        try:
            answer = await self._send(observer, self.order, self.params, CLAIMING_S)
        except CommandRefusedError as error:
            self.failed_routes["observer"] = str(error)
            return None
        if answer.outcome in UNCLAIMED:
            self.failed_routes["observer"] = (
                f"robot {observer!r} did not take the command: {answer.why}"
            )
            return None
        return await self._with_evidence(situation, answer)

    async def _with_evidence(self, situation: Situation, answer: CommandAnswer) -> CommandAnswer:
        """Add evidence from the recording: other controllers may prevent what Webots accepted."""
        if answer.outcome != "done":
            return answer
        answer.route = "observer"
        if self.order not in ("pause", "step"):
            answer.evidence = await self._await_evidence(situation, _EVIDENCE_S)
            answer.hint = answer.hint if answer.evidence else _NOT_SHOWN
            await self.dispatcher.refresh_mode(answer)
        return answer

    def _with_failed_routes(self, answer: CommandAnswer) -> CommandAnswer:
        others = {name: why for name, why in self.failed_routes.items() if name != "bridge"}
        if answer.outcome != "done" and others:
            answer.failed_routes = others
        return answer

    # -- by Webots' WebSocket ----------------------------------------------------------------------

    async def _by_websocket(self, situation: Situation) -> CommandAnswer | None:
        try:
            address = await to_thread.run_sync(find_address, self.recording, situation)
            await self._permit(self.order, self.params, address.port)
            reply, made = await self._give_order(address)
        except CommandRefusedError as error:
            self.failed_routes["websocket"] = str(error)
            return None
        if made:
            return await self._answer_to_reply(situation, reply, made)
        seen = None
        if self.order in RESTARTING:  # Webots need not reply to these
            restart_s = 5.0  # until a controller that Webots restarts has recorded
            seen = await self._await_evidence(situation, restart_s)
        if seen is None:
            self.failed_routes["websocket"] = await to_thread.run_sync(why_no_reply, address, reply)
            return None
        return await self._answer(situation, "websocket", seen)

    async def _give_order(self, address: WebotsAddress) -> tuple[OrderReply, int]:
        """Give the order once per wanted step; return the last reply and the number of replies."""
        reply, made = OrderReply(None, is_alive=False), 0
        while made < self._wanted_steps and (made == 0 or self._left_s > MIN_ROUTE_S):
            timeout_s = min(ANSWER_S, self._left_s)
            reply = await to_thread.run_sync(give_order, address, self.order, timeout_s)
            if reply.text is None:
                break
            made += 1
        return reply, made

    @property
    def _wanted_steps(self) -> int:
        return int(self.params.get("steps", 1))

    async def _answer_to_reply(
        self, situation: Situation, reply: OrderReply, made: int
    ) -> CommandAnswer:
        """Answer after Webots' reply, with evidence from the recording where there is some."""
        replied = f"Webots replied {reply.text!r}" if reply.text else "Webots obeyed"
        if self._wanted_steps > 1:
            replied = f"Webots made {made} of {self._wanted_steps} basic time steps"
        wait_s = self._left_s if self.order in RESTARTING else _EVIDENCE_S
        seen = None if self.order == "pause" else await self._await_evidence(situation, wait_s)
        evidence = f"{replied}; {seen}" if seen else replied
        answer = await self._answer(situation, "websocket", evidence)
        if made < self._wanted_steps:
            answer.outcome = "failed"
        elif seen is None and self.order != "pause" and situation.robot is not None:
            answer.hint = _NOT_SHOWN
        return answer

    # -- by key presses ----------------------------------------------------------------------------

    async def _by_keyboard(self, situation: Situation) -> CommandAnswer | None:
        if not self.force:
            self.failed_routes["keyboard"] = (
                "not tried: it presses keys in Webots' window, which needs force=true"
            )
            return None
        try:
            found = await to_thread.run_sync(find_instance, self.recording, situation)
            await self._permit(self.order, self.params, found.port)
            await to_thread.run_sync(press, self.order, found.pid)
        except CommandRefusedError as error:
            self.failed_routes["keyboard"] = str(error)
            return None
        seen = await self._await_evidence(situation, self.timeout_s)
        if seen is not None:
            return await self._answer(situation, "keyboard", seen)
        self.failed_routes["keyboard"] = (
            f"{KEYS[self.order].spoken} was pressed, but the recording does not show that Webots "
            "obeyed: check its window"
        )
        return None

    # -- evidence and answer -----------------------------------------------------------------------

    async def _await_evidence(self, situation: Situation, wait_s: float) -> str | None:
        """Return the evidence in the recording as soon as there is some; None after that time."""
        if situation.robot is None:
            return None
        until_s = time.monotonic() + min(wait_s, self._left_s)
        while True:
            evidence = await to_thread.run_sync(self._find_evidence, situation)
            if evidence is not None or time.monotonic() > until_s:
                return evidence
            await anyio.sleep(0.05)

    def _find_evidence(self, situation: Situation) -> str | None:
        with self.recording.view(situation.robot) as view:
            return find_evidence(self.order, situation.before, view)

    async def _answer(self, situation: Situation, route: str, evidence: str) -> CommandAnswer:
        header: dict[str, Any] = {}
        if situation.robot is not None:
            header = await to_thread.run_sync(self._header, situation.robot)
        return CommandAnswer(
            **header,
            action=self.order,
            outcome="done",
            waited_wall_s=self._waited_s,
            route=route,
            evidence=evidence,
        )

    def _no_route_text(self) -> str:
        return (
            f"no route to {self.order} the simulation works. {self._failed_routes_text()}. Press "
            f"{KEYS[self.order].spoken} in Webots, start Webots with --stream, or open the world "
            "with an observer in it (made by 'webots-mcp init --observer WORLD'): both let it be "
            "steered without a controller"
        )


def why_no_reply(address: WebotsAddress, reply: OrderReply) -> str:
    """Say why Webots did not reply to an order, by its command line if it runs on this machine."""
    found = instance_at(address.port)
    if reply.is_alive and found is not None and found.address == address and found.streams:
        return (
            f"Webots at {address} was started with --stream and received the order; it may have "
            "obeyed, but neither its reply nor the recording shows it; check webots_get_logs"
        )
    return why_not_obeyed(address, reply)
