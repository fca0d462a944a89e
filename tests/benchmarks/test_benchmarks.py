"""That every benchmark runs; how fast anything is, no test asks."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import pytest

from tests.benchmarks.__main__ import BENCHMARKS, main
from tests.benchmarks.core import (
    Bench,
    Benchmark,
    Line,
    Samples,
    Section,
    Target,
    alternate,
    ratio,
    render,
)

pytestmark = pytest.mark.slow
TINY = 0.001


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda benchmark: benchmark.name)
def test_a_benchmark_yields_lines_with_figures(benchmark: Benchmark, tmp_path: Path) -> None:
    section = benchmark.run(Bench(tmp_path, TINY, lambda text: None))
    assert section.lines or section.skipped
    for line in section.lines:
        assert math.isfinite(line.measured)
        assert line.what in render([section])


def test_who_reads_only_the_first_lines_sees_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w", encoding="utf-8") as stdout:  # closed as at the end of Python
        monkeypatch.setattr(sys, "stdout", stdout)
        assert main(["--quick", "--only", "conditions"]) == 0


def test_contenders_take_turns_after_a_block_that_is_forgotten() -> None:
    order: list[str] = []
    contenders = {name: lambda name=name: order.append(name) or len(order) for name in "ab"}
    assert alternate(contenders, 2) == {"a": [3, 5], "b": [4, 6]}
    assert "".join(order) == "ababab"


def test_a_drift_that_both_share_falls_out_of_the_ratio() -> None:
    ours, theirs = Samples.of([1, 2, 4]), Samples.of([2, 4, 8])
    assert ratio(ours, theirs) == 0.5


def test_a_line_says_whether_its_target_is_met_or_by_how_much_it_is_missed() -> None:
    lines = [
        Line("quick", "1 us", "files 10 us", 0.1, target=Target(0.15)),
        Line("slow", "3 us", "files 10 us", 0.3, target=Target(0.15)),
        Line("kept", "80/s", "none 100/s", 0.8, target=Target(0.85, least=True)),
        Line("lost", "9 kills", "", 2, "rows", Target(0)),
    ]
    ends = [line.rsplit("  ", 1)[1] for line in render([Section("t", lines)]).splitlines()[4:]]
    assert ends == ["met", "missed by 100 %", "missed by 5.88 %", "missed by 2"]
