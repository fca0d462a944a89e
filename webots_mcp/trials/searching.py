"""Searches ranges of parameters with Optuna's samplers, through the extra `search`.

A sampler is asked for one set at a time, and knows what the trial table says: the study is made
anew for each question, in memory. So a search that was killed goes on as if it had not been.
"""

from __future__ import annotations

import random
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.requirements import explain_extra
from webots_mcp.store.trials import Trial, ranking_of
from webots_mcp.trials.plan import Plan
from webots_mcp.trials.ranges import Range

if TYPE_CHECKING:
    import optuna

_STATES: Final = {"done": "COMPLETE", "failed": "FAIL", "pruned": "PRUNED"}
_UNDER_WAY: Final = "RUNNING"


def require_optuna() -> None:
    """See that there is what a search needs, before anything is written.

    Raises:
        InvalidInputError: Optuna is not installed.
    """
    try:
        import_module("optuna")
    except ImportError as error:
        raise InvalidInputError(explain_extra("a search", "search")) from error


def next_parameters(plan: Plan, trials: Sequence[Trial]) -> dict[str, Any] | None:
    """The parameters of the trial after these; None where there is none, or none yet.

    Each set is tried `plan.repeats` times in a row; with 1, the best is tried again at the end.
    """
    number = len(trials)
    if number < plan.sets * plan.repeats:
        first = number - number % plan.repeats
        return trials[first].values if first < number else _suggested(plan, trials)
    if plan.repeats > 1 or number > plan.sets or not all(each.is_over for each in trials):
        return None
    best = ranking_of(list(trials), plan.best).sets[0]
    return best.parameters if best.scores else None


def _suggested(plan: Plan, trials: Sequence[Trial]) -> dict[str, Any]:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize" if plan.best == "highest" else "minimize",
        sampler=_sampler(plan, len(trials)),
    )
    distributions = {name: _distribution(each) for name, each in plan.ranges.items()}
    for trial in trials:
        state = optuna.trial.TrialState[_STATES.get(trial.status, _UNDER_WAY)]
        study.add_trial(
            optuna.trial.create_trial(
                state=state, value=trial.score, params=trial.values, distributions=distributions
            )
        )
    return study.ask(distributions).params


def _sampler(plan: Plan, number: int) -> optuna.samplers.BaseSampler:
    """With a seed of its own for each trial: what it says hangs on nothing but the trials."""
    import optuna

    seed = random.Random(f"{plan.seed} {number}").getrandbits(32)
    if plan.search == "random":
        return optuna.samplers.RandomSampler(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # Trials that run at the same time are not to try the same place.
        return optuna.samplers.TPESampler(seed=seed, constant_liar=True)


def _distribution(each: Range) -> optuna.distributions.BaseDistribution:
    import optuna

    if each.choices is not None:
        return optuna.distributions.CategoricalDistribution(each.choices)
    assert each.low is not None
    assert each.high is not None
    if each.is_whole:
        low, high, step = int(each.low), int(each.high), int(each.step or 1)
        return optuna.distributions.IntDistribution(low, high, log=each.log, step=step)
    return optuna.distributions.FloatDistribution(each.low, each.high, log=each.log, step=each.step)
