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

from webots_mcp.analysis.arrays import Array, np
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
    """

    runs: int = 100
    checked: int = 20
    check_s: float = 1.0
    points: int = 60
    curves_s: float = 1.0
    kept: int = 2000
    decimals: int = 3


LIMITS: Final = RunListLimits()


class RunCurve(NamedTuple):
    """A signal over one run: means at equal distances of simulation time, NaN where none is."""

    times_s: Array
    values: Array


_NO_CURVE: Final = RunCurve(np.empty(0), np.empty(0))
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
    recording: RecordingAccess, connection: sqlite3.Connection, robot: RobotRecord, signal: str
) -> dict[str, Any]:
    """Return the newest runs, each with its reward and a small curve. All curves share their axes.

    Args:
        recording: The recording.
        connection: Its reader.
        robot: Whose runs.
        signal: Name of the signal of the curves; "" for none.

    Returns:
        Of each run: id, texts, the reward (None without one), and the curve as pairs of shares of
        the width and height; `low` and `high` are the values at the bottom and the top. `is_whole`
        is False if time ran out. `has_more` is True if this request made new curves: then ask again
        for the rest.
    """
    found = list_runs(connection, robot=robot.name, limit=LIMITS.runs)
    runs = found.runs
    curves, is_whole, has_more = _curves_of(recording, connection, robot, runs, signal)
    rewards = published_rewards(connection, sorted(run.run_id for run in runs))
    low, high = _bounds([curve.values for curve in curves.values()])
    longest_s = max((float(curve.times_s[-1]) for curve in curves.values()), default=0.0)
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
    """Return the curves by run, whether there was time for all, and whether some are new."""
    found: dict[int, RunCurve] = {}
    if not name or not runs:
        return found, True, False
    deadline = Deadline(LIMITS.curves_s)
    signal: RegisteredSignal | None = None
    is_whole, has_more = True, False
    for run in runs:
        key = (_key_of(recording, run), name)
        curve = _CURVES.get(key)
        if curve is None:
            if deadline.passed:
                is_whole = False
                continue
            subject = Subject(robot.id, robot.name, run.run_id)
            signal = signal or catalogue(connection, subject).get(name)
            curve, is_final = _curve(connection, run.run_id, signal, deadline)
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
    """Return a signal over a run from its first row, and whether all of the run was read."""
    segment = whole_run(connection, run_id)
    if segment is None or signal is None:
        return _NO_CURVE, True
    frame = read_frame(connection, segment, deadline)
    if signal.name not in frame:
        return _NO_CURVE, not frame.unread
    buckets = buckets_of(frame, LIMITS.points)
    values = cells_of(frame, signal, buckets, None).mean
    if not np.isfinite(values).any():
        return _NO_CURVE, not frame.unread
    return RunCurve(buckets.starts_s - frame.bounds_s[0], values), not frame.unread


def _bounds(curves: Sequence[Array]) -> tuple[float | None, float | None]:
    """Return the lowest and the highest value of all curves; None without one."""
    if not curves:
        return None, None
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    return float(values.min()), float(values.max())


def _scaled(
    curve: RunCurve | None, longest_s: float, low: float | None, high: float | None
) -> list[tuple[float, float | None]]:
    """Return a curve as shares of the width and the height of the axes that all curves share."""
    if curve is None or low is None or high is None:
        return []
    shares = (curve.values - low) / (high - low or 1.0)
    return [
        (
            round(float(at_s) / (longest_s or 1.0), LIMITS.decimals),
            round(float(share), LIMITS.decimals) if math.isfinite(share) else None,
        )
        for at_s, share in zip(curve.times_s, shares, strict=True)
    ]


def _keep(key: tuple[_RunKey, str], curve: RunCurve) -> None:
    with _CURVES_LOCK:
        while len(_CURVES) >= LIMITS.kept:
            del _CURVES[next(iter(_CURVES))]
        _CURVES[key] = curve
