"""A time range as a recording of Rerun, through the extra `rerun` (rerun-sdk 0.24 or newer).

Everything has two timelines: `sim_time`, a duration, and `wall_time`, a timestamp.
"""

from __future__ import annotations

import math
import os
import sqlite3
import sys
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import chain, groupby, islice
from operator import attrgetter
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, Final, NamedTuple, TypeVar
from uuid import NAMESPACE_URL, uuid5

from webots_mcp.analysis.arrays import np
from webots_mcp.database.files import placed
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.plugins.formats.contents import (
    KINDS,
    Contents,
    Item,
    PlacedCommand,
    Pose,
    SampledPath,
)
from webots_mcp.plugins.formats.mcap_layout import main_signals
from webots_mcp.store.export import (
    Exported,
    FlatRow,
    Progress,
    Recorded,
    as_text,
    flat_row,
    kind_of,
)
from webots_mcp.store.logs import LogLine
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.run_rows import EventRecord

_MEDIA_TYPES: Final = {"png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg"}
_WORLD: Final = "world"
_Item = TypeVar("_Item", bound=Item)


@dataclass(frozen=True)
class RerunExport:
    """How much is copied or in memory at a time.

    Attributes:
        copy_bytes: Bytes that are copied at a time.
        group_rows: Rows in memory at a time: about 10 MB.
    """

    copy_bytes: int = 1 << 16
    group_rows: int = 10_000


_EXPORT: Final = RerunExport()


def export_rrd(
    connection: sqlite3.Connection,
    data_dir: Path,
    wanted: TimeRange,
    file: Path,
    progress: Progress | None = None,
) -> Exported:
    """Export a range; see `export_for_viewers`."""
    with placed(file) as aside:
        contents = Contents.of(connection, data_dir, wanted, 1, progress)
        return Exported(write_rrd(contents, aside), notes=contents.source.notes)


def write_rrd(contents: Contents, file: Path) -> Counter[str]:
    """Write everything of a range, in columns.

    Each number and flag of the states is an entity of scalars: flags are 0 and 1, a long array is
    several scalars at a time. A text is an entity of its changes; null is left out. The entities
    are /ROBOT/state/..., /ROBOT/camera/DEVICE, /ROBOT/screenshot, /ROBOT/log, /ROBOT/events,
    /ROBOT/commands and /world/ROBOT. If there are several runs, all begin with /run_ID.

    Returns:
        The number of items of each kind.

    Raises:
        InvalidInputError: The library is not installed, or is switched off.
        OSError: The file cannot be written, such as on a full disk.
    """
    rerun = _library()
    with warnings.catch_warnings():
        warnings.simplefilter("error", rerun.error_utils.RerunWarning)
        stream = rerun.RecordingStream("webots_mcp", recording_id=_recording_id(contents))
        with _PipedFile(file) as saved:
            writing = _RerunWriter(contents, rerun, stream, saved)
            stream.save(str(saved.path), default_blueprint=writing.blueprint())
            saved.begin()
            try:
                writing.write()
            finally:
                stream.disconnect()
    if not file.stat().st_size:
        raise InvalidInputError("Rerun wrote nothing: is the environment variable RERUN 'off'?")
    return writing.counts


class _PipedFile:
    """A pipe that Rerun saves to, and a thread that copies it to the file.

    On a full disk Rerun's own thread stops, and a flush then waits for it for ever. The pipe
    accepts everything, and `check` raises the error of the file.
    """

    def __init__(self, file: Path) -> None:
        self.path = file
        self._file = file
        self._folder: TemporaryDirectory[str] | None = None
        self._end = -1
        self._error: OSError | None = None
        self._thread = Thread(target=self._copy, name="rrd")

    def __enter__(self) -> _PipedFile:
        if sys.platform != "win32":  # Windows has no named pipes in folders: Rerun writes the file.
            self._folder = TemporaryDirectory()
            self.path = Path(self._folder.name, "pipe")
            try:
                os.mkfifo(self.path)
                self._end = os.open(
                    self.path, os.O_RDONLY | os.O_NONBLOCK
                )  # Does not wait for a writer.
                os.set_blocking(self._end, True)
            except OSError:
                self._folder.cleanup()
                raise
        return self

    def begin(self) -> None:
        """Start the copy, once Rerun has opened the pipe."""
        if self._folder:
            self._thread.start()

    def check(self) -> None:
        """Raise the OSError of the file, if there was one."""
        if self._error:
            raise self._error

    def __exit__(self, kind: object, *_: object) -> None:
        if self._folder:
            if self._thread.ident:
                self._thread.join()
            os.close(self._end)
            self._folder.cleanup()
        if kind is None:
            self.check()

    def _copy(self) -> None:
        try:
            with open(self._end, "rb", 0, closefd=False) as pipe, self._file.open("wb") as sink:
                copyfileobj(pipe, sink)
        except OSError as error:
            self._error = error
        finally:
            while os.read(self._end, _EXPORT.copy_bytes):  # Rerun waits until everything was read.
                pass


