"""A range as an MCAP file, through the extra `mcap`, for Foxglove, Lichtblick and PlotJuggler.

Messages are JSON. Their log time is simulation time in nanoseconds from 0, so that plots have the
robot's own clock, whatever the simulation's speed was and however long it was paused; their publish
time is wall time in nanoseconds since 1970. Of several runs each has topics of its own, which lie
over each other, since simulation time begins again in each.
"""

from __future__ import annotations

import base64
import json
import math
import re
import sqlite3
from collections import Counter
from dataclasses import dataclass, field
from functools import partial, singledispatchmethod
from importlib import import_module
from itertools import chain, count
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from webots_mcp.database.files import placed
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.plugins.formats.contents import KINDS, Contents, PlacedCommand, Pose, SampledPath
from webots_mcp.store.chunks import parse
from webots_mcp.store.export import Exported, Progress, Recorded, json_text, value_at
from webots_mcp.store.logs import LogLine
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.run_rows import Event, StoredImage
from webots_mcp.store.signals import Signal

WORLD_FRAME: Final = "world"
_PROFILE: Final = ""  # of no middleware
_LEVELS: Final = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5}
_NOT_IN_TOPICS: Final = re.compile(r"[^A-Za-z0-9_-]+")  # as message paths take them unquoted
_NOT_IN_JSON: Final = re.compile("NaN|Infinity")  # Python reads them as numbers, viewers do not
FIXED: Final[dict[str, Schema]] = json.loads(
    Path(__file__).with_name("mcap_schemas.json").read_text("utf-8")
)
_SCALARS: Final = {bool: "boolean", int: "number", float: "number", str: "string"}
# What a message path can say without quotes: others are plotted by hand.
_PLAIN_PATH: Final = re.compile(r"\$(\.[A-Za-z_]\w*|\[\d+\])+")
_MOST_PLOTTED: Final = 8
_MOST_CAMERAS: Final = 4
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


def write_mcap(contents: Contents, sink: BinaryIO) -> Counter[str]:
    """Everything of a range as messages: see `Topics` for the topics.

    A state is the message as it was published, with `replaced` beside, which names the path of
    every value that JSON cannot hold (null in the message) and what it was.

    Returns:
        How many there are of each kind.

    Raises:
        InvalidInputError: The library is not installed.
    """
    writer = _library().Writer(sink)
    writer.start(profile=_PROFILE, library="webots-mcp")
    writing = _McapWriter(contents, writer)
    writing.begin()
    for item in contents.items(pass_number=2):
        writing.write(item)
    writer.finish()
    return writing.counts


def _library() -> Any:
    try:
        return import_module("mcap.writer")
    except ImportError as error:
        raise InvalidInputError(
            f"{explain_extra('an MCAP file', 'mcap')}; or export as csv or jsonl"
        ) from error


class Topics:
    """How the topics of a range are called.

    They are /ROBOT/state, /ROBOT/pose, /ROBOT/way, /ROBOT/camera/DEVICE, /ROBOT/screenshot,
    /ROBOT/log, /ROBOT/events and /ROBOT/commands; of several runs /run_ID/ROBOT/... each. Of two
    devices that would be called the same, one is called NAME_2.
    """

    def __init__(self, contents: Contents) -> None:
        self._devices: dict[str, str] = {}
        devices = {image.device for image in contents.images() if image.device}
        for device in sorted(devices, key=lambda each: (_named(each) != each, each)):
            self._device(device)  # first those that may be called as they are
        self._robot = _named(contents.wanted.robot)
        self._several = len(contents.run_ids) > 1

    def frame(self, run_id: int) -> str:
        """The coordinate frame of the robot, and the branch of its topics."""
        return f"run_{run_id}/{self._robot}" if self._several else self._robot

    def topic(self, run_id: int, name: str) -> str:
        """The topic of that name."""
        return f"/{self.frame(run_id)}/{name}"

    def image(self, image: StoredImage) -> str:
        """The topic of a picture; those of a kept stretch are its camera's."""
        name = f"camera/{self._device(image.device)}" if image.device else image.kind
        return self.topic(image.run_id, name)

    def _device(self, name: str) -> str:
        """What a device is called, unlike all others; its first picture may have come just now."""
        if name not in self._devices:
            plain, taken = _named(name), self._devices.values()
            numbered = (f"{plain}_{number}" for number in count(2))
            free = (each for each in chain([plain], numbered) if each not in taken)
            self._devices[name] = next(free)
        return self._devices[name]


