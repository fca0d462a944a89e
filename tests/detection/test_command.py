"""`python -m tests.detection` prints figures, the same for the same seed, and fails if asked to."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.detection import goals
from tests.detection.__main__ import main
from tests.detection.travelling import measure_travelled

pytestmark = pytest.mark.slow


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


def test_below_the_goals_it_fails_only_where_it_is_asked_to(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--kinds", "gaps", "--cases", "1"]
    assert main([*asked, "--check"]) == 0
    monkeypatch.setattr(goals, "LEAST_SHARE", 1.1)  # which nothing reaches
    assert main(asked) == 0
    assert main([*asked, "--check"]) == 1
    assert "recall" in capsys.readouterr().out


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