def _library() -> Any:
    try:
        import_module("rerun.blueprint")
        return import_module("rerun")
    except ImportError as error:
        raise InvalidInputError(
            f"{explain_extra('a file of Rerun', 'rerun')}; or export as mcap or csv"
        ) from error


def _recording_id(contents: Contents) -> str:
    """Return an id that is the same for the same runs, so that viewers recognize them."""
    names = [contents.about(run_id).get("uuid", f"{run_id}") for run_id in contents.run_ids]
    return names[0] if len(names) == 1 else str(uuid5(NAMESPACE_URL, " ".join(names)))


class _Times(NamedTuple):
    """Simulation and wall times of a group of items, as NumPy arrays."""

    sim: Any
    wall: Any


class _RerunWriter:
    """Writes a recording of Rerun."""

    def __init__(self, contents: Contents, rerun: Any, stream: Any, saved: _PipedFile) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self._contents = contents
        self._rerun = rerun
        self._stream = stream
        self._saved = saved
        self._text_type = getattr(rerun, "StateChange", None)  # In Rerun 0.33 and newer.
        self._last_texts: dict[tuple[int, str], str | None] = {}
        self._several = len(contents.run_ids) > 1

    def blueprint(self) -> Any:
        """Return a layout of the main signals, the path, the pictures and the log."""
        views, run_id = self._rerun.blueprint, self._contents.run_ids[-1]
        shown = [
            self._path(each, "state", *signal.name.split("."))
            for each in self._contents.run_ids
            for signal in main_signals(self._contents)
        ]
        parts = [views.TimeSeriesView(name="signals", contents=shown)]
        if self._contents.motion.position is not None:
            parts.append(views.Spatial3DView(name="way", origin=f"/{_WORLD}"))
        cameras = {(image.run_id, *_picture_name(image)): None for image in self._contents.images()}
        for run, *name in islice(cameras, 4):
            parts.append(views.Spatial2DView(name=name[-1], origin=self._path(run, *name)))
        parts.append(views.TextLogView(name="log", origin=self._path(run_id)))
        return views.Blueprint(views.Grid(*parts), collapse_panels=False)

    def write(self) -> None:
        """Write everything."""
        contents = self._contents
        for run_id in contents.run_ids:
            about = self._rerun.AnyValues(**_identifiers(contents.about(run_id)))
            self._stream.log(self._path(run_id, "run"), about, static=True)
        self._write_states()
        self._write_lines("log lines", "log", contents.log_lines(), _log_text)
        self._write_lines("events", "events", contents.events(), _event_text)
        self._write_lines("commands", "commands", contents.commands(), _command_text)
        self._write_pictures()

    def _write_states(self) -> None:
        recorded = self._contents.source.recorded()
        for run_id, rows in groupby(recorded, attrgetter("run_id")):
            path = SampledPath()
            for group in _groups(rows):
                self.counts["states"] += len(group)
                self._write_group(run_id, group, [flat_row(each) for each in group], path)
            if path.poses:
                points = [[pose.x_m, pose.y_m, pose.z_m] for pose in path.poses]
                line = self._rerun.LineStrips3D([points])
                self._stream.log(f"{self._frame(run_id)}_way", line, static=True)

    def _write_group(
        self, run_id: int, group: Sequence[Recorded], rows: Sequence[FlatRow], path: SampledPath
    ) -> None:
        numbers, texts = dict[str, list[tuple[int, Any]]](), dict[str, list[tuple[int, str]]]()
        poses: list[tuple[int, Pose]] = []
        for index, row in enumerate(rows):
            for name, value in row.values.items():
                self._sort_in(run_id, name, index, value, numbers, texts)
            pose = self._contents.pose(row.values.get)
            if pose is not None:
                poses.append((index, pose))
                path.add(group[index], pose)
        times = _times(group)
        for name, pairs in numbers.items():
            self._send(self._signal(run_id, name), times, pairs, self._scalars(pairs))
        for name, pairs in texts.items():
            self._send(self._signal(run_id, name), times, pairs, self._texts(pairs))
        if poses:
            self._send(self._frame(run_id), times, poses, self._transforms(poses))
        self._stream.flush()

    def _sort_in(
        self,
        run_id: int,
        name: str,
        index: int,
        value: Any,
        numbers: dict[str, list[tuple[int, Any]]],
        texts: dict[str, list[tuple[int, str]]],
    ) -> None:
        if kind_of(value) in ("num", "int", "bool", "numbers"):
            numbers.setdefault(name, []).append((index, value))
            return
        text = as_text(value)
        if self._last_texts.get((run_id, name)) != text:
            self._last_texts[run_id, name] = text
            if text is not None:
                texts.setdefault(name, []).append((index, text))

    def _scalars(self, pairs: Sequence[tuple[int, Any]]) -> Any:
        values = [value for _, value in pairs]
        listed = [isinstance(value, list) for value in values]
        if not any(listed):
            return self._rerun.Scalars.columns(scalars=np.array(values, float))
        parts: list[list[float]] = [
            value if is_list else [value] for value, is_list in zip(values, listed, strict=True)
        ]
        flat = np.fromiter(chain.from_iterable(parts), float)
        return self._rerun.Scalars.columns(scalars=flat).partition([*map(len, parts)])

    def _texts(self, pairs: Sequence[tuple[int, str]]) -> Any:
        texts = [text for _, text in pairs]
        if self._text_type is None:
            return self._rerun.TextLog.columns(text=texts)
        return self._text_type.columns(state=texts)

    def _transforms(self, poses: Sequence[tuple[int, Pose]]) -> Any:
        halves = [pose.yaw_rad / 2 for _, pose in poses]
        return self._rerun.Transform3D.columns(
            translation=[[pose.x_m, pose.y_m, pose.z_m] for _, pose in poses],
            quaternion=[[0.0, 0.0, math.sin(half), math.cos(half)] for half in halves],
        )

    def _write_lines(self, kind: str, name: str, items: Iterable[Any], text_of: Any) -> None:
        for run_id, rows in groupby(items, attrgetter("run_id")):
            for group in _groups(rows):
                self.counts[kind] += len(group)
                texts, levels = zip(*map(text_of, group), strict=True)
                lines = self._rerun.TextLog.columns(text=texts, level=levels)
                self._send(self._path(run_id, name), _times(group), [*enumerate(texts)], lines)

    def _write_pictures(self) -> None:
        for image in self._contents.images():
            data = self._contents.picture(image)
            self.counts["pictures" if data is not None else "pictures that are gone"] += 1
            if data is not None:
                media = _MEDIA_TYPES.get(image.path.rpartition(".")[2].lower(), "image/png")
                picture = self._rerun.EncodedImage.columns(blob=[data], media_type=[media])
                path = self._path(image.run_id, *_picture_name(image))
                self._send(path, _times([image]), [(0, None)], picture)

    def _send(
        self, path: str, times: _Times, pairs: Sequence[tuple[int, Any]], columns: Any
    ) -> None:
        """Send columns of the items of a group whose indices are in `pairs`, with their times."""
        chosen = [index for index, _ in pairs]
        column = self._rerun.TimeColumn
        indexes = [
            column("sim_time", duration=times.sim[chosen]),
            column("wall_time", timestamp=times.wall[chosen]),
        ]
        self._stream.send_columns(path, indexes=indexes, columns=columns)
        self._saved.check()

    def _signal(self, run_id: int, name: str) -> str:
        return self._path(run_id, "state", *name.split("."))

    def _frame(self, run_id: int) -> str:
        return f"/{_WORLD}{self._path(run_id)}"

    def _path(self, run_id: int, *parts: str) -> str:
        branch = (f"run_{run_id}",) if self._several else ()
        named = (part or "(empty)" for part in (*branch, self._contents.wanted.robot, *parts))
        return str(self._rerun.new_entity_path(list(named)))


