"""Shipping a recording to a pool of many."""

from __future__ import annotations

import argparse
import functools
import math
import sys
from typing import TYPE_CHECKING

from webots_mcp.cli.command import DATA_DIR, DATABASE, argument, command, open_recording
from webots_mcp.cli.tables import print_notes
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.plugins.pool.report import Report


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.1 <= seconds <= 86_400:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number of seconds, 0.1 to 86400")
    return seconds


@command(
    "ship", DATA_DIR, DATABASE,
    argument("--to", metavar="URL", action="append", required=True, dest="urls",
             help="the pool: postgresql://[USER@]HOST/DATABASE, a folder, or s3://BUCKET/PREFIX "
             "and the like"),
    argument("--follow", action="store_true", help="go on with what comes, until Ctrl-C"),
    argument("--full", action="store_true",
             help="ship all states; else only those of kept stretches, and the rollups of all"),
    argument("--pictures", action="store_true", help="ship the files of pictures as well"),
    argument("--every", type=_seconds, metavar="SECONDS", dest="pause_s",
             help="with --follow, how long to wait between two looks (2; for files 60)"),
)  # fmt: skip
def ship(arguments: argparse.Namespace) -> None:
    """Ship a recording to a pool, where the recordings of many machines are.

    The pool is a PostgreSQL database, or a dataset of Parquet files in a folder or an object store.
    The recording is only read, but that runs whose process was killed are ended. What the pool has
    is not sent again, so that this may be killed and started again at any time; a run that another
    recording has shipped stays that one's.

    Runs, commands, events, log lines, parameters, trials, rollups and kept stretches are shipped,
    with --full each state. A password comes from PGPASSWORD, ~/.pgpass or a service file, never
    from the URL.
    """
    from webots_mcp.plugins.pool.engines import open_target, pause_of
    from webots_mcp.plugins.pool.following import follow
    from webots_mcp.plugins.pool.report import Report
    from webots_mcp.plugins.pool.shipping import Order
    from webots_mcp.plugins.pool.shipping import ship as ship_once
    from webots_mcp.plugins.pool.target import redacted

    if len(arguments.urls) > 1:
        raise InvalidInputError(
            f"--to is given {len(arguments.urls)} times: one call ships to one pool; start another "
            "for the other"
        )
    if arguments.pause_s is not None and not arguments.follow:
        raise InvalidInputError("--every is for --follow: without it, everything is shipped once")
    (url,) = arguments.urls
    connect = functools.partial(open_target, url)
    order = Order(open_recording(arguments), connect, arguments.full, arguments.pictures)
    report, is_done = Report(), False
    try:
        if arguments.follow:
            _say(f"shipping to {redacted(url)} until Ctrl-C")
            follow(order, report, _say, arguments.pause_s or pause_of(url))
        else:
            ship_once(order, report)
            is_done = True
    finally:
        _print_report(redacted(url), report, is_done=is_done)


def _say(text: str) -> None:
    print(f"webots-mcp: {text}", file=sys.stderr, flush=True)


def _print_report(address: str, report: Report, *, is_done: bool) -> None:
    sent = [f"{table} {rows}" for table, rows in sorted(report.rows.items()) if rows]
    sent += [f"pictures {report.pictures}"] if report.pictures else []
    if sent:
        print(f"sent to {address}: {', '.join(sent)}")
    elif is_done:
        print(f"{address} has everything already")
    print_notes([*_notes(report), *report.notes])


def _notes(report: Report) -> list[str]:
    notes: list[str] = []
    if lost := [f"{table} {rows}" for table, rows in sorted(report.lost.items()) if rows]:
        notes.append(f"rows deleted before they could be shipped: {', '.join(lost)}")
    if report.replaced:
        altered = [f"{column} {values}" for column, values in sorted(report.replaced.items())]
        notes.append(
            "values that the pool cannot hold, in whose place is what comes nearest: "
            + ", ".join(altered)
        )
    if report.lost_pictures:
        notes.append(f"pictures that are not there any more: {report.lost_pictures}")
    for recording in sorted(set(report.foreign.values())):
        runs = [uuid for uuid, owner in report.foreign.items() if owner == recording]
        notes.append(
            f"{len(runs)} runs are left to the recording {recording}, which shipped them before"
        )
    return notes
