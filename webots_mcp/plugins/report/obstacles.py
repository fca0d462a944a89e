"""What stands in the world of a run, and the bodies of its robots, for its map.

It is read from the world file where that is possible, else from what an observer recorded.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from webots_mcp.plotting.trajectory import Obstacle, Outline, PlottedPath
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.robots import world_seen
from webots_mcp.store.run_rows import RunRecord, fetch_run

if TYPE_CHECKING:
    from webots_mcp.standin.arena import Body
    from webots_mcp.standin.geometry import Shape


_MAX_WORLD_BYTES: Final = 1_000_000  # Reading a larger world file would take seconds.
_CORNERS: Final = ((1, 1), (-1, 1), (-1, -1), (1, -1))
_SIDES: Final = 24  # Of the polygon that a circle is drawn as.


def obstacles_of(
    connection: sqlite3.Connection, ranges: Sequence[TimeRange]
) -> tuple[Obstacle, ...]:
    """Return the obstacles in the world of the last run of some ranges.

    They are the fixed bodies of the world file, of types that the stand-in knows. Movable bodies
    are left out, since the file has only their start. Without a world file they are the solids that
    an observer recorded.
    """
    run = fetch_run(connection, ranges[-1].segments[-1].run_id)
    return _of_file(run) or _seen(connection, run)


def with_bodies(
    connection: sqlite3.Connection, tracks: Sequence[PlottedPath], ranges: Sequence[TimeRange]
) -> list[PlottedPath]:
    """Return paths with the outlines of their robots, as far as the world files have them.

    Args:
        connection: Of the recording.
        tracks: One path for each run of the ranges.
        ranges: What was read.
    """
    segments = [(each.robot, segment.run_id) for each in ranges for segment in each.segments]
    if len(segments) != len(tracks):  # A run without rows has no path.
        segments = segments[-1:] * len(tracks)
    return [
        replace(track, body=_bodies_of_file(fetch_run(connection, run_id)).get(robot, ()))
        for track, (robot, run_id) in zip(tracks, segments, strict=True)
    ]


def robot_outline(
    connection: sqlite3.Connection, robot: TimeRange
) -> tuple[tuple[float, float], ...]:
    """Return the outline of a robot as its world file has it, seen from above.

    Its corners are ahead of the robot's origin and to the left of it, in metres. It is empty where
    the file is missing, or has no shape of the robot that the stand-in knows.
    """
    run = fetch_run(connection, robot.segments[-1].run_id)
    body = next((each for each in _bodies_in(run) if each.name == robot.robot), None)
    if body is None or body.node.type_name != "Robot":
        return ()
    return _hull([corner for shape in body.shapes for corner in _corners(shape, body)])


def _bodies_of_file(run: RunRecord) -> dict[str, tuple[Outline, ...]]:
    return {
        body.name: tuple(_corners(shape, body) for shape in body.solid_shapes or body.shapes)
        for body in _bodies_in(run)
        if body.node.type_name == "Robot"
    }


def _of_file(run: RunRecord) -> tuple[Obstacle, ...]:
    return tuple(each for body in _bodies_in(run) for each in _outlines(body))


def _bodies_in(run: RunRecord) -> tuple[Body, ...]:
    file = Path(run.world or "")
    try:
        status = file.stat()
    except (OSError, ValueError):
        return ()
    if file.suffix != ".wbt" or not file.is_file() or status.st_size > _MAX_WORLD_BYTES:
        return ()
    return _loaded(file, status.st_mtime_ns)


@lru_cache(maxsize=8)
def _loaded(file: Path, _changed_ns: int) -> tuple[Body, ...]:
    from webots_mcp.standin.arena import Arena
    from webots_mcp.standin.standin_errors import WorldError
    from webots_mcp.standin.world import load_world

    try:
        return tuple(Arena(load_world(file)).bodies)
    except (WorldError, OSError):
        return ()  # The path is drawn without them.


def _hull(corners: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Return the convex outline of points."""
    points = sorted(corners)
    if len(points) < 3:
        return ()
    halves = [_half_hull(points), _half_hull(points[::-1])]
    return tuple(point for half in halves for point in half[:-1])


def _half_hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the hull below sorted points (A. M. Andrew, 1979)."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    return hull


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Return whether three points turn left (positive), right (negative) or not at all."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _outlines(body: Body) -> Iterator[Obstacle]:
    if body.node.type_name == "Robot" or body.is_movable:
        return
    for shape in body.solid_shapes:
        yield Obstacle(body.name, shape.x, shape.y, _corners(shape))


def _corners(shape: Shape, of: Body | None = None) -> Outline:
    """Return the corners of a shape in the world, or in the frame of a body."""
    from webots_mcp.standin.geometry import Disc

    if isinstance(shape, Disc):
        angles = [math.tau * side / _SIDES for side in range(_SIDES)]
        radius_m = shape.radius_m
        corners = [
            (shape.x + radius_m * math.cos(angle), shape.y + radius_m * math.sin(angle))
            for angle in angles
        ]
    else:
        halves = [(a * shape.half_x_m, b * shape.half_y_m) for a, b in _CORNERS]
        cos, sin = shape.cos_yaw, shape.sin_yaw
        corners = [(shape.x + cos * u - sin * v, shape.y + sin * u + cos * v) for u, v in halves]
    if of is None:
        return tuple(corners)
    cos, sin = math.cos(of.yaw_rad), math.sin(of.yaw_rad)
    moved = ((x - of.x, y - of.y) for x, y in corners)
    return tuple((cos * x + sin * y, cos * y - sin * x) for x, y in moved)


def _seen(connection: sqlite3.Connection, run: RunRecord) -> tuple[Obstacle, ...]:
    world = world_seen(connection, run)
    solids = world.content.get("solids", ()) if world else ()
    places = world.places if world else {}
    told = [(each["key"], each | places.get(each["key"], {})) for each in solids]
    return tuple(
        Obstacle(str(key), float(body["x_m"]), float(body["y_m"]))
        for key, body in told
        if body.get("x_m") is not None and body.get("y_m") is not None
    )
