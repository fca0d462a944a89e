"""The runs of a robot on the page: outcome of the check, reward, and a small curve of a signal.

Ended runs do not change: their outcomes and curves are kept in memory.
"""

from __future__ import annotations

import logging
import math
import sqlite3
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Indexes, np
from webots_mcp.errors import WebotsMCPError
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.run_series import published_rewards
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.frame_summary import buckets_of, cells_of
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline, Subject
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.robots import RobotRecord
from webots_mcp.store.runs import RunInfo, list_runs

_RunKey = tuple[str, int, float]  # database, run, start: a new database reuses ids of runs

_log: Final = logging.getLogger(__name__)
_NO_OUTCOME: Final = "not checked"  # of runs that were not checked yet, or cannot be
_WORDS: Final = {"fail": "failed", "warn": "warned", "pass": "passed"}
_OUTCOMES: Final[dict[_RunKey, str]] = {}
# Runs are checked in the background, so that no request waits for a check.
_CHECKER: Final = ThreadPoolExecutor(1, "webots-mcp outcomes")
_CURVES_LOCK: Final = threading.Lock()


@dataclass(frozen=True)
class RunListLimits:
    """How much of the runs the page shows.

    Attributes:
        runs: Newest runs that are listed.
        checked: Newest ended runs that are checked.
        check_s: Time limit of the check of one run.
        points: Points of a small curve.
        curves_s: Time limit of the curves of one request; the next request continues.
        kept: Curves that are kept in memory.
        decimals: Decimals of the curves, which are all scaled to 0..1 together.
        joined: A line breaks where values are missing for more than this many usual distances.
    """

    runs: int = 100
    checked: int = 20
    check_s: float = 1.0
    points: int = 60
    curves_s: float = 1.0
    kept: int = 2000
    decimals: int = 3
    joined: float = 3.0


LIMITS: Final = RunListLimits()


class RunCurve(NamedTuple):
    """A signal over one run: means of short stretches; NaN where the line breaks.

    Attributes:
        times_s: The middles of the stretches, since the first row.
        length_s: From the first row of the run to the last.
    """

    times_s: Array
    values: Array
    length_s: float


_NO_CURVE: Final = RunCurve(np.empty(0), np.empty(0), 0.0)
_CURVES: Final[dict[tuple[_RunKey, str], RunCurve]] = {}


def run_choices(recording: RecordingAccess, runs: Sequence[RunInfo]) -> list[dict[str, Any]]:
    """Return the runs to choose from; ended ones with the outcome of their check, if known."""
    choices: list[dict[str, Any]] = []
    checked = 0
    for run in runs:
        outcome = ""
        if run.end_reason and checked < LIMITS.checked:
            checked += 1
            key = _key_of(recording, run)
            if key not in _OUTCOMES:
                _OUTCOMES[key] = _NO_OUTCOME
                _CHECKER.submit(_check, recording, key)
            outcome = _OUTCOMES[key]
        title = " · ".join(filter(None, (_title(run), outcome)))
        choices.append({"id": run.run_id, "title": title, "outcome": outcome})
    return choices


def listed_runs(
    recording: RecordingAccess,
    connection: sqlite3.Connection,
    robot: RobotRecord,
    names: Sequence[str],
) -> dict[str, Any]:
    """Return the newest runs, each with its reward and a small curve. All curves share their axes.

    Args:
        recording: The recording.
        connection: Its reader.
        robot: Whose runs.
        names: Signals, the first of which that is no text is drawn.

    Returns:
        Of each run: id, texts, the reward (None without one), and the curve as pairs of shares of
        the width and height (None where its line breaks). `low` and `high` are the values at the
        bottom and the top. `is_whole` is False if time ran out, and `has_more` is True if this
        request made new curves: then ask again for the rest.
    """
    found = list_runs(connection, robot=robot.name, limit=LIMITS.runs)
    runs = found.runs
    signal = _drawn(connection, robot, runs, names)
    curves, is_whole, has_more = _curves_of(recording, connection, robot, runs, signal)
    rewards = published_rewards(connection, sorted(run.run_id for run in runs))
    low, high = _bounds([curve.values for curve in curves.values()])
    longest_s = max((curve.length_s for curve in curves.values()), default=0.0)
    choices = run_choices(recording, runs)
    return {
        "signal": spelled_out(signal) if curves else "",
        "low": low, "high": high, "longest_s": longest_s,
        "is_whole": is_whole, "has_more": has_more,
        "total": found.total,
        "has_rewards": bool(rewards),
        "rows": [
            {
                "id": run.run_id,
                "label": spelled_out(run.label or ""),
                "began": _began(run),
                "length": f"{run.duration_s:.1f} s",
                "ended": spelled_out(run.end_reason or "running"),
                "outcome": choice["outcome"],
                "reward": rewards.get(run.run_id),
                "curve": _scaled(curves.get(run.run_id), longest_s, low, high),
            }
            for run, choice in zip(runs, choices, strict=True)
        ],
    }  # fmt: skip


