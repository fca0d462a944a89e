"""Commands that show a recording: as lines that follow it, and as a picture."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts.validators import Number

from webots_mcp.cli.recordings import (
    HERE,
    Json,
    Range,
    Robot,
    Where,
    make_chunks_first,
    only_reading,
    past_wrong_values,
)
from webots_mcp.cli.rendering import print_json, print_notes, printable
from webots_mcp.cli.terminal import wait
from webots_mcp.cli.values import Count, Id, Parameter, whole_number
from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.plotting import Picture
    from webots_mcp.store.logs import Line


@only_reading
def tail(
    *,
    limit: Annotated[
        int,
        Parameter(
            "-n",
            help="Begin with so many of the last lines (10).",
            converter=whole_number,
            validator=Number(gte=0),
        ),
    ] = 10,
    robot: Robot = None,
    interval_s: Annotated[
        float,
        Parameter("--interval", help="Seconds between looks (0.5).", validator=Number(gt=0)),
    ] = 0.5,
    no_follow: Annotated[
        bool, Parameter("--no-follow", negative=(), help="Print the last lines and end.")
    ] = False,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Follow what is being recorded: states, log lines, events, commands. Ctrl-C ends it.

    Of the states that came since the last look the newest of each robot is shown. Where nothing
    can be written, nothing can come, and it ends after the last lines. As JSON each line is an
    object.
    """
    from webots_mcp.store.logs import Follower
    from webots_mcp.store.recording import storage
    from webots_mcp.store.robots import resolve_robot

    with recorded.reader() as connection:
        found = robot and resolve_robot(connection, robot, time.time())
        follower = Follower(connection, found.id if found else None)
        _print_lines(follower.look(limit), as_json=json)
        following = not no_follow and not storage(connection)
        while following:
            wait(interval_s)
            _print_lines(_newest_states_only(follower.look()), as_json=json)


def _print_lines(lines: Sequence[Line], *, as_json: bool) -> None:
    for line in lines:
        if as_json:
            print(json.dumps(line._asdict(), ensure_ascii=False), flush=True)
            continue
        clock = time.strftime("%H:%M:%S", time.localtime(line.wall_time_s))
        at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
        print(printable(f"{clock} {line.robot} {at:>11} {line.kind:<8} {line.text}"), flush=True)


def _newest_states_only(lines: Sequence[Line]) -> list[Line]:
    """A robot that publishes a hundred times a second would scroll all else away."""
    newest = {line.robot: line for line in lines if line.kind == "state"}
    return [line for line in lines if line.kind != "state" or newest[line.robot] is line]


def plot(
    *signals: Annotated[str, Parameter("SIGNAL", help="Names, with '*' (all).")],
    output: Annotated[Path, Parameter(("-o", "--output"), help="A .png or .svg file.")],
    trajectory: Annotated[
        bool,
        Parameter("--trajectory", negative=(), help="The path of the robot, seen from above."),
    ] = False,
    run_ids: Annotated[
        list[str] | None,
        Parameter(
            "--runs", negative=(), consume_multiple=True, help="Several runs, laid over each other."
        ),
    ] = None,
    trial_set: Annotated[
        Id | None,
        Parameter(
            "--trials",
            help="The scores of a trial set, over one or two parameters (named as signals).",
        ),
    ] = None,
    width_px: Annotated[Count, Parameter("--width", help="Pixels (900).")] = 900,
    height_px: Annotated[Count, Parameter("--height", help="Pixels (500).")] = 500,
    span: Range | None = None,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Draw signals over time, the robot's path, or trials; without signals what changed most."""
    ids = [int(each) for each in run_ids or () if _is_id(each)]
    behind_runs = [each for each in run_ids or () if not _is_id(each)]

    def draw() -> None:
        from webots_mcp import plotting

        make_chunks_first(recorded.recording())
        with recorded.reader() as connection:
            picture = plotting.plot(
                connection,
                "trajectory" if trajectory else "signals",
                [*signals, *behind_runs],
                scope=(span or Range()).scope(),
                run_ids=ids,
                trial_set=trial_set,
                width_px=width_px,
                height_px=height_px,
                image_format=plotting.image_format_of(output),
            )
        write_picture(output, picture, as_json=json)

    past_wrong_values(draw)


def _is_id(text: str) -> bool:
    """Whether it is the id of a run; what is none is a signal that was typed behind the runs."""
    return text.isascii() and text.isdecimal()


def write_picture(file: Path, picture: Picture, *, as_json: bool = False) -> None:
    """Write a picture as a file of its owner alone, and say what it shows.

    Raises:
        InvalidInputError: The file cannot be written.
    """
    try:
        with whole_file(file) as aside:
            aside.write_bytes(picture.data)
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error
    if as_json:
        return print_json(
            {"file": str(file), "caption": picture.caption, "notes": list(picture.notes)}
        )
    print(f"{file}: {printable(picture.caption)}")
    print_notes(picture.notes)
