"""Requests about the world as a whole: opening another one in Webots, and ending Webots."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import anyio
from anyio import to_thread

from webots_mcp.answers.answer_models import CommandAnswer
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.instances import instance_at
from webots_mcp.simulator.launch import SessionStart, WebotsLaunch, newest_in, starts_since
from webots_mcp.simulator.orders import ANSWER_S, WebotsAddress, address_of, load_world
from webots_mcp.steering.launcher import Launcher
from webots_mcp.steering.routes import CLAIMING_S, MIN_ROUTE_S, UNCLAIMED, Request, why_no_reply
from webots_mcp.steering.situation import Situation, assess, find_address
from webots_mcp.store.policy import LAUNCH

_POLL_S: Final = 0.1


@dataclass
class WorldRequest(Request):
    """A request about the world as a whole, in the Webots that a recording knows.

    Attributes:
        launcher: Holds the Webots that this server has started, if any.
    """

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
        return await self._with_run(answer, situation, evidence, world, before)

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
            reason = (
                "this robot is not in the Webots that was started by this server (without robot "
                "it is ended)"
                if ours
                else "no Webots that was started by this server runs"
            )
            raise CommandRefusedError(
                f"{reason}, and no controller can be asked to "
                f"end another. {self._failed_routes_text()}. Close its window (Ctrl+Q)"
            )
        if answer.outcome == "done":
            answer.evidence = await self._await_end(situation.address)
        return answer

    async def _is_meant(self, ours: WebotsLaunch) -> bool:
        """Return whether the Webots of this server is that of the robot, if a robot is named."""
        if self.robot is None:
            return True
        situation = await self._assess("quit")
        address = await to_thread.run_sync(ours.webots.address_now)
        return situation.is_address_sure and situation.address == address

    async def _assess(self, action: str) -> Situation:
        return await to_thread.run_sync(assess, self.recording, self.robot, action)

    async def _by_controller(
        self, situation: Situation, action: str, params: dict[str, Any]
    ) -> CommandAnswer | None:
        """Ask the robot's controller, then the observer; return None if neither claimed it."""
        if situation.why_silent is None:
            answer = await self._ask("bridge", self.robot, action, params)
            if answer is not None:
                return answer
        else:
            self.failed_routes["bridge"] = situation.why_silent
        if situation.observer in (None, situation.robot):
            return None
        return await self._ask("observer", situation.observer, action, params)

    async def _ask(
        self, route: str, robot: str | None, action: str, params: dict[str, Any]
    ) -> CommandAnswer | None:
        answer = await self._send(robot, action, params, CLAIMING_S)
        if answer.outcome in UNCLAIMED:
            self.failed_routes[route] = answer.hint or answer.error or "it did not take the command"
            return None
        answer.route = route if answer.outcome == "done" else None
        return answer

    async def _by_websocket(self, situation: Situation, world: Path) -> str:
        """Ask Webots over its WebSocket, and return its reply.

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
                f"no route to open {world.name} works. {self._failed_routes_text()}. Open it in "
                "Webots (File, Open World), or end Webots and start it with that world "
                "(webots_launch_world can quit it, and launch one with stream=true)"
            ) from error
        return f"Webots replied {reply.text!r}"

    def _require_same_folder(
        self, situation: Situation, address: WebotsAddress, world: Path
    ) -> None:
        """Refuse a world of another folder: Webots searches it next to the current world only."""
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
        """Find the address of the robot's Webots, else of this server's, else of the only one.

        Raises:
            CommandRefusedError: There are several, or the only one is not of this project.
        """
        ours = self.launcher.running
        started = ours.webots.address if ours and not situation.is_address_sure else None
        return started or find_address(self.recording, situation)

    async def _with_run(
        self, answer: CommandAnswer, situation: Situation, evidence: str, world: Path, before: int
    ) -> CommandAnswer:
        """Add to an answer the run that began in the world, or a hint why none has."""
        begun = await self._await_start(lambda: self._begun_in(situation, world, before))
        if begun is None:
            answer.evidence = evidence
            answer.hint = (
                "no controller has recorded in it yet: its robots may have no bridge, or the "
                "simulation is paused; check webots_get_logs and webots_diagnose_setup"
            )
        else:
            answer = answer.model_copy(update=await to_thread.run_sync(self._header, begun.robot))
            answer.evidence = (
                f"{evidence}; run {begun.run_id} of {begun.robot} began in {world.name}"
            )
        if self.launcher.running is not None:
            self.launcher.running.world = world
        answer.waited_wall_s = self._waited_s
        return answer

    def _begun_in(self, situation: Situation, world: Path, before: int) -> SessionStart | None:
        for start in starts_since(self.recording, before):
            is_ours = situation.address in (None, address_of(start.instance))
            if is_ours and start.run_id and start.world and Path(start.world).resolve() == world:
                return start
        return None

    async def _await_start(self, find: Callable[[], SessionStart | None]) -> SessionStart | None:
        while True:
            found = await to_thread.run_sync(find)
            if found is not None or self._left_s <= MIN_ROUTE_S:
                return found
            await anyio.sleep(_POLL_S)

    async def _await_end(self, address: WebotsAddress | None) -> str:
        """Return the evidence that Webots has ended, or that it still listens."""
        if address is None:
            return "its controller has ended"
        until_s = time.monotonic() + 5.0  # from the end of its controllers to that of Webots
        while await to_thread.run_sync(instance_at, address.port) is not None:
            if time.monotonic() > until_s:
                return f"its controller has ended; Webots still listens at port {address.port}"
            await anyio.sleep(_POLL_S)
        return f"no Webots listens at port {address.port} any more"

    def _answer(self, action: str, route: str, evidence: str) -> CommandAnswer:
        waited_s = self._waited_s
        return CommandAnswer(
            action=action, outcome="done", waited_wall_s=waited_s, route=route, evidence=evidence
        )
