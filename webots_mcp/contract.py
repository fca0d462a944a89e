"""What the bridge and the server agree on: names, limits, and where data lives.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple, get_args

VERSION: Final = "0.1.0"
APPLICATION_ID: Final = 0x57424D43  # "WBMC", shown by the `file` command
PREVIOUS_SCHEMA_VERSION: Final = 10  # of recordings that `webots-mcp import` brings over
SCHEMA_VERSION: Final = 11  # PRAGMA user_version of a database that this version reads and writes

ToolTier = Literal["core", "default", "all"]  # lists of tools: each has those of the one before
TOOL_TIERS: Final[tuple[ToolTier, ...]] = get_args(ToolTier)

DATABASE_NAME: Final = "webots.db"
WORLD_ENDING: Final = ".wbt"
WORLD_FOLDER: Final = "worlds"  # of a Webots project
CONTROLLER_FOLDER: Final = "controllers"  # of one; a project of extern controllers has none
PROJECT_IS: Final = f"a folder that holds {WORLD_FOLDER}/ with a {WORLD_ENDING} file"
PROJECT_DATA_FOLDER: Final = "mcp_data"  # in a Webots project
PROJECT_FILE: Final = "webots-mcp.toml"  # beside that folder: what is expected and allowed there
CAMERA_FOLDER: Final = "camera"
SCREENSHOT_FOLDER: Final = "screenshots"
SCENE_FOLDER: Final = "scenes"  # movies and animations of the simulation
LOG_CHARACTERS: Final = 10_000  # of a log line that are stored; WMCP_MAX_LOG of webots_mcp.h too
MAX_CAMERA_PICTURES: Final = 50  # of a camera that are stored; older ones are deleted
KEPT_FRAME: Final = "kept"  # the kind of a picture that belongs to the kept stretch it lies in
DATA_DIR_VARIABLE: Final = "WEBOTS_MCP_DATA_DIR"
STRICT_VARIABLE: Final = "WEBOTS_MCP_STRICT"
THROTTLE_VARIABLE: Final = "WEBOTS_MCP_THROTTLE_INTERVAL"
KEEP_LAST_VARIABLE: Final = "WEBOTS_MCP_KEEP_LAST_S"
HANG_VARIABLE: Final = "WEBOTS_MCP_HANG_AFTER_S"
PARAMETERS_VARIABLE: Final = "WEBOTS_MCP_PARAMETERS"
RESTORED_VARIABLE: Final = "WEBOTS_MCP_RESTORED"  # of a branch: the file with the moment's states
RESTORED_EVENT: Final = "restored"  # a controller has read what it is to continue with
INSPECT_VARIABLE: Final = "WEBOTS_MCP_INSPECT"  # 0: a controller's variables are never read


CommandStatus = Literal["pending", "claimed", "done", "failed", "expired", "cancelled", "lost"]
FINAL_STATUSES: Final = ("done", "failed", "expired", "cancelled", "lost")
LogLevel = Literal["debug", "info", "warning", "error", "critical"]
LOG_LEVELS: Final[tuple[LogLevel, ...]] = get_args(LogLevel)  # rising; in `logging` 10, 20, ... 50
# Who logged a line. Those of Webots' console: what Webots says itself is of `webots`, what a
# controller printed, and it does not say which, of `console`.
LogSource = Literal["controller", "bridge", "console", "webots"]
_LEVEL_ALIASES: Final[dict[str, LogLevel]] = {
    **{level: level for level in LOG_LEVELS},
    "warn": "warning",
    "err": "error",
    "fatal": "critical",
}

_PACKAGE: Final = Path(__file__).parent
C_HEADER: Final = _PACKAGE / "webots_mcp.h"  # by which controllers in C and C++ record
OBSERVER: Final = "Observer"  # the kind of a robot that only looks at the others, and steers
CUSTOM_DATA: Final = "customData"  # the kind of a robot that the observer records from this field
OBSERVER_NAME: Final = "mcp_observer"  # of its Robot node and of its controller
WORLD_EVENT: Final = "world"  # the event with the robots and solids that an observer sees
INSPECTION_EVENT: Final = "inspection"  # the event with the variables of a controller
EPISODE_EVENT: Final = "episode"  # the event with the summed reward of a run that has ended
WATCHED: Final = "watched"  # the key of a state under which watched variables are recorded
MODE_EVENT: Final = "mode"  # the event with the simulation mode that an observer sees
LOOK_AT: Final = "look_at"  # its action
MAX_BREAKPOINTS: Final = 32  # of one robot that are armed
KEEP_LAST_S: Final = 5.0  # before a moment, kept at full rate
HANG_AFTER_S: Final = 3.0  # of wall time without a sign of life of the loop
KEEP_AFTER_S: Final = 2.0  # after it
LOOPING: Final = ("step", "run")  # actions that let the loop come round; one is under way at most
ENDING: Final = ("load_world", "quit")  # actions that are done when the controller ends
SEE_STEPS: Final = (
    "call bridge.publish({...}) and bridge.get_command() in every round of the loop, or "
    "MCPBridge.attach(robot) before anything takes or replaces robot.step"
)
UNSEEN: Final = f"the controller's loop steps in a way that the bridge does not see: {SEE_STEPS}"
UNMOVED: Final = (
    "the bridge has not seen simulation time advance since it began: the simulation is paused in "
    "Webots, the controller has not reached its loop, or its loop steps in a way that the bridge "
    f"does not see; then {SEE_STEPS}"
)
ENDED_BY: Final = "the controller ended by"  # an exception, as it is logged
MAX_RUN_S: Final = 1e6  # of simulation time, of one `run` command
COMMAND_TIME_TO_LIVE_S: Final = 10.0
HEARTBEAT_INTERVAL_S: Final = 0.5  # how often a session says that its loop is alive
HEARTBEAT_LATE_S: Final = 2.0  # a session silent for longer is not looping
REMOTE_SILENCE_S: Final = 10.0  # one on another host, whose process cannot be asked, is dead then
ISSUED_TIME_TO_LIVE_S: Final = 60.0  # how long a reload may take until it counts as lost
MAX_STEPS: Final = 100_000
MOST_NAME_CHARACTERS: Final = 200  # of a robot
BY_PROCESS: Final = " process "  # in an instance that names no simulator


class BuiltInAction(NamedTuple):
    """What has to be known of an action that every bridge has, before it is run.

    Attributes:
        needs_supervisor: Only a Supervisor can do it.
        ends_steps: A `step` or `run` command that is still at work ends with it.
        runs_user_code: It calls functions of the controller, which may take their time.
        parameters: The names of its parameters; None where the controller decides.
        required: Those that must be given.
    """

    parameters: tuple[str, ...] | None = ()
    required: tuple[str, ...] = ()
    needs_supervisor: bool = True
    ends_steps: bool = False
    runs_user_code: bool = False


# The one list of them. What each does is the method of that name in `bridge/*_actions.py`.
BUILT_IN_ACTIONS: Final[dict[str, BuiltInAction]] = {
    "pause": BuiltInAction(ends_steps=True),
    "resume": BuiltInAction(ends_steps=True),
    "fast": BuiltInAction(ends_steps=True),
    "step": BuiltInAction(("steps",), ends_steps=True),
    "run": BuiltInAction(
        ("until", "for_s", "reset", "pace", "then", "parameters", "prune", "by"), ends_steps=True
    ),
    "cancel_run": BuiltInAction(("command_id",), ("command_id",), needs_supervisor=False),
    "reset": BuiltInAction(ends_steps=True),
    "reload": BuiltInAction(ends_steps=True),
    "load_world": BuiltInAction(("world",), ("world",), ends_steps=True),
    "quit": BuiltInAction(("status",), ends_steps=True),
    "screenshot": BuiltInAction(("quality",)),
    "take_frame": BuiltInAction(("camera",), needs_supervisor=False),
    "record_scene": BuiltInAction(
        ("do", "kind", "width", "height", "quality", "speed", "caption"), ("do",)
    ),
    "save_world": BuiltInAction(("name",), ("name",)),
    "reset_state": BuiltInAction(None, needs_supervisor=False, runs_user_code=True),
    "set_parameters": BuiltInAction(("values", "when", "by"), ("values",), needs_supervisor=False),
    "arm_breakpoints": BuiltInAction(needs_supervisor=False),
    "keep": BuiltInAction(("reason",), ("reason",), needs_supervisor=False),
    "inspect": BuiltInAction(("path",), needs_supervisor=False),
    "watch": BuiltInAction(("path", "every", "stop"), ("path",), needs_supervisor=False),
    "get_scene": BuiltInAction(("path", "types", "names", "fields", "depth", "cursor")),
    "get_field": BuiltInAction(("path", "start"), ("path",)),
    "set_field": BuiltInAction(("path", "value", "stop"), ("path", "value")),
    "add_node": BuiltInAction(("path", "vrml"), ("vrml",)),
    "remove_node": BuiltInAction(("path",), ("path",)),
}


BreakpointAction = Literal["pause", "log", "keep"]
BREAKPOINT_ACTIONS: Final[tuple[BreakpointAction, ...]] = get_args(BreakpointAction)
Pace = Literal["fast", "real_time"]  # of a `run` command
Then = Literal["pause", "go_on", "as_before"]  # what it does at its end
RunEnd = Literal[
    "condition held",
    "simulation time reached",
    "pruned",
    "run ended",
    "interrupted",
    "condition failed",
]


def find_log_level(level: object) -> LogLevel | None:
    """Return the level of a name, in either case, or of a number of `logging`.

    Returns:
        None for what is neither. A number between two levels is the lower one; less than 10 is
        `debug`.
    """
    if isinstance(level, str):
        return _LEVEL_ALIASES.get(level.strip().lower())
    if isinstance(level, bool) or not isinstance(level, (int, float)) or level != level:
        return None
    return LOG_LEVELS[int(min(max(level, 10), 50)) // 10 - 1]


def recorded_name(name: str) -> str:
    """The name under which a robot is recorded: a long one is shortened, with a hash of all of it.

    So long names that begin alike differ, and one that is asked for is found by all of it.
    """
    if len(name) <= MOST_NAME_CHARACTERS:
        return name
    mark = f"~{zlib.crc32(name.encode('utf-8', 'replace')):08x}"
    return name[: MOST_NAME_CHARACTERS - len(mark)] + mark


def host_name() -> str:
    """This machine's name, as sessions are entered and judged by it."""
    if sys.platform != "win32":
        return os.uname().nodename
    import socket  # only where needed: it is a tenth of the bridge's import time

    return socket.gethostname()


