"""All that a range holds, as the formats of viewers take it: not its states alone."""

from __future__ import annotations

import heapq
import math
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, TypeAlias, TypeVar

from webots_mcp.analysis.arrays import np
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.extras.requirements import install_line
from webots_mcp.judging.detection.kinds import EventOptions
from webots_mcp.judging.detection.search import Motion, find_motion
from webots_mcp.signals.naming import FARTHEST_M, metres_in
from webots_mcp.store.chunk_table import Cells
from webots_mcp.store.export import (
    CHUNK_ROWS,
    Column,
    ColumnKind,
    Progress,
    Recorded,
    Row,
    Source,
    Table,
    as_text,
)
from webots_mcp.store.logs import LogLine
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import Segment
from webots_mcp.store.run_rows import MAX_FILE_BYTES, Event, StoredImage, columns_of
from webots_mcp.store.signals import Signal

# What there is to count, in the order in which it is told.
KINDS: Final = (
    "states", "log lines", "events", "commands", "pictures", "pictures that are gone",
)  # fmt: skip
_WAY_POSES: Final = 1000  # of a run at least, in its way
_IN_SEGMENT: Final = (
    "sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND wall_time_s >= :wall_start_s AND wall_time_s < :wall_end_s"
)
_PAGE: Final = (
    f"SELECT {{columns}} FROM {{table}} WHERE run_id = :run_id AND {_IN_SEGMENT} "
    "AND (sim_time_s > :start_s OR id > :after_id) ORDER BY sim_time_s, id LIMIT :limit"
)
# A command belongs to the run of its robot that went on when it was claimed, else created. One that
# nobody claimed stands at the newest state before it.
_COMMANDS: Final = (
    "WITH own AS (SELECT id AS run_id, robot_id, started_sim_time_s, started_wall_time_s, "
    "coalesce((SELECT min(n.started_wall_time_s) FROM run n WHERE n.robot_id = r.robot_id "
    "AND n.id > r.id), 9e99) AS next_s FROM run r WHERE id = :run_id), "
    "placed AS (SELECT c.*, own.run_id, started_wall_time_s, next_s, "
    "coalesce(claimed_wall_time_s, created_wall_time_s) AS wall_time_s, "
    "coalesce(claimed_sim_time_s, (SELECT s.sim_time_s FROM state s WHERE s.run_id = own.run_id "
    "AND s.wall_time_s <= c.created_wall_time_s ORDER BY s.sim_time_s DESC, s.id DESC LIMIT 1), "
    "started_sim_time_s) AS sim_time_s FROM command c JOIN own USING (robot_id)) "
    f"SELECT {{columns}} FROM placed WHERE {_IN_SEGMENT} "
    "AND wall_time_s >= started_wall_time_s AND wall_time_s < next_s ORDER BY sim_time_s, id"
)
_RUN: Final = (
    "SELECT r.uuid, r.world, r.basic_time_step_ms, r.start_reason, r.end_reason, r.label, r.note, "
    "strftime('%Y-%m-%dT%H:%M:%fZ', r.started_wall_time_s, 'unixepoch') AS started, "
    "s.controller, s.controller_sha256, s.git_commit, s.versions "
    "FROM run r JOIN session s ON s.id = r.session_id WHERE r.id = ?"
)
_PARAMETERS: Final = "SELECT name, value FROM parameter_value WHERE run_id = ? ORDER BY id"
_GROUP_ROWS: Final = 10_000  # about 10 MB of rows in memory at a time


@dataclass(frozen=True)
class PlacedCommand:
    """A command and its fate, with its run and when it was claimed, or else created."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    action: str
    params: str
    status: str
    requested_by: str | None
    finished_sim_time_s: float | None
    finished_wall_time_s: float | None
    result: str | None
    error: str | None


class Pose(NamedTuple):
    """Where a robot is, and where it looks (0 where nothing tells)."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


