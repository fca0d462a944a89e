"""Tools that start Webots on a world, open another world in it, and end it."""

from __future__ import annotations

import time
from typing import Annotated, Any, Final

import anyio
from anyio import to_thread
from pydantic import Field

from webots_mcp.errors import CommandRefusedError
from webots_mcp.launch import Launch, SessionStart, require_world
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.questions.argument_types import RobotName, TimeoutS
from webots_mcp.questions.declaring import CHANGES, DESTROYS, Caller, question
from webots_mcp.questions.shortening import cut_text
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.launcher import project_of
from webots_mcp.steering.worlds import WorldRequest
from webots_mcp.store.recording import Recording
from webots_mcp.webots.starting import Mode, Start, free_port

_STARTING_S: Final = 60.0  # Webots downloads what it has not cached
_WAIT_S: Final = 30.0
_LOOK_EVERY_S: Final = 0.2
_LONGEST_LINE: Final = 200

World = Annotated[str, Field(max_length=1000, description="A .wbt file.")]


@question("Launch Webots on a world", CHANGES)
async def webots_launch_world(
    recording: Recording,
    world: World,
    caller: Caller,
    mode: Annotated[Mode | None, Field(description="To begin with; else as it prefers.")] = None,
    headless: Annotated[bool, Field(description="Without its window and 3D view.")] = False,
    stream: Annotated[
        bool, Field(description="Obey without a controller; opens the project to the net.")
    ] = False,
    timeout_wall_s: TimeoutS = _STARTING_S,
) -> CommandAnswer:
    """Start Webots and wait until the first controller records, or say why none does.

    It ends with this server, or when it is quit. One at a time.
    """
    launcher = caller.companions.webots
    project = await to_thread.run_sync(project_of, recording)
    file, _ = await to_thread.run_sync(require_world, world, project)
    port = await to_thread.run_sync(free_port)
    start = Start(file, mode, headless, stream, port)
    started_s = time.monotonic()
    launched = await to_thread.run_sync(launcher.begin, start)
    first = await _wait(launched, caller, started_s + timeout_wall_s)
    return await to_thread.run_sync(_answer, recording, launched, first, started_s)


@question("Load another world", DESTROYS)
async def webots_load_world(
    recording: Recording,
    world: World,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Open another world in the running Webots; all controllers end.

    By a controller that is a Supervisor, else by Webots if started with --stream.
    """
    project = await to_thread.run_sync(project_of, recording)
    file, _ = await to_thread.run_sync(require_world, world, project)
    return await _request(recording, caller, robot, timeout_wall_s).load(file)


@question("Quit Webots", DESTROYS)
async def webots_quit(
    recording: Recording,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """End Webots: the one of webots_launch_world; another only by a robot that is a Supervisor."""
    return await _request(recording, caller, robot, timeout_wall_s).quit()


def _request(
    recording: Recording, caller: Caller, robot: str | None, timeout_wall_s: float
) -> WorldRequest:
    dispatcher = Dispatcher(recording, caller.report)
    return WorldRequest(recording, dispatcher, robot, timeout_wall_s, caller.companions.webots)


async def _wait(launched: Launch, caller: Caller, until_s: float) -> SessionStart | None:
    """Until a controller records; None where the time was over first.

    Raises:
        CommandRefusedError: Webots has ended.
    """
    begun_s = time.monotonic()
    while True:
        is_over = launched.webots.is_over  # before the look: what came last is seen
        first = await to_thread.run_sync(launched.first_record)
        if first is not None or time.monotonic() > until_s:
            return first
        if is_over:
            await to_thread.run_sync(launched.webots.end)
            await to_thread.run_sync(launched.record_last_words)
            raise CommandRefusedError(await to_thread.run_sync(launched.silence))
        lines = launched.webots.lines
        said = cut_text(lines[-1].text, _LONGEST_LINE) if lines else "Webots starts"
        await caller.report(time.monotonic() - begun_s, until_s - begun_s, said)
        await anyio.sleep(_LOOK_EVERY_S)


def _answer(
    recording: Recording, launched: Launch, first: SessionStart | None, started_s: float
) -> CommandAnswer:
    header: dict[str, Any] = {}
    if first is not None:
        with recording.view(first.robot) as view:
            header = view.header()
    return CommandAnswer(
        **header,
        action="launch",
        outcome="done" if first else "claimed",
        waited_s=round(time.monotonic() - started_s, 3),
        result=_described(launched),
        route="process",
        evidence=f"{first.robot} records: run {first.run_id}" if first else None,
        hint=None if first else f"Webots runs, but {launched.silence()}{_then(launched)}",
    )


def _then(launched: Launch) -> str:
    """How a start in pause goes on."""
    if launched.start.mode != "pause":
        return ""
    by_us = 'webots_simulation_control("resume") plays it'
    alone = "press play in its window, or quit it and start it in another mode or with stream"
    return f". {by_us if launched.start.streams else alone}"


def _described(launched: Launch) -> dict[str, Any]:
    address = launched.webots.address
    return {
        "world": str(launched.world),
        "port": address.port if address else launched.start.port,
        "pid": launched.webots.pid,
    }
