"""All of a range as a recording of Rerun's: its own reader gives what was recorded."""

from __future__ import annotations

import errno
import json
import math
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings

from tests.recordings.rover import Recorder
from tests.recordings.rows import Recorded as RecordedOnDisk
from tests.recordings.runs import Recorded
from tests.store.export.test_export import STATES, expected, publish, recorded_run, same
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.formats.rrd import RerunExport
from webots_mcp.store.export import export_for_viewers
from webots_mcp.store.reading.ranges import Scope, find_range

rerun: Any = pytest.importorskip("rerun", reason="the extra 'rerun' is not installed")
reader: Any = pytest.importorskip("rerun.chunk", reason="this rerun-sdk has another reader")

Points = list[tuple[int, int, Any]]  # simulation time and wall time in nanoseconds, and what it is


class Rrd:
    """A file as the library itself reads it: by entity and component."""

    def __init__(self, file: Path) -> None:
        self.points: dict[tuple[str, str], Points] = {}
        self.static: dict[tuple[str, str], Any] = {}
        for chunk in reader.RrdReader(str(file)).stream():
            entity, table = chunk.entity_path, chunk.to_record_batch()
            ours = [each for each in table.schema.names if not each.startswith("rerun.controls")]
            names = [each for each in ours if each not in TIMELINES]
            for name in names:
                values = table.column(name).to_pylist()
                if "sim_time" not in table.schema.names:
                    self.static[entity, name] = values[0]
                    continue
                times = [table.column(each).cast("int64").to_pylist() for each in TIMELINES]
                rows = zip(*times, values, strict=True)
                told = [row for row in rows if row[2] is not None]
                self.points.setdefault((entity, name), []).extend(told)

    def values(self, entity: str, component: str) -> list[Any]:
        return [value for *_, value in sorted(self.points.get((entity, component), []))]

    def scalars(self, entity: str) -> list[Any]:
        return self.values(entity, "Scalars:scalars")

    def texts(self, entity: str) -> list[str]:
        state = "StateChange:state" if hasattr(rerun, "StateChange") else "TextLog:text"
        return [text for (text,) in self.values(entity, state)]


TIMELINES = ("sim_time", "wall_time")


def exported(recorder: Recorder, folder: Path, **wanted: Any) -> Rrd:
    file = folder / "run.rrd"
    connection = recorder.connection
    export_for_viewers(connection, folder, find_range(connection, Scope(**wanted)), "rrd", file)
    return Rrd(file)


def entity(name: str) -> str:
    parts = [part or "(empty)" for part in name.split(".")]
    return str(rerun.new_entity_path(["rover", "state", *parts]))


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(STATES)
def test_numbers_and_texts_read_back_as_they_were_published(
    tmp_path_factory: pytest.TempPathFactory, states: list[dict[str, Any]]
) -> None:
    with recorded_run() as recorder:
        for i, state in enumerate(states):
            publish(recorder, float(i), state)
        read = exported(recorder, tmp_path_factory.mktemp("rrd"))
    flat = [expected(state) for state in states]
    # Rerun itself takes the slash after a part that ends in a backslash for one of its characters.
    for name in {name for leaves in flat for name in leaves if "\\" not in name}:
        values = [leaves[name] for leaves in flat if name in leaves]
        numbers = [value for value in map(as_scalars, values) if value is not None]
        assert same(read.scalars(entity(name)), numbers)
        kept = [v for v in values if v is None or as_scalars(v) is None]
        changes = [v for before, v in zip([None, *kept], kept, strict=False) if v != before]
        texts = [v if isinstance(v, str) else json.dumps(v) for v in changes if v is not None]
        if all(isinstance(v, str) for v in changes if v is not None):
            assert read.texts(entity(name)) == texts


def as_scalars(value: Any) -> list[float] | None:
    """What of it is scalars; None of a text, of null, and of a list of anything else."""
    if isinstance(value, (bool, int, float)):
        return [float(value)]
    if isinstance(value, list):
        items: list[Any] = value
        plain = all(type(item) in (int, float) for item in items)
        return [float(item) for item in items] if plain else None
    return None


def test_everything_stands_on_both_timelines(recorder: Recorder, tmp_path: Path) -> None:
    publish(recorder, 0.016, {"x": 1.5, "flag": True, "lidar": [0.5] * 20, "mode": "go"})
    publish(recorder, 8.008, {"x": math.nan, "flag": False, "lidar": [1.0] * 17, "mode": "go"})
    read = exported(recorder, tmp_path)
    walls = [round((recorder.run_start_s + at_s / 2) * 1e9) for at_s in (0.016, 8.008)]
    first, last = read.points["/rover/state/x", "Scalars:scalars"]
    assert first == (16_000_000, walls[0], [1.5])
    assert last[:2] == (8_008_000_000, walls[1])
    assert math.isnan(last[2][0])
    assert read.scalars("/rover/state/flag") == [[1.0], [0.0]]
    assert read.scalars("/rover/state/lidar") == [[0.5] * 20, [1.0] * 17]
    assert read.texts("/rover/state/mode") == ["go"]


