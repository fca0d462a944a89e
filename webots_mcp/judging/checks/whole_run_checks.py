"""Checks of a run as a whole: its pace, its log, its end, its goal, and what was expected of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

from webots_mcp.errors import ConditionFailedError
from webots_mcp.judging.checks.check import (
    Examined,
    RunUnderCheck,
    times,
    total_s,
)
from webots_mcp.judging.detection.condition import (
    NONE_EXPECTED,
    Adherence,
    judge_expectation,
)
from webots_mcp.judging.detection.event import NotSearchableError
from webots_mcp.judging.detection.pace import SLOW, SLOW_SIMULATION, PacePart, pace_of, together
from webots_mcp.judging.verdicts import Coverage, Fault
from webots_mcp.signals.conditions.expectation import Expectation
from webots_mcp.signals.meaning import DECLARED_WORDS, declaration_of
from webots_mcp.signals.naming import counted, listed
from webots_mcp.store.recording import waiting_rows_note
from webots_mcp.store.sessions import fetch_session

_MOST_PARTS: Final = 3  # slow ones that are named
_LONGEST_MESSAGE: Final = 120
_MUCH: Final = 0.05  # of the run, or of its rows
_HABIT: Final = 3  # gaps or resets from which on they are the program's habit
_MOST_UNKNOWN: Final = 5  # names in the evidence


def keeps_pace(run: RunUnderCheck) -> Examined:
    """Warns where a part of it was slower than 0.9 of real time; waits do not count.

    Parts are divided where the pace changes, also for a while, by a test of ranks with a
    false-alarm rate of 1 in 1,000 for a run. A wait is over a second long and over 20 times as long
    as its step.
    """
    found = pace_of(run.search)
    waited = f"; longest wait between two rows {found.longest_wait_s:.3g} s"
    waited = waited if found.longest_wait_s > 1.0 else ""
    slow = [part for part in found.slow if part.factor < SLOW]
    said = [f"{part.factor:.3g} times real time" for part in slow or [together(found.parts)]]
    if len(found.parts) > 1 and slow:
        others = [part for part in found.parts if part not in slow]
        said = [
            f"{e.factor:.3g} times real time {_span(e, found.parts)}" for e in slow[:_MOST_PARTS]
        ]
        said += [f"else {together(others).factor:.3g}"] if others else []
    evidence = ", ".join(said) + waited
    if not slow:
        judged = counted(len(run.frame), "row")
        return run.covered(evidence, judged=judged, limit=f"limit {SLOW:g} times real time")
    since_s = slow[0].start_s if slow[0] is not found.parts[0] else float(run.frame.times[0])
    return Fault("warn", evidence, since_s, len(slow), run.more(SLOW_SIMULATION.name))


def _span(part: PacePart, parts: Sequence[PacePart]) -> str:
    until = "on" if part is parts[-1] else f"to {part.end_s:.4g} s"
    return f"from {part.start_s:.4g} s {until}"


def misses_no_steps(run: RunUnderCheck) -> Examined:
    """Warns where simulation time went on without rows, fails from 5 % of the run on.

    Where more than 5 % of the rows are followed by none for long, they come unevenly by nature.
    """
    gaps = run.events("gap")
    if not gaps:
        return run.covered(
            "rows came as evenly as usual", of="gap", judged=counted(len(run.frame), "row")
        )
    gone_s, length_s = total_s(gaps), max(run.search.length_s, 1e-9)
    longest = max(gaps, key=lambda each: each.duration_s)
    span = f"{longest.duration_s:.3g} s ({longest.start_s:.6g} to {longest.end_s:.6g} s)"
    evidence = f"one gap of {span}"
    if len(gaps) > 1:
        evidence = f"{len(gaps)} gaps, {gone_s:.3g} s in total; the longest {span}"
    is_habit = len(gaps) > _MUCH * len(run.frame) and len(gaps) >= _HABIT
    between_s = total_s(each for each in gaps if "until" not in each.details)  # then it may be done
    severity = "fail" if between_s > _MUCH * length_s and not is_habit else "warn"
    return Fault(severity, evidence, gaps[0].start_s, len(gaps), run.more("gap"))


def logs_no_errors(run: RunUnderCheck) -> Examined:
    """Fails where an error was logged, warns where a warning was."""
    lines = run.events("log")
    errors = [each for each in lines if each.name in ("error", "critical")]
    if not lines:
        return run.covered("no warning and no error was logged", of="log")
    first = (errors or lines)[0]
    counts = Counter(each.name or "" for each in lines)
    said = str(first.details["message"]).strip().splitlines() or [""]
    line = said[-1 if said[0].startswith("Traceback") else 0]  # which exception it was
    evidence = ", ".join(f"{count} {level}" for level, count in counts.items())
    evidence += f"; first: {line[:_LONGEST_MESSAGE]}"
    more = f"webots_get_logs(run_id={run.info.run_id})"
    return Fault("fail" if errors else "warn", evidence, first.start_s, len(lines), more)


def _of_end(run: RunUnderCheck, says: str) -> Coverage:
    return run.covered(says, lasts_s=0.0)


def ends_well(run: RunUnderCheck) -> Examined:
    """Fails where its controller crashed; warns of a reset or reload that no command asked for."""
    reason, session = run.info.end_reason, run.info.session_id
    more = f"webots_get_logs(run_id={run.info.run_id})"
    if reason is None:
        process = fetch_session(run.search.connection, session)
        if process is None or process.is_alive(time.time()):
            return _of_end(run, "it goes on")
        silent = f"its controller, on {process.host}, has been silent and did not say that it ended"
        return Fault("warn", silent, run.search.ended_s, 1, more)
    if reason == "crashed":
        return Fault("fail", "its controller crashed or was killed", run.search.ended_s, 1, more)
    if reason == "superseded":
        return Fault("warn", "another bridge took its robot over", run.search.ended_s, 1, more)
    if reason not in ("reset", "reload"):
        return _of_end(run, f"it ended: {reason}")
    last_s = run.info.started_wall_time_s + run.info.wall_duration_s
    asked = {"session": session, "last": last_s}
    if run.search.connection.execute(
        "SELECT count(*) FROM command WHERE session_id = :session AND status = 'done' "
        "AND (action IN ('reset', 'reload', 'load_world', 'quit') "
        "OR action = 'run' AND json_extract(params, '$.reset')) "
        "AND claimed_wall_time_s BETWEEN :last - 30 AND :last + 30",
        asked,
    ).fetchone()[0]:
        return _of_end(run, f"it ended by a {reason} that a command asked for")
    others = (session, run.info.run_id)
    habit = int(
        run.search.connection.execute(
            "SELECT count(*) FROM run WHERE session_id = ? AND end_reason = 'reset' AND id <> ?",
            others,
        ).fetchone()[0]
    )
    if reason == "reset" and habit >= _HABIT:  # other runs of the session
        return _of_end(run, f"it ended by a reset, as {habit} others of its session")
    evidence = f"it ended by a {reason} that no command asked for: by hand, or by code"
    return Fault("warn", evidence, run.search.ended_s, 1, more)


def loses_no_rows(run: RunUnderCheck) -> Examined:
    """Fails where rows were dropped, warns where the database was in trouble or rows wait."""
    noticed = run.events("bridge_event")
    dropped = [each for each in noticed if each.details["what"] == "dropped"]
    if found := dropped or [each for each in noticed if each.details["what"] == "storage"]:
        data: list[dict[str, Any]] = [each.details.get("data") or {} for each in found]
        rows = sum(each.get("row_count", each.get("rows", 0)) for each in data)
        lost = "1 row was dropped" if rows == 1 else f"{rows or 'some'} rows were dropped"
        evidence = lost if dropped else "trouble with the database"
        evidence += f": {data[0].get('why', 'no reason was noted')}"
        more = run.more("bridge_event")
        return Fault("fail" if dropped else "warn", evidence, found[0].start_s, len(found), more)
    if not run.info.row_count:
        return Fault("warn", f"run {run.info.run_id} has no state row: call bridge.publish")
    verb = "were" if run.info.purged_rows else "are"  # they were deleted since
    waiting, error = run.search.connection.execute(
        "SELECT rows_waiting, last_error FROM session WHERE id = ?", (run.info.session_id,)
    ).fetchone()
    if run.info.end_reason and waiting:
        left = f"{counted(waiting, 'row')} of its session waiting still: {error or 'no reason'}"
        return Fault("warn", left)
    if waiting := waiting_rows_note(run.search.connection):
        return Fault("warn", waiting)
    rows = f"all {run.info.row_count} rows {verb}" if run.info.row_count > 1 else "its only row is"
    return run.covered(f"{rows} recorded", lasts_s=0.0)


def keeps_expectations(run: RunUnderCheck) -> Iterator[Examined]:
    """Fails where something that was expected did not hold. Each expectation is a line."""
    if not run.expected:
        raise NotSearchableError(NONE_EXPECTED)
    frame = run.every_call
    for each in run.expected:
        name = f"expects: {each.name}"
        missing = [*each.violation.describe_unknown(run.search.known)]
        if missing and not each.asks_missing:
            yield Coverage.lacking("; ".join(missing), subject=name)
            continue
        try:
            held = judge_expectation(each, frame, run.search.known)
        except ConditionFailedError as error:
            yield Coverage.lacking(str(error), "unread", name)
            continue
        made = _held(run, each, held)
        yield (
            made._replace(subject=name) if isinstance(made, Fault) else replace(made, subject=name)
        )


def _held(run: RunUnderCheck, each: Expectation, held: Adherence) -> Examined:
    lacking = f"; without a value in {counted(held.lacking, 'row')}" if held.lacking else ""
    if each.within_s is not None:
        return _reached(run, each, held)
    if not held.rows:
        why = f"{each.during.text!r} never held" if each.during else "it was too short"
        return Coverage.lacking(f"it was never asked{lacking or f': {why}'}", "absent")
    share = f"{100 * held.held_s / held.meant_s:.4g}" if held.meant_s else ""
    if share == "100" and len(held.violations):
        share = "over 99.99"
    of_all = f"held {share} % of {held.meant_s:.4g} s ({counted(held.rows, 'row')})"
    evidence = (of_all if share else "asked of its only row") + lacking
    if not len(held.violations):
        return run.covered(evidence, lasts_s=0.0)
    evidence = f"{evidence}; {times(len(held.violations))} violated"
    return _violated(run, each, held, evidence)


def _reached(run: RunUnderCheck, each: Expectation, held: Adherence) -> Examined:
    after = "" if held.after_s is None else f"after {held.after_s:.4g} s"
    if not len(held.violations):
        short = f"it lasted {run.search.length_s:.4g} s, not longer than {each.within_s:g} s"
        return run.covered(after, lasts_s=0.0) if after else Coverage.lacking(short, "absent")
    evidence = f"not within {each.within_s:g} s: {after or f'never in {run.search.length_s:.4g} s'}"
    return _violated(run, each, held, evidence)


def _violated(run: RunUnderCheck, each: Expectation, held: Adherence, evidence: str) -> Fault:
    if held.worst is not None:
        evidence += f"; worst {held.worst[0]} = {held.worst[1]:.4g}"
    where = (each.violation if each.within_s is None else each.expected).text
    more = f"webots_find_events(where={where!r}, run_id={run.info.run_id})"
    since_s = float(held.violations.starts_s[0])
    return Fault("fail", evidence, since_s, len(held.violations), more)


def reaches_goal(run: RunUnderCheck) -> Examined:
    """Fails where the condition of its last run command, or trial, did not come to hold."""
    asked = (run.robot_id, run.info.run_id)
    row = run.search.connection.execute(
        "SELECT json_extract(params, '$.until'), json_extract(result, '$.ended'), "
        "json_extract(result, '$.advanced_s'), json_extract(result, '$.sim_time_s') FROM command "
        "WHERE robot_id = ? AND action = 'run' AND json_valid(result) AND json_extract(result, "
        "'$.run_id') = ? AND json_extract(params, '$.until') IS NOT NULL ORDER BY id DESC LIMIT 1",
        asked,
    ).fetchone()
    if row is None:
        raise NotSearchableError("no finished run command had a goal: webots_run(until=...)")
    goal, ended, took_s, at_s = row
    if ended == "condition held":
        return run.covered(f"{goal}: after {took_s:.4g} s", lasts_s=0.0)
    return Fault("fail", f"{goal}: not reached ({ended})", at_s, 1, run.more("command"))


def understands_signals(run: RunUnderCheck) -> Examined:
    """Not judged where numeric signals have an unknown meaning: no other check is about them."""
    changes: Counter[str] = Counter()
    understood = 0
    for name, signal in run.search.known.items():
        zones = run.frame.zone_map(name)
        if not signal.is_number or not zones.value_count.any():
            continue
        if run.meanings[name].quantity is not None and run.meanings[name].is_firm:
            understood += 1
        elif signal.reduction is None:
            changes[name] += int(zones.change_count.sum())
    if not changes and not understood:
        raise NotSearchableError("no number was published: call bridge.publish")
    if not changes:
        said = "the meaning of its number is" if understood == 1 else "the meanings of all are"
        says = f"{counted(understood, 'numeric signal')}, {said} known"
        return run.covered(says, lasts_s=0.0)
    branches = list(dict.fromkeys(_whole_array(name) for name, _ in changes.most_common()))
    named = listed(branches, _MOST_UNKNOWN)
    evidence = f"{counted(len(changes), 'signal')} of unknown meaning: {named}"
    evidence += f"; declare them with webots_describe_signals(...): {DECLARED_WORDS}"
    more = declaration_of(branches[0])
    unknown = Coverage.lacking(evidence, "undecided")
    return replace(unknown, often=len(changes), more=more)


def _whole_array(name: str) -> str:
    """The pattern of an array for one of its items, so that an array is named once."""
    branch, _, item = name.rpartition(".")
    return f"{branch}.*" if branch and item.isdigit() else name