def _named(name: str) -> str:
    return _NOT_IN_TOPICS.sub("_", name)


class _McapWriter:
    """A file that is being written."""

    def __init__(self, contents: Contents, writer: Any) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self._contents = contents
        self._writer = writer
        self._topics = Topics(contents)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def begin(self) -> None:
        """What comes before the messages: the schemas of states, ways, and what runs these are."""
        shapes = {run_id: FieldShape({"object"}) for run_id in self._contents.run_ids}
        ways = {run_id: SampledPath() for run_id in self._contents.run_ids}
        for recorded in self._contents.source.recorded():
            state = parse(recorded.data)
            shapes[recorded.run_id].see(_renamed(state))
            pose = self._contents.pose(partial(value_at, state))
            if pose is not None:
                ways[recorded.run_id].see(recorded, pose)
        for run_id, shape in shapes.items():
            name = f"webots_mcp.State.{self._topics.frame(run_id)}".replace("/", ".")
            schema = shape.schema() or {"type": "object", "properties": {}}
            self._register(self._topics.topic(run_id, "state"), name, schema)
            self._writer.add_metadata(f"run {run_id}", self._contents.about(run_id))
            if ways[run_id].poses:
                self._write_way(run_id, ways[run_id])

    @singledispatchmethod
    def write(self, item: Any) -> None:
        """Write what was recorded as the messages that it is."""
        raise TypeError(f"no message is made of {type(item)}")

    @write.register
    def _(self, item: Recorded) -> None:
        self.counts["states"] += 1
        state = parse(item.data)
        self._send(item, self._topics.topic(item.run_id, "state"), _state_text(item, state))
        pose = self._contents.pose(partial(value_at, state))
        if pose is not None:
            self._write_pose(item, pose)

    @write.register
    def _(self, item: LogLine) -> None:
        self.counts["log lines"] += 1
        name = ": ".join(filter(None, (item.source, item.logger)))
        level = _LEVELS.get(item.level, 0)
        message = {"level": level, "message": item.message, "name": name, "file": "", "line": 0}
        self._encode(item, "log", "foxglove.Log", message)

    @write.register
    def _(self, item: Event) -> None:
        self.counts["events"] += 1
        message = {"kind": item.kind, "name": item.name, "data": item.details()}
        self._encode(item, "events", "webots_mcp.Event", message)

    @write.register
    def _(self, item: PlacedCommand) -> None:
        self.counts["commands"] += 1
        took_s = item.finished_wall_time_s and item.finished_wall_time_s - item.wall_time_s
        message = {
            "id": item.id,
            "action": item.action,
            "params": json.loads(item.params),
            "status": item.status,
            "requested_by": item.requested_by,
            "finished_sim_time_s": item.finished_sim_time_s,
            "took_wall_s": took_s,
            "result": json.loads(item.result) if item.result else None,
            "error": item.error,
        }
        self._encode(item, "commands", "webots_mcp.Command", message)

    @write.register
    def _(self, item: StoredImage) -> None:
        data = self._contents.picture(item)
        self.counts["pictures" if data is not None else "pictures that are gone"] += 1
        if data is None:
            return
        ending = item.path.rpartition(".")[2].lower()
        message = {
            "timestamp": _time(item.sim_time_s),
            "frame_id": item.device or item.kind,
            "data": base64.b64encode(data).decode(),
            "format": {"jpg": "jpeg"}.get(ending, ending),
        }
        self._message(item, self._topics.image(item), "foxglove.CompressedImage", message)

    def _write_pose(self, item: Recorded, pose: Pose) -> None:
        parts = _pose(pose)
        message = {
            "timestamp": _time(item.sim_time_s),
            "parent_frame_id": WORLD_FRAME,
            "child_frame_id": self._topics.frame(item.run_id),
            "translation": parts["position"],
            "rotation": parts["orientation"],
        }
        topic = self._topics.topic(item.run_id, "pose")
        self._message(item, topic, "foxglove.FrameTransform", message)

    def _write_way(self, run_id: int, way: SampledPath) -> None:
        first = way.first
        assert first is not None
        poses = [_pose(pose) for pose in way.poses]
        message = {"timestamp": _time(first.sim_time_s), "frame_id": WORLD_FRAME, "poses": poses}
        topic = self._topics.topic(run_id, "way")
        self._message(first, topic, "foxglove.PosesInFrame", message)

    def _encode(self, item: Any, name: str, schema: str, message: dict[str, Any]) -> None:
        """A message with its time, without what is null."""
        told = {key: value for key, value in message.items() if value is not None}
        stamped = {"timestamp": _time(item.sim_time_s), **told}
        self._message(item, self._topics.topic(item.run_id, name), schema, stamped)

    def _message(self, item: Any, topic: str, schema: str, message: dict[str, Any]) -> None:
        if topic not in self._channels:
            self._register(topic, schema, FIXED[schema])
        self._send(item, topic, json_text(message))

    def _send(self, item: Any, topic: str, text: str) -> None:
        times = (_nanoseconds(item.sim_time_s), _nanoseconds(item.wall_time_s))
        self._writer.add_message(self._channels[topic], times[0], text.encode(), times[1])

    def _register(self, topic: str, name: str, schema: Schema) -> None:
        if name not in self._schemas:
            data = json.dumps({"title": name, **schema}).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", data)
        self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[name])


