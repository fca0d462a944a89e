"""The commands of pools: `pool` lists or queries, `ship` writes and `fetch` reads back."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

from cyclopts.validators import Number

from webots_mcp.cli.options import HERE, Count, Json, Parameter, Where
from webots_mcp.cli.streams import shown_activity, shown_progress
from webots_mcp.cli.terminal import (
    clock_text,
    print_json,
    print_notes,
    print_table,
    runs_named,
)
from webots_mcp.errors import InvalidInputError, WebotsMCPError
from webots_mcp.plugins.pool.pool_contents import (
    RunFilter,
    chosen_runs,
    chosen_trial_sets,
    resolve_filter,
    robots,
)

if TYPE_CHECKING:
    from webots_mcp.plugins.pool.fetching import FetchResult
    from webots_mcp.plugins.pool.pool_interface import Pool
    from webots_mcp.plugins.pool.shipping import ShippingReport
    from webots_mcp.store.sql import SqlResult

_MOST_NAMED: Final = 3
_SHORT: Final = 8  # Characters of a UUID that tell it from others.
_ALL: Final = RunFilter()


def fetch(
    *,
    url: Annotated[
        str,
        Parameter(
            "--from",
            metavar="URL",
            help="Pool: a folder, postgresql://HOST/DATABASE or s3://BUCKET/PREFIX.",
        ),
    ],
    choice: RunFilter = _ALL,
    recorded: Where = HERE,
    json: Json = False,
) -> int:
    """Fetch runs from a pool into a local recording.

        webots-mcp fetch --from ./pool --label baseline

    Runs come with their sessions, commands, trials and shipped pictures. Fetching again changes
    nothing. If only chunks of a run were shipped, the values of all its signals come, but no
    states. Runs that are still recording or being shipped are skipped; fetch them later.
    """
    from webots_mcp.plugins.pool.fetching import fetch as fetch_runs
    from webots_mcp.plugins.pool.pool_contents import open_pool

    with open_pool(url) as pool:
        wanted = resolve_filter(pool, choice)  # First, so that no database is made in vain.
        with (
            recorded.writer("fetch", create=True) as (here, connection),
            shown_progress("fetching") as progress,
        ):
            found = fetch_runs(pool, connection, here.data_dir, wanted, progress)
        if json:
            print_json({"pool": pool.address, **_as_data(found)})
        else:
            _print_fetched(found, pool.address)
    return 0 if found.runs else 1


def _as_data(found: FetchResult) -> dict[str, Any]:
    """Return the ids of fetched runs, and the UUIDs of runs that were not fetched."""
    return {
        "fetched_run_ids": found.come,
        "known_run_ids": [found.runs[uuid] for uuid in found.known],
        "only_chunks_run_ids": [found.runs[uuid] for uuid in found.only_chunks],
        "incomplete_chunks_run_ids": [found.runs[uuid] for uuid in found.unchunked],
        "not_taken": {
            "going_on": found.going_on,
            "not_wholly_shipped": found.arriving,
        },
    }


def _print_fetched(found: FetchResult, address: str) -> None:
    def runs(uuids: Iterable[str]) -> str:
        return runs_named([found.runs[uuid] for uuid in uuids])

    print(f"Fetched {runs_named(found.come) if found.come else 'no new run'} from {address}.")
    if found.known:
        print(f"Already in this recording: {runs(found.known)}.")
    if found.only_chunks:
        print(
            f"Only chunks were shipped of {runs(found.only_chunks)}, and no states. To ship states "
            "use 'webots-mcp ship --full'."
        )
    if found.unchunked:
        print(
            f"Some rows are missing in {runs(found.unchunked)}: retention had deleted them, or the "
            "recording was read-only when it was shipped. 'webots-mcp ship --full' ships the rows "
            "that still exist."
        )
    if found.going_on:
        print(f"Skipped {_named(found.going_on)}: still recording, or its end was not shipped yet.")
    if found.arriving:
        print(
            f"Skipped {_named(found.arriving)}: only partly shipped. Repeat 'webots-mcp ship' on "
            "the machine that recorded it, then fetch again."
        )


def _named(uuids: Sequence[str]) -> str:
    shown = ", ".join(uuids[:_MOST_NAMED])
    return f"run {shown}" + (f" and {len(uuids) - _MOST_NAMED} more" * (len(uuids) > _MOST_NAMED))


def pool(
    url: Annotated[
        str,
        Parameter("URL", help="Pool: a folder, postgresql://HOST/DATABASE or s3://BUCKET/PREFIX."),
    ],
    part: Annotated[
        Literal["robots", "runs", "trials"],
        Parameter("PART", help="What to list. Default: robots."),
    ] = "robots",
    /,
    *,
    sql: Annotated[
        str | None,
        Parameter(
            "--sql",
            metavar="SELECT",
            help="Run this SELECT, in the SQL of the pool (PostgreSQL or DuckDB).",
        ),
    ] = None,
    max_rows: Annotated[
        Count,
        Parameter(
            "-n", metavar="N", help="Maximum number of rows, up to 1000 with --sql. Default: 20."
        ),
    ] = 20,
    choice: RunFilter = _ALL,
    json: Json = False,
) -> None:
    """List robots, runs or trials in a pool, or run one SELECT on it. Changes nothing.

    A SELECT is stopped after 60 s; over Parquet files after 20 s or 1 GB of memory. Values are cut
    to 200 characters.

        webots-mcp pool ./pool runs --robot rover

        webots-mcp pool postgresql:///lab --sql 'SELECT count(*) FROM run'
    """
    from webots_mcp.plugins.pool.pool_contents import open_pool

    with open_pool(url) as opened:
        if sql is not None:
            answer = opened.select(sql, max_rows)
            return print_json(asdict(answer)) if json else _print_answer(answer)
        listed = _listed(opened, part, choice)
        address = opened.address
    total = len(listed.found)
    if json:
        shown = [vars(each) for each in listed.found[:max_rows]]
        return print_json({listed.key: shown, "total": total})
    kind = listed.key.replace("_", " ").removesuffix("s" if total == 1 else "")
    more = f", the first {max_rows} of which are shown (-n shows more)" * (total > max_rows)
    print(f"{total or 'No'} {kind} in {address}{more}.")
    if total:
        print_table(listed.columns, listed.rows[:max_rows])


class _List(NamedTuple):
    """A list of what a pool holds: its name in JSON, its items, and its table."""

    key: str
    found: Sequence[object]
    columns: tuple[str, ...]
    rows: Sequence[list[Any]]


def _listed(pool: Pool, part: str, choice: RunFilter) -> _List:
    if part == "robots":
        found = robots(chosen_runs(pool, choice))
        columns = ("robot", "recordings", "runs", "rows", "first", "last")
        rows: list[list[Any]] = [
            [
                each.robot, each.recordings, each.runs, each.row_count,
                clock_text(each.started_wall_time_s), clock_text(each.last_wall_time_s),
            ]
            for each in found
        ]  # fmt: skip
        return _List("robots", found, columns, rows)
    if part == "trials":
        sets = chosen_trial_sets(pool, choice)[::-1]
        columns = ("set", "made", "trials", "runs", "recording")
        rows = [
            [
                each.uuid[:_SHORT], clock_text(each.created_wall_time_s), each.trials,
                len(each.runs), each.recording_uuid[:_SHORT],
            ]
            for each in sets
        ]  # fmt: skip
        return _List("trial_sets", sets, columns, rows)
    runs = chosen_runs(pool, choice)[::-1]
    columns = ("run", "robot", "label", "started", "duration_s", "rows", "ended by", "recording")
    rows = [
        [
            run.uuid[:_SHORT], run.robot, run.label, clock_text(run.started_wall_time_s),
            run.last_sim_time_s - run.started_sim_time_s, run.row_count,
            run.end_reason or "going on", run.recording_uuid[:_SHORT],
        ]
        for run in runs
    ]  # fmt: skip
    return _List("runs", runs, columns, rows)


def _print_answer(answer: SqlResult) -> None:
    rows = [["NULL" if cell is None else cell for cell in row] for row in answer.rows]
    print_table(answer.columns, rows)
    cut = f"{answer.shortened} long values are cut" if answer.shortened else None
    print_notes(filter(None, (answer.truncated, cut, None if rows else "no row")))


def ship(
    *,
    urls: Annotated[
        list[str],
        Parameter(
            "--to",
            metavar="URL",
            help="Pool: a folder, postgresql://[USER@]HOST/DATABASE or s3://BUCKET/PREFIX.",
        ),
    ],
    follow: Annotated[
        bool, Parameter("--follow", help="Keep shipping new rows until Ctrl-C.")
    ] = False,
    full: Annotated[
        bool,
        Parameter(
            "--full",
            help="Ship every state. Default: chunks of all states, and full-rate segments.",
        ),
    ] = False,
    pictures: Annotated[
        bool, Parameter("--pictures", help="Also ship the files of pictures and tapes.")
    ] = False,
    pause_s: Annotated[
        float | None,
        Parameter(
            "--every",
            metavar="S",
            validator=Number(gte=0.1, lte=86_400),
            help="With --follow: seconds between two shipments. Default: 2 for PostgreSQL, 60 for "
            "files.",
        ),
    ] = None,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """Ship a recording to a pool, which collects recordings of many machines.

        webots-mcp ship --to postgresql://HOST/lab --follow

    A pool is a PostgreSQL database, or a set of Parquet files in a folder or an object store. Rows
    that the pool already has are not sent again, so this can be stopped and restarted at any time.
    A run that was shipped from another recording is left to that recording.

    Ships runs, commands, events, log lines, parameters, trials, chunks and full-rate segments. The
    only change to the recording is that runs of killed processes are marked as ended. Passwords
    come from PGPASSWORD, ~/.pgpass or a service file, never from the URL.
    """
    from webots_mcp.plugins.pool.pool_contents import is_postgres, open_pool
    from webots_mcp.plugins.pool.pool_interface import redacted
    from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport
    from webots_mcp.plugins.pool.shipping import follow as follow_recording
    from webots_mcp.plugins.pool.shipping import ship as ship_once

    if len(urls) > 1:
        raise InvalidInputError(
            f"--to was given {len(urls)} times, but one command ships to one pool. Start one "
            f"command "
            "per pool."
        )
    if pause_s is not None and not follow:
        raise InvalidInputError(
            "--every applies only to --follow: without it, everything is shipped once. Add "
            "--follow."
        )
    (url,) = urls
    connect = functools.partial(open_pool, url, ships=True)
    order = ShippingJob(recorded.recording(), connect, full, pictures)
    report, is_done = ShippingReport(), False
    try:
        if follow:
            _say(f"shipping to {redacted(url)} until Ctrl-C")
            default_s = (
                2.0 if is_postgres(url) else 60.0
            )  # Shorter pauses would make many small files.
            follow_recording(order, report, _say, pause_s or default_s)
        else:
            with shown_activity(f"shipping to {redacted(url)}"):
                ship_once(order, report)
            is_done = True
    finally:
        is_reported = json and isinstance(sys.exc_info()[1], WebotsMCPError)  # As the only object.
        if not is_reported:
            _show_report(redacted(url), report, is_done=is_done, as_json=json)


def _say(text: str) -> None:
    print(f"webots-mcp: {text}", file=sys.stderr, flush=True)


def _show_report(address: str, report: ShippingReport, *, is_done: bool, as_json: bool) -> None:
    notes = [*_notes(report), *report.notes]
    if as_json:
        return print_json({"pool": address, "complete": is_done, **vars(report), "notes": notes})
    sent = [f"{table} {rows}" for table, rows in sorted(report.rows.items()) if rows]
    sent += [f"pictures {report.pictures}"] if report.pictures else []
    if sent:
        print(f"Shipped to {address}: {', '.join(sent)}.")
    elif is_done:
        print(f"Nothing to ship: {address} already has everything.")
    print_notes(notes)


def _notes(report: ShippingReport) -> list[str]:
    notes: list[str] = []
    if lost := [f"{table} {rows}" for table, rows in sorted(report.lost.items()) if rows]:
        notes.append(f"rows deleted before they could be shipped: {', '.join(lost)}")
    if report.replaced:
        altered = [f"{column} {values}" for column, values in sorted(report.replaced.items())]
        notes.append(
            "values that the pool cannot hold, replaced by the nearest ones: " + ", ".join(altered)
        )
    if report.lost_pictures:
        notes.append(f"missing picture files: {report.lost_pictures}")
    for recording in sorted(set(report.foreign.values())):
        runs = [uuid for uuid, owner in report.foreign.items() if owner == recording]
        notes.append(
            f"{len(runs)} runs were skipped: the recording {recording} shipped them before"
        )
    return notes