class SampledPath:
    """Poses of a run, as many as a viewer draws at once: every second one goes when it is full."""

    def __init__(self) -> None:
        self.poses: list[Pose] = []
        self.first: Recorded | None = None
        self._every = 1
        self._seen = 0

    def see(self, recorded: Recorded, pose: Pose) -> None:
        """Take in the pose of a state, if it is its turn."""
        self._seen += 1
        if self._seen % self._every:
            return
        self.first = self.first or recorded
        self.poses.append(pose)
        if len(self.poses) == 2 * _WAY_POSES:
            del self.poses[::2]
            self._every *= 2


Item: TypeAlias = "Recorded | LogLine | Event | PlacedCommand | StoredImage"
_Row = TypeVar("_Row", LogLine, Event, StoredImage)


@dataclass(frozen=True)
class Contents:
    """A range with all that was recorded in it; everything can be read more than once."""

    connection: sqlite3.Connection
    data_dir: Path
    wanted: TimeRange
    source: Source

    @classmethod
    def of(
        cls,
        connection: sqlite3.Connection,
        data_dir: Path,
        wanted: TimeRange,
        passes: int,
        progress: Progress | None,
    ) -> Contents:
        """What the range has now, of which the states will be read `passes` times."""
        source = Source.of(connection, wanted.segments, passes, progress)
        return cls(connection, data_dir, wanted, source)

    @property
    def run_ids(self) -> list[int]:
        """The runs, in order."""
        return [segment.run_id for segment in self.wanted.segments]

    @cached_property
    def signals(self) -> dict[str, Signal]:
        """All of the robot, by name."""
        return known_signals(self.connection, self.wanted)

    @cached_property
    def motion(self) -> Motion:
        """Which of them tell how the robot moves."""
        return find_motion(self.signals, EventOptions())

    def items(self, pass_number: int) -> Iterator[Item]:
        """Everything, run by run, in the order of simulation time."""
        streams = (
            self.source.recorded(pass_number),
            self.log_lines(),
            self.events(),
            self.commands(),
            self.images(),
        )
        return heapq.merge(*streams, key=attrgetter("run_id", "sim_time_s"))

    def log_lines(self) -> Iterator[LogLine]:
        """What was logged in the runs themselves."""
        return self._pages("log", LogLine)

    def events(self) -> Iterator[Event]:
        """What the bridge noticed."""
        return self._pages("event", Event)

    def images(self) -> Iterator[StoredImage]:
        """Rows of pictures, whether or not their files are still there."""
        return self._pages("image", StoredImage)

    def commands(self) -> Iterator[PlacedCommand]:
        """What was asked of the robot."""
        query = _COMMANDS.format(columns=columns_of(PlacedCommand))
        for segment in self.wanted.segments:
            for row in self.connection.execute(query, _bounds(segment)).fetchall():
                yield PlacedCommand(*row)

    def picture(self, image: StoredImage) -> bytes | None:
        """The file; None where it is gone, or is none that is opened."""
        try:
            file = image.file(self.data_dir)
            return file.read_bytes() if file.stat().st_size <= MAX_FILE_BYTES else None
        except (InvalidInputError, NothingRecordedError, OSError):
            return None

    def pose(self, value_of: Callable[[str], Any]) -> Pose | None:
        """The pose in a state, of which `value_of` gives values by name; None without one."""
        if self.motion.position is None:
            return None
        x_m, y_m = (_metres(value_of, signal) for signal in self.motion.position)
        if x_m is None or y_m is None:
            return None
        height, heading = self.motion.height, self.motion.heading
        z_m = _metres(value_of, height) if height else None
        return Pose(x_m, y_m, z_m or 0.0, _radians(value_of, heading) if heading else 0.0)

    def about(self, run_id: int) -> dict[str, str]:
        """Which run it is: uuid, robot, world, code, parameters; what is not known is left out."""
        cursor = self.connection.execute(_RUN, (run_id,))
        names = [column[0] for column in cursor.description]
        told: dict[str, Any] = {"run_id": run_id, "robot": self.wanted.robot}
        told |= dict(zip(names, cursor.fetchone(), strict=True))
        for name, value in self.connection.execute(_PARAMETERS, (run_id,)):
            told[f"parameter {name}"] = value  # the last one that it had
        return {name: str(value) for name, value in told.items() if value is not None}

    def _pages(self, table: str, row: type[_Row]) -> Iterator[_Row]:
        query = _PAGE.format(columns=columns_of(row), table=table)
        for segment in self.wanted.segments:
            place: dict[str, Any] = {**_bounds(segment), "after_id": 0, "limit": CHUNK_ROWS}
            while page := [row(*each) for each in self.connection.execute(query, place).fetchall()]:
                yield from page
                place |= {"start_s": page[-1].sim_time_s, "after_id": page[-1].id}