def _state_text(item: Recorded, state: dict[str, Any]) -> str:
    """The state as it is stored, unless it has to be written anew."""
    renamed = _renamed(state)
    if renamed is not state or not state or _NOT_IN_JSON.search(item.data):
        return json_text(
            renamed | ({"replaced": json.loads(item.replaced)} if item.replaced else {})
        )
    if item.replaced:
        return f'{item.data.rstrip()[:-1]},"replaced":{item.replaced}}}'
    return item.data


def _renamed(state: dict[str, Any]) -> dict[str, Any]:
    """With `replaced` called `state.replaced`, as in all exports: the message has its own."""
    if "replaced" not in state:
        return state
    return {("state.replaced" if key == "replaced" else key): value for key, value in state.items()}


def _pose(pose: Pose) -> dict[str, Any]:
    half_rad = pose.yaw_rad / 2
    return {
        "position": {"x": pose.x_m, "y": pose.y_m, "z": pose.z_m},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half_rad), "w": math.cos(half_rad)},
    }


def _time(time_s: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(_nanoseconds(time_s), 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


def _nanoseconds(time_s: float) -> int:
    """MCAP knows no time before 0."""
    return max(0, round(time_s * 1e9))


# -- schemas of messages, as JSON --------------------------------------------------------------
#
# Viewers know the ones called `foxglove.NAME` and draw them; the schema of states is made of what
# they hold. Foxglove's and Lichtblick's readers of schemas take one type per field, and arrays of
# one scalar type or of objects; a schema with anything else makes a whole topic unreadable. What a
# state holds besides is therefore in the messages, but not in the schema: it is shown, not offered
# to plot.

Schema = dict[str, Any]


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


@dataclass
class FieldShape:
    """What values of one field were seen to be: of which types, and what is inside of them."""

    types: set[str] = field(default_factory=set[str])
    fields: dict[str, FieldShape] = field(default_factory=dict[str, "FieldShape"])
    items: FieldShape | None = None

    def see(self, value: Any) -> None:
        """Take in a value; null says nothing."""
        scalar = _SCALARS.get(cast("type[Any]", type(value)))
        if scalar is not None:
            self.types.add(scalar)
        elif isinstance(value, dict):
            self.types.add("object")
            for name, inner in cast("dict[str, Any]", value).items():
                shape = self.fields.get(name)
                if shape is None:
                    shape = self.fields[name] = FieldShape()
                shape.see(inner)
        elif isinstance(value, list):
            self.types.add("array")
            self.items = self.items or FieldShape()
            self.items.see_each(cast("list[Any]", value))

    def see_each(self, values: list[Any]) -> None:
        """Take in the items of an array: of thousands of numbers only the types."""
        kinds = {cast("type[Any]", type(value)) for value in values}
        if kinds.isdisjoint((dict, list)):
            self.types.update(_SCALARS[kind] for kind in kinds & _SCALARS.keys())
        else:
            for value in values:
                self.see(value)

    def schema(self) -> Schema | None:
        """None where a schema cannot say it."""
        if len(self.types) != 1:
            return None
        (name,) = self.types
        if name == "object":
            inner = {key: shape.schema() for key, shape in self.fields.items()}
            return _object(**{key: schema for key, schema in inner.items() if schema is not None})
        if name == "array":
            items = self.items.schema() if self.items else None
            told = items is not None and items["type"] != "array"
            return {"type": "array", "items": items} if told else None
        return {"type": name}


# -- the file, with a layout for Foxglove and Lichtblick that shows what it holds --------------


def export_mcap(
    connection: sqlite3.Connection,
    data_dir: Path,
    wanted: TimeRange,
    file: Path,
    progress: Progress | None = None,
) -> Exported:
    """As `export_for_viewers`, with the layout beside the file."""
    contents = Contents.of(connection, data_dir, wanted, 2, progress)
    with placed(file) as aside, aside.open("wb") as sink:
        counts = write_mcap(contents, sink)
    with placed(layout_file(file)) as aside:
        aside.write_text(json.dumps(layout(contents), indent=2), "utf-8")
    beside = f"layout for Foxglove and Lichtblick: {layout_file(file)}"
    return Exported(counts, beside, contents.source.notes)


def layout_file(file: Path) -> Path:
    """The layout beside a file for viewers."""
    return file.with_suffix(".layout.json")


def layout(contents: Contents) -> dict[str, Any]:
    """Panels for the main signals, the mode, the way, the pictures and the log."""
    topics, panels = Topics(contents), dict[str, dict[str, Any]]()
    _add_signals(panels, contents, topics)
    columns = [list(panels)]
    if contents.motion.position is not None:
        panels["3D!way"] = _way(contents, topics)
    cameras = {topics.image(image): None for image in contents.images()}
    for number, topic in enumerate([*cameras][:_MOST_CAMERAS]):
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


def main_signals(contents: Contents) -> list[Signal]:
    """What tells most of a run: how the robot moves, else the first numbers that it published."""
    numbers = [signal for signal in contents.signals.values() if signal.kind in ("num", "angle")]
    moving = [signal for signal in contents.motion.evidence if signal in numbers]
    return (moving or numbers)[:_MOST_PLOTTED]


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


def _paths(contents: Contents, topics: Topics, signal: Signal) -> list[dict[str, Any]]:
    if signal.reduction or not _PLAIN_PATH.fullmatch(signal.path):
        return []
    return [
        {
            "value": f"{topics.topic(run_id, 'state')}{signal.path[1:]}",
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for run_id in contents.run_ids
    ]


def _way(contents: Contents, topics: Topics) -> dict[str, Any]:
    shown = {
        topics.topic(run_id, "way"): {"visible": True, "type": "line"}
        for run_id in contents.run_ids
    }
    return {"followTf": WORLD_FRAME, "followMode": "follow-none", "topics": shown,
            "layers": {"grid": _GRID}}  # fmt: skip


def _split(parts: list[Any], direction: str) -> Any:
    """One part after the other, all of the same size."""
    if len(parts) == 1:
        return parts[0]
    rest = _split(parts[1:], direction)
    percentage = 100 / len(parts)
    return {"first": parts[0], "second": rest, "direction": direction,
            "splitPercentage": percentage}  # fmt: skip
