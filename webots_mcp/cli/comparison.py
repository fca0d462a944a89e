"""How a comparison of runs is printed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.tables import print_notes, print_table

if TYPE_CHECKING:
    from webots_mcp.store.analysis.spread import Spread
    from webots_mcp.store.questions.compare import Comparison, Group
    from webots_mcp.store.questions.differences import Difference
    from webots_mcp.store.questions.outcomes import Measure

_MOST_NAMED: Final = 20


def print_comparison(found: Comparison) -> None:
    """Print the groups, their measures, the signals that differ most, and the notes."""
    columns = ("", "runs", "total_duration_s", "ended by", "code", "parameters")
    print_table(columns, [_group_row(group) for group in found.groups])
    names = [group.name for group in found.groups]
    verdicts = [f"{name} differs" for name in names[1:]]
    print(f"\nThe first {found.compared_s:.3f} s of each run:")
    print_table(["", *names, *verdicts], [_measure_row(each) for each in found.measures])
    if found.differences:
        _print_differences(found, verdicts)
    unknown = [f"not known: {figures}: {why}" for figures, why in found.not_known.items()]
    print_notes([*found.notes, *unknown, *_only_in(found)])


def _group_row(group: Group) -> list[object]:
    return [
        group.name,
        ", ".join(str(run.run_id) for run in group.runs),
        group.total_duration_s,
        _each(run.end_reason or "going on" for run in group.runs),
        _each((run.controller_sha256 or "")[:8] for run in group.runs) or None,
        {name: "; ".join(map(str, each)) for name, each in group.parameters.items()} or None,
    ]


def _measure_row(measure: Measure) -> list[object]:
    verdicts = map(_verdict, measure.different[1:], measure.interval[1:], measure.runs_wanted[1:])
    return [measure.name, *map(_spelled_spread, measure.spread), *verdicts]


def _each(texts: Iterable[str]) -> str:
    """Each text once."""
    return ", ".join(dict.fromkeys(filter(None, texts)))


def _only_in(found: Comparison) -> list[str]:
    """The signals that some groups lack, by the groups that have them."""
    names_by_groups: dict[str, list[str]] = {}
    for name, groups in found.only_in.items():
        names_by_groups.setdefault(" and ".join(groups), []).append(name)
    return [f"only in {groups}: {_listed(names)}" for groups, names in names_by_groups.items()]


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + more


def _print_differences(found: Comparison, verdicts: Sequence[str]) -> None:
    names = [group.name for group in found.groups]
    print("\nSignals, what differs most first:")
    columns = [f"mean {name}" for name in names] + [f"effect {name}" for name in names[1:]]
    columns += [f"deviation {name}" for name in names[1:]]
    rows = [_difference_row(each) for each in found.differences]
    print_table(["signal", *columns, *verdicts], rows)


def _difference_row(difference: Difference) -> list[object]:
    means = map(_spelled_spread, difference.mean)
    ratios = [each if each is None else f"x {each:.3g}" for each in difference.deviation_ratio[1:]]
    verdicts = map(_verdict, difference.different[1:], difference.interval[1:])
    return [difference.name, *means, *difference.effect[1:], *ratios, *verdicts]


def _spelled_spread(spread: Spread | None) -> str | None:
    """The median, and the range of several runs."""
    if spread is None:
        return None
    several = "" if spread.low == spread.high else f" ({spread.low:.4g} to {spread.high:.4g})"
    return f"{spread.median:.4g}{several}"


def _verdict(
    different: bool | None,
    interval: tuple[float, float] | None,
    runs_wanted: int | None = None,
) -> str:
    said = {True: "yes", False: "no", None: "not known"}[different]
    said += f" ({interval[0]:+.3g} to {interval[1]:+.3g})" if interval else ""
    return said if runs_wanted is None else f"{said}: {runs_wanted} runs of each would tell"
