"""The parts of one bridge."""

from __future__ import annotations

from typing import NamedTuple

from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.command_queue import ClaimedCommands
from webots_mcp.bridge.declared_parameters import Parameters
from webots_mcp.bridge.goal import Watch
from webots_mcp.bridge.heartbeat import Heartbeat
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.keeping import Keeper
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.picture_files import Album
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.reloads import Reloads
from webots_mcp.bridge.scene_edits import SceneEdits
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.bridge.webots_api import Simulation


class Context(NamedTuple):
    """The parts that serving commands and each built-in action work with."""

    simulation: Simulation
    clock: Clock
    recorder: Recorder
    journal: Journal
    album: Album
    heartbeat: Heartbeat
    throttle: Throttle
    reloads: Reloads
    queue: ClaimedCommands
    pause: Pause
    parameters: Parameters
    breakpoints: Breakpoints
    watch: Watch
    keeper: Keeper
    scene: SceneEdits