def instance_of(environment: Mapping[str, str], parent: int) -> str:
    """Which Webots a controller belongs to: its host and port, else the process that started it.

    Args:
        environment: Of the controller, which runs on this host.
        parent: The process that started it.
    """
    folder = environment.get("WEBOTS_INSTANCE_PATH", "").rstrip("/\\")
    url = environment.get("WEBOTS_CONTROLLER_URL", "")
    if folder and not is_extern(environment):
        port = folder[len(folder.rstrip("0123456789")) :]  # /tmp/webots/ada/1234, ...\webots-1234
        return f"{host_name()}:{port}" if port else f"{host_name()}:{folder}"
    if "://" in url:
        return _simulator_of(url)
    return f"{host_name()}{BY_PROCESS}{parent}"


def _simulator_of(url: str) -> str:
    """Of `ipc://1234/robot` or `tcp://192.168.1.5:1234/robot`; the robot may be left out."""
    place = url.partition("://")[2].partition("/")[0]
    host, _, port = place.rpartition(":")
    here = ("", "localhost", "127.0.0.1", "::1", host_name().lower())
    return f"{host_name() if host.strip('[]').lower() in here else host}:{port}"


def is_extern(environment: Mapping[str, str]) -> bool:
    """Return whether Webots did not start the controller, and so will not start its successor.

    The variables are tested in the order in which Webots' library reads them.
    """
    intern = "WEBOTS_ROBOT_NAME" in environment and "WEBOTS_INSTANCE_PATH" in environment
    return not intern and "WEBOTS_CONTROLLER_URL" in environment


def new_uuid() -> str:
    """Return a random UUID (version 4, RFC 9562), which names a row among those of all machines.

    By hand, because `import uuid` takes 3 ms of the time in which a controller starts.
    """
    number = bytearray(os.urandom(16))
    number[6] = number[6] & 0x0F | 0x40  # the version
    number[8] = number[8] & 0x3F | 0x80  # the variant
    text = number.hex()
    return "-".join((text[:8], text[8:12], text[12:16], text[16:20], text[20:]))


def bundled(name: str) -> Path:
    """Return the folder `name` (examples): in the package, or in a checkout next to it.

    Raises:
        FileNotFoundError: It is in neither place; the installation is broken.
    """
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"{name}/ is missing: install webots-mcp again")