def _bounds(segment: Segment) -> dict[str, Any]:
    return {
        "run_id": segment.run_id,
        "start_s": segment.holds_from_s,
        "end_s": segment.holds_to_s,
        "wall_start_s": segment.wall_start_s,
        "wall_end_s": segment.wall_end_s,
    }


def _number(value_of: Callable[[str], Any], signal: Signal, factor: float) -> float | None:
    value = value_of(signal.name)
    if isinstance(value, (int, float)) and abs(value) <= FARTHEST_M:
        return value * factor
    return None


def _metres(value_of: Callable[[str], Any], signal: Signal) -> float | None:
    return _number(value_of, signal, metres_in(signal.name))


def _radians(value_of: Callable[[str], Any], heading: Signal) -> float:
    return _number(value_of, heading, math.tau / (heading.turn or math.tau)) or 0.0


# Rows as Parquet, through the extra `parquet` (pyarrow).


def write_parquet(source: Table, sink: BinaryIO) -> None:
    """One column per dotted name: int64, double (NaN where a value was not a number), bool, text.

    A long array of numbers is a list of doubles; a column of several kinds is text.

    Raises:
        InvalidInputError: pyarrow is not installed.
    """
    arrow, parquet = _pyarrow()
    by_column = source.by_column() if isinstance(source, Source) else None
    columns = [each for _, each in by_column.columns] if by_column else source.columns()
    types = {
        "null": arrow.null(), "bool": arrow.bool_(), "int": arrow.int64(),
        "num": arrow.float64(), "text": arrow.string(), "numbers": arrow.list_(arrow.float64()),
    }  # fmt: skip
    schema = arrow.schema(
        [(column.name, types[column.kind]) for column in (*source.head, *columns)]
    )
    with parquet.ParquetWriter(sink, schema, compression="zstd") as writer:
        if by_column is not None:
            for head, cells in by_column.slices(_GROUP_ROWS):
                arrays = [*head, *map(partial(_array, arrow), cells, columns)]
                writer.write_table(arrow.table(arrays, schema=schema))
            return
        rows = source.rows(pass_number=2)
        while group := list(islice(rows, _GROUP_ROWS)):
            arrays = [*zip(*(row.head for row in group), strict=True)]
            arrays += [_values(group, column) for column in columns]
            writer.write_table(arrow.table(arrays, schema=schema))


def _pyarrow() -> tuple[Any, Any]:
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise InvalidInputError(
            f"a Parquet file needs pyarrow: {install_line(['pyarrow'])}; or export as csv or jsonl"
        ) from error


def _array(arrow: Any, cells: Cells, column: Column) -> Any:
    """The cells of a column as Arrow has them."""
    if column.kind == "null":
        return arrow.nulls(len(cells.is_null))
    if column.kind == "text":
        texts = arrow.array(cells.labels or [""], arrow.string())
        places = arrow.array(cells.values.astype(np.int32), mask=cells.is_null)
        return arrow.DictionaryArray.from_arrays(places, texts).cast(arrow.string())
    return arrow.array(cells.values, mask=cells.is_null)


def _values(group: list[Row], column: Column) -> list[Any]:
    convert = _CONVERSIONS.get(column.kind)
    values = [row.values.get(column.name) for row in group]
    return values if convert is None else [v if v is None else convert(v) for v in values]


# Arrow refuses an integer that a double cannot hold exactly.
_CONVERSIONS: Final[dict[ColumnKind, Callable[[Any], object]]] = {
    "text": as_text,
    "num": float,
    "numbers": lambda items: [*map(float, items)],
}
