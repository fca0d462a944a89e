"""All runs of a robot as one series: how a score develops over hundreds or thousands of runs.

Scores that need only extremes, first or last values are computed from the statistics of chunks, for
all runs at once. Other scores, and events, are computed run by run until a deadline, in an order
that spreads evenly over the series, so that what was reached in time is a fair sample of it.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, np
from webots_mcp.analysis.level_changes import level_changes
from webots_mcp.contract import EPISODE_EVENT
from webots_mcp.errors import (
    ConditionFailedError,
    InvalidConditionError,
    InvalidInputError,
    UnknownSignalError,
    WebotsMCPError,
)
from webots_mcp.judging.detection.condition import holds_in, position_in
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import search_events
from webots_mcp.judging.run_measures import goals_of
from webots_mcp.judging.run_score import require_kinds, score_run
from webots_mcp.judging.run_statistics import RunStatistics
from webots_mcp.signals.conditions.compiler import Condition, parse_condition
from webots_mcp.signals.conditions.scoring import Score, Scored, parse_score
from webots_mcp.signals.conditions.syntax import is_signal
from webots_mcp.signals.naming import listed, nearest_first
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import TimeRange, whole_run
from webots_mcp.store.reading.segment import Deadline, Subject
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.runs import run_info

MOST_RUNS: Final = 20_000
FEWEST_RUNS: Final = 3
_NEWEST: Final = 20  # runs of which it is asked whether their process is gone
REWARD_NAME: Final = "reward"  # by which one asks for the reward that was published
_UNSCORED: Final = Scored(None, "not scored before the deadline")


@dataclass(frozen=True)
class SeriesSettings:
    """How a series of runs is divided and judged.

    Attributes:
        points: Rows of the curve at most.
        blocks: Changes are searched in means of consecutive runs, at most this many: the search
            takes time and memory by the square of their number.
        false_alarms: How often at most a series without a change is divided, if its runs are
            independent of each other. Runs of a learner that keeps its state are not quite: a
            change then says that the level moved, not why.
        ends: How many of the best and of the worst runs are listed and compared.
        kinds: Events whose share of runs is reported.
        searched: Runs in which they are searched, spread evenly over all.
        recent_share: Share of the runs at the end in which a rise is searched.
        score_share: Of the time for what is computed run by run, the share that scores may take.
    """

    points: int = 12
    blocks: int = 200
    false_alarms: float = 0.01
    ends: int = 10
    kinds: tuple[str, ...] = ("stuck", "fall")
    searched: int = 24
    recent_share: float = 1 / 3
    score_share: float = 0.5


SETTINGS: Final = SeriesSettings()


class ScoredRun(NamedTuple):
    """A run and its score; None with the reason."""

    run_id: int
    value: float | None
    why: str | None = None


@dataclass(frozen=True)
class Level:
    """Consecutive runs whose scores have the same level.

    Attributes:
        first_run: The number of the first of them, as `last_run` of the last.
    """

    first_run: int
    last_run: int
    count: int
    mean: float


@dataclass(frozen=True)
class CurvePoint:
    """Consecutive runs on the curve of a score.

    Attributes:
        count: Runs, of which `scored` have a score.
        mean: Of the scores; a tenth of them is at most `low`, a tenth at least `high`.
        shares: Of an outcome, the runs that had it and the runs of which that is known.
    """

    first_run: int
    last_run: int
    count: int
    scored: int
    mean: float | None
    median: float | None
    low: float | None
    high: float | None
    shares: dict[str, tuple[int, int]]


@dataclass(frozen=True)
class ScoreSeries:
    """How a score developed over runs, oldest first.

    Attributes:
        score: Its text.
        runs: All of them, with their scores.
        sampled: Whether only a part of the runs was scored before the deadline.
        levels: Levels of the score; one if it never changed.
        is_rising: Whether the scores of the last `recent` runs rise (Mann-Kendall test at the rate
            of false alarms of the settings): those of the last level, and at least a third of all.
        known: Of each outcome, how many runs it is known of.
        unknown: Outcomes that are not known, with the reason.
    """

    score: str
    runs: tuple[ScoredRun, ...]
    sampled: bool
    curve: tuple[CurvePoint, ...]
    levels: tuple[Level, ...]
    is_rising: bool
    recent: int
    known: dict[str, int]
    unknown: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def ranked(self) -> list[ScoredRun]:
        """The runs that have a score, the best first; of equal ones the older."""
        scored = [run for run in self.runs if run.value is not None]
        return sorted(scored, key=lambda run: (-(run.value or 0.0), run.run_id))

    @property
    def best_level(self) -> Level | None:
        """The level with the highest mean; of equal ones the first."""
        return max(self.levels, key=lambda level: level.mean, default=None)

    @property
    def ends(self) -> tuple[list[int], list[int]]:
        """The best and the worst runs, as many of each, at most a third of all.

        None if equal scores would be divided into best and worst.
        """
        ranked = self.ranked
        count = min(SETTINGS.ends, len(ranked) // 3)
        best, worst = ranked[:count], ranked[len(ranked) - count :]
        if not count or best[-1].value == worst[0].value:
            return [], []
        return sorted(run.run_id for run in best), sorted(run.run_id for run in worst)


def score_series(
    connection: sqlite3.Connection,
    robot_id: int,
    robot: str,
    run_ids: Sequence[int] | None = None,
    *,
    required: Collection[int] = (),
    score: str | None = None,
    goal: str | None = None,
    deadline_s: float,
) -> ScoreSeries:
    """Score runs of a robot and find how the score developed.

    Args:
        connection: Any.
        robot_id: Whose runs.
        robot: Its name.
        run_ids: Which of them; None for all that recorded a state. Ids of other runs do not count.
        required: Ids that have to be runs of the robot with a state.
        score: As for trials: `max(pose.x) - count(stuck)`; more is better. None or "reward" for
            the sum of the rewards that each run published.
        goal: A condition that holds at some time of a run which reached its goal. None for the
            goals of run commands, else what episodes say of `success`.
        deadline_s: Wall time for what is computed run by run.

    Raises:
        InvalidInputError: Too few or too many runs, a kind of event that does not exist, a goal
            that is neither true nor false, or no reward and no other score.
        InvalidConditionError: The text is no score, or the goal no condition.
        UnknownSignalError: The robot has no such signal.
    """
    ids = _runs_of(connection, robot_id, run_ids, required)
    deadline = Deadline(deadline_s)
    subject = Subject(robot_id, robot, ids[-1])
    known = catalogue(connection, subject)
    condition = None if goal is None else _condition(goal, known)
    facts = RunStatistics(connection, robot_id, ids, known)
    if score is None or score.strip() == REWARD_NAME:
        scored = _rewards(connection, ids, REWARD_NAME in known)
        text = REWARD_NAME
    else:
        parsed = _parse(score)
        parsed.require_known(known)
        require_kinds(connection, parsed, ids[-1])
        scored = _scored(connection, parsed, facts, ids, deadline.part(SETTINGS.score_share))
        text = parsed.text
    runs = tuple(ScoredRun(run_id, *scored.get(run_id, _UNSCORED)) for run_id in ids)
    outcomes, unknown = _outcomes(connection, subject, facts, ids, condition, deadline)
    scored_runs = [run for run in runs if run.value is not None]
    levels = levels_of(scored_runs)
    in_last_level = levels[-1].count if levels else 0
    recent = max(in_last_level, math.ceil(len(scored_runs) * SETTINGS.recent_share))
    return ScoreSeries(
        text,
        runs,
        any(scored.get(run_id, _UNSCORED) is _UNSCORED for run_id in ids),
        tuple(_curve(runs, outcomes)),
        tuple(levels),
        _is_rising(scored_runs[-recent:]),
        recent,
        {name: len(found) for name, found in outcomes.items()},
        unknown,
    )


def _parse(text: str) -> Score:
    """Return a score of runs; its error offers what sums up rewards where a sum was asked for."""
    try:
        return parse_score(text)
    except InvalidConditionError as error:
        if re.search(rf"\bsum\({REWARD_NAME}\)", text.replace(" ", "")):
            raise InvalidConditionError(
                f"{error}. The bridge sums up the rewards of a run: ask for score='{REWARD_NAME}'."
            ) from None
        raise


def _condition(text: str, known: Mapping[str, RegisteredSignal]) -> Condition:
    """Return the condition of a goal; its signals must be known."""
    condition = parse_condition(text)
    for name in condition.signals:
        if name not in known:
            offer = ", ".join(nearest_first(name, known)[:3]) or "none yet"
            raise UnknownSignalError(
                f"goal={text!r}: no signal {name!r} is recorded. Nearest signals: {offer}"
            )
    if is_signal(condition.tree) and known[condition.signals[0]].kind == "text":
        raise InvalidInputError(
            f"goal={text!r} is a text, and a goal is true or false. Compare it, for example "
            f"goal=\"{text} == 'done'\"."
        )
    return condition


def _runs_of(
    connection: sqlite3.Connection,
    robot_id: int,
    run_ids: Sequence[int] | None,
    required: Collection[int],
) -> list[int]:
    """Return the runs that recorded something, oldest first."""
    found = [
        int(run_id)
        for (run_id,) in connection.execute(
            "SELECT r.id FROM run r WHERE r.robot_id = ? AND (r.row_count > 0 OR EXISTS "
            "(SELECT 1 FROM state WHERE run_id = r.id)) ORDER BY r.id",
            (robot_id,),
        )
    ]
    own = set(found)
    missing = [run_id for run_id in required if run_id not in own]
    if missing:
        named = listed([str(each) for each in missing])
        raise InvalidInputError(
            f"Run {named}: no run of this robot with a recorded state. Its runs are "
            f"{found[0]} to {found[-1]}; leave out the others, or give robot."
            if found
            else f"Run {named}: this robot has no run with a recorded state. Give robot."
        )
    if run_ids is not None:
        found = sorted(own.intersection(run_ids))
    if not FEWEST_RUNS <= len(found) <= MOST_RUNS:
        raise InvalidInputError(
            f"A series needs {FEWEST_RUNS} to {MOST_RUNS:,} runs of one robot, and there are "
            f"{len(found):,}. Compare single runs without score, or choose other run_ids."
        )
    return found


# -- the score of each run -------------------------------------------------------------------------


def score_each(
    connection: sqlite3.Connection, run_ids: Sequence[int], score: str, deadline_s: float
) -> dict[int, Scored]:
    """Return the score of some runs, of whichever robots; see `score_series` for its text.

    Raises:
        InvalidConditionError: The text is no score.
    """
    if score.strip() == REWARD_NAME:
        return _rewards(connection, sorted(run_ids), is_published=True) if run_ids else {}
    _parse(score)
    deadline, scored = Deadline(deadline_s), dict[int, Scored]()
    for run_id in run_ids:
        scored[run_id] = _score_of(connection, run_id, score, deadline)
    return scored


def _score_of(
    connection: sqlite3.Connection, run_id: int, score: str, deadline: Deadline
) -> Scored:
    if deadline.passed:
        return _UNSCORED
    try:
        found = score_run(connection, run_id, score, deadline_s=deadline.left_s)
    except WebotsMCPError as error:
        return Scored(None, str(error))
    return Scored(found.value, found.why)


def published_rewards(connection: sqlite3.Connection, run_ids: Sequence[int]) -> dict[int, float]:
    """Return the rewards that bridges summed up, by run.

    Args:
        connection: Any.
        run_ids: In ascending order; runs without a reward are not in the result.
    """
    if not run_ids:
        return {}
    wanted = set(run_ids)
    return {  # a controller that goes on after its last step leaves a second event
        int(run_id): float(reward)
        for run_id, reward in connection.execute(
            "SELECT run_id, total(json_extract(data, '$.reward')) FROM event WHERE kind = ? "
            "AND json_valid(data) AND json_type(data, '$.reward') IN ('integer', 'real') "
            "AND run_id BETWEEN ? AND ? GROUP BY run_id",
            (EPISODE_EVENT, run_ids[0], run_ids[-1]),
        )
        if run_id in wanted
    }


def _rewards(
    connection: sqlite3.Connection, run_ids: Sequence[int], is_published: bool
) -> dict[int, Scored]:
    """Return the rewards as scores, by run."""
    of_all = published_rewards(connection, run_ids)
    if not of_all:
        raise InvalidInputError(
            "No run has a summed reward: bridges before this version did not sum it up, and "
            "neither do controllers without the bridge. Give another score, such as "
            "score='mean(reward)'."
            if is_published
            else "No run has published a reward. Give another score, for example "
            "score='max(pose.x)', or publish a number named 'reward' in each step."
        )
    missing = Scored(
        None, "no summed reward: the run goes on, its controller was killed, or it published none"
    )
    return {run_id: Scored(of_all[run_id]) if run_id in of_all else missing for run_id in run_ids}


def _scored(
    connection: sqlite3.Connection,
    score: Score,
    facts: RunStatistics,
    run_ids: Sequence[int],
    deadline: Deadline,
) -> dict[int, Scored]:
    """Return the scores, from statistics where they tell, else run by run until the deadline."""
    scored = facts.scores(score)
    for run_id in evenly(run_ids):
        if run_id in scored:
            continue
        if deadline.passed:
            break
        scored[run_id] = _score_of(connection, run_id, score.text, deadline)
    return scored


def evenly(items: Sequence[int]) -> Iterator[int]:
    """Yield items in an order whose every beginning is spread evenly over them.

    The indexes are those of the van der Corput sequence in base 2: 0, 1/2, 1/4, 3/4, 1/8, ...
    """
    bits = max(1, (len(items) - 1).bit_length())
    for number in range(1 << bits):
        place = int(f"{number:0{bits}b}"[::-1], 2)
        if place < len(items):
            yield items[place]


# -- how runs ended --------------------------------------------------------------------------------

_Outcomes = dict[str, dict[int, bool]]  # by name and run, where it is known


def _outcomes(
    connection: sqlite3.Connection,
    subject: Subject,
    facts: RunStatistics,
    run_ids: Sequence[int],
    goal: Condition | None,
    deadline: Deadline,
) -> tuple[_Outcomes, dict[str, str]]:
    """Return what is known of how the runs ended, and why the rest is not."""
    found: _Outcomes = {}
    unknown: dict[str, str] = {}
    reached = _goals(connection, subject, facts, run_ids, goal, deadline)
    if reached:
        found["goal"] = reached
    else:
        unknown["goal"] = "no goal is known: give goal, such as goal='goal_m < 0.1'"
    ends = connection.execute(
        "SELECT id, end_reason = 'crashed' FROM run WHERE robot_id = ? AND id BETWEEN ? AND ? "
        "AND end_reason IS NOT NULL",
        (subject.robot_id, run_ids[0], run_ids[-1]),
    )
    wanted = set(run_ids)
    crashed = {int(run_id): bool(value) for run_id, value in ends if run_id in wanted}
    for run_id in run_ids[-_NEWEST:]:  # whose process may be gone without a word
        if run_id not in crashed and (ended := run_info(connection, run_id).end_reason):
            crashed[run_id] = ended == "crashed"
    found["crashed"] = crashed
    timed_out = _flags_of_episodes(connection, run_ids, "truncated")
    if timed_out:
        found["time over"] = timed_out
    for number, kind in enumerate(SETTINGS.kinds):
        share = deadline.part(1 / (len(SETTINGS.kinds) - number))
        searched, why = _had_event(connection, subject, run_ids, kind, share)
        if searched:
            found[kind] = searched
        else:
            unknown[kind] = why or "not searched before the deadline"
    return found, unknown


def _goals(
    connection: sqlite3.Connection,
    subject: Subject,
    facts: RunStatistics,
    run_ids: Sequence[int],
    goal: Condition | None,
    deadline: Deadline,
) -> dict[int, bool]:
    """Return which runs reached their goal: a given one, that of their command or episode."""
    if goal is None:
        of_commands = goals_of(connection, subject.robot_id, run_ids)
        told = {run_id: each.took_s is not None for run_id, each in of_commands.items()}
        return _flags_of_episodes(connection, run_ids, "success") | told
    reached = facts.holds(goal)
    for run_id in evenly(run_ids):
        if run_id in reached:
            continue
        if deadline.passed:
            break
        held = _holds_in_run(connection, subject, run_id, goal, deadline)
        if held is not None:
            reached[run_id] = held
    return reached


def _holds_in_run(
    connection: sqlite3.Connection,
    subject: Subject,
    run_id: int,
    goal: Condition,
    deadline: Deadline,
) -> bool | None:
    """Return whether a condition holds in a row of a run; None if that is not known."""
    segment = whole_run(connection, run_id)
    if segment is None:
        return None
    frame = read_frame(connection, segment, deadline, full_rate=False)
    if frame.cut_at_s is not None or frame.unread:
        return None
    known = catalogue(connection, Subject(subject.robot_id, subject.robot, run_id))
    try:
        return bool(holds_in(goal.scanned, goal.tree, frame, position_in(frame, known)).any())
    except ConditionFailedError:
        return None


def _flags_of_episodes(
    connection: sqlite3.Connection, run_ids: Sequence[int], name: str
) -> dict[int, bool]:
    """Return a flag of the episode events, by run."""
    wanted = set(run_ids)
    return {
        int(run_id): bool(flag)
        for run_id, flag in connection.execute(
            "SELECT run_id, json_extract(data, '$.' || ?) FROM event WHERE kind = ? "
            "AND json_valid(data) AND run_id BETWEEN ? AND ? ORDER BY id",
            (name, EPISODE_EVENT, run_ids[0], run_ids[-1]),
        )
        if flag in (0, 1) and run_id in wanted
    }


def _had_event(
    connection: sqlite3.Connection,
    subject: Subject,
    run_ids: Sequence[int],
    kind: str,
    deadline: Deadline,
) -> tuple[dict[int, bool], str | None]:
    """Return whether runs had an event of a kind, as far as searched; else why not."""
    found: dict[int, bool] = {}
    why: str | None = None
    for run_id in islice(evenly(run_ids), SETTINGS.searched):
        if deadline.passed:
            break
        segment = whole_run(connection, run_id)
        if segment is None:
            continue
        time_range = TimeRange(subject.robot_id, subject.robot, (segment,), "simulation")
        searched = search_events(
            connection,
            time_range,
            EventOptions(kinds=(kind,)),
            around=(),
            group=False,
            deadline_s=deadline.left_s,
        )
        missing = searched.verdicts.not_searched.get(kind)
        if missing is None:
            found[run_id] = bool(searched.events)
        why = why or missing
    return found, why


# -- how the score developed -----------------------------------------------------------------------


def levels_of(scored: Sequence[ScoredRun]) -> list[Level]:
    """Return the levels of the score, oldest first.

    Blocks are compared by their means: of scores that are mostly 0, such as sparse rewards, the
    medians say nothing. The test is one of ranks, so that single outliers divide nothing.
    """
    if not scored:
        return []
    per_block = math.ceil(len(scored) / SETTINGS.blocks)
    starts = range(0, len(scored), per_block)
    means: Array = np.array([_mean(scored[at : at + per_block]) for at in starts], np.float64)
    edges = [0, *level_changes(means, SETTINGS.false_alarms), len(means)]
    return [
        Level(part[0].run_id, part[-1].run_id, len(part), _mean(part))
        for first, last in pairwise(edges)
        for part in (scored[first * per_block : last * per_block],)
    ]


def _mean(runs: Sequence[ScoredRun]) -> float:
    return float(np.mean([run.value for run in runs if run.value is not None]))


def _is_rising(scored: Sequence[ScoredRun]) -> bool:
    """Return whether scores rise (H. B. Mann, Nonparametric tests against trend, 1945).

    Of n values without a trend the sum of the signs of all differences is about normal, with the
    variance n (n - 1) (2 n + 5) / 18; equal values make it smaller, which errs on the safe side.
    """
    per_block = math.ceil(max(1, len(scored)) / SETTINGS.blocks)
    values = np.array(
        [_mean(scored[at : at + per_block]) for at in range(0, len(scored), per_block)]
    )
    count = len(values)
    if count < 8:  # of fewer the sum is not about normal
        return False
    signs = float(np.sign(values[None, :] - values[:, None])[np.triu_indices(count, 1)].sum())
    deviation = math.sqrt(count * (count - 1) * (2 * count + 5) / 18)
    return 0.5 * math.erfc((signs - 1) / deviation / math.sqrt(2)) < SETTINGS.false_alarms


def _curve(runs: Sequence[ScoredRun], outcomes: _Outcomes) -> Iterator[CurvePoint]:
    """Yield the points of the curve: equally many runs each, but for the last."""
    per_point = _round_up(math.ceil(len(runs) / SETTINGS.points))
    for start in range(0, len(runs), per_point):
        part = runs[start : start + per_point]
        values = [run.value for run in part if run.value is not None]
        low, median, high = (
            map(float, np.percentile(values, (10, 50, 90))) if values else (None, None, None)
        )
        shares = {
            name: (sum(known), len(known))
            for name, by_run in outcomes.items()
            for known in ([by_run[run.run_id] for run in part if run.run_id in by_run],)
        }
        ends = part[0].run_id, part[-1].run_id
        mean = float(np.mean(values)) if values else None
        yield CurvePoint(*ends, len(part), len(values), mean, median, low, high, shares)


def _round_up(count: int) -> int:
    """Return the next number of 1, 2, 5, 10, 20, 50, ..."""
    power = 10 ** int(math.log10(max(1, count)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= count)
