"""Define the commands about the recording: export, import, prune, retention, tail and plot."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

from cyclopts.validators import Number

from webots_mcp.cli.options import (
    HERE,
    Count,
    Id,
    Json,
    Parameter,
    RetentionOptions,
    TimeRangeOptions,
    Where,
    make_chunks_first,
    only_reading,
    past_invalid_rows,
    past_wrong_values,
    refuse_options,
    whole_number,
)
from webots_mcp.cli.streams import binary_stdout, shown_activity, shown_progress, wait
from webots_mcp.cli.terminal import (
    id_ranges,
    print_json,
    print_notes,
    print_table,
    printable,
    runs_named,
)
from webots_mcp.database.files import placed
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.plugin_registry import export_formats
from webots_mcp.store.merging import write_bundle
from webots_mcp.store.purge import Purged

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.plotting.canvas import PlotImage
    from webots_mcp.store.logs import FollowedLine
    from webots_mcp.store.reading.ranges import TimeRange
    from webots_mcp.store.recording import RecordingAccess
    from webots_mcp.store.retention_limits import Retention
    from webots_mcp.store.retention_plan import Plan

    _Format = str
else:
    _Format = Literal[("csv", "jsonl", *(each.name for each in export_formats()), "zip")]

_ALL: Final = TimeRangeOptions()
_STDOUT: Final = Path("-")
_UNLIMITED: Final = RetentionOptions()


class _Written(NamedTuple):
    """The outcome of an export; for a table on stdout only notes about it."""

    file: Path | None
    text: str
    data: dict[str, Any]
    notes: tuple[str, ...] = ()


def export(
    *,
    output: Annotated[
        Path | None,
        Parameter(
            ("--output", "-o"),
            metavar="FILE",
            allow_leading_hyphen=True,  # for stdout
            validator=refuse_options,
            help="File to write: .csv, .jsonl, .parquet, .mcap, .rrd or .zip. Default: CSV to "
            "stdout.",
        ),
    ] = None,
    form: Annotated[
        _Format | None, Parameter("--format", help="File format. Default: by the ending of FILE.")
    ] = None,
    safe_cells: Annotated[
        bool,
        Parameter(
            "--safe-cells",
            help="In CSV, put an apostrophe before texts that a spreadsheet would run as a formula "
            "(they start with =, +, - or @).",
        ),
    ] = False,
    trial_set: Annotated[
        Id | None,
        Parameter(
            "--trials",
            metavar="SET",
            help="Export the trials of this set instead, one row each, with score, rank and "
            "spread.",
        ),
    ] = None,
    part: TimeRangeOptions = _ALL,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """Export states as a table, or a whole run for a viewer or for another recording.

        webots-mcp export --run 4 -o run4.csv

    Exports the newest run unless a run or a range is given; --since 0 exports all runs of a robot.

    Tables (.csv, .jsonl, .parquet) have one row per state. The columns are run, row, times, and the
    dotted names of published signals. NaN and infinity are kept.

    Files for viewers, .mcap (Foxglove, Lichtblick, PlotJuggler) and .rrd (Rerun), hold states,
    poses, pictures, log lines, events and commands.

    A .zip bundle holds one finished run with its pictures, for 'webots-mcp import'.

    Parquet needs pyarrow, MCAP needs mcap and Rerun needs rerun-sdk. If one is missing, the error
    shows the command that installs it.
    """
    from webots_mcp.store.export import BUNDLE, FOR_VIEWERS, FORMATS, format_of
    from webots_mcp.store.reading.ranges import Scope

    file = output if output != _STDOUT else None
    form = form or (format_of(file) if file else "csv")
    if trial_set is not None and part.scope() != Scope():
        raise InvalidInputError(
            "--trials cannot be combined with a robot, run or range of states, because trials are "
            "a table of their own. Leave one of them out."
        )
    recording = recorded.recording()
    if file is None:
        _require_for_stdout(form, as_json=json)
    elif isinstance(recording.database, Path) and file.resolve() == recording.database:
        raise InvalidInputError(
            f"{file} is the recording itself, which would be lost. Choose another file with -o."
        )
    if trial_set is not None and form not in FORMATS:
        raise InvalidInputError(
            f"Trials cannot be exported as {form}, because they are a table. Use "
            f"--format {' or '.join(FORMATS)}."
        )
    if form == BUNDLE and file is not None:
        return _show(_export_bundle(recorded, part, file), as_json=json)

    def run() -> None:
        if form in FOR_VIEWERS and file is not None:
            written = _export_for_viewers(recorded, part, file, form)
        else:
            written = _export_table(recorded, part, trial_set, file, form, safe_cells=safe_cells)
        _show(written, as_json=json)

    # Output to stdout cannot be taken back, so each row is checked first.
    past_invalid_rows(run) if file is None else past_wrong_values(run)


def _require_for_stdout(form: str, *, as_json: bool) -> None:
    from webots_mcp.store.export import FORMATS

    if form not in FORMATS:
        raise InvalidInputError(f"{form} cannot be written to stdout. Name a file with -o.")
    if not FORMATS[form].is_text and sys.stdout.isatty():
        raise InvalidInputError(f"{form} is binary and not for a terminal. Name a file with -o.")
    if as_json:
        raise InvalidInputError(
            "--json describes an exported file, and none was named. Name one with -o, or write "
            "states as JSON with --format jsonl."
        )


def _export_table(
    recorded: Where,
    part: TimeRangeOptions,
    trial_set: int | None,
    file: Path | None,
    form: str,
    *,
    safe_cells: bool,
) -> _Written:
    from webots_mcp.store.export import TrialTable, export_file
    from webots_mcp.store.export import export as write

    with recorded.reader() as connection, shown_progress("exporting") as progress:
        if trial_set is not None:
            wanted = TrialTable.of(connection, trial_set)
            notes = list(wanted.notes)
        else:
            wanted = part.in_recording(connection)
            notes = _notes_of(wanted)
        how: dict[str, Any] = {"safe_cells": safe_cells, "notes": notes}
        if file is None:
            write(connection, wanted, form, binary_stdout(), progress, **how)
            return _Written(None, "", {}, tuple(notes))
        rows = export_file(connection, wanted, form, file, progress, **how)
    return _Written(file, f"{rows:,} rows", {"row_count": rows}, tuple(notes))


def _export_for_viewers(recorded: Where, part: TimeRangeOptions, file: Path, form: str) -> _Written:
    from webots_mcp.store.export import export_for_viewers

    data_dir = recorded.recording().data_dir
    with recorded.reader() as connection, shown_progress("exporting") as progress:
        wanted = part.in_recording(connection)
        written = export_for_viewers(connection, data_dir, wanted, form, file, progress)
    counts = {kind: count for kind, count in written.counts.items() if count}
    text = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    by_kind = {kind.replace(" ", "_"): count for kind, count in counts.items()}
    data: dict[str, Any] = {"counts": by_kind}
    if written.beside:
        data["beside"] = written.beside
    return _Written(file, text, data, (*_notes_of(wanted), *written.notes))


def _notes_of(wanted: TimeRange) -> list[str]:
    """Note that each call in a full-rate segment is a row of an export."""
    from webots_mcp.store.reading.ranges import USE_EVERY_ROW

    return [note.removesuffix(USE_EVERY_ROW) for note in wanted.notes]


def _export_bundle(recorded: Where, part: TimeRangeOptions, file: Path) -> _Written:
    from webots_mcp.store.reading.ranges import Scope, find_subject

    scope, recording = part.scope(), recorded.recording()
    if scope != Scope(robot=scope.robot, run_id=scope.run_id):
        raise InvalidInputError(
            "A .zip bundle holds a whole run, so a time range cannot be applied. Use only --run or "
            "--robot."
        )
    assert isinstance(recording.database, Path)
    with recorded.reader() as connection, shown_progress("packing") as progress:
        run_id = find_subject(connection, scope.robot, scope.run_id).run_id
        place = (recording.database, recording.data_dir, run_id)
        with placed(file) as aside:
            write_bundle(connection, *place, aside, progress)
    size = file.stat().st_size
    data = {"run_id": run_id, "size_bytes": size}
    return _Written(file, f"run {run_id} ({size:,} bytes)", data)


def _show(written: _Written, *, as_json: bool) -> None:
    if as_json:
        return print_json({"file": str(written.file), **written.data, "notes": list(written.notes)})
    if written.file is not None:
        beside = str(written.data.get("beside", ""))
        beside = f" {beside[0].upper()}{beside[1:]}" if beside else ""
        print(f"Exported {written.text} to {written.file}.{beside}")
    print_notes(written.notes, sys.stderr)  # stdout may hold the table


def import_(
    source: Annotated[
        Path,
        Parameter(
            "SOURCE",
            help="Database of another recording (webots.db), or a .zip bundle.",
        ),
    ],
    /,
    *,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """Import the runs of another recording, or of a bundle made by 'webots-mcp export'.

        webots-mcp import run4.zip

    The source must not be recording. Runs that were imported before are left unchanged, so the same
    source can be imported again.
    """
    from webots_mcp.store.merging import is_bundle, unpacked

    if not source.is_file():
        why = (
            "it is a folder. Name the webots.db in it."
            if source.is_dir()
            else "there is no such file. Check the path."
        )
        raise InvalidInputError(f"{source} cannot be imported: {why}")
    with shown_activity("importing"):
        if is_bundle(source):
            with unpacked(source) as database:
                found = _take_in(recorded, database)
        else:
            found = _take_in(recorded, source)
    if json:
        return print_json({"source": str(source), **found})
    print(_imported(found, source))


def _take_in(recorded: Where, source: Path) -> dict[str, Any]:
    """Return what the import has brought, from the runs that both recordings now have."""
    from webots_mcp.database.schema_migration import in_current_schema
    from webots_mcp.store.merging import settled

    with in_current_schema(source) as current:
        settled(current)  # first, so that no database is created for a file that is no recording
        return _merge_into(recorded, source, current)


def _merge_into(recorded: Where, source: Path, current: Path) -> dict[str, Any]:
    """Merge a settled recording; `current` is the source, or its copy in the current schema."""
    from webots_mcp.store.merging import merge

    with recorded.writer("import", {"source": source}, create=True) as (recording, connection):
        if isinstance(recording.database, Path) and source.samefile(recording.database):
            raise InvalidInputError(
                f"{source} is the recording that would be imported into. Choose another file."
            )
        (newest,) = connection.execute("SELECT coalesce(max(id), 0) FROM run").fetchone()
        changes = connection.total_changes
        runs = merge(connection, recording.data_dir, current, pictures=source.parent).values()
        runs = sorted(runs)
        return {
            "new_run_ids": [run_id for run_id in runs if run_id > newest],
            "known_run_ids": [run_id for run_id in runs if run_id <= newest],
            "changed": connection.total_changes > changes,
        }


def _imported(found: dict[str, Any], source: Path) -> str:
    """Return a sentence on what an import has brought."""
    new, known = found["new_run_ids"], found["known_run_ids"]
    was = "was" if len(known) == 1 else "were"
    before = f"{runs_named(known)} {was} imported before" if known else ""
    if new:
        return f"Imported {runs_named(new)} from {source}{'; ' if known else ''}{before}."
    if found["changed"]:
        what = "sessions without runs, or trials"
        return f"Imported no new run from {source}, but {what}{'; ' if known else ''}{before}."
    return f"Nothing new in {source}: {before or 'it has no runs'}."


def prune(
    *,
    dry_run: Annotated[
        bool, Parameter("--dry-run", help="Show what would be deleted, and delete nothing.")
    ] = False,
    limits: RetentionOptions = _UNLIMITED,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """Delete the oldest rows beyond the limits, and return the space to the disk.

        webots-mcp prune --keep-states 500MB --dry-run

    A LIMIT is a size (500MB), an age (30d), a number of rows (100000rows), several of these joined
    by commas, 'all' (no limit) or 'default'. Limits given here are stored in the database and
    apply to servers too; with --dry-run they are only tried.

    The oldest rows are deleted first, across all runs. Runs with a label or a note, and runs marked
    by 'webots-mcp retention', are never pruned and do not count; labels of trials do not protect a
    run. Robots may record meanwhile. The MCP server prunes in the same way every few seconds.
    """
    from webots_mcp.store.retention_limits import in_force, set_limits
    from webots_mcp.store.retention_plan import file_sizes, plan

    asked = limits.asked()

    def preview() -> None:
        with recorded.reader() as connection:
            wanted, sizes = plan(connection, in_force(connection, asked)), file_sizes(connection)
        disk = _on_disk(wanted, sizes)
        if json:
            return print_json({"dry_run": True, **_as_data(wanted), "disk_bytes": disk})
        _print_plan(wanted, "Would delete")
        _print_disk(disk)

    if dry_run:
        return past_wrong_values(preview)
    with recorded.writer("prune", asked) as (recording, connection):
        set_limits(connection, asked, "prune")
        retention = in_force(connection)
        wanted = plan(connection, retention)
        purged = _prune(recording, connection, retention)
    if json:
        done = {"freed_bytes": purged.freed_bytes, "notes": purged.problems}
        return print_json({"dry_run": False, **_as_data(wanted), **done})
    _print_plan(wanted, "Deleted", freed_bytes=purged.freed_bytes)
    print_notes(purged.problems)


def retention(
    *run_ids: Annotated[Id, Parameter("RUN", help="Run numbers, from 'webots-mcp runs'.")],
    release: Annotated[
        bool, Parameter("--release", help="Remove the mark from these runs.")
    ] = False,
    limits: RetentionOptions = _UNLIMITED,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """Mark runs that are never pruned, or set the limits for the others.

        webots-mcp retention 4 7 --keep-states 20GB

    A LIMIT is a size (500MB), an age (30d), a number of rows (100000rows), several of these joined
    by commas, 'all' (no limit) or 'default'. Limits are stored in the database and apply at once.
    'webots-mcp status --storage' shows them.
    """
    from webots_mcp.store.retention_limits import described, mark_kept, set_limits

    asked = limits.asked()
    if not run_ids and not asked:
        raise InvalidInputError(
            "Nothing to change: no run and no limit was given. Name runs to keep, such as "
            "'webots-mcp "
            "retention 4', or a limit, such as --keep-states 20GB."
        )
    given = {"run_ids": run_ids, "release": release, **asked}
    with recorded.writer("retain", given) as (_, connection):
        mark_kept(connection, run_ids, keep=not release)
        set_limits(connection, asked, "retain")
        if json:
            done = {"run_ids": run_ids, "retained": not release} if run_ids else {}
            return print_json({**done, "limits": described(connection)})
    ids = [*run_ids]
    if ids and release:
        print(f"Removed the mark from {runs_named(ids)}: retention applies again.")
    elif ids:
        print(f"Marked {runs_named(ids)}: never pruned.")
    if asked:
        print("Limits are set; 'webots-mcp status --storage' shows them.")


def _prune(
    recording: RecordingAccess, connection: sqlite3.Connection, retention: Retention
) -> Purged:
    """Purge, while a maintainer keeps the log of the database short."""
    from webots_mcp.database.connection import CHECKPOINT_TIMEOUT_MS
    from webots_mcp.database.maintenance import Maintainer
    from webots_mcp.store.purge import prune as purge
    from webots_mcp.store.robots import list_robots

    assert isinstance(recording.database, Path)
    connection.execute(f"PRAGMA busy_timeout={CHECKPOINT_TIMEOUT_MS}")
    live = any(robot.live for robot in list_robots(connection, time.time()))
    # idle while a server or a bridge is the maintainer
    maintainer = Maintainer(recording.database, "prune")
    maintainer.start()
    try:
        with shown_progress("pruning") as progress:
            return purge(connection, recording.data_dir, retention, rest=live, progress=progress)
    finally:
        maintainer.stop()


def _as_data(wanted: Plan) -> dict[str, Any]:
    """Return what is deleted and what stays, for programs."""
    return {
        "goes": [
            {
                "table": table, "row_count": rows, "size_bytes": wanted.size_of(table),
                "run_ids": wanted.runs_of(table),
            }
            for table, rows in wanted.rows_by_table().items()
        ],
        "spared": [vars(each) for each in wanted.spared],
        "retained": {"run_ids": wanted.kept_run_ids, "size_bytes": wanted.kept_bytes},
    }  # fmt: skip


def _print_plan(wanted: Plan, done: str, *, freed_bytes: int = 0) -> None:
    """Print what was or would be deleted: first in a sentence, then by kind of row."""
    from webots_mcp.store.retention_limits import size_text

    rows = wanted.rows_by_table()
    total, size = sum(rows.values()), size_text(sum(map(wanted.size_of, rows)))
    freed = f"; the file is {size_text(freed_bytes)} smaller" if freed_bytes else ""
    if rows:
        print(f"{done} {total:,} row{'s' * (total != 1)} beyond the limits, about {size}{freed}.")
    else:
        print(f"Nothing is beyond the limits{freed}.")
    table = [
        [kind, rows[kind], size_text(wanted.size_of(kind)), id_ranges(wanted.runs_of(kind))]
        for kind in rows
    ]
    if table:
        print_table(("kind", "rows", "size", "runs"), table)
    print_notes(
        [
            f"beyond the limit, but kept: {each.rows} rows of {each.table}, about "
            f"{size_text(each.size_bytes)}, {each.why}"
            for each in wanted.spared
        ]
    )
    if wanted.kept_run_ids:
        kept, size = runs_named(wanted.kept_run_ids), size_text(wanted.kept_bytes)
        why = "kept because of a label, a note or a mark, and not counted"
        print_notes([f"{why}: {kept}, about {size}"])


def _on_disk(wanted: Plan, sizes: dict[str, int]) -> dict[str, Any]:
    """Return what takes space on the disk, in bytes; limits count rows only."""
    held = dict(wanted.held_bytes)
    beside = {"pictures": held.pop("image"), "log": sizes["log_beside_bytes"]}
    free = sizes["free_in_file_bytes"]
    rest = max(sizes["file_bytes"] - free - sum(held.values()), 0)
    inside = {**{f"{kind}s": size for kind, size in held.items()}, "free": free}
    inside["signals, runs, commands"] = rest
    return {"file": sizes["file_bytes"], "in_file": inside, "beside": beside}


def _print_disk(disk: dict[str, Any]) -> None:
    from webots_mcp.store.retention_limits import size_text

    def sized(sizes: dict[str, int]) -> str:
        return ", ".join(f"{name} {size_text(size)}" for name, size in sizes.items())

    parts, others = sized(disk["in_file"]), sized(disk["beside"])
    print_notes([f"the file takes {size_text(disk['file'])}: {parts}; next to it {others}"])


# -- a recording as lines that follow it, and as a picture --


@only_reading
def tail(
    *,
    limit: Annotated[
        int,
        Parameter(
            "-n",
            metavar="N",
            help="Number of earlier lines to start with. Default: 10.",
            converter=whole_number,
            validator=Number(gte=0),
        ),
    ] = 10,
    robot: Annotated[
        str | None,
        Parameter("--robot", metavar="NAME", help="Follow only this robot. Default: all robots."),
    ] = None,
    interval_s: Annotated[
        float,
        Parameter(
            "--interval",
            metavar="S",
            help="Seconds between two reads of the recording. Default: 0.5.",
            validator=Number(gt=0),
        ),
    ] = 0.5,
    no_follow: Annotated[
        bool, Parameter("--no-follow", negative=(), help="Print the last lines and stop.")
    ] = False,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Follow a recording live: states, log lines, events and commands, until Ctrl-C.

        webots-mcp tail -n 20 --robot rover

    Shows the newest state of each robot at every read, and all other lines. Stops after the last
    lines if the recording cannot grow. With --json each line is an object.
    """
    from webots_mcp.store.logs import Follower
    from webots_mcp.store.robots import resolve_robot

    with recorded.reader() as connection:
        found = robot and resolve_robot(connection, robot, time.time())
        follower = Follower(connection, found.id if found else None)
        following = not no_follow and recorded.may_change()
        subject = found.name if found else "all robots"
        where = f"{subject} in {recorded.recording().database}"
        if following:
            print(f"webots-mcp: following {where}; Ctrl-C stops it", file=sys.stderr, flush=True)
        _print_lines(follower.read_new(limit), as_json=json)
        while following:
            wait(interval_s)
            recorded.recording().ingest()
            _print_lines(_newest_states_only(follower.read_new()), as_json=json)


