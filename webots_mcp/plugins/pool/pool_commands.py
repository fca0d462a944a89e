"""Commands about a pool: what is in it, and runs of it brought back."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    JSON,
    Argument,
    argument,
    command,
    count,
    writing,
)
from webots_mcp.cli.progress import shown_progress
from webots_mcp.cli.tables import clock_text, id_ranges, print_notes, print_result, print_table

if TYPE_CHECKING:
    from webots_mcp.plugins.pool.catalogue import Choice
    from webots_mcp.plugins.pool.fetching import Fetched
    from webots_mcp.plugins.pool.target import Pool

_MOST_NAMED: Final = 3
_SHORT: Final = 8  # of a UUID: as much of it as tells one from the others
_CHOICE: Final[tuple[Argument, ...]] = (
    argument("--run", metavar="UUID", dest="run_uuid",
             help="the run of that UUID, or that begins so"),
    argument("--label", metavar="TEXT", help="runs with that label, with '*'"),
    argument("--trials", metavar="UUID", help="the runs of that trial set, and its trials"),
    argument("--robot", metavar="NAME", help="runs of that robot"),
    argument("--since", metavar="TIME",
             help="runs that went on after this wall time (ISO 8601 or Unix seconds)"),
    argument("--until", metavar="TIME", help="runs that began before this wall time"),
)  # fmt: skip


@command(
    "fetch", DATA_DIR, DATABASE, *_CHOICE,
    argument("--from", dest="url", metavar="URL", required=True,
             help="the pool: postgresql://HOST/DATABASE, a folder, s3://BUCKET/PREFIX, ..."),
)  # fmt: skip
def fetch(arguments: argparse.Namespace) -> int:
    """Bring runs of a pool back into a recording here, for every command, tool and plot.

    They come with their sessions, commands, trials and what was shipped of their pictures, each
    once however often it is fetched; what is here is left as it is. Of a run of which summaries
    were shipped and no rows, the summaries come, and every answer says so. A run that goes on or is
    still being shipped is not taken: fetch it again when it is whole.
    """
    from webots_mcp.plugins.pool.catalogue import meant
    from webots_mcp.plugins.pool.engines import open_pool
    from webots_mcp.plugins.pool.fetching import fetch as fetch_runs

    with open_pool(arguments.url) as pool:
        wanted = meant(pool, _choice(arguments))  # first: no database is made for nothing
        with (
            writing(arguments, create=True) as (here, connection),
            shown_progress("fetching") as progress,
        ):
            found = fetch_runs(pool, connection, here.data_dir, wanted, progress)
        _print_fetched(found, pool.address)
    return 0 if found.runs else 1


def _print_fetched(found: Fetched, address: str) -> None:
    def listed(uuids: Iterable[str]) -> str | None:
        return id_ranges([found.runs[uuid] for uuid in uuids])

    print(f"fetched from {address}: run {id_ranges(found.come) or 'none'}")
    if found.known:
        print(f"here already: run {listed(found.known)}")
    if found.summaries:
        print(
            f"of run {listed(found.summaries)} only summaries were shipped, no rows "
            "('webots-mcp ship --full' does)"
        )
    if found.unsummed:
        print(
            f"of run {listed(found.unsummed)} not even summaries of all rows: those were not made "
            "where it was recorded, which a server does ('webots-mcp serve')"
        )
    if found.nameless:
        print(f"not taken: {found.nameless} runs without a UUID, which every bridge of today gives")
    if found.going_on:
        print(f"not taken: {_named(found.going_on)} goes on, or nobody has shipped its end")
    if found.arriving:
        print(
            f"not taken: {_named(found.arriving)} is not wholly shipped yet; where it was recorded "
            "'webots-mcp ship' goes on, as it was given before; then fetch it again"
        )


def _named(uuids: Sequence[str]) -> str:
    shown = ", ".join(uuids[:_MOST_NAMED])
    return f"run {shown}" + (f" and {len(uuids) - _MOST_NAMED} more" * (len(uuids) > _MOST_NAMED))


@command(
    "pool", JSON, *_CHOICE,
    argument("url", metavar="URL", help="postgresql://HOST/DATABASE, a folder, s3://..."),
    argument("part", nargs="?", choices=("robots", "runs", "trials", "sizes"), default="robots",
             help="what to list (robots)"),
    argument("--sql", metavar="SELECT", help="one SELECT in the language of the pool, in quotes"),
    count("-n", "the newest N, or N rows (of a SELECT up to 1000)", default=20, dest="max_rows"),
)  # fmt: skip
def pool(arguments: argparse.Namespace) -> None:
    """List what is in a pool, or ask it one SELECT; nothing is changed.

    A SELECT ends after a minute, and its values are cut to 200 characters.

    webots-mcp pool ./pool runs --robot rover

    webots-mcp pool postgresql:///lab --sql 'SELECT count(*) FROM run'
    """
    from webots_mcp.plugins.pool.engines import open_pool

    with open_pool(arguments.url) as opened:
        if arguments.sql is not None:
            found = opened.select(arguments.sql, arguments.max_rows)
            return print_result(found, as_json=arguments.json)
        return _LISTS[arguments.part](opened, arguments)


def _print_robots(pool: Pool, arguments: argparse.Namespace) -> None:
    from webots_mcp.plugins.pool.catalogue import chosen_runs, robots

    found = robots(chosen_runs(pool, _choice(arguments)))
    shown = found[: arguments.max_rows]
    if arguments.json:
        return _print({"robots": [vars(robot) for robot in shown], "total": len(found)})
    print_table(
        ("robot", "recordings", "runs", "rows", "first", "last"),
        [
            [
                each.robot, each.recordings, each.runs, each.rows,
                clock_text(each.started_wall_time_s), clock_text(each.last_wall_time_s),
            ]
            for each in shown
        ],
    )  # fmt: skip
    _say_more(shown, found, "robots")


def _print_runs(pool: Pool, arguments: argparse.Namespace) -> None:
    from webots_mcp.plugins.pool.catalogue import chosen_runs

    found = chosen_runs(pool, _choice(arguments))[::-1]
    shown = found[: arguments.max_rows]
    if arguments.json:
        return _print({"runs": [vars(run) for run in shown], "total": len(found)})
    print_table(
        ("run", "robot", "label", "started", "duration_s", "rows", "ended by", "recording"),
        [
            [
                run.uuid[:_SHORT], run.robot, run.label, clock_text(run.started_wall_time_s),
                run.last_sim_time_s - run.started_sim_time_s, run.rows,
                run.end_reason or "going on", run.recording_uuid[:_SHORT],
            ]
            for run in shown
        ],
    )  # fmt: skip
    _say_more(shown, found, "runs")


def _print_trials(pool: Pool, arguments: argparse.Namespace) -> None:
    from webots_mcp.plugins.pool.catalogue import chosen_trial_sets

    found = chosen_trial_sets(pool, _choice(arguments))[::-1]
    shown = found[: arguments.max_rows]
    if arguments.json:
        return _print({"trial_sets": [vars(each) for each in shown], "total": len(found)})
    print_table(
        ("set", "made", "trials", "runs", "recording"),
        [
            [
                each.uuid[:_SHORT], clock_text(each.created_wall_time_s), each.trials,
                len(each.runs), each.recording_uuid[:_SHORT],
            ]
            for each in shown
        ],
    )  # fmt: skip
    _say_more(shown, found, "trial sets")


def _print_sizes(pool: Pool, arguments: argparse.Namespace) -> None:
    from webots_mcp.store.retention.notation import size_text

    found = list(pool.sizes())
    if arguments.json:
        return _print({"tables": [vars(each) for each in found]})
    sizes = [each.size_bytes for each in found if each.size_bytes is not None]
    rows: list[list[Any]] = [
        [each.table, each.rows, None if each.size_bytes is None else size_text(each.size_bytes)]
        for each in found
    ]
    print_table(("table", "rows", "size"), rows)
    print_notes([f"{size_text(sum(sizes))} in all"] if sizes else [])


_LISTS: Final = {
    "robots": _print_robots, "runs": _print_runs, "trials": _print_trials, "sizes": _print_sizes,
}  # fmt: skip


def _choice(arguments: argparse.Namespace) -> Choice:
    from webots_mcp.plugins.pool.catalogue import Choice

    return Choice(**{each.name: getattr(arguments, each.name) for each in fields(Choice)})


def _say_more(shown: Sequence[object], found: Sequence[object], what: str) -> None:
    print_notes([f"{len(found)} {what} in all: -n shows more"] if len(found) > len(shown) else [])


def _print(found: dict[str, Any]) -> None:
    print(json.dumps(found, ensure_ascii=False, default=str))
