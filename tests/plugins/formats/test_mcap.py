"""All of a range as MCAP: what its own reader gives is what was recorded, for viewers to draw."""

from __future__ import annotations

import base64
import json
import math
import sys
import tracemalloc
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from mcap.reader import make_reader

from tests.recordings.rover import Recorder
from tests.recordings.runs import ROW_S, Recorded
from tests.store.export.test_export import STATES, publish, recorded_run, same
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.formats.mcap import layout_file
from webots_mcp.store.export import export_for_viewers
from webots_mcp.store.reading.ranges import Scope, find_range


class Message(NamedTuple):
    log_time: int
    publish_time: int
    value: Any


class Mcap:
    """A file as the library itself reads it."""

    def __init__(self, file: Path) -> None:
        self.messages: dict[str, list[Message]] = {}
        self.schemas: dict[str, tuple[str, dict[str, Any]]] = {}
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema is not None
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                self.schemas[channel.topic] = (schema.name, json.loads(schema.data))
                value = json.loads(message.data, parse_constant=pytest.fail)
                read = Message(message.log_time, message.publish_time, value)
                self.messages.setdefault(channel.topic, []).append(read)
            self.metadata = {each.name: each.metadata for each in reader.iter_metadata()}
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            assert summary.statistics.message_count == sum(map(len, self.messages.values()))

    def values(self, topic: str) -> list[Any]:
        return [message.value for message in self.messages.get(topic, [])]


def exported(recorder: Recorder, folder: Path, **wanted: Any) -> Mcap:
    file = folder / "run.mcap"
    export_for_viewers(
        recorder.connection, folder, find_range(recorder.connection, Scope(**wanted)), "mcap", file
    )
    return Mcap(file)


def required_by_viewers(schema: dict[str, Any]) -> None:
    """What their readers of JSON schemas take; they refuse a topic over anything else."""
    assert schema["type"] == "object"
    for inner in schema["properties"].values():
        assert inner["type"] in ("boolean", "string", "number", "integer", "object", "array")
        assert inner.get("contentEncoding") in (None, "base64")
        if inner["type"] == "object":
            required_by_viewers(inner)
        if inner["type"] == "array":
            assert inner["items"]["type"] in ("boolean", "string", "number", "object")
            if inner["items"]["type"] == "object":
                required_by_viewers(inner["items"])


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(STATES)
def test_states_read_back_as_they_were_published(
    tmp_path_factory: pytest.TempPathFactory, states: list[dict[str, Any]]
) -> None:
    with recorded_run() as recorder:
        for i, state in enumerate(states):
            publish(recorder, float(i), state)
        rows = recorder.connection.execute(
            "SELECT data, replaced FROM state ORDER BY id"
        ).fetchall()
        read = exported(recorder, tmp_path_factory.mktemp("mcap"))
    for value, (data, replaced) in zip(read.values("/rover/state"), rows, strict=True):
        assert value.pop("replaced", None) == (json.loads(replaced) if replaced else None)
        assert same(
            value,
            {"state.replaced" if k == "replaced" else k: v for k, v in json.loads(data).items()},
        )
    required_by_viewers(read.schemas["/rover/state"][1])


def test_a_schema_names_each_field_that_has_one_type(recorder: Recorder, tmp_path: Path) -> None:
    publish(recorder, 0.0, {"x": 1, "flag": True, "lidar": None, "grid": [[1]], "both": 1})
    publish(recorder, 1.0, {"x": 1.5, "lidar": {"near": 0.5, "all": [1.0] * 99}, "both": "a"})
    publish(recorder, 2.0, {"blobs": [{"id": 3, "at": [1, 2.5]}], "title": "t", "never": None})
    name, schema = exported(recorder, tmp_path).schemas["/rover/state"]
    number = {"type": "number"}
    numbers = {"type": "array", "items": number}
    blob = {"type": "object", "properties": {"id": number, "at": numbers}}
    assert name == "webots_mcp.State.rover"
    assert schema["properties"] == {
        "x": number,
        "flag": {"type": "boolean"},
        "lidar": {"type": "object", "properties": {"near": number, "all": numbers}},
        "blobs": {"type": "array", "items": blob},
        "title": {"type": "string"},
    }


@pytest.mark.parametrize("data", ["", "no JSON", "[1]", '{"a": NaN}', '{"a": 1, "replaced": 2} '])
def test_a_row_that_no_bridge_has_written_is_valid_json_all_the_same(
    recorder: Recorder, tmp_path: Path, data: str
) -> None:
    recorder.insert("state", **recorder.at(1.0), data=data, replaced='{"b": "nan"}')
    (value,) = exported(recorder, tmp_path).values("/rover/state")
    assert value.pop("replaced") == {"b": "nan"}
    assert value in ({}, {"a": None}, {"a": 1, "state.replaced": 2})