def _print_lines(lines: Sequence[FollowedLine], *, as_json: bool) -> None:
    for line in lines:
        if as_json:
            print(json.dumps(line._asdict(), ensure_ascii=False), flush=True)
            continue
        clock = time.strftime("%H:%M:%S", time.localtime(line.wall_time_s))
        at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
        print(printable(f"{clock} {line.robot} {at:>11} {line.kind:<8} {line.text}"), flush=True)


def _newest_states_only(lines: Sequence[FollowedLine]) -> list[FollowedLine]:
    """Keep only the newest state of each robot; a hundred a second would hide the rest."""
    newest = {line.robot: line for line in lines if line.kind == "state"}
    return [line for line in lines if line.kind != "state" or newest[line.robot] is line]


def plot(
    *signals: Annotated[str, Parameter("SIGNAL", help="Signals to draw; '*' means any text.")],
    output: Annotated[
        Path, Parameter(("-o", "--output"), metavar="FILE", help="File to write: .png or .svg.")
    ],
    trajectory: Annotated[
        bool,
        Parameter("--trajectory", negative=(), help="Draw the robot's path, seen from above."),
    ] = False,
    run_ids: Annotated[
        list[str] | None,
        Parameter(
            "--runs",
            metavar="ID",
            negative=(),
            consume_multiple=True,
            help="Draw several runs over each other, such as --runs 3 4.",
        ),
    ] = None,
    trial_set: Annotated[
        Id | None,
        Parameter(
            "--trials",
            metavar="SET",
            help="Draw the scores of this trial set over one or two parameters, given as SIGNAL.",
        ),
    ] = None,
    score: Annotated[
        str | None,
        Parameter(
            "--score",
            metavar="SCORE",
            help="Draw this score over all runs, such as 'max(pose.x)'; reward: the sum of the "
            "published rewards.",
        ),
    ] = None,
    width_px: Annotated[
        Count, Parameter("--width", metavar="N", help="Width in pixels. Default: 900.")
    ] = 900,
    height_px: Annotated[
        Count, Parameter("--height", metavar="N", help="Height in pixels. Default: 500.")
    ] = 500,
    span: TimeRangeOptions | None = None,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Draw signals over time, the robot's path, or the scores of runs or trials.

        webots-mcp plot 'pose*' --last 10 -o pose.png

    Without SIGNAL it draws the signals that changed most.
    """
    if score is not None and (signals or trajectory or trial_set is not None):
        raise InvalidInputError(
            "--score draws a score over runs, and excludes SIGNAL, --trajectory and --trials. "
            "Leave those out."
        )
    is_range = score is not None
    from webots_mcp.questions.scored_runs import spelled_out

    ids, _ = spelled_out([each for each in run_ids or () if _is_id(each, ranges=is_range)])
    behind_runs = [each for each in run_ids or () if not _is_id(each, ranges=is_range)]

    def draw() -> None:
        from webots_mcp import plotting
        from webots_mcp.plotting.canvas import image_format_of

        make_chunks_first(recorded.recording())
        kind: plotting.PlotKind = "trajectory" if trajectory else "signals"
        with recorded.reader() as connection:
            picture = plotting.plot(
                connection,
                kind if score is None else "runs",
                [*signals, *behind_runs] if score is None else [score],
                scope=(span or TimeRangeOptions()).scope(),
                run_ids=ids or (),
                trial_set=trial_set,
                width_px=width_px,
                height_px=height_px,
                image_format=image_format_of(output),
            )
        write_picture(output, picture, as_json=json)

    past_wrong_values(draw)


def _is_id(text: str, *, ranges: bool = False) -> bool:
    """Return whether a text is the id of a run, or a range of ids; otherwise it is a signal."""
    return re.fullmatch(r"[0-9]+(-[0-9]+)?" if ranges else r"[0-9]+", text, re.ASCII) is not None


def write_picture(file: Path, picture: PlotImage, *, as_json: bool = False) -> None:
    """Write a picture as a private file, and describe it.

    Raises:
        InvalidInputError: The file cannot be written.
    """
    with placed(file) as aside:
        aside.write_bytes(picture.data)
    if as_json:
        return print_json(
            {"file": str(file), "caption": picture.caption, "notes": list(picture.notes)}
        )
    print(f"Wrote {file}: {printable(picture.caption)}")
    print_notes(picture.notes)
