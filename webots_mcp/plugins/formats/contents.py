"""Everything that a time range holds, for the formats of viewers: states, logs, events and more."""

from __future__ import annotations

import heapq
import math
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import Motion, find_motion
from webots_mcp.signals.naming import FARTHEST_M, metres_in
from webots_mcp.store.export import (
    CHUNK_ROWS,
    Progress,
    Recorded,
    StateTable,
)
from webots_mcp.store.logs import LogLine
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import Segment
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.run_rows import MAX_FILE_BYTES, EventRecord, StoredImage, columns_of

# What is counted, in the order in which it is reported.
KINDS: Final = (
    "states", "log lines", "events", "commands", "pictures", "pictures that are gone",
)  # fmt: skip
_PATH_POSES: Final = 1000  # Minimum of poses in the path of a longer run.
_IN_SEGMENT: Final = (
    "sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND wall_time_s >= :wall_start_s AND wall_time_s < :wall_end_s"
)
# A command belongs to the run of its robot during which it was claimed, else created. A command
# that was never claimed gets the time of the newest state before it.
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


@dataclass(frozen=True)
class PlacedCommand:
    """A command and its outcome, with its run and the time it was claimed, else created."""

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
    """Position and heading of a robot; 0 for what is unknown."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


class SampledPath:
    """A sample of the poses of a run. When it is full, every second pose is removed."""

    def __init__(self) -> None:
        self.poses: list[Pose] = []
        self.first: Recorded | None = None
        self._every = 1
        self._seen = 0

    def add(self, recorded: Recorded, pose: Pose) -> None:
        """Add the pose of a state, if it is due."""
        self._seen += 1
        if self._seen % self._every:
            return
        self.first = self.first or recorded
        self.poses.append(pose)
        if len(self.poses) == 2 * _PATH_POSES:
            del self.poses[::2]
            self._every *= 2


Item: TypeAlias = "Recorded | LogLine | EventRecord | PlacedCommand | StoredImage"
_Row = TypeVar("_Row", LogLine, EventRecord, StoredImage)


@dataclass(frozen=True)
class Contents:
    """A time range with everything that was recorded in it. All of it can be read repeatedly."""

    connection: sqlite3.Connection
    data_dir: Path
    wanted: TimeRange
    source: StateTable

    @classmethod
    def of(
        cls,
        connection: sqlite3.Connection,
        data_dir: Path,
        wanted: TimeRange,
        passes: int,
        progress: Progress | None,
    ) -> Contents:
        """Return the contents of a range, whose states will be read `passes` times."""
        source = StateTable.of(connection, wanted.segments, passes, progress)
        return cls(connection, data_dir, wanted, source)

    @property
    def run_ids(self) -> list[int]:
        """Return the ids of the runs, in order."""
        return [segment.run_id for segment in self.wanted.segments]

    @cached_property
    def signals(self) -> dict[str, RegisteredSignal]:
        """Return all signals of the robot, by name."""
        return known_signals(self.connection, self.wanted)

    @cached_property
    def motion(self) -> Motion:
        """Return the signals that describe how the robot moves."""
        return find_motion(self.signals, EventOptions())

    def items(self, pass_number: int) -> Iterator[Item]:
        """Yield everything, run by run, in the order of simulation time."""
        streams = (
            self.source.recorded(pass_number),
            self.log_lines(),
            self.events(),
            self.commands(),
            self.images(),
        )
        return heapq.merge(*streams, key=attrgetter("run_id", "sim_time_s"))

    def log_lines(self) -> Iterator[LogLine]:
        """Yield the log lines of the runs."""
        return self._pages("log", LogLine)

    def events(self) -> Iterator[EventRecord]:
        """Yield the events that the bridge stored."""
        return self._pages("event", EventRecord)

    def images(self) -> Iterator[StoredImage]:
        """Yield the rows of pictures, whether or not their files still exist."""
        return self._pages("image", StoredImage)

    def commands(self) -> Iterator[PlacedCommand]:
        """Yield the commands to the robot."""
        query = _COMMANDS.format(columns=columns_of(PlacedCommand))
        for segment in self.wanted.segments:
            for row in self.connection.execute(query, _bounds(segment)).fetchall():
                yield PlacedCommand(*row)

    def picture(self, image: StoredImage) -> bytes | None:
        """Return the file of a picture; None if it is missing or not allowed."""
        try:
            file = image.file(self.data_dir)
            return file.read_bytes() if file.stat().st_size <= MAX_FILE_BYTES else None
        except (InvalidInputError, NothingRecordedError, OSError):
            return None

    def pose(self, value_of: Callable[[str], Any]) -> Pose | None:
        """Return the pose in a state, whose values `value_of` returns by name; None without one."""
        if self.motion.position is None:
            return None
        x_m, y_m = (_metres(value_of, signal) for signal in self.motion.position)
        if x_m is None or y_m is None:
            return None
        height, heading = self.motion.height, self.motion.heading
        z_m = _metres(value_of, height) if height else None
        return Pose(x_m, y_m, z_m or 0.0, _radians(value_of, heading) if heading else 0.0)

    def about(self, run_id: int) -> dict[str, str]:
        """Return the known facts of a run: uuid, robot, world, code, parameters."""
        cursor = self.connection.execute(
            "SELECT r.uuid, r.world, r.basic_time_step_ms, r.start_reason, r.end_reason, "
            "r.label, r.note, strftime('%Y-%m-%dT%H:%M:%fZ', r.started_wall_time_s, 'unixepoch') "
            "AS started, s.controller, s.controller_sha256, s.git_commit, s.versions FROM run r "
            "JOIN session s ON s.id = r.session_id WHERE r.id = ?",
            (run_id,),
        )
        names = [column[0] for column in cursor.description]
        facts: dict[str, Any] = {"run_id": run_id, "robot": self.wanted.robot}
        facts |= dict(zip(names, cursor.fetchone(), strict=True))
        for name, value in self.connection.execute(
            "SELECT name, value FROM parameter_value WHERE run_id = ? ORDER BY id", (run_id,)
        ):
            facts[f"parameter {name}"] = value  # The last value.
        return {name: str(value) for name, value in facts.items() if value is not None}

    def _pages(self, table: str, row: type[_Row]) -> Iterator[_Row]:
        page_query = (
            f"SELECT {{columns}} FROM {{table}} WHERE run_id = :run_id AND {_IN_SEGMENT} "
            "AND (sim_time_s > :start_s OR id > :after_id) ORDER BY sim_time_s, id LIMIT :limit"
        )
        query = page_query.format(columns=columns_of(row), table=table)
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


def _number(
    value_of: Callable[[str], Any], signal: RegisteredSignal, factor: float
) -> float | None:
    value = value_of(signal.name)
    if isinstance(value, (int, float)) and abs(value) <= FARTHEST_M:
        return value * factor
    return None


def _metres(value_of: Callable[[str], Any], signal: RegisteredSignal) -> float | None:
    return _number(value_of, signal, metres_in(signal.name))


def _radians(value_of: Callable[[str], Any], heading: RegisteredSignal) -> float:
    return _number(value_of, heading, math.tau / (heading.turn or math.tau)) or 0.0
