"""Which check noticed which kind of fault, and what was said of healthy runs."""

from __future__ import annotations

import zlib
from collections import Counter
from typing import Final, NamedTuple

import numpy as np

from tests.judging.checks.labelled import FAULTS, WRITTEN, healthy, record
from tests.judging.detection.writing import put_in_chunks
from tests.memory import memory_connection
from webots_mcp.judging.checks.check import Finding
from webots_mcp.judging.checks.check_run import CHECKS, check_run

OF_EACH_FAULT: Final = 5
HEALTHY: Final = "healthy"
_UNHURRIED_S: Final = 300.0


class Judged(NamedTuple):
    """What was said of all runs of a kind.

    Attributes:
        checked_by: The check that has to notice it; empty of healthy runs.
        said: By check and outcome, how often.
        wrong: Evidence of fails that name another check than that one.
    """

    checked_by: str
    runs: int
    said: Counter[tuple[str, str]]
    wrong: list[str]

    @property
    def noticed(self) -> int:
        """In how many runs the fault was noticed."""
        return self.said[self.checked_by, "fail"] + self.said[self.checked_by, "warn"]


def judge(
    healthy_runs: int, of_each_fault: int = OF_EACH_FAULT, first: int = 0
) -> dict[str, Judged]:
    """Draw runs, from that number on, check them and count."""
    kinds = {HEALTHY: ("", healthy_runs)}
    kinds |= {name: (by, of_each_fault) for name, (_, by) in (FAULTS | WRITTEN).items()}
    return {
        kind: _judge(kind, by, range(first, first + runs)) for kind, (by, runs) in kinds.items()
    }


def _judge(kind: str, by: str, numbers: range) -> Judged:
    found = Judged(by, len(numbers), Counter(), [])
    for number in numbers:
        for each in checked(kind, number):
            found.said[each.name, each.outcome] += 1
            if each.outcome == "fail" and each.name != by:
                found.wrong.append(f"{kind} {number}: {each.name}: {each.evidence}")
    return found


def checked(kind: str, number: int, *, deadline_s: float = _UNHURRIED_S) -> list[Finding]:
    """What is said of the run of that kind and number; every second one is in chunks."""
    rng = np.random.default_rng([1, number, zlib.crc32(kind.encode())])
    run = healthy(rng)
    if kind in FAULTS:
        run = FAULTS[kind][0](rng, run)
    with memory_connection() as connection:
        run_id = record(connection, run, WRITTEN[kind][0] if kind in WRITTEN else "")
        if number % 2 == 0:
            put_in_chunks(connection)
        return list(check_run(connection, run_id, deadline_s=deadline_s).findings)


def render(judged: dict[str, Judged]) -> str:
    """A table: kinds of runs by checks; how many fails and warnings (in parentheses)."""
    names = [check.name for check in CHECKS]
    lines = [f"{'':16}" + " ".join(f"{place:>6}" for place in range(1, len(names) + 1))]
    for kind, each in judged.items():
        cells = [_cell(each.said[name, "fail"], each.said[name, "warn"]) for name in names]
        lines.append(f"{kind:16}" + " ".join(cells) + f"  of {each.runs}")
    lines += [f"{place:>4} {name}" for place, name in enumerate(names, 1)]
    return "\n".join([*lines, *(line for each in judged.values() for line in each.wrong)])


def _cell(fails: int, warnings: int) -> str:
    text = (str(fails) if fails else "") + (f"({warnings})" if warnings else "")
    return f"{text or '.':>6}"
