"""Commands about the past: the same questions that the MCP tools ask."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
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
from webots_mcp.cli.ranges import RANGE, range_of, scope_of
from webots_mcp.cli.tables import clock_text, print_json, print_notes, print_table, printable
from webots_mcp.contract import whole_file
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.plotting import Picture
    from webots_mcp.store.detection.event import EventOptions
    from webots_mcp.store.detection.verdict import Verdicts
    from webots_mcp.store.questions.series import ChangeColumns, RunHistory
    from webots_mcp.store.questions.trends import RunTrends, StateTrend
    from webots_mcp.store.reading.changes import Point


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


@question(
    "history", DATA_DIR, DATABASE, *RANGE, JSON,
    argument("signals", nargs="+", metavar="SIGNAL", help="names, with '*'"),
    count("--points", "at most N buckets", default=20, dest="max_points"),
)  # fmt: skip
def history(arguments: argparse.Namespace) -> None:
    """Show signals over time: mean, minimum and maximum of each bucket; changes of modes and flags.

    Without a range the whole newest run is shown.
    """
    from webots_mcp.store.questions.series import query_history

    with reading_long(arguments) as connection:
        found = query_history(
            connection, range_of(connection, arguments), arguments.signals,
            max_points=arguments.max_points,
        )  # fmt: skip
    if arguments.json:
        return print_json(found)
    for run in found.runs:
        _print_history(run)
    print_notes(found.notes)


@question(
    "trends", DATA_DIR, DATABASE, *RANGE, JSON, SIGNALS,
    count("-n", "the N that changed most", default=20),
)  # fmt: skip
def trends(arguments: argparse.Namespace) -> None:
    """Say in one line each what the signals did; what changed most comes first."""
    from webots_mcp.store.questions.trends import trends as find_trends

    with reading_long(arguments) as connection:
        found = find_trends(
            connection, range_of(connection, arguments), arguments.signals or ["*"],
            limit=arguments.limit,
        )  # fmt: skip
    if arguments.json:
        return print_json(found)
    for run in found.runs:
        _print_trends(run)
    print_notes(found.notes)


MOTION: Final[tuple[Argument, ...]] = (
    argument("--position", nargs=2, metavar=("X", "Y"),
             help="the signals of the position, if their names do not tell"),
    argument("--mode", metavar="NAME", help="the signal of the mode, a text or a number"),
)  # fmt: skip


@question(
    "events", DATA_DIR, DATABASE, *RANGE, JSON,
    argument("--kind", action="append", metavar="KIND", help="only this kind; may be repeated"),
    argument("--signal", action="append", metavar="NAME", help="only this signal; with '*'"),
    argument("--where", metavar="CONDITION",
             help="where a condition held, such as 'front_m < 0.1 for 0.5'"),
    argument("--above", type=float, metavar="X", help="where the signals were above X"),
    argument("--below", type=float, metavar="X", help="where the signals were below X"),
    argument("--for", type=float, default=0.0, dest="for_s", metavar="S",
             help="for at least S simulated seconds"),
    argument("--silent", type=float, default=1.0, dest="silent_s", metavar="S",
             help="silent is who has no value for at least S simulated seconds (1)"),
    *MOTION,
    argument("--one-by-one", action="store_false", dest="group",
             help="alike events too, many of which are told as one else"),
    count("-n", "at most N events", default=50),
    argument("--after", metavar="CURSOR", help="what an answer with that cursor left out"),
)  # fmt: skip
def events(arguments: argparse.Namespace) -> None:
    """Find what happened: changes, stuck, standstills, gaps, jumps, silent sensors, warnings."""
    from webots_mcp.store.questions.events import find_events

    with reading_long(arguments) as connection:
        found = find_events(
            connection, range_of(connection, arguments), _options(arguments), limit=arguments.limit,
            group=arguments.group, after=arguments.after,
        )  # fmt: skip
    if arguments.json:
        return print_json(found)
    several = len({event.run_id for event in found.events}) > 1
    rows = [
        [
            event.run_id if several else None, event.start_s,
            (event.count == 1 and event.duration_s) or None, event.kind,
            event.name, event.details or None,
        ]
        for event in found.events
    ]  # fmt: skip
    print_table(("run", "start_s", "duration_s", "kind", "name", "details"), rows)
    left_out = [
        f"left out: {each.count} of kind {kind} {each.span}"
        for kind, each in found.left_out.items()
    ]
    left_out += [f"--after '{found.cursor}' shows them, -n more at once"] if found.cursor else []
    print_notes([*_verdicts(found.verdicts), *found.notes, *left_out])


def _verdicts(verdicts: Verdicts) -> list[str]:
    """What became of the kinds that are not in the table, or not all."""
    near = [f"{kind} ({what})" for kind, what in verdicts.came_near.items()]
    absent = [*verdicts.far, *near]
    unsearched = [f"not looked for: {kinds}: {why}" for kinds, why in verdicts.gaps.items()]
    return [f"looked for and absent: {', '.join(absent)}"] * bool(absent) + unsearched


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


def _options(arguments: argparse.Namespace) -> EventOptions:
    from webots_mcp.store.detection.event import EventOptions, both_of
    from webots_mcp.store.detection.threshold import thresholds_on

    limits = thresholds_on(
        arguments.signal or (), arguments.above, arguments.below, arguments.for_s
    )
    given = ("threshold",) * bool(limits) + ("condition",) * (arguments.where is not None)
    return EventOptions(
        kinds=tuple(arguments.kind or given),
        signals=tuple(arguments.signal or "*"),
        thresholds=limits,
        where=arguments.where,
        silent_s=arguments.silent_s,
        position=both_of(arguments.position),
        mode=arguments.mode,
    )


def _print_heading(run_id: int, start_s: float, end_s: float, more: str = "") -> None:
    print(f"run {run_id}, {start_s:.3f} to {end_s:.3f} s{more}")


def _print_history(run: RunHistory) -> None:
    step = f", a row is {run.step_s:g} s" if run.step_s else ""
    _print_heading(run.run_id, run.start_s, run.end_s, step)
    columns = ["sim_time_s"]
    series: list[Sequence[float | None]] = [run.sim_time_s]
    for number in run.numbers:
        if run.step_s is None:
            columns.append(number.name)
            series.append(number.last)
        else:
            columns += [f"{number.name} mean", "min", "max"]
            series += [number.mean, number.min, number.max]
    if run.numbers:
        print_table(columns, list(zip(*series, strict=True)))
    changes = [
        [states.name, _since(states, point), "null" if point.value is None else point.value]
        for states in run.changes
        for point in states.points
    ]
    if changes:
        print_table(("signal", "since_s", "value"), changes)
    print_notes([f"no row from {gap.start_s:.3f} to {gap.end_s:.3f} s" for gap in run.gaps[:10]])
    print_notes(_unread(run.cut_at_s))


def _print_trends(run: RunTrends) -> None:
    _print_heading(run.run_id, run.start_s, run.end_s, f", {run.rows} rows")
    numbers = [
        [trend.name, trend.says, trend.mean, trend.deviation, trend.unit] for trend in run.numbers
    ]
    if numbers:
        print_table(("signal", "what it did", "mean", "deviation", "unit"), numbers)
    states = [
        [state.name, state.changes, _spelled(state.last), state.since_s, _times(state)]
        for state in run.states
    ]
    if states:
        print_table(("signal", "changes", "last", "since_s", "seconds in each value"), states)
    left = run.total - len(run.numbers)
    print_notes([f"{left} more signals that changed less: -n shows them"] if left else [])
    print_notes(_unread(run.cut_at_s))


def _since(states: ChangeColumns, point: Point) -> float | str:
    first = states.since_before and states.total == len(states.points)
    is_open = first and point is states.points[0]
    return f"before {point.sim_time_s:.3f}" if is_open else point.sim_time_s


def _unread(cut_at_s: float | None) -> list[str]:
    """From where on the answer is not of all rows."""
    if cut_at_s is None:
        return []
    return [f"not all was read from {cut_at_s:.3f} s on, the time was over: ask for less time"]


def _times(state: StateTrend) -> str:
    return ", ".join(f"{value} {time_s:.1f}" for value, time_s in state.time_by_value_s.items())


def _spelled(value: object) -> object:
    return "null" if value is None else value
