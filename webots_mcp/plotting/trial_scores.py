"""The scores of trials as a picture: over one parameter, or over two."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from typing import Any

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.naming import listed, nearest_first
from webots_mcp.plotting.canvas import Picture, Sheet
from webots_mcp.plotting.trial_axes import TrialAxes, paint_trials
from webots_mcp.store.analysis.spread import Outcome, rank
from webots_mcp.store.parameters import Trial, best_of, fetch_trial_set, trials_of


def plot_trials(
    connection: sqlite3.Connection,
    set_id: int,
    names: Sequence[str] = (),
    *,
    sheet: Sheet | None = None,
) -> Picture:
    """The scores of a trial set: each, their mean and their spread; the best is marked.

    Args:
        connection: Any.
        set_id: The trial set.
        names: One or two parameters; none for the first one or two that were varied.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        InvalidInputError: There is no such set, or it did not try a parameter of that name.
        NothingRecordedError: No trial has a score yet.
    """
    sheet = sheet or Sheet()
    plot, notes = compose_trials(connection, set_id, names)
    canvas = paint_trials(plot, sheet.width_px, sheet.height_px)
    caption = f"{plot.title}: {plot.score} over {' and '.join(plot.names)}"
    return canvas.picture(sheet.image_format, caption, notes)


def compose_trials(
    connection: sqlite3.Connection, set_id: int, names: Sequence[str] = ()
) -> tuple[TrialAxes, tuple[str, ...]]:
    """What `plot_trials` paints, and its notes; arguments and errors as there."""
    over = [each for each in trials_of(connection, set_id) if each.is_over]
    if not any(each.score is not None for each in over):
        raise NothingRecordedError(f"no trial of set {set_id} has a score yet: nothing to draw")
    plan = json.loads(fetch_trial_set(connection, set_id).plan)
    varied = _varied(over)
    chosen = _chosen(over, names) or varied[:2] or list(over[0].values)[:1]
    ranking = rank([_outcome(each, chosen) for each in over], best_of(plan))
    others = [name for name in varied if name not in chosen]
    notes = [f"each over all values of {listed(others)}"] * bool(others)
    best = ranking.sets[0].parameters if ranking.sets[0].score else None
    title = f"trial set {set_id}, {len(over)} trials"
    return TrialAxes(title, chosen, str(plan.get("score")), ranking.sets, best), tuple(notes)


def _varied(trials: Sequence[Trial]) -> list[str]:
    """The parameters that had more than one value."""
    names = dict.fromkeys(name for each in trials for name in each.values)
    return [name for name in names if len({repr(each.values.get(name)) for each in trials}) > 1]


def _chosen(trials: Sequence[Trial], names: Sequence[str]) -> list[str]:
    known = list(dict.fromkeys(name for each in trials for name in each.values))
    for name in names:
        if name not in known:
            near = ", ".join(nearest_first(name, known)[:5])
            raise InvalidInputError(f"these trials did not try {name!r:.80}; they tried {near}")
    if len(names) > 2:
        raise InvalidInputError(f"name one or two parameters to draw over, not {len(names)}")
    return list(names)


def _outcome(trial: Trial, names: Sequence[str]) -> Outcome:
    values: dict[str, Any] = {name: trial.values.get(name) for name in names}
    return Outcome(values, trial.score, trial.error, pruned=trial.status == "pruned")
