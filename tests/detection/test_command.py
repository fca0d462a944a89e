"""`python -m tests.detection` prints figures, the same for the same seed, and fails if asked to."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.detection import goals
from tests.detection.__main__ import main
from tests.detection.measuring import measure
from tests.detection.pairs import measure_pairs
from tests.detection.travelling import MOST_AT_REST_M, Travelled, measure_travelled


def test_a_line_is_printed_for_each_kind_and_what_is_judged_in_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["--kinds", "gaps", "swing_gap", "--cases", "1", "--seed", "2"]) == 0
    printed = capsys.readouterr().out
    lines = [line.split()[:2] for line in printed.splitlines()]
    assert ["gaps", "gap"] in lines and ["swing_gap", "swing"] in lines
    assert "seed 2" in printed


def test_who_reads_only_the_first_lines_sees_no_traceback() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "tests.detection", "--kinds", "gaps", "--cases", "1"]
    ended = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_the_same_seed_gives_the_same_figures() -> None:
    first, again = (measure(["leaps", "dropouts"], 1, 7) for _ in range(2))
    assert first.wrong == again.wrong
    assert [each.found for each in first.tallies.values()] == [
        each.found for each in again.tallies.values()
    ]


def test_below_the_goals_it_fails_only_where_it_is_asked_to(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--kinds", "gaps", "--cases", "1"]
    assert main([*asked, "--check"]) == 0
    monkeypatch.setattr(goals, "LEAST_SHARE", 1.1)  # which nothing reaches
    assert main(asked) == 0
    assert main([*asked, "--check"]) == 1
    assert "recall" in capsys.readouterr().out


def test_an_unknown_kind_is_refused_with_those_that_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["--kinds", "gasp"])
    assert refused.value.code == 2 and "gaps" in capsys.readouterr().err


def test_a_long_run_is_told_alike_of_rows_of_chunks_and_after_a_purge(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["--kinds", "gaps", "--cases", "1", "--long", "--check"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    gaps = {line[2]: line[3:] for line in lines if line[:2] == ["gaps", "gap"] and len(line) > 3}
    assert gaps["rows"][1] != "0" and gaps["rows"][2] == "1.00"
    assert gaps["rows"][:-2] == gaps["chunks"][:-2] == gaps["purged"][:-2]
    assert ["gaps", "gap", "0"] in lines


def test_what_is_told_of_a_stretch_is_looked_for_in_the_whole_run(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["--kinds", "gaps", "widened", "--cases", "1", "--check"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    alone, both = next(line[2:] for line in lines if line[:2] == ["gaps", "gap"] and len(line) == 4)
    assert alone == both != "0"


def test_a_robot_that_drives_without_noise_has_travelled_as_far_as_it_did() -> None:
    exact = next(iter(measure_travelled(1, 1)))
    assert exact.noise_m == 0.0 and exact.missed == []
    assert exact.ratios == pytest.approx([1.0], abs=0.005)
    assert exact.slow[0] == pytest.approx((1.0, 1.0), abs=0.005)
    assert exact.rest_m == pytest.approx([0.0])


def test_who_rested_and_travelled_misses_the_goal_of_its_noise() -> None:
    for noise_m, most_m in MOST_AT_REST_M.items():
        assert Travelled(noise_m, (0.9 * most_m,), (1.01,), 0).missed == []
        assert Travelled(noise_m, (1.1 * most_m,), (1.06,), 1).missed == [
            "rest", "distance", "unknown",
        ]  # fmt: skip


def test_who_drove_slowly_went_about_as_far_as_told_or_as_said_to_be_possible() -> None:
    told_and_most = {(0.95, 0.95): [], (0.6, 1.2): [], (0.6, 0.85): ["slow"], (1.2, 1.2): ["slow"]}
    for slow, missed in told_and_most.items():
        assert Travelled(0.03, (), (), 0, (slow,)).missed == missed


def test_pairs_are_compared_across_an_edit() -> None:
    pairs = measure_pairs(1, same=1, faster=1)
    assert len(pairs.claimed) == 1 and pairs.faster == 1
    assert 0 <= pairs.found <= 1
