"""What stands in the world of a run, for its map.

It is read from the world file where that is possible, else from what an observer recorded.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from webots_mcp.plotting.trajectory import Obstacle
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


def robot_outline(
    connection: sqlite3.Connection, robot: TimeRange
) -> tuple[tuple[float, float], ...]:
    """Return the outline of a robot as its world file has it, seen from above.

    Its corners are ahead of the robot's origin and to the left of it, in metres. It is empty where
    the file is not there, or has no shape of it that the stand-in knows.
    """
    run = fetch_run(connection, robot.segments[-1].run_id)
    return _world_of(run).robots.get(robot.robot, ())


def _of_file(run: RunRecord) -> tuple[Obstacle, ...]:
    return _world_of(run).obstacles


class _WorldOutlines(NamedTuple):
    """What the file of a world has: its fixed bodies, and the outline of each robot by its name."""

    obstacles: tuple[Obstacle, ...] = ()
    robots: Mapping[str, tuple[tuple[float, float], ...]] = MappingProxyType({})


def _world_of(run: RunRecord) -> _WorldOutlines:
    file = Path(run.world or "")
    try:
        status = file.stat()
    except (OSError, ValueError):
        return _WorldOutlines()
    if file.suffix != ".wbt" or not file.is_file() or status.st_size > _MAX_WORLD_BYTES:
        return _WorldOutlines()
    return _standing(file, status.st_mtime_ns)


@lru_cache(maxsize=8)
def _standing(file: Path, _changed_ns: int) -> _WorldOutlines:
    from webots_mcp.standin.arena import Arena
    from webots_mcp.standin.standin_errors import WorldError
    from webots_mcp.standin.world import load_world

    try:
        bodies = Arena(load_world(file)).bodies
    except (WorldError, OSError):
        return _WorldOutlines()  # The path is drawn without them.
    return _WorldOutlines(
        tuple(each for body in bodies for each in _outlines(body)),
        {body.name: _hull(body) for body in bodies if body.node.type_name == "Robot"},
    )


def _hull(body: Body) -> tuple[tuple[float, float], ...]:
    """Return the convex outline of all shapes of a robot, in its own frame."""
    cos, sin = math.cos(body.yaw_rad), math.sin(body.yaw_rad)
    points = sorted(
        (cos * (x - body.x) + sin * (y - body.y), cos * (y - body.y) - sin * (x - body.x))
        for shape in body.shapes
        for x, y in _corners(shape)
    )
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


def _corners(shape: Shape) -> tuple[tuple[float, float], ...]:
    from webots_mcp.standin.geometry import Disc

    if isinstance(shape, Disc):
        angles = [math.tau * side / _SIDES for side in range(_SIDES)]
        radius_m = shape.radius_m
        return tuple(
            (shape.x + radius_m * math.cos(angle), shape.y + radius_m * math.sin(angle))
            for angle in angles
        )
    halves = [(a * shape.half_x_m, b * shape.half_y_m) for a, b in _CORNERS]
    cos, sin = shape.cos_yaw, shape.sin_yaw
    return tuple((shape.x + cos * u - sin * v, shape.y + sin * u + cos * v) for u, v in halves)


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
