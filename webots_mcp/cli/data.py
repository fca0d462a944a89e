"""Commands about the recording as a file: taking data out, in, and away."""

from __future__ import annotations

import argparse
import functools
import sqlite3
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    argument,
    command,
    open_recording,
    past_invalid_rows,
    past_wrong_values,
    reading,
    row_id,
    writing,
)
from webots_mcp.cli.limits import LIMITS, limits_of
from webots_mcp.cli.progress import shown_progress
from webots_mcp.cli.ranges import RANGE, range_of, scope_of
from webots_mcp.cli.tables import id_ranges, print_notes, print_table
from webots_mcp.cli.terminal import binary_stdout
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins import export_formats

if TYPE_CHECKING:
    from webots_mcp.store.recording import Recording
    from webots_mcp.store.retention.planning import Plan
    from webots_mcp.store.retention.policy import Retention
    from webots_mcp.store.retention.purge import Purged


@command(
    "export", DATA_DIR, DATABASE, *RANGE,
    argument("-o", "--output", metavar="FILE",
             help="a .csv, .jsonl, .parquet, .mcap, .rrd or .zip file (default: CSV to stdout)"),
    argument("--format", choices=("csv", "jsonl", *(each.name for each in export_formats()), "zip"),
             help="where the file's name does not tell it"),
    argument("--safe-cells", action="store_true",
             help="in CSV, an apostrophe before texts that a spreadsheet would run as a formula "
             "(they begin with =, +, - or @)"),
    argument("--trials", type=row_id, dest="trial_set", metavar="SET",
             help="the trials of that set instead, one row each, with score, rank and spread"),
)  # fmt: skip
def export(arguments: argparse.Namespace) -> None:
    """Write recorded states as a table, or all of a run for a viewer or for another recording.

    The newest run is written, or a range; --since 0 writes all runs of a robot. A table has one row
    per state; columns are run, row, times, and the dotted names of what the controller published;
    NaN and infinity are kept. A .mcap (Foxglove, Lichtblick, PlotJuggler) or .rrd file (Rerun) has
    states, poses, pictures, log lines, events and commands. A .zip file is a bundle: a run that is
    over, as a recording of its own with its pictures, which 'webots-mcp import' takes in. Parquet
    needs pyarrow, MCAP mcap, and Rerun rerun-sdk; the line that installs them is printed.
    """
    from webots_mcp.store.export import (
        BUNDLE,
        FOR_VIEWERS,
        FORMATS,
        TrialTable,
        export_file,
        format_of,
    )
    from webots_mcp.store.export import export as write
    from webots_mcp.store.reading.ranges import Scope

    file = Path(arguments.output) if arguments.output not in (None, "-") else None
    form = arguments.format or (format_of(file) if file else "csv")
    if arguments.trial_set is not None and scope_of(arguments) != Scope():
        raise InvalidInputError("give --trials or a range of states, not both")
    recording = open_recording(arguments)
    if file and isinstance(recording.database, Path) and file.resolve() == recording.database:
        raise InvalidInputError(f"{file} is the recording itself: choose another file")
    if form in (*FOR_VIEWERS, BUNDLE):
        return _export_whole(arguments, recording, file, form)
    if file is None and not FORMATS[form].is_text and sys.stdout.isatty():
        raise InvalidInputError(f"{form} is not for a terminal: give a file with -o")

    def run() -> None:
        with reading(arguments) as connection, shown_progress("exporting") as progress:
            safe = arguments.safe_cells
            if arguments.trial_set is not None:
                wanted = TrialTable.of(connection, arguments.trial_set)
            else:
                wanted = range_of(connection, arguments)
            if file is None:
                write(connection, wanted, form, binary_stdout(), progress, safe_cells=safe)
            else:
                rows = export_file(connection, wanted, form, file, progress, safe_cells=safe)
                print(f"{file}: {rows} rows")
        print_notes(wanted.notes, sys.stderr)  # stdout may be the table

    # What went to stdout cannot be taken back: there each row is looked at first.
    past_invalid_rows(run) if file is None else past_wrong_values(run)


def _export_whole(
    arguments: argparse.Namespace, recording: Recording, file: Path | None, form: str
) -> None:
    from webots_mcp.store.export import BUNDLE, FORMATS

    if file is None:
        raise InvalidInputError(f"{form} is not for stdout: give a file with -o")
    if arguments.trial_set is not None:
        raise InvalidInputError(f"trials are a table: choose {' or '.join(FORMATS)}, not {form}")
    if form == BUNDLE:
        return _export_bundle(arguments, recording, file)
    past_wrong_values(functools.partial(_export_for_viewers, arguments, recording, file, form))


def _export_for_viewers(
    arguments: argparse.Namespace, recording: Recording, file: Path, form: str
) -> None:
    from webots_mcp.store.export import export_for_viewers

    with reading(arguments) as connection, shown_progress("exporting") as progress:
        wanted = range_of(connection, arguments)
        written = export_for_viewers(connection, recording.data_dir, wanted, form, file, progress)
    told = ", ".join(f"{count} {kind}" for kind, count in written.counts.items() if count)
    print(f"{file}: {told}{written.beside and f'; {written.beside}'}")
    print_notes(wanted.notes, sys.stderr)