def test_everything_of_a_run_is_there(recorded: Recorded, tmp_path: Path) -> None:
    run_id = recorded.add_run(8)
    recorded.connection.execute("UPDATE run SET uuid = 'u-u' WHERE id = ?", (run_id,))
    recorded.connection.execute("UPDATE log SET level = 'warning', logger = 'nav'")
    read = exported(recorded, tmp_path, run_id=run_id)
    assert read.scalars("/rover/state/x") == [[float(i)] for i in range(8)]
    assert read.values("/rover/log", "TextLog:text") == [["[controller: nav] line"]] * 4
    assert read.values("/rover/log", "TextLog:level") == [["WARN"]] * 4
    assert (
        read.values("/rover/events", "TextLog:text")
        == [['change mode {"from": "a", "to": "b"}']] * 4
    )
    assert read.values("/rover/commands", "TextLog:text") == [["a {}: done"]]
    ((blob,),) = read.values("/rover/camera/c", "EncodedImage:blob")
    assert bytes(blob) == b"picture"
    assert read.values("/rover/camera/c", "EncodedImage:media_type") == [["image/png"]]
    assert read.static["/rover/run", "uuid"] == ["u-u"]


def test_a_pose_is_a_transform_in_the_world_in_metres(recorder: Recorder, tmp_path: Path) -> None:
    publish(recorder, 0.0, {"pose_mm": [1000, 2000], "heading_deg": 90})
    publish(recorder, 1.0, {"pose_mm": [1500, 2000], "heading_deg": 0})
    read = exported(recorder, tmp_path)
    places = read.values("/world/rover", "Transform3D:translation")
    turns = read.values("/world/rover", "Transform3D:quaternion")
    assert places == [[[1.0, 2.0, 0.0]], [[1.5, 2.0, 0.0]]]
    assert turns[0][0] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    assert read.static["/world/rover_way", "LineStrips3D:strips"] == [
        [[1.0, 2.0, 0.0], [1.5, 2.0, 0.0]]
    ]


def test_several_runs_have_branches_of_their_own(recorded: Recorded, tmp_path: Path) -> None:
    runs = [recorded.add_run(rows) for rows in (5, 3)]
    read = exported(recorded, tmp_path, since_wall_time=0)
    assert [len(read.scalars(f"/run_{run_id}/rover/state/x")) for run_id in runs] == [5, 3]


def test_groups_of_rows_follow_each_other(
    recorder: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.plugins.formats.rrd._EXPORT", RerunExport(group_rows=7))
    for i in range(30):
        recorder.publish(float(i), {"x": i, "mode": "ab"[i // 15]})
    read = exported(recorder, tmp_path)
    assert read.scalars("/rover/state/x") == [[float(i)] for i in range(30)]
    assert read.texts("/rover/state/mode") == ["a", "b"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no file's size")
def test_a_disk_that_is_full_ends_the_export_and_is_told(tmp_path: Path) -> None:
    import resource

    with closing(RecordedOnDisk(tmp_path / "webots.db")) as recorded:
        robot = recorded.robot()
        for i in range(2_000):
            robot.state(i * 0.1, {f"x{k}": i * 0.37 + k for k in range(10)})
    file = tmp_path / "run.rrd"
    ran = subprocess.run(
        [sys.executable, "-m", "webots_mcp", "export", "-o", file, "--data-dir", tmp_path],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
        capture_output=True,
        text=True,
        timeout=60,  # Rerun's own thread may wait for ever
        check=False,
    )
    assert ran.returncode == 2
    assert f"{file} cannot be written: [Errno {errno.EFBIG}]" in ran.stderr
    assert not list(tmp_path.glob("run.rrd*"))


def test_rerun_that_is_switched_off_is_told(
    recorder: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    recorder.publish(0.0, {"x": 1})
    with pytest.raises(InvalidInputError, match="environment variable RERUN"):
        exported(recorder, tmp_path)


def test_without_the_sdk_the_extra_is_named(
    recorder: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun.blueprint", None)
    recorder.publish(0.0, {"x": 1})
    with pytest.raises(InvalidInputError, match="pip install 'rerun-sdk>="):
        exported(recorder, tmp_path)
    assert list(tmp_path.iterdir()) == []
