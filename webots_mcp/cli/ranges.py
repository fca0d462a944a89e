"""Which run of which robot, and which stretch of it: the arguments that commands share."""

from __future__ import annotations

import argparse
import sqlite3
from dataclasses import fields
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.command import ROBOT, Argument, argument, row_id

if TYPE_CHECKING:
    from webots_mcp.store.reading.ranges import Scope, TimeRange

RUN: Final = argument(
    "--run", type=row_id, dest="run_id", metavar="ID", help="that run instead of the newest one"
)
SIMULATION_TIMES: Final[tuple[Argument, ...]] = (
    argument(
        "--last",
        type=float,
        dest="last_s",
        metavar="S",
        help="the last S seconds of simulation time",
    ),
    argument(
        "--start", type=float, dest="start_s", metavar="S", help="from this simulation time on"
    ),
    argument(
        "--end",
        type=float,
        dest="end_s",
        metavar="S",
        help="up to, not including, this simulation time",
    ),
)
TIMES: Final[tuple[Argument, ...]] = (
    *SIMULATION_TIMES,
    argument(
        "--since",
        dest="since_wall_time",
        metavar="TIME",
        help="from this wall time on (ISO 8601 or Unix seconds)",
    ),
    argument(
        "--until",
        dest="until_wall_time",
        metavar="TIME",
        help="up to, not including, this wall time",
    ),
)
RANGE: Final = (ROBOT, RUN, *TIMES)


def range_of(connection: sqlite3.Connection, arguments: argparse.Namespace) -> TimeRange:
    """What the arguments of `RANGE` mean in the recording."""
    from webots_mcp.store.reading.ranges import find_range

    return find_range(connection, scope_of(arguments))


def scope_of(arguments: argparse.Namespace) -> Scope:
    """What the arguments of `RANGE` ask for."""
    from webots_mcp.store.reading.ranges import Scope

    return Scope(**{each.name: getattr(arguments, each.name) for each in fields(Scope)})