def _export_bundle(arguments: argparse.Namespace, recording: Recording, file: Path) -> None:
    from webots_mcp.store.bundle import write_bundle
    from webots_mcp.store.export import placed
    from webots_mcp.store.reading.ranges import Scope
    from webots_mcp.store.reading.subject import find_subject

    scope = scope_of(arguments)
    if scope != Scope(robot=scope.robot, run_id=scope.run_id):
        raise InvalidInputError("a bundle is a whole run: give --run or --robot, and no times")
    assert isinstance(recording.database, Path)
    with reading(arguments) as connection, shown_progress("packing") as progress:
        run_id = find_subject(connection, scope.robot, scope.run_id).run_id
        place = (recording.database, recording.data_dir, run_id)
        with placed(file) as aside:
            write_bundle(connection, *place, aside, progress)
    print(f"{file}: run {run_id}, {file.stat().st_size:,} bytes")


@command(
    "import", DATA_DIR, DATABASE,
    argument("source", metavar="SOURCE",
             help="a folder with status.json, logs/, camera/, ...; a recording, a webots.db; or a "
             "bundle, a .zip of 'webots-mcp export'"),
    argument("--robot", default="imported", metavar="NAME",
             help="the name to record under, which no robot may have yet (imported)"),
)  # fmt: skip
def import_(arguments: argparse.Namespace) -> None:
    """Import another recording, or the data folder of a bridge that writes JSON files.

    A recording that is over comes with all of its runs and trial sets, a bundle with its run; what
    is there already is left as it is, so that it may be imported again.

    Of such a folder status.json, logs/controller.log, camera/*.png, screenshots/*.png and
    commands.json become one finished run; if a file is damaged, nothing does. It has no simulation
    times: they are counted in seconds of wall time from its earliest entry.
    """
    from webots_mcp.store.json_folder import import_folder, read_folder

    if (source := Path(arguments.source)).is_file():
        return _import_file(arguments, source)
    read_folder(source)  # first: no database is made for what cannot be imported
    with writing(arguments, create=True) as (recording, connection):
        with shown_progress("importing") as progress:
            made = import_folder(connection, source, recording.data_dir, arguments.robot, progress)
        print(
            f"run {made.run_id} of robot {made.robot!r}: states {made.states}, log lines "
            f"{made.lines}, pictures {made.pictures}, commands {made.commands}"
        )


def _import_file(arguments: argparse.Namespace, file: Path) -> None:
    from webots_mcp.store.bundle import is_bundle, unpacked

    if not is_bundle(file):
        return _import_recording(arguments, file, file)
    with unpacked(file) as source:
        _import_recording(arguments, source, file)


def _import_recording(arguments: argparse.Namespace, source: Path, told: Path) -> None:
    from webots_mcp.store.merging import merge, settled

    settled(source)  # first: no database is made for what is no recording
    with writing(arguments, create=True) as (recording, connection):
        if isinstance(recording.database, Path) and source.samefile(recording.database):
            raise InvalidInputError(f"{source} is the recording itself: choose another file")
        (newest,) = connection.execute("SELECT coalesce(max(id), 0) FROM run").fetchone()
        changes = connection.total_changes
        runs = list(merge(connection, recording.data_dir, source).values())
        is_changed = connection.total_changes > changes
    print(f"{told}: {_taken_in(runs, newest, is_changed=is_changed)}")


def _taken_in(runs: list[int], newest_before: int, *, is_changed: bool) -> str:
    """What an import has brought, of the runs that are in both recordings now."""
    new = [run_id for run_id in runs if run_id > newest_before]
    before = [run_id for run_id in runs if run_id <= newest_before]
    known = f"run {id_ranges(before)} was here already" if before else ""
    if new:
        return f"new here: run {id_ranges(new)}" + (f"; {known}" if known else "")
    if is_changed:
        beside = f"; {known}" if known else ""
        return f"no run is new, but sessions without runs, or trials, are{beside}"
    return f"nothing is new{': ' if known else ', it has no runs'}{known}"