def test_everything_of_a_run_is_there(recorded: Recorded, tmp_path: Path) -> None:
    run_id = recorded.add_run(8)
    recorded.connection.execute(
        "UPDATE run SET uuid = 'u-u', note = 'a note' WHERE id = ?", (run_id,)
    )
    read = exported(recorded, tmp_path, run_id=run_id)
    assert {topic: len(messages) for topic, messages in read.messages.items()} == {
        "/rover/state": 8,
        "/rover/log": 4,
        "/rover/events": 4,
        "/rover/commands": 1,
        "/rover/camera/c": 1,
    }
    (walls,) = zip(*recorded.connection.execute("SELECT wall_time_s FROM state"), strict=True)
    states = read.messages["/rover/state"]
    assert [each.log_time for each in states] == [round(i * ROW_S * 1e9) for i in range(8)]
    assert [each.publish_time for each in states] == [round(wall * 1e9) for wall in walls]
    half_a_second = {"sec": 0, "nsec": 500_000_000}
    assert read.values("/rover/log")[0] == {
        "timestamp": half_a_second,
        "level": 2,
        "message": "line",
        "name": "controller",
        "file": "",
        "line": 0,
    }
    event = {"timestamp": half_a_second, "kind": "change", "name": "mode"}
    assert read.values("/rover/events")[0] == {**event, "data": {"from": "a", "to": "b"}}
    (command,) = read.values("/rover/commands")
    assert {name: command[name] for name in ("action", "params", "status")} == {
        "action": "a",
        "params": {},
        "status": "done",
    }
    (picture,) = read.values("/rover/camera/c")
    assert base64.b64decode(picture["data"]) == b"picture"
    assert (picture["format"], picture["timestamp"]) == ("png", {"sec": 1, "nsec": 0})
    for name, schema in read.schemas.values():
        assert name.startswith(("foxglove.", "webots_mcp."))
        required_by_viewers(schema)
    about = read.metadata[f"run {run_id}"]
    assert (
        about["uuid"],
        about["robot"],
        about["world"],
        about["note"],
        about["parameter kp"],
    ) == (
        "u-u",
        "rover",
        "/project/worlds/arena.wbt",
        "a note",
        "2.0",
    )


def test_a_picture_that_is_gone_or_outside_is_counted_and_left_out(
    recorder: Recorder, tmp_path: Path
) -> None:
    recorder.publish(0.0, {"x": 1})
    (tmp_path / "secret.png").write_bytes(b"secret")
    for path in ("camera/gone.png", "../secret.png"):
        recorder.insert(
            "image", **recorder.at(0.0), kind="camera", device="a b", path=path, width=1, height=1,
            size_bytes=1,
        )  # fmt: skip
    wanted = find_range(recorder.connection, Scope())
    (tmp_path / "data").mkdir()
    written = export_for_viewers(
        recorder.connection, tmp_path / "data", wanted, "mcap", tmp_path / "run.mcap"
    )
    assert +written.counts == {"states": 1, "pictures that are gone": 2}


def test_devices_with_names_alike_have_topics_of_their_own(
    recorder: Recorder, tmp_path: Path
) -> None:
    recorder.publish(0.0, {"x": 1})
    devices = ["a b", "a_b", "a/b", "a_b_2", "c"]
    for number, device in enumerate(devices):
        (tmp_path / f"{number}.png").write_bytes(device.encode())
        recorder.insert(
            "image", **recorder.at(0.0), kind="camera", device=device, path=f"{number}.png",
            width=1, height=1, size_bytes=3,
        )  # fmt: skip
    read = exported(recorder, tmp_path)
    told = {
        topic: [base64.b64decode(each["data"]).decode() for each in read.values(topic)]
        for topic in read.messages
        if "camera" in topic
    }
    assert told == {
        "/rover/camera/a_b": ["a_b"],
        "/rover/camera/a_b_2": ["a_b_2"],
        "/rover/camera/a_b_3": ["a b"],
        "/rover/camera/a_b_4": ["a/b"],
        "/rover/camera/c": ["c"],
    }
    panels = json.loads(layout_file(tmp_path / "run.mcap").read_text())["configById"].values()
    shown = [panel["imageMode"]["imageTopic"] for panel in panels if "imageMode" in panel]
    assert len(shown) == 4
    assert set(shown) <= set(told)


