"""A layout for Foxglove and Lichtblick that shows what an MCAP file holds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.plugins.formats.contents import Contents
from webots_mcp.plugins.formats.mcap_topics import WORLD_FRAME, Topics
from webots_mcp.store.registered_signals import RegisteredSignal

_GRID: Final = {
    "layerId": "foxglove.Grid",
    "instanceId": "grid",
    "label": "Grid",
    "visible": True,
    "size": 10,
    "divisions": 10,
    "position": [0, 0, 0],
    "rotation": [0, 0, 0],
}


@dataclass(frozen=True)
class LayoutLimits:
    """How much a layout shows.

    Attributes:
        plotted: Signals in a plot.
        cameras: Cameras.
    """

    plotted: int = 8
    cameras: int = 4


_LIMITS: Final = LayoutLimits()


def layout(contents: Contents) -> dict[str, Any]:
    """Return panels for the main signals, the mode, the path, the pictures and the log."""
    topics, panels = Topics(contents), dict[str, dict[str, Any]]()
    _add_signals(panels, contents, topics)
    columns = [list(panels)]
    if contents.motion.position is not None:
        panels["3D!way"] = _path_panel(contents, topics)
    cameras = {topics.image(image): None for image in contents.images()}
    for number, topic in enumerate([*cameras][: _LIMITS.cameras]):
        panels[f"Image!{number}"] = {"imageMode": {"imageTopic": topic}}
    newest = contents.run_ids[-1]
    panels["RosOut!log"] = {"topicToRender": topics.topic(newest, "log"), "minLogLevel": 1}
    panels["RawMessages!state"] = {"topicPath": topics.topic(newest, "state")}
    columns.append([name for name in panels if name not in columns[0]])
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split([_split(each, "column") for each in columns if each], "row"),
    }


def main_signals(contents: Contents) -> list[RegisteredSignal]:
    """Return the signals of the robot's motion, else the first numbers that it published."""
    numbers = [signal for signal in contents.signals.values() if signal.kind in ("num", "angle")]
    moving = [signal for signal in contents.motion.evidence if signal in numbers]
    return (moving or numbers)[: _LIMITS.plotted]


def _add_signals(panels: dict[str, dict[str, Any]], contents: Contents, topics: Topics) -> None:
    position = contents.motion.position or ()
    places = [signal for signal in main_signals(contents) if signal in position]
    others = [signal for signal in main_signals(contents) if signal not in position]
    mode = [signal for signal in (contents.motion.mode,) if signal is not None]
    plots = (("Plot!position", places), ("Plot!signals", others), ("StateTransitions!mode", mode))
    for name, signals in plots:
        paths = [path for signal in signals for path in _paths(contents, topics, signal)]
        if paths:
            panels[name] = {"paths": paths, "isSynced": True}


def _paths(contents: Contents, topics: Topics, signal: RegisteredSignal) -> list[dict[str, Any]]:
    # Only message paths without quotes can be plotted; others have to be plotted by hand.
    if signal.reduction or not re.fullmatch(r"\$(\.[A-Za-z_]\w*|\[\d+\])+", signal.path):
        return []
    return [
        {
            "value": f"{topics.topic(run_id, 'state')}{signal.path[1:]}",
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for run_id in contents.run_ids
    ]


def _path_panel(contents: Contents, topics: Topics) -> dict[str, Any]:
    shown = {
        topics.topic(run_id, "way"): {"visible": True, "type": "line"}
        for run_id in contents.run_ids
    }
    return {"followTf": WORLD_FRAME, "followMode": "follow-none", "topics": shown,
            "layers": {"grid": _GRID}}  # fmt: skip


def _split(parts: list[Any], direction: str) -> Any:
    """Arrange parts one after the other, all of the same size."""
    if len(parts) == 1:
        return parts[0]
    rest = _split(parts[1:], direction)
    percentage = 100 / len(parts)
    return {"first": parts[0], "second": rest, "direction": direction,
            "splitPercentage": percentage}  # fmt: skip
