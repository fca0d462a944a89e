"""What a controller in a branch continues with: the moment at which another run was left.

A branch runs in a simulator of its own, on a world that was saved in motion. The states of its
robots at that moment are in a file that an environment variable names.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.contract import RESTORED_VARIABLE, recorded_name


class RestoredState(NamedTuple):
    """The moment from which a branch continues, as `MCPBridge.restored` gives it.

    Attributes:
        state: The last state that was published before it.
        parameters: The values of the parameters at that moment; those of the branch may differ.
        sim_time_s: Its simulation time in the run that was left. The clock of a branch begins at 0.
        run_id: The run that was left, in the recording of that run.
    """

    state: dict[str, Any]
    parameters: dict[str, Any]
    sim_time_s: float
    run_id: int


class BranchOrigin(NamedTuple):
    """Where a controller in a branch comes from.

    Attributes:
        world: The world file of the run that was left.
        restored: What the controller continues with; None of a robot that was not recorded.
        calls: How many states it had published in that run.
    """

    world: str
    restored: RestoredState | None
    calls: int


_NOWHERE: Final = "the controller begins without bridge.restored"


def find_origin(robot_name: str, errors: ErrorReport) -> BranchOrigin | None:
    """Return where this process comes from; None unless it runs in a branch.

    For a file that cannot be used, a warning is printed.
    """
    file = os.environ.get(RESTORED_VARIABLE)
    if not file:
        return None
    try:
        found = cast("dict[str, Any]", json.loads(Path(file).read_text("utf-8")))
        world, robots = str(found["world"]), _mapping(found["robots"])
        own = next((robots[name] for name in robots if recorded_name(name) == robot_name), None)
        if own is None:
            return BranchOrigin(world, None, 0)
        moment = RestoredState(
            _mapping(own["state"]), _mapping(own["parameters"]), float(own["sim_time_s"]),
            int(own["run_id"]),
        )  # fmt: skip
        return BranchOrigin(world, moment, int(own["calls"]))
    except Exception as error:  # noqa: BLE001  (the robot comes first, whatever is in the file)
        errors.warn(RESTORED_VARIABLE, f"{RESTORED_VARIABLE}={file}: {error}; {_NOWHERE}")
        return None


def _mapping(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"an object was expected, not {value!r:.50}")
    return cast("dict[str, Any]", value)
