"""Commands about the past: the same questions that the MCP tools ask."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    JSON,
    ROBOT,
    Argument,
    argument,
    count,
    question,
    reading,
    reading_long,
    row_id,
    settings_of,
)
from webots_mcp.cli.comparison import print_comparison
from webots_mcp.cli.ranges import RANGE, scope_of
from webots_mcp.cli.tables import clock_text, print_json, print_notes, print_table, printable
from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.plotting import Picture


def _id_or_signal(text: str) -> int | str:
    """The id of a run; what is none is a signal that was typed behind the runs."""
    return int(text) if text.isascii() and text.isdecimal() else text


SIGNALS: Final = argument("signals", nargs="*", metavar="SIGNAL", help="names, with '*' (all)")


@question(
    "runs", DATA_DIR, DATABASE, ROBOT, JSON,
    argument("--parameter", action="append", metavar="NAME=VALUE",
             help="only runs in which it had this value; may be repeated"),
    count("-n", "the newest N runs", default=20),
)  # fmt: skip
def runs(arguments: argparse.Namespace) -> None:
    """List the runs: when, with which code, how long, how fast, how they ended."""
    from webots_mcp.store.parameters import kinds_of
    from webots_mcp.store.questions.runs import list_runs

    with reading(arguments) as connection:
        wanted = settings_of(arguments.parameter or [], kinds_of(connection))
        found = list_runs(
            connection, robot=arguments.robot, limit=arguments.limit, parameters=wanted
        )
    if arguments.json:
        return print_json(found)
    rows = [
        [
            run.run_id, run.robot, run.label, run.parameters or None,
            clock_text(run.started_wall_time_s), run.duration_s, run.real_time_factor, run.rows,
            run.end_reason or "going on",
            (run.controller_sha256 or "")[:8] or None, run.notable or None, run.note,
        ]
        for run in found.runs
    ]  # fmt: skip
    columns = ("run", "robot", "label", "parameters", "started", "duration_s", "pace", "rows",
               "ended by", "code", "notable", "note")  # fmt: skip
    print_table(columns, rows)
    print_notes([f"{found.total} runs in all: -n shows more"] if found.cursor else [])


MOTION: Final[tuple[Argument, ...]] = (
    argument("--position", nargs=2, metavar=("X", "Y"),
             help="the signals of the position, if their names do not tell"),
    argument("--mode", metavar="NAME", help="the signal of the mode, a text or a number"),
)  # fmt: skip


@question(
    "plot", DATA_DIR, DATABASE, *RANGE, SIGNALS,
    argument("-o", "--output", required=True, metavar="FILE", help="a .png or .svg file"),
    argument("--trajectory", action="store_true", help="the way of the robot, seen from above"),
    argument("--runs", type=_id_or_signal, nargs="+", default=[], dest="run_ids", metavar="ID",
             help="several runs, laid over each other"),
    argument("--trials", type=row_id, dest="trial_set", metavar="SET",
             help="the scores of a trial set, over one or two parameters (named as signals)"),
    count("--width", "pixels", default=900, dest="width_px", metavar="PX"),
    count("--height", "pixels", default=500, dest="height_px", metavar="PX"),
)  # fmt: skip
def plot(arguments: argparse.Namespace) -> None:
    """Draw signals over time, the robot's way, or trials; without signals what changed most."""
    from webots_mcp import plotting

    file = Path(arguments.output)
    run_ids = [each for each in arguments.run_ids if isinstance(each, int)]
    behind_runs = [each for each in arguments.run_ids if isinstance(each, str)]
    with reading_long(arguments) as connection:
        picture = plotting.plot(
            connection,
            "trajectory" if arguments.trajectory else "signals",
            [*arguments.signals, *behind_runs],
            scope=scope_of(arguments),
            run_ids=run_ids,
            trial_set=arguments.trial_set,
            width_px=arguments.width_px,
            height_px=arguments.height_px,
            image_format=plotting.image_format_of(file),
        )
    write_picture(file, picture)


def write_picture(file: Path, picture: Picture) -> None:
    """Write a picture as a file of its owner alone, and say what it shows.

    Raises:
        InvalidInputError: The file cannot be written.
    """
    try:
        with whole_file(file) as aside:
            aside.write_bytes(picture.data)
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error
    print(f"{file}: {printable(picture.caption)}")
    print_notes(picture.notes)


@question(
    "compare", DATA_DIR, DATABASE, ROBOT, JSON,
    argument("run_ids", type=row_id, nargs="*", metavar="RUN",
             help="one or more runs; none: before and after the last edit of the controller"),
    argument("--trials", type=row_id, dest="trial_set", metavar="SET",
             help="the runs of a trial set, by their parameters"),
    argument("--signal", action="append", metavar="NAME", help="only this signal; with '*'"),
    argument("--matters", type=float, default=1.0, dest="matters_sd", metavar="SD",
             help="a difference of SD standard deviations between like runs matters (1)"),
    *MOTION,
    count("-n", "the N that differ most", default=15),
)  # fmt: skip
def compare(arguments: argparse.Namespace) -> None:
    """What runs came to: distance, time per mode, events, and the signals that differ most."""
    from webots_mcp.store.detection.event import EventOptions, both_of
    from webots_mcp.store.questions.compare import compare_code, compare_runs, compare_trials

    options = EventOptions(position=both_of(arguments.position), mode=arguments.mode)
    wanted: dict[str, Any] = {
        "names": arguments.signal or ["*"], "limit": arguments.limit, "options": options,
        "matters_sd": arguments.matters_sd,
    }  # fmt: skip
    if arguments.run_ids and arguments.trial_set is not None:
        raise InvalidInputError("name runs or give --trials, not both")
    with reading_long(arguments) as connection:
        if arguments.trial_set is not None:
            found = compare_trials(connection, arguments.trial_set, **wanted)
        elif arguments.run_ids:
            found = compare_runs(connection, arguments.run_ids, **wanted)
        else:
            found = compare_code(connection, robot=arguments.robot, **wanted)
    if arguments.json:
        return print_json(found)
    print_comparison(found)
