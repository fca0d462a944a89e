"""Opening another world in a Webots that runs, and ending it: by its controller, or by itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import anyio
from anyio import to_thread

from webots_mcp.errors import CommandRefusedError
from webots_mcp.launch import Launch, SessionStart, newest_in, starts_since
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.steering.launcher import Launcher
from webots_mcp.steering.request import CLAIMING_S, LEAST_S, UNCLAIMED, Request
from webots_mcp.steering.routes import Situation, assess, find_webots, why_no_reply
from webots_mcp.webots import instance_at
from webots_mcp.webots.orders import ANSWER_S, WebotsAddress, address_of, load_world

_POLL_S: Final = 0.1
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
            await anyio.sleep(_POLL_S)

    async def _gone(self, address: WebotsAddress | None) -> str:
        """The evidence that Webots has ended."""
        if address is None:
            return "its controller has ended"
        until_s = time.monotonic() + _GONE_S
        while await to_thread.run_sync(instance_at, address.port) is not None:
            if time.monotonic() > until_s:
                return f"its controller has ended; Webots still listens at port {address.port}"
            await anyio.sleep(_POLL_S)
        return f"no Webots listens at port {address.port} any more"

    def _answer(self, action: str, route: str, evidence: str) -> CommandAnswer:
        waited_s = self._waited_s
        return CommandAnswer(
            action=action, outcome="done", waited_s=waited_s, route=route, evidence=evidence
        )