def _drawn(
    connection: sqlite3.Connection,
    robot: RobotRecord,
    runs: Sequence[RunInfo],
    names: Sequence[str],
) -> str:
    """Return the first signal that is no text; "" without one."""
    if not runs:
        return ""
    known = catalogue(connection, Subject(robot.id, robot.name, runs[0].run_id))
    drawable = (name for name in names if name not in known or known[name].kind != "text")
    return next(drawable, "")


def _key_of(recording: RecordingAccess, run: RunInfo) -> _RunKey:
    return str(recording.database), run.run_id, run.started_wall_time_s


def _began(run: RunInfo) -> str:
    return datetime.fromtimestamp(run.started_wall_time_s).strftime("%d %b %H:%M:%S")


def _title(run: RunInfo) -> str:
    """Return a run in one line: its number, label, start and length."""
    label = f" “{spelled_out(run.label)}”" if run.label else ""
    return f"run {run.run_id}{label} · {_began(run)} · {run.duration_s:.1f} s"


def _check(recording: RecordingAccess, key: _RunKey) -> None:
    """Check a run. A run that cannot be read now is checked with a later request."""
    try:
        with recording.reader() as connection:
            outcome = check_run(connection, key[1], deadline_s=LIMITS.check_s).outcome
        _OUTCOMES[key] = _WORDS.get(outcome, _NO_OUTCOME)
    except (WebotsMCPError, sqlite3.Error):
        del _OUTCOMES[key]
    except Exception:  # noqa: BLE001 - No request waits for it and could report it.
        _log.exception("run %d cannot be judged", key[1])


def _curves_of(
    recording: RecordingAccess,
    connection: sqlite3.Connection,
    robot: RobotRecord,
    runs: Sequence[RunInfo],
    name: str,
) -> tuple[dict[int, RunCurve], bool, bool]:
    """Return the curves by run, whether there was time for all, and whether some are new.

    Short runs are read first, so that a long one does not keep the others away.
    """
    found: dict[int, RunCurve] = {}
    if not name or not runs:
        return found, True, False
    deadline = Deadline(LIMITS.curves_s)
    signal: RegisteredSignal | None = None
    is_whole, has_more = True, False
    for run in sorted(runs, key=lambda each: each.row_count):
        key = (_key_of(recording, run), name)
        curve = _CURVES.get(key)
        if curve is None:
            if deadline.passed:
                is_whole = False
                continue
            subject = Subject(robot.id, robot.name, run.run_id)
            signal = signal or catalogue(connection, subject).get(name)
            curve, is_final = _curve(connection, run.run_id, signal, deadline)
            if not is_final and deadline.passed:
                is_whole = False
                continue
            if run.end_reason and is_final:
                _keep(key, curve)
                has_more = True
        if len(curve.times_s):
            found[run.run_id] = curve
    return found, is_whole, has_more


def _curve(
    connection: sqlite3.Connection,
    run_id: int,
    signal: RegisteredSignal | None,
    deadline: Deadline,
) -> tuple[RunCurve, bool]:
    """Return a signal over a run, and whether all of the run was read."""
    segment = whole_run(connection, run_id)
    if segment is None or signal is None or signal.kind == "text":
        return _NO_CURVE, True
    frame = read_frame(connection, segment, deadline)
    if signal.name not in frame:
        return _NO_CURVE, not frame.unread
    buckets = buckets_of(frame, LIMITS.points)
    values = cells_of(frame, signal, buckets, None).mean
    held = np.flatnonzero(np.isfinite(values))
    if not len(held):
        return _NO_CURVE, not frame.unread
    first_s, last_s = frame.bounds_s
    middles_s = buckets.starts_s + (buckets.step_s or 0.0) / 2
    times_s = np.minimum(np.maximum(middles_s, first_s), last_s)[held] - first_s
    breaks = _breaks_of(held)
    times_s, values = (np.insert(each, breaks, np.nan) for each in (times_s, values[held]))
    curve = RunCurve(times_s, values, last_s - first_s)
    return curve, not frame.unread


def _breaks_of(places: Indexes) -> Indexes:
    """Return the indexes before which a line breaks, for the places that have a value."""
    apart = np.diff(places)
    if not len(apart):
        return np.empty(0, np.intp)
    return 1 + np.flatnonzero(apart > LIMITS.joined * np.median(apart))


def _bounds(curves: Sequence[Array]) -> tuple[float | None, float | None]:
    """Return the lowest and the highest value of all curves; None without one."""
    if not curves:
        return None, None
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    return float(values.min()), float(values.max())


def _scaled(
    curve: RunCurve | None, longest_s: float, low: float | None, high: float | None
) -> list[tuple[float, float] | None]:
    """Return a curve as shares of the width and height of the common axes; None for a break."""
    if curve is None or low is None or high is None:
        return []
    places = curve.times_s / (longest_s or 1.0)
    shares = (curve.values - low) / (high - low or 1.0)
    return [
        (round(float(place), LIMITS.decimals), round(float(share), LIMITS.decimals))
        if math.isfinite(share)
        else None
        for place, share in zip(places, shares, strict=True)
    ]


def _keep(key: tuple[_RunKey, str], curve: RunCurve) -> None:
    with _CURVES_LOCK:
        while len(_CURVES) >= LIMITS.kept:
            del _CURVES[next(iter(_CURVES))]
        _CURVES[key] = curve
