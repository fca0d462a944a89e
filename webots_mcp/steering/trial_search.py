"""Searching for parameters: samplers of Optuna (the extra `search`) propose what is tried next.

A sampler is asked for one set at a time and knows the trial table only: the study is built again
for each proposal, in memory. A search that was killed continues as if it had not been.
"""

from __future__ import annotations

import random
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

from webots_mcp.errors import (
    InvalidInputError,
)
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.steering.trial_plan import ParameterRange, TrialPlan
from webots_mcp.store.trial_sets import TrialRecord

if TYPE_CHECKING:
    import optuna


def require_optuna() -> None:
    """Check that Optuna is installed, before anything is written.

    Raises:
        InvalidInputError: If it is not installed.
    """
    try:
        import_module("optuna")
    except ImportError as error:
        raise InvalidInputError(explain_extra("a search", "search")) from error


def next_parameters(plan: TrialPlan, trials: Sequence[TrialRecord]) -> dict[str, Any] | None:
    """Return the parameters of the next trial; None if all trials are done.

    Each set is tried `plan.repeats` times in a row.
    """
    number = len(trials)
    if number >= plan.trial_count:
        return None
    first = number - number % plan.repeats
    return trials[first].values if first < number else _suggested(plan, trials)


def _suggested(plan: TrialPlan, trials: Sequence[TrialRecord]) -> dict[str, Any]:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize" if plan.best == "highest" else "minimize",
        sampler=_sampler(plan, len(trials)),
    )
    distributions = {name: _distribution(each) for name, each in plan.ranges.items()}
    for trial in trials:
        state = optuna.trial.TrialState[
            {"done": "COMPLETE", "failed": "FAIL", "pruned": "PRUNED"}.get(trial.status, "RUNNING")
        ]
        study.add_trial(
            optuna.trial.create_trial(
                state=state, value=trial.score, params=trial.values, distributions=distributions
            )
        )
    return study.ask(distributions).params


def _sampler(plan: TrialPlan, number: int) -> optuna.samplers.BaseSampler:
    """Return a sampler seeded by the trial number: a proposal depends on the trials only."""
    import optuna

    seed = random.Random(f"{plan.seed} {number}").getrandbits(32)
    if plan.search == "random":
        return optuna.samplers.RandomSampler(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # Trials that run at the same time are not to try the same place.
        return optuna.samplers.TPESampler(seed=seed, constant_liar=True)


def _distribution(each: ParameterRange) -> optuna.distributions.BaseDistribution:
    import optuna

    if each.choices is not None:
        return optuna.distributions.CategoricalDistribution(each.choices)
    assert each.low is not None
    assert each.high is not None
    if each.is_whole:
        low, high, step = int(each.low), int(each.high), int(each.step or 1)
        return optuna.distributions.IntDistribution(low, high, log=each.log, step=step)
    return optuna.distributions.FloatDistribution(each.low, each.high, log=each.log, step=each.step)