@command(
    "prune", DATA_DIR, DATABASE,
    argument("--dry-run", action="store_true", help="only tell what would go"), *LIMITS,
)  # fmt: skip
def prune(arguments: argparse.Namespace) -> None:
    """Delete what is beyond the limits, and give the space back to the disk.

    Rows go in the order in which they were recorded, whatever their run. Runs with a label (but
    that of a trial) or a note, and those marked by 'webots-mcp retain', lose nothing and do not
    count. A LIMIT is a size
    (500MB), an age (30d), a number of rows (100000rows), several of them with commas between; all,
    which keeps everything; or default. What is given belongs to the database from then on, and
    servers keep to it; with --dry-run it is only tried. A size or a number of rows always holds; an
    age spares the newest rows, as many as the options tell. Robots may record meanwhile. The MCP
    server does the same every few seconds.
    """
    from webots_mcp.store.retention.limits import in_force, set_limits
    from webots_mcp.store.retention.planning import plan
    from webots_mcp.store.retention.usage import file_sizes

    limits = limits_of(arguments)

    def look() -> None:
        with reading(arguments) as connection:
            wanted, sizes = plan(connection, in_force(connection, limits)), file_sizes(connection)
        _print_plan(wanted, "would go")
        _print_disk(wanted, sizes)

    if arguments.dry_run:
        return past_wrong_values(look)
    with writing(arguments) as (recording, connection):
        set_limits(connection, limits, "prune")
        retention = in_force(connection)
        _print_plan(plan(connection, retention), "goes")
        _print_purged(_prune(recording, connection, retention))


@command(
    "retain", DATA_DIR, DATABASE,
    argument("run_ids", type=row_id, nargs="*", metavar="RUN",
             help="as 'webots-mcp runs' lists them"),
    argument("--release", action="store_true", help="let retention have them again"), *LIMITS,
)  # fmt: skip
def retain(arguments: argparse.Namespace) -> None:
    """Mark runs that are never pruned, or set how much is kept of the others.

    The limits belong to the database and hold at once, whoever maintains it; 'default' goes back
    to what holds where nothing is set. 'webots-mcp status' shows them.
    """
    from webots_mcp.store.retention.limits import set_limits
    from webots_mcp.store.retention.policy import mark_kept

    limits = limits_of(arguments)
    if not arguments.run_ids and not limits:
        raise InvalidInputError("name runs to retain, or a limit to set: --keep-states 20GB")
    with writing(arguments) as (_, connection):
        mark_kept(connection, arguments.run_ids, keep=not arguments.release)
        set_limits(connection, limits, "retain")


def _prune(recording: Recording, connection: sqlite3.Connection, retention: Retention) -> Purged:
    """Purge, with somebody who keeps the log of the database short meanwhile."""
    from webots_mcp.connection import CHECKPOINT_TIMEOUT_MS
    from webots_mcp.maintenance import Maintainer
    from webots_mcp.store.retention.purge import prune as purge
    from webots_mcp.store.robots import list_robots

    assert isinstance(recording.database, Path)
    connection.execute(f"PRAGMA busy_timeout={CHECKPOINT_TIMEOUT_MS}")
    live = any(robot.live for robot in list_robots(connection, time.time()))
    maintainer = Maintainer(recording.database, "prune")  # idle while a server or a bridge is it
    maintainer.start()
    try:
        with shown_progress("pruning") as progress:
            return purge(connection, recording.data_dir, retention, rest=live, progress=progress)
    finally:
        maintainer.stop()


def _print_plan(wanted: Plan, going: str) -> None:
    from webots_mcp.store.retention.notation import size_text

    rows = wanted.rows_by_table()
    table = [
        [kind, rows[kind], size_text(wanted.size_of(kind)), id_ranges(wanted.runs_of(kind))]
        for kind in rows
    ]
    if table:
        print_table((going, "rows", "about", "runs"), table)
    else:
        print("nothing is beyond the limits")
    print_notes(
        [
            f"beyond the limit, but spared: {each.rows} rows of {each.table}, about "
            f"{size_text(each.size_bytes)}, {each.why}"
            for each in wanted.spared
        ]
    )
    print_notes(
        [
            f"goes although it is {each.why}: {each.rows} rows of {each.table}"
            for each in wanted.unshipped
        ]
    )
    if wanted.kept_run_ids:
        ids, size = id_ranges(wanted.kept_run_ids), size_text(wanted.kept_bytes)
        why = "kept because of a label, a note or a mark, and not counted"
        print_notes([f"{why}: run {ids}, about {size}"])


def _print_disk(wanted: Plan, sizes: dict[str, int]) -> None:
    """What lies on the disk: limits are about the rows, not about summaries and free room."""
    from webots_mcp.store.retention.notation import size_text

    held = dict(wanted.held_bytes)
    beside = {"pictures": held.pop("image"), "log": sizes["log_beside_bytes"]}
    free = sizes["free_in_file_bytes"]
    rest = max(sizes["file_bytes"] - free - sum(held.values()), 0)
    inside = {**{f"{kind}s": size for kind, size in held.items()}, "free": free}
    inside["summaries, runs, commands"] = rest
    parts = ", ".join(f"{name} {size_text(size)}" for name, size in inside.items())
    others = ", ".join(f"{name} {size_text(size)}" for name, size in beside.items())
    whole = size_text(sizes["file_bytes"])
    print_notes([f"the file has {whole}, about: {parts}; beside it {others}"])


def _print_purged(purged: Purged) -> None:
    from webots_mcp.store.retention.notation import size_text

    if purged.freed_bytes:
        print(f"{size_text(purged.freed_bytes)} of the database file freed")
    print_notes(purged.problems)
