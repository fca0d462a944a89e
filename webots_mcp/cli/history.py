"""Commands about the past: the same questions that the MCP tools ask."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    argument,
    count,
    question,
    reading_long,
    row_id,
)
from webots_mcp.cli.ranges import RANGE, scope_of
from webots_mcp.cli.tables import print_notes, printable
from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.plotting import Picture


def _id_or_signal(text: str) -> int | str:
    """The id of a run; what is none is a signal that was typed behind the runs."""
    return int(text) if text.isascii() and text.isdecimal() else text


SIGNALS: Final = argument("signals", nargs="*", metavar="SIGNAL", help="names, with '*' (all)")


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