def test_a_pose_is_a_frame_in_the_world_in_metres(recorder: Recorder, tmp_path: Path) -> None:
    publish(recorder, 0.0, {"pose_mm": [1000, 2000], "heading_deg": 90})
    publish(recorder, 1.0, {"pose_mm": [math.nan, 2000], "heading_deg": 90})
    publish(recorder, 2.0, {"pose_mm": [1500, 2000], "heading_deg": 0})
    read = exported(recorder, tmp_path)
    first, last = read.values("/rover/pose")
    assert (first["parent_frame_id"], first["child_frame_id"]) == ("world", "rover")
    assert first["translation"] == {"x": 1.0, "y": 2.0, "z": 0.0}
    assert first["rotation"] == pytest.approx({"x": 0, "y": 0, "z": 0.5**0.5, "w": 0.5**0.5})
    assert last["translation"] == {"x": 1.5, "y": 2.0, "z": 0.0}
    (way,) = read.values("/rover/way")
    assert [pose["position"]["x"] for pose in way["poses"]] == [1.0, 1.5]


def test_a_way_keeps_its_poses_few(recorder: Recorder, tmp_path: Path) -> None:
    for i in range(4500):
        recorder.publish(float(i), {"pose": [i / 10, 0.0]})
    (way,) = exported(recorder, tmp_path).values("/rover/way")
    assert 1000 <= len(way["poses"]) < 2000
    assert way["poses"][-1]["position"]["x"] > 449.0


def test_several_runs_lie_over_each_other_on_topics_of_their_own(
    recorded: Recorded, tmp_path: Path
) -> None:
    runs = [recorded.add_run(rows) for rows in (5, 3)]
    read = exported(recorded, tmp_path, since_wall_time=0)
    assert [len(read.messages[f"/run_{run_id}/rover/state"]) for run_id in runs] == [5, 3]
    assert [read.messages[f"/run_{run_id}/rover/state"][0].log_time for run_id in runs] == [0, 0]


def test_a_range_limits_everything(recorded: Recorded, tmp_path: Path) -> None:
    recorded.add_run(8)
    read = exported(recorded, tmp_path, start_s=1.5, end_s=3.0)
    assert {topic: len(messages) for topic, messages in read.messages.items()} == {
        "/rover/state": 3,
        "/rover/log": 2,
        "/rover/events": 2,
    }


def test_the_layout_shows_what_the_file_holds(recorded: Recorded, tmp_path: Path) -> None:
    recorded.connection.execute("UPDATE robot SET name = 'rover #2'")
    run_id = recorded.run(recorded.session(recorded.robot_id, "a" * 64), recorded.robot_id)
    for i in range(20):
        state = {"pose": [0.1 * i, 0.0, 0.5], "mode": "go", "wheel": {"left": 1.0 + i}, "a b": 1.0}
        publish(recorded, float(i), state)
    recorded.add_picture(run_id)
    read = exported(recorded, tmp_path)
    layout = json.loads(layout_file(tmp_path / "run.mcap").read_text())
    panels = layout["configById"]
    assert {name.partition("!")[0] for name in panels} == {
        "Plot", "StateTransitions", "3D", "Image", "RosOut", "RawMessages",
    }  # fmt: skip
    assert sorted(panels) == sorted(leaves(layout["layout"]))
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    assert len(paths) == 5
    for path in paths:
        topic, _, field = path.partition(".")
        read_path(read.values(topic)[0], field)
    assert panels["Image!0"]["imageMode"]["imageTopic"] in read.messages
    assert set(panels["3D!way"]["topics"]) <= set(read.messages)


def leaves(tree: Any) -> list[str]:
    return [tree] if isinstance(tree, str) else [*leaves(tree["first"]), *leaves(tree["second"])]


def read_path(value: Any, path: str) -> None:
    for step in path.replace("[", ".").replace("]", "").split("."):
        value = value[int(step)] if isinstance(value, list) else value[step]
    assert isinstance(value, (int, float, str))


@pytest.mark.slow
def test_memory_does_not_grow_with_a_recording_for_viewers(
    recorder: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.store.export.CHUNK_ROWS", 100)
    peaks: list[int] = []
    for rows in (2000, 2000, 4000):
        for i in range(rows):
            recorder.publish(float(i), {"text": "t" * 500})
        tracemalloc.start()
        exported_to = tmp_path / "run.mcap"
        wanted = find_range(recorder.connection, Scope())
        export_for_viewers(recorder.connection, tmp_path, wanted, "mcap", exported_to)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[-1] < 1.2 * peaks[0]


def test_without_the_library_the_extra_is_named(
    recorder: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    recorder.publish(0.0, {"x": 1})
    with pytest.raises(InvalidInputError, match="pip install 'mcap>="):
        exported(recorder, tmp_path)
    assert list(tmp_path.iterdir()) == []
