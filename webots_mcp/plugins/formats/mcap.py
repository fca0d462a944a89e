"""A time range as an MCAP file, through the extra `mcap`: for Foxglove, Lichtblick, PlotJuggler.

Messages are JSON. Their log time is simulation time in nanoseconds from 0, so that plots have the
robot's own clock, independent of the simulation's speed and pauses. Their publish time is wall time
in nanoseconds since 1970. Each of several runs has its own topics, which overlap in time, since
simulation time begins again in each run.
"""

from __future__ import annotations

import base64
import json
import math
import re
import sqlite3
from collections import Counter
from functools import partial, singledispatchmethod
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Final

from webots_mcp.database.files import placed
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.plugins.formats.contents import KINDS, Contents, PlacedCommand, Pose, SampledPath
from webots_mcp.plugins.formats.mcap_layout import layout
from webots_mcp.plugins.formats.mcap_schemas import FIXED, FieldShape, Schema
from webots_mcp.plugins.formats.mcap_topics import WORLD_FRAME, Topics
from webots_mcp.store.chunks import parse
from webots_mcp.store.export import Exported, Progress, Recorded, json_text, value_at
from webots_mcp.store.logs import LogLine
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.run_rows import EventRecord, StoredImage

_LEVELS: Final = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5}


def write_mcap(contents: Contents, sink: BinaryIO) -> Counter[str]:
    """Write everything of a range as messages; `Topics` describes the topics.

    A state is the message as it was published, plus `replaced`, which names the path of each value
    that JSON cannot hold (null in the message) and what it was.

    Returns:
        The number of items of each kind.

    Raises:
        InvalidInputError: The library is not installed.
    """
    writer = _library().Writer(sink)
    # An empty profile says that no middleware is involved.
    writer.start(profile="", library="webots-mcp")
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


class _McapWriter:
    """Writes an MCAP file."""

    def __init__(self, contents: Contents, writer: Any) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self._contents = contents
        self._writer = writer
        self._topics = Topics(contents)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def begin(self) -> None:
        """Write what precedes the messages: schemas of states, paths and facts of the runs."""
        shapes = {run_id: FieldShape({"object"}) for run_id in self._contents.run_ids}
        paths = {run_id: SampledPath() for run_id in self._contents.run_ids}
        for recorded in self._contents.source.recorded():
            state = parse(recorded.data)
            shapes[recorded.run_id].add(_renamed(state))
            pose = self._contents.pose(partial(value_at, state))
            if pose is not None:
                paths[recorded.run_id].add(recorded, pose)
        for run_id, shape in shapes.items():
            name = f"webots_mcp.State.{self._topics.frame(run_id)}".replace("/", ".")
            schema = shape.schema() or {"type": "object", "properties": {}}
            self._register(self._topics.topic(run_id, "state"), name, schema)
            self._writer.add_metadata(f"run {run_id}", self._contents.about(run_id))
            if paths[run_id].poses:
                self._write_path(run_id, paths[run_id])

    @singledispatchmethod
    def write(self, item: Any) -> None:
        """Write an item as messages."""
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
    def _(self, item: EventRecord) -> None:
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

    def _write_path(self, run_id: int, path: SampledPath) -> None:
        first = path.first
        assert first is not None
        poses = [_pose(pose) for pose in path.poses]
        message = {"timestamp": _time(first.sim_time_s), "frame_id": WORLD_FRAME, "poses": poses}
        topic = self._topics.topic(run_id, "way")
        self._message(first, topic, "foxglove.PosesInFrame", message)

    def _encode(self, item: Any, name: str, schema: str, message: dict[str, Any]) -> None:
        """Write a message with its time, without null values."""
        known = {key: value for key, value in message.items() if value is not None}
        stamped = {"timestamp": _time(item.sim_time_s), **known}
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
    """Return the text of a state as it is stored, unless it has to be changed."""
    renamed = _renamed(state)
    # Python accepts these words as numbers, viewers do not.
    if renamed is not state or not state or re.search("NaN|Infinity", item.data):
        return json_text(
            renamed | ({"replaced": json.loads(item.replaced)} if item.replaced else {})
        )
    if item.replaced:
        return f'{item.data.rstrip()[:-1]},"replaced":{item.replaced}}}'
    return item.data


def _renamed(state: dict[str, Any]) -> dict[str, Any]:
    """Rename a published `replaced` to `state.replaced` as in all exports, which add their own."""
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
    """Return a time in nanoseconds, at least 0: MCAP has no times before."""
    return max(0, round(time_s * 1e9))


def export_mcap(
    connection: sqlite3.Connection,
    data_dir: Path,
    wanted: TimeRange,
    file: Path,
    progress: Progress | None = None,
) -> Exported:
    """Export a range with a layout next to the file; see `export_for_viewers`."""
    contents = Contents.of(connection, data_dir, wanted, 2, progress)
    with placed(file) as aside, aside.open("wb") as sink:
        counts = write_mcap(contents, sink)
    with placed(layout_file(file)) as aside:
        aside.write_text(json.dumps(layout(contents), indent=2), "utf-8")
    also = f"layout for Foxglove and Lichtblick: {layout_file(file)}"
    return Exported(counts, also, contents.source.notes)


def layout_file(file: Path) -> Path:
    """Return the path of the layout next to an exported file."""
    return file.with_suffix(".layout.json")