def _times(group: Sequence[Any]) -> _Times:
    sim = np.array([round(each.sim_time_s * 1e9) for each in group], "timedelta64[ns]")
    wall = np.array([round(each.wall_time_s * 1e9) for each in group], "datetime64[ns]")
    return _Times(sim, wall)


def _groups(rows: Iterable[_Item]) -> Iterator[list[_Item]]:
    going = iter(rows)
    while group := list(islice(going, _EXPORT.group_rows)):
        yield group


def _picture_name(image: Any) -> tuple[str, ...]:
    return ("camera", image.device) if image.device else (image.kind,)


def _identifiers(about: dict[str, str]) -> dict[str, str]:
    return {name.replace(" ", "_"): value for name, value in about.items()}


def _log_text(line: LogLine) -> tuple[str, str]:
    who = ": ".join(filter(None, (line.source, line.logger)))
    # The other names of Rerun are those of the recording in capitals.
    return f"[{who}] {line.message}", {"warning": "WARN"}.get(line.level, line.level.upper())


def _event_text(event: EventRecord) -> tuple[str, str]:
    return " ".join(filter(None, (event.kind, event.name, event.data))), "INFO"


def _command_text(command: PlacedCommand) -> tuple[str, str]:
    outcome = command.error or command.result
    text = f"{command.action} {command.params}: {command.status}"
    return f"{text} {outcome}" if outcome else text, "ERROR" if command.error else "INFO"
